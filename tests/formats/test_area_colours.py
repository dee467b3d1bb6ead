"""Rooms and aisles have the quiet colours of the web page in every picture and file; other zones do not."""

from __future__ import annotations

import re
import sqlite3
from pathlib import Path

import pytest
import shapely
from lxml import etree

from app import formats
from app.convert.painting import THEMES
from app.formats import WriteContext
from app.model.areas import AREA_COLOUR, AREA_KINDS, DARK_AREA_COLOUR
from app.model.features import features
from app.model.frame import Datum
from app.model.layers import Layers, PartKey

KINDS = (*AREA_KINDS, "keepout", "speed")


@pytest.fixture(name="layers")
def layers_fixture() -> Layers:
    zones = [(kind, shapely.box(5 * k, 0, 5 * k + 4, 3), {"kind": kind}) for k, kind in enumerate(KINDS)]
    return Layers({PartKey("zones", "ground", "zones"): features(zones, "local")}, Datum(53.0, -0.5))


def one_file(name: str, layers: Layers) -> bytes:
    (content,) = formats.write(formats.get_format(name), layers, WriteContext()).values()
    return content


def test_page_has_the_same_colours() -> None:
    css = Path("app/web/src/styles/base.css").read_text()
    light, dark = re.findall(r"--map-object: #(\w{6});", css)
    assert bytes.fromhex(light) == bytes(AREA_COLOUR) == bytes(THEMES["light"].area)
    assert bytes.fromhex(dark) == bytes(DARK_AREA_COLOUR) == bytes(THEMES["dark"].area)


def test_kml_draws_areas_quietly(layers: Layers) -> None:
    root = etree.fromstring(one_file("kml", layers))
    urls = [mark.findtext("{*}styleUrl") for mark in root.iter("{*}Placemark")]
    assert sorted(url for url in urls if url) == ["#fleetmap-area"] * 5 + ["#fleetmap-zone"] * 2
    (line,) = root.xpath('//*[@id="fleetmap-area"]/*[local-name()="LineStyle"]/*[local-name()="color"]')
    assert line.text == "ff" + bytes(AREA_COLOUR[::-1]).hex()


def test_geopackage_styles_areas_by_kind(layers: Layers, tmp_path: Path) -> None:
    path = tmp_path / "site.gpkg"
    path.write_bytes(one_file("gpkg", layers))
    with sqlite3.connect(path) as database:
        ((text,),) = database.execute("SELECT styleQML FROM layer_styles WHERE f_table_name = 'zones'")
        columns = [row[1] for row in database.execute("PRAGMA table_info(zones)")]
    root = etree.fromstring(text)
    (renderer,) = root.iter("renderer-v2")
    assert renderer.get("attr") in columns
    colours = {}
    for category in renderer.iter("category"):
        (fill,) = renderer.xpath(f'symbols/symbol[@name="{category.get("symbol")}"]/layer/prop[@k="outline_color"]')
        colours[category.get("value")] = fill.get("v")
    quiet = ",".join(map(str, AREA_COLOUR)) + ",255"
    assert {kind for kind, colour in colours.items() if colour == quiet} == set(AREA_KINDS)
    assert colours[""] == "211,47,47,255", "all others"
