"""Licences and credits of sources: stored with the parts, and written into formats that can express them."""

from __future__ import annotations

import zipfile
from io import BytesIO

import orjson
import pytest
import yaml
from lxml import etree

from app import formats
from app.convert.files import offline
from app.model.frame import Datum
from app.upload_reader import UploadHints
from tests.api.conftest import Api

HERE = Datum(53.2686, -0.5245)
ODBL = "http://opendatacommons.org/licenses/odbl/1-0/"
CREDIT = ["OpenStreetMap & contributors", ODBL]
OSM = f"""<osm version="0.6" attribution="OpenStreetMap &amp; contributors" license="{ODBL}">
<node id="1" version="1" lat="53.2686" lon="-0.5245"/><node id="2" version="1" lat="53.2687" lon="-0.5245"/>
<way id="1" version="1"><nd ref="1"/><nd ref="2"/><tag k="highway" v="path"/></way></osm>""".encode()
KML = b"""<kml xmlns="http://www.opengis.net/kml/2.2"><Document><Placemark><name>gate</name>
<Point><coordinates>-0.5245,53.2686</coordinates></Point></Placemark></Document></kml>"""
LICENSE = b"\n                MIT License\n\nCopyright (c) 2024 A Farm\n\nPermission is hereby granted ...\n"
MIT = "MIT License, Copyright (c) 2024 A Farm (LICENSE)"


def attribution_of(name: str, files: dict[str, bytes]) -> str:
    """Read the attribution of a map with an independent parser."""
    data = next(iter(files.values()))
    if name == "kmz":
        with zipfile.ZipFile(BytesIO(data)) as z:
            data = z.read("doc.kml")
    if name in ("kml", "kmz"):
        texts = etree.fromstring(data).xpath("//*[local-name() = 'Document']/*[local-name() = 'description']/text()")
        return "\n".join(texts)
    if name == "osm":
        root = etree.fromstring(data)
        return "; ".join(root.get(k, "") for k in ("attribution", "copyright", "license"))
    if name == "tmap2":
        return str(yaml.safe_load(data)["meta"].get("attribution", ""))
    return str(orjson.loads(data).get("attribution", ""))


WITH_A_PLACE = ("osm", "kml", "kmz", "geojson", "tmap2", "nav2_route")


@pytest.mark.parametrize("name", WITH_A_PLACE)
def test_credits_survive_formats_that_can_express_them(name: str) -> None:
    converted = offline({"a.osm": OSM}, name, datum=HERE)
    assert sorted(converted.report.as_dict()["attribution"]) == sorted(CREDIT)
    assert all(text in attribution_of(name, converted.files) for text in CREDIT)
    # Reading them back restores them, for the report and for the next format.
    again = offline(converted.files, name, hints=UploadHints(name), datum=HERE)
    assert again.files == converted.files
    assert all(text in "; ".join(again.report.as_dict()["attribution"]) for text in CREDIT)
    assert all(
        text in attribution_of("kml", offline(converted.files, "kml", hints=UploadHints(name), datum=HERE).files)
        for text in CREDIT
    )


@pytest.mark.parametrize("name", WITH_A_PLACE)
def test_attribution_is_empty_without_credits(name: str) -> None:
    bare = OSM.replace(b'attribution="OpenStreetMap &amp; contributors"', b"").replace(
        f'license="{ODBL}"'.encode(), b""
    )
    converted = offline({"a.osm": bare}, name, datum=HERE)
    assert converted.report.as_dict()["attribution"] == []
    assert attribution_of(name, converted.files).strip("; ") == ""


def test_licence_file_applies_to_its_directory_and_below() -> None:
    files = {"a/LICENSE": LICENSE, "a/maps/gate.kml": KML, "b/field.osm": OSM}
    converted = offline(files, "geojson", datum=HERE)
    lines = {(line["layer"], line["name"]): line["attribution"] for line in converted.report.as_dict()["layers"]}
    assert lines["objects", "kml"] == ["MIT License, Copyright (c) 2024 A Farm (a/LICENSE)"]
    assert lines["topology", "network"] == CREDIT


@pytest.mark.parametrize(
    ("name", "text", "expected"),
    [
        ("LICENSE", LICENSE, MIT),
        (
            "COPYING.txt",
            b"   Apache License\n   Version 2.0, January 2004\nCopyright [yyyy] [name of copyright owner]\n",
            "Apache License, Version 2.0, January 2004 (COPYING.txt)",
        ),
        ("NOTICE.md", "# Maps\n© 2023 Jürgen\n".encode(), "Maps, © 2023 Jürgen (NOTICE.md)"),
        ("LICENSE", b"\n\n", None),
        ("license_plates.csv", b"AB 123", None),
    ],
)
def test_licence_file_is_summarised_in_one_line(name: str, text: bytes, expected: str | None) -> None:
    converted = offline({name: text, "gate.kml": KML}, "kml", datum=HERE)
    assert converted.report.as_dict()["attribution"] == ([expected] if expected else [])


def test_drawing_with_a_licence_file_survives_a_round_trip() -> None:
    converted = offline({"LICENSE": LICENSE, "gate.kml": KML}, "kml", hints=UploadHints())
    assert attribution_of("kml", converted.files) == MIT
    assert offline(converted.files, "kml").files == converted.files, "read back and written, the same bytes"
    alone = offline({"gate.kml": KML}, "kml")
    assert attribution_of("kml", alone.files) == ""


def test_drawing_with_its_own_credit_is_unchanged() -> None:
    kml = KML.replace(b"<Document>", f"<Document><description>{MIT}</description>".encode())
    converted = offline({"LICENSE": LICENSE, "gate.kml": kml}, "kml")
    assert converted.files == offline({"gate.kml": kml}, "kml").files


def test_credits_change_the_etag_of_a_map(api: Api) -> None:
    """Equal layers under another licence are another map: with another tag, and a cache entry of its own."""
    tags = []
    for env, files in (("bare", {"gate.kml": KML}), ("licensed", {"gate.kml": KML, "LICENSE": LICENSE})):
        api.post("environments", {"name": env})
        version = api.upload(env, files).json()
        sources = {s["name"] for s in api.get(f"environments/{env}/versions/1/sources").json()}
        assert sources == set(files), "the licence file is stored as a source"
        assert version["version"] == 1
        answer = api.get(f"/maps/{env}/kml")
        tags.append(answer.headers["etag"])
        assert (MIT in answer.text) == ("LICENSE" in files)
        report = api.get(f"environments/{env}/versions/1/reports/kml").json()
        assert report["attribution"] == ([MIT] if "LICENSE" in files else [])
    assert tags[0] != tags[1]
    roots = {api.get(f"environments/{env}/versions/1").json()["root"] for env in ("bare", "licensed")}
    assert len(roots) == 1, "a licence is not a layer"


def test_formats_with_credits_are_recognised_again() -> None:
    for name in WITH_A_PLACE:
        converted = offline({"LICENSE": LICENSE, "a.osm": OSM}, name, datum=HERE)
        groups, _ = formats.group(converted.files)
        assert name in {g.format.name for g in groups}
