"""Multipart uploads: limits, names, malformed bodies; nothing is stored partially or left behind."""

from __future__ import annotations

import http.client
import json
import socket
import time
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlsplit

import pytest

from tests.api import samples
from tests.api.conftest import ADMIN, Api, parts, problem, running, settings_for

BOUNDARY = "frontier"


@pytest.fixture(scope="module")
def tight(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Api]:
    """Run a server with small limits."""
    settings = settings_for(
        tmp_path_factory.mktemp("tight"),
        max_upload_bytes=200_000,
        max_files=5,
        max_uploads=1,
        max_json_bytes=2048,
        body_seconds=1.0,
        header_seconds=1.0,
    )
    with running(settings) as api:
        api.post("environments", {"name": "farm"})
        yield api


def raw(api: Api, body: bytes, content_type: str = f"multipart/form-data; boundary={BOUNDARY}") -> object:
    return api("POST", "environments/farm/versions", content=body, headers={"Content-Type": content_type})


def part(disposition: str, data: bytes, extra: str = "") -> bytes:
    head = f"--{BOUNDARY}\r\nContent-Disposition: {disposition}\r\n{extra}\r\n".encode()
    return head + data + b"\r\n"


END = f"--{BOUNDARY}--\r\n".encode()
FILE = part('form-data; name="files"; filename="n.tmap2.yaml"', samples.tmap2())


def spool_is_empty(api: Api) -> bool:
    """Test that no upload of this process is left on disk."""
    spool: Path = api.app.state.services.options.spool_dir
    return {p.name for p in spool.rglob("*") if p.is_file()} == {".lock"}


def test_upload_leaves_an_empty_spool(tight: Api) -> None:
    answer = raw(tight, FILE + part('form-data; name="dry_run"', b"true") + END)
    assert answer.status_code == 200, answer.text  # type: ignore[attr-defined]
    assert spool_is_empty(tight)


@pytest.mark.parametrize(
    ("body", "status"),
    [
        (b"", 400),
        (END, 422),
        (FILE, 400),
        (FILE[:-200], 400),
        (b"garbage", 400),
        (part('form-data; name="files"', samples.tmap2()) + END, 422),
        (part('form-data; name="files"; filename=""', b"x") + END, 422),
        (part('form-data; name="upload"; filename="a"', b"x") + END, 422),
        (part("attachment", b"x") + END, 400),
        (part('form-data; filename="a"', b"x") + END, 400),
        (part('form-data; name="files"; filename="../a"', b"x") + END, 422),
        (part('form-data; name="files"; filename="/etc/passwd"', b"x") + END, 422),
        (part('form-data; name="files"; filename="a\\\\b"', b"x") + END, 422),
        (part('form-data; name="files"; filename="a//b"', b"x") + END, 422),
        (part('form-data; name="files"; filename="a\x01b"', b"x") + END, 422),
        (FILE + FILE + END, 422),
        (FILE + part('form-data; name="mode"', b"replace") * 2 + END, 422),
        (FILE + part('form-data; name="mode"', b"sometimes") + END, 422),
        (FILE + part('form-data; name="layer"', b"sky") + END, 422),
        (FILE + part('form-data; name="dry_run"', b"perhaps") + END, 422),
        (FILE + part('form-data; name="format"', b"word") + END, 422),
        (FILE + part('form-data; name="no_such_option"', b"1") + END, 422),
        (FILE + part('form-data; name="message"', b"\xff\xfe") + END, 422),
        (FILE + part('form-data; name="message"', b"x" * 70_000) + END, 413),
        (part('form-data; name="files"; filename="a"', b"x", "Content-Transfer-Encoding: base64\r\n") + END, 400),
        (part('form-data; name="files"; filename="a"', b"x", "X: y\r\n" * 50) + END, 400),
        (part('form-data; name="files"; filename="a"', b"x", "X: " + "y" * 20_000 + "\r\n") + END, 400),
        (b"".join(part(f'form-data; name="f{k}"', b"x") for k in range(200)) + END, 413),
        (b"".join(part(f'form-data; name="files"; filename="f{k}"', b"x") for k in range(6)) + END, 413),
        (part('form-data; name="files"; filename="big"', b"x" * 300_000) + END, 413),
    ],
)
def test_invalid_forms_are_refused(tight: Api, body: bytes, status: int) -> None:
    answer = raw(tight, body)
    assert answer.status_code == status, answer.text  # type: ignore[attr-defined]
    problem(answer)  # type: ignore[arg-type]
    assert tight.get("environments/farm").json()["version"] == 0
    assert spool_is_empty(tight)


@pytest.mark.parametrize(
    "content_type",
    ["multipart/form-data", "multipart/form-data; boundary=", "multipart/form-data; boundary=" + "x" * 999],
)
def test_missing_boundary_returns_400(tight: Api, content_type: str) -> None:
    assert raw(tight, FILE + END, content_type).status_code == 400  # type: ignore[attr-defined]


def test_other_media_types_return_415(tight: Api) -> None:
    for content_type in ("text/plain", "application/x-www-form-urlencoded", "application/octet-stream"):
        answer = raw(tight, b"x", content_type)
        assert answer.status_code == 415  # type: ignore[attr-defined]
        problem(answer)  # type: ignore[arg-type]
    tight.problem("POST", "environments", 415, content=b'{"name": "x"}', headers={"Content-Type": "text/plain"})
    tight.problem("POST", "environments", 415, files=parts({"a": b"b"}))


def test_compressed_bodies_return_415(tight: Api) -> None:
    for coding in ("gzip", "zstd", "br", "gzip, identity"):
        headers = {"Content-Encoding": coding, "Content-Type": f"multipart/form-data; boundary={BOUNDARY}"}
        tight.problem("POST", "environments/farm/versions", 415, content=FILE + END, headers=headers)
    headers = {"Content-Encoding": "identity", "Content-Type": f"multipart/form-data; boundary={BOUNDARY}"}
    tight("POST", "environments/farm/versions?dry_run=true", 200, content=FILE + END, headers=headers)


def test_declared_length_is_enough_to_refuse(tight: Api) -> None:
    place = urlsplit(tight.url)
    connection = http.client.HTTPConnection(place.hostname or "", place.port, timeout=60)
    connection.putrequest("POST", "/api/v1/environments/farm/versions")
    connection.putheader("Authorization", f"Bearer {ADMIN}")
    connection.putheader("Content-Type", f"multipart/form-data; boundary={BOUNDARY}")
    connection.putheader("Content-Length", str(10 * 2**30))
    connection.putheader("Expect", "100-continue")
    connection.endheaders()
    answer = connection.getresponse()
    assert answer.status == 413
    assert answer.getheader("Content-Type") == "application/problem+json"
    assert answer.getheader("Connection") == "close"
    connection.close()


def test_json_body_size_is_limited(tight: Api) -> None:
    body = {"name": "x", "description": "y" * 5000}
    tight.problem("POST", "environments", 413, json=body)
    chunks = (b"x" * 500 for _ in range(10))
    tight.problem("POST", "environments", 413, content=chunks, headers={"Content-Type": "application/json"})


def _request(api: Api, head: str) -> socket.socket:
    place = urlsplit(api.url)
    line = socket.create_connection((place.hostname or "", place.port or 0), timeout=60)
    line.sendall(head.encode())
    return line


def test_stalled_body_returns_408(tight: Api) -> None:
    with _request(
        tight,
        "POST /api/v1/environments/farm/versions HTTP/1.1\r\nHost: x\r\n"
        f"Authorization: Bearer {ADMIN}\r\nContent-Type: multipart/form-data; boundary={BOUNDARY}\r\n"
        "Content-Length: 1000\r\n\r\n--fron",
    ) as line:
        started = time.monotonic()
        answer = line.recv(65536)
        assert answer.startswith(b"HTTP/1.1 408 ")
        assert 0.5 < time.monotonic() - started < 50
    assert spool_is_empty(tight)


def test_stalled_head_closes_the_connection(tight: Api) -> None:
    for head in ("", "GET /healthz HTTP/1.1\r\nHost: x\r\nX-Slow: "):
        with _request(tight, head) as line:
            assert line.recv(65536) == b"", "the connection is closed without a response"


def test_endless_head_returns_431(tight: Api) -> None:
    with _request(tight, "GET /healthz HTTP/1.1\r\nHost: x\r\nX: " + "y" * 100_000 + "\r\n\r\n") as line:
        assert line.recv(65536).startswith(b"HTTP/1.1 431 ")
    with _request(tight, "no http at all\r\n\r\n") as line:
        answer = line.recv(65536)
        assert answer.startswith(b"HTTP/1.1 400 ")
        assert b"application/problem+json" in answer


def test_disconnected_client_leaves_an_empty_spool(tight: Api) -> None:
    line = _request(
        tight,
        "POST /api/v1/environments/farm/versions HTTP/1.1\r\nHost: x\r\n"
        f"Authorization: Bearer {ADMIN}\r\nContent-Type: multipart/form-data; boundary={BOUNDARY}\r\n"
        f"Content-Length: 100000\r\n\r\n--{BOUNDARY}\r\n",
    )
    line.close()
    deadline = time.monotonic() + 10
    while (status := raw(tight, FILE + part('form-data; name="dry_run"', b"true") + END).status_code) != 200:  # type: ignore[attr-defined]
        assert status == 503, "its place is in use until the server notices"
        assert time.monotonic() < deadline
        time.sleep(0.05)
    assert spool_is_empty(tight)


def test_too_many_uploads_return_503(tight: Api) -> None:
    with _request(
        tight,
        "POST /api/v1/environments/farm/versions HTTP/1.1\r\nHost: x\r\n"
        f"Authorization: Bearer {ADMIN}\r\nContent-Type: multipart/form-data; boundary={BOUNDARY}\r\n"
        f"Content-Length: 100000\r\n\r\n--{BOUNDARY}\r\n",
    ):
        deadline = time.monotonic() + 60
        while spool_is_empty(tight) and not _active(tight):
            assert time.monotonic() < deadline
            time.sleep(0.01)
        answer = raw(tight, FILE + END)
        assert answer.status_code == 503  # type: ignore[attr-defined]
        assert int(answer.headers["retry-after"]) > 0  # type: ignore[attr-defined]
        problem(answer)  # type: ignore[arg-type]


def _active(api: Api) -> bool:
    return bool(api.app.state.services.intake._active)


def test_start_removes_files_of_a_killed_server(tmp_path: Path) -> None:
    left = tmp_path / "spool" / "dead" / "upload"
    left.mkdir(parents=True)
    (left / "0").write_bytes(b"half a file")
    (tmp_path / "spool" / "dead" / ".lock").touch()
    with running(settings_for(tmp_path)) as api:
        assert not left.exists()
        assert spool_is_empty(api)
    assert [p.name for p in (tmp_path / "spool").iterdir()] == [".lock"]


@pytest.mark.parametrize(
    ("name", "data"),
    [
        ("bad.yaml", b"nodes: [\n"),
        ("bomb.tmap2.yaml", b"a: &a [x,x]\nb: &b [*a,*a]\n" + b"".join(
            b"%c: &%c [*%c,*%c]\n" % (k + 1, k + 1, k, k) for k in range(98, 121)) + b"nodes: *y\n"),
        ("bad.kml", b'<?xml version="1.0"?><!DOCTYPE k [<!ENTITY a "b">]><kml>&a;</kml>'),
        ("bad.zip", b"PK\x03\x04nonsense"),
        ("map.yaml", b"image: ../../etc/passwd\nresolution: 0.05\norigin: [0,0,0]\noccupied_thresh: 0.65\n"
                     b"free_thresh: 0.196\nnegate: 0\n"),
        ("datum.yaml", b"datum_latitude: 99\ndatum_longitude: .nan\n"),
    ],
)  # fmt: skip
def test_damaged_files_return_422(api: Api, bare: str, name: str, data: bytes) -> None:
    answer = api.upload(bare, {name: data}, expect=413 if "bomb" in name else 422)
    body = problem(answer)
    assert body["errors"], body
    assert api.get(f"environments/{bare}").json()["version"] == 0


@pytest.mark.parametrize("name", ["a/b", "../../x", "..", ".hidden", "C:\\x", "C:x", "a\nb", "x" * 101])
def test_grid_names_that_no_file_can_have_are_refused(api: Api, bare: str, name: str) -> None:
    body = problem(api.upload(bare, samples.grid(), expect=422, grid=name))
    assert body["errors"][0]["where"] == "grid"
    files = [("files", (n, data)) for n, data in samples.grid().items()]
    api.problem("POST", "convert", 422, files=files, data={"to": "occupancy_grid", "grid": name})


def test_grid_in_a_file_with_a_special_name_is_served(api: Api, bare: str) -> None:
    files = {f"maps/C:{n}" if n.endswith("yaml") else f"maps/{n}": data for n, data in samples.grid().items()}
    api.upload(bare, files)
    assert api.get(f"/maps/{bare}/occupancy_grid").status_code == 200


def test_unused_form_fields_add_warnings(api: Api, bare: str) -> None:
    body = api.upload(bare, {"n.tmap2.yaml": samples.tmap2()}, layer="zones", grid="keepout").json()
    assert {w["where"] for w in body["warnings"]} == {"layer", "grid"}
    assert api.upload(bare, samples.grid(), grid="keepout").json()["warnings"] == []
    assert not [w for w in api.upload(bare, {"d.kml": samples.KML}, layer="zones").json()["warnings"] if "where" in w]


FAR_KML = """<kml xmlns="http://www.opengis.net/kml/2.2"><Document><Placemark><name>a</name>
<Point><coordinates>{},{}</coordinates></Point></Placemark></Document></kml>"""


@pytest.mark.parametrize(("lon", "lat", "far"), [(-0.5, 53.2, False), (0.6, 53.2, False), (53.2, -0.5, True)])
def test_content_far_from_the_datum_adds_warnings(api: Api, lon: float, lat: float, far: bool) -> None:
    env = f"far-{abs(int(lon * 10))}"
    api.post("environments", {"name": env, "datum": {"latitude": 53.2, "longitude": -0.5}})
    version = api.upload(env, {"a.kml": FAR_KML.format(lon, lat).encode()}).json()
    warnings = [w["problem"] for w in version["warnings"] if "km from the datum" in w["problem"]]
    assert bool(warnings) == far
    if far:
        assert "7746 km" in warnings[0], "by the spherical law of cosines, computed independently"


@pytest.mark.parametrize(("layer", "kind"), [("zones", "keepout"), ("location", "fence")])
def test_drawing_that_is_all_zones_or_fence_keeps_the_objects(api: Api, bare: str, layer: str, kind: str) -> None:
    def drawing(name: str) -> dict[str, bytes]:
        ring = [[-0.5245, 53.2686], [-0.5244, 53.2686], [-0.5244, 53.2687], [-0.5245, 53.2686]]
        shape = {"type": "Polygon", "coordinates": [ring]}
        feature = {"type": "Feature", "id": name, "properties": {"name": name}, "geometry": shape}
        return {f"{name}.geojson": json.dumps({"type": "FeatureCollection", "features": [feature]}).encode()}

    api.upload(bare, drawing("shed"))
    changes = api.upload(bare, drawing("yard"), layer=layer, mode="replace").json()["changes"]
    assert "objects" not in changes
    latest = f"environments/{bare}/versions/latest/layers"
    assert [f["id"] for f in api.get(f"{latest}/objects").json()["features"]] == ["shed"]
    (area,) = api.get(f"{latest}/{layer}").json()["features"]
    assert area["properties"]["kind"] == kind


def test_zones_from_geojson_delete_no_objects_from_geojson(api: Api, bare: str) -> None:
    """A drawing of zones only says nothing of objects: mode=replace keeps those that came from GeoJSON, too."""
    ring = [[-0.52, 53.26], [-0.51, 53.26], [-0.51, 53.27], [-0.52, 53.26]]
    tree = {"type": "Feature", "id": "tree", "properties": {"kind": "tree"},
            "geometry": {"type": "Point", "coordinates": [-0.52, 53.26]}}  # fmt: skip
    wet = {"type": "Feature", "id": "wet", "properties": {"kind": "region"},
           "geometry": {"type": "Polygon", "coordinates": [ring]}}  # fmt: skip

    def collection(*features: dict[str, object]) -> bytes:
        return json.dumps({"type": "FeatureCollection", "features": features}).encode()

    api.upload(bare, {"objects.geojson": collection(tree)}, layer="objects")
    api.upload(bare, {"zones.geojson": collection(wet)}, layer="zones", mode="replace")
    for layer, name in (("objects", "tree"), ("zones", "wet")):
        layers = api.get(f"environments/{bare}/versions/latest/layers/{layer}").json()
        assert [feature["id"] for feature in layers["features"]] == [name]
