"""Hostile uploads by name, with the expected verdict.

``verdict``: ``refused`` (never stored), ``read`` (unusual, but real: accepted, with a warning if appropriate) or ``any``
(damage that may be detected or not; never a hang, never a crash).
"""

# ruff: noqa: E501, UP031 - lines of data, one case each; braces of JSON

from __future__ import annotations

import bz2
import functools
import gzip
import io
import random
import struct
import zipfile
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

SAMPLES = Path(__file__).resolve().parents[1] / "samples"

Verdict = Literal["refused", "read", "any"]


@dataclass(frozen=True)
class Case:
    """One upload. format: as stated by the sender."""

    name: str
    files: dict[str, bytes]
    verdict: Verdict
    format: str | None = None


# --- building blocks ---------------------------------------------------------------------------------------------


def chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def png(width: int, height: int, pixels: bytes | None, *, depth: int = 8, colour: int = 0, more: bytes = b"") -> bytes:
    """Build a PNG with this header; ``pixels`` are the packed rows, None: only a few bytes."""
    body = zlib.compress(b"\0" * 64 if pixels is None else pixels, 9)
    head = struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + more + chunk(b"IDAT", body) + chunk(b"IEND", b"")


def zipped(members: dict[str, bytes], method: int = zipfile.ZIP_DEFLATED) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", method) as archive:
        for name, body in members.items():
            archive.writestr(zipfile.ZipInfo(name), body, method)
    return out.getvalue()


def raw_zip(members: list[tuple[bytes, bytes, dict[str, int]]]) -> bytes:
    """Build an archive by hand, with arbitrary headers: per member name, body, and header fields to override."""
    out, directory = b"", b""
    for name, body, lies in members:
        crc = lies.get("crc", zlib.crc32(body))
        size, packed = lies.get("size", len(body)), lies.get("packed", len(body))
        flags, method = lies.get("flags", 0x800), lies.get("method", 0)
        start = lies.get("start", len(out))
        out += struct.pack("<4s5H3L2H", b"PK\3\4", 20, flags, method, 0, 33, crc, packed, size, len(name), 0)
        out += name + body
        attributes = lies.get("mode", 0o100644) << 16
        directory += struct.pack(
            "<4s6H3L5H2L", b"PK\1\2", 0x314, 20, flags, method, 0, 33, crc, packed,
            lies.get("central_size", size), len(name), 0, 0, 0, 0, attributes, start,
        )  # fmt: skip
        directory += name
    count = len(members)
    return out + directory + struct.pack("<4s4H2LH", b"PK\5\6", 0, 0, count, count, len(directory), len(out), 0)


@functools.cache
def zeros(mebibytes: int) -> tuple[bytes, dict[str, int]]:
    """Build a member for ``raw_zip`` that decompresses to this many MiB of zeros; cached."""
    packer = zlib.compressobj(9, zlib.DEFLATED, -15)
    block = packer.compress(bytes(2**20)) + packer.flush(zlib.Z_FULL_FLUSH)
    size = mebibytes * 2**20
    fields = {"method": 8, "size": size, "central_size": size, "crc": zlib.crc32(bytes(size))}
    return block * mebibytes + packer.flush(), fields


ROOM = (
    b"image: room.pgm\nresolution: 0.5\norigin: [0.0, 0.0, 0.0]\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
)
PGM = b"P5 4 3 255\n" + bytes(12)
KML = (
    '<kml xmlns="http://www.opengis.net/kml/2.2"><Document><Placemark><name>{name}</name>'
    "<Point><coordinates>{at}</coordinates></Point></Placemark></Document></kml>"
)
OSM = "<osm version='0.6'><node id='{id}' lat='{lat}' lon='{lon}'/></osm>"
DATUM = "datum_latitude: {lat}\ndatum_longitude: {lon}\n"


def tmap2(name: str = "a", x: str = "1.0", edges: str = "[]", extra: str = "", verts: str = "[]") -> bytes:
    return (
        "meta: {last_updated: x}\nmetric_map: m\nname: net\npointset: net\nnodes:\n"
        f"- meta: {{map: m, node: {name}, pointset: net}}\n  node:\n    edges: {edges}\n    name: {name}\n"
        f"    parent_frame: map\n    pose:\n      orientation: {{w: 1.0, x: 0.0, y: 0.0, z: 0.0}}\n"
        f"      position: {{x: {x}, y: 2.0, z: 0.0}}\n    verts: {verts}\n{extra}"
    ).encode()


def geojson(geometry: str, properties: str = "{}", more: str = "") -> bytes:
    return (
        '{"type": "FeatureCollection", "features": [{"type": "Feature", "properties": %s, "geometry": %s%s}]}'
        % (properties, geometry, more)
    ).encode()


def room(text: bytes = ROOM, picture: bytes = PGM, name: str = "room.pgm") -> dict[str, bytes]:
    return {"room.yaml": text, name: picture}


HUGE = "9" * 5000


# --- cases -------------------------------------------------------------------------------------------------------


def yaml_cases() -> Iterator[Case]:
    """Yield YAML attacks in a datum, a grid and a network."""

    def datum(name: str, tail: str | bytes, verdict: Verdict = "refused") -> Case:
        body = DATUM.format(lat=53.0, lon=-0.5).encode() + (tail.encode() if isinstance(tail, str) else tail)
        return Case(f"datum/{name}", {"datum.yaml": body}, verdict, "datum")

    bomb = "a0: &a0 [x, x, x, x, x, x, x, x, x, x]\n" + "".join(
        f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 10)}]\n" for k in range(1, 12)
    )
    yield datum("alias bomb", bomb)
    yield datum("alias of itself", "extra: &a [*a]\n")
    yield datum("alias without anchor", "extra: *nothing\n")
    yield datum("brackets", "extra: " + "[" * 60_000 + "\n")
    yield datum("brackets closed", "extra: " + "[" * 5000 + "]" * 5000 + "\n")
    yield datum("braces", "extra: " + "{a: " * 60_000 + "\n")
    yield datum("dashes", "extra:\n" + "".join(" " * k + "-\n" for k in range(1, 400)))
    yield datum("dashes on one line", "extra:\n  " + "- " * 50_000 + "x\n")
    yield datum("question marks", "? " * 50_000 + "x\n")
    yield datum("merge key", "base: &b {a: 1}\nextra:\n  <<: *b\n")
    yield datum("key twice", "datum_latitude: 12.0\n")
    yield datum("second document", "---\ndatum_latitude: 1.0\n")
    yield datum("python tag", "extra: !!python/object/apply:os.system ['true']\n")
    yield datum("python name", "extra: !!python/name:os.system\n")
    yield datum("binary tag", "extra: !!binary aGFsbG8=\n")
    yield datum("own tag", "extra: !mine 1\n")
    yield datum("long integer", f"extra: {HUGE}\n")
    yield datum("64 bit and one", f"extra: {2**63}\n")
    yield datum("not a number", "extra: .nan\n")
    yield datum("beyond float", "extra: 1.0e999\n")
    yield datum("complex key", "? [a, b]\n: 1\n")
    yield datum("tab", "extra:\n\t- 1\n")
    yield datum("lone surrogate", 'extra: "\\ud800"\n')
    yield datum("surrogate in bytes", b"extra: \xed\xa0\x80\n")
    yield datum("latin-1", b"extra: Stra\xdfe\n")
    yield datum("null byte", b"extra: \0\n")
    yield datum("sexagesimal", "extra: 12:30:45\nanother: 010\nday: 2022-01-01\n", "read")
    yield datum("huge text", "extra: '" + "x" * 2_000_000 + "'\n", "read")
    tag = b"%TAG ! tag:example.org,2000:\n---\n" + DATUM.format(lat=1.0, lon=1.0).encode()
    yield Case("datum/tag directive", {"datum.yaml": tag}, "refused", "datum")
    for bad in (
        ".nan",
        "-.inf",
        "1.0e999",
        "90.5",
        "-86.0",
        "true",
        "[]",
        "{}",
        "'north'",
        "null",
        HUGE,
        "0x10",
        "1_0",
    ):
        text = DATUM.format(lat=bad, lon=1.0)
        yield Case(f"datum/latitude {bad[:12]}", {"datum.yaml": text.encode()}, "any" if bad == "0x10" else "refused")
    for bad in (".nan", "180.5", "1e999", "-1000", "[1]", HUGE):
        text = DATUM.format(lat=1.0, lon=bad)
        yield Case(f"datum/longitude {bad[:12]}", {"datum.yaml": text.encode()}, "refused")
    for bad in ("5", "[[1]]", "[[a, b]]", "[[1.0, .nan]]", "[[91, 0], [1, 1], [2, 2]]", "{a: 1}", "[[[[1]]]]", "'x'"):
        text = DATUM.format(lat=1.0, lon=1.0) + f"gnss_fence: {{gnss_fence_coords: {bad}}}\n"
        yield Case(f"datum/fence {bad[:12]}", {"datum.yaml": text.encode()}, "any")
    for top in (b"[]", b"5", b"~", b"- datum_latitude: 1\n- datum_longitude: 2\n", b"'datum_latitude: 1'"):
        yield Case(f"datum/top {top[:10].decode()}", {"datum.yaml": top}, "refused", "datum")
    for coding in ("utf-16", "utf-16-be", "utf-32", "utf-7"):
        body = (DATUM.format(lat=1.0, lon=1.0) + "extra: grün\n").encode(coding)
        yield Case(f"datum/{coding}", {"datum.yaml": body}, "any" if coding == "utf-7" else "refused", "datum")

    for bad in ("0", "-0.5", ".nan", ".inf", "1e999", "true", "[]", "'a'", "null", HUGE, "1.0e-300", "1.0e+300"):
        text = ROOM.replace(b"resolution: 0.5", f"resolution: {bad}".encode())
        yield Case(f"grid/resolution {bad[:12]}", room(text), "refused")
    for bad in ("[0, 0]", "[a, b, c]", "[0, 0, .nan]", "[1.0e300, 0, 0]", "5", "{}", "[0, 0, 0, 0]", "[true, 0, 0]"):
        text = ROOM.replace(b"[0.0, 0.0, 0.0]", bad.encode())
        yield Case(f"grid/origin {bad}", room(text), "refused")
    for bad in ("7.5", "[]", "1.5", "-1", "'x'", ".nan"):
        text = ROOM.replace(b"occupied_thresh: 0.65", f"occupied_thresh: {bad}".encode())
        yield Case(f"grid/threshold {bad}", room(text), "refused")
    escapes = (
        "../room.pgm", "/etc/passwd", "~/room.pgm", "file:///etc/passwd", "http://127.0.0.1/a.pgm", "..", ".", "room.yaml",
        "$HOME/x.pgm", "%2e%2e/room2.pgm", "a\\\\b.pgm", "C:\\\\x.pgm", "//host/share.pgm", "{}", "5", "''", "x" * 5000,
    )  # fmt: skip
    for image_path in escapes:
        text = ROOM.replace(
            b"image: room.pgm", f'image: "{image_path}"'.encode() if image_path != "{}" else b"image: {}"
        )
        alone = image_path.rpartition("/")[2] == "room.pgm"
        yield Case(f"grid/image {image_path[:20]}", room(text), "read" if alone else "refused")
    yield Case("grid/image missing", {"room.yaml": ROOM}, "refused")
    yield Case(
        "grid/image twice elsewhere",
        {"a/room.yaml": ROOM.replace(b"room.pgm", b"/x/room.pgm"), "b/room.pgm": PGM, "c/room.pgm": PGM},
        "refused",
    )

    edge = "[{action: go, edge_id: e, node: %s}]"
    yield Case("network/self loop", {"n.tmap2.yaml": tmap2(edges=edge % "a")}, "read")
    yield Case("network/dangling edge", {"n.tmap2.yaml": tmap2(edges=edge % "nowhere")}, "read")
    node = tmap2().partition(b"nodes:\n")[2].decode()
    yield Case("network/name twice", {"n.tmap2.yaml": tmap2(extra=node)}, "read")
    yield Case("network/bidi name", {"n.tmap2.yaml": tmap2(name='"a\\u202eb"')}, "read")
    yield Case("network/zero-width name", {"n.tmap2.yaml": tmap2(name='"a\\u200bb"')}, "read")
    names = ('"a\\u0000b"', '"a\\nb"', '"a\\u001b[31mb"', "''", '"' + "n" * 300 + '"', "[]", "{}", '"\\ud800"', "null")
    for name in names:
        verdict: Verdict = "any" if name == "null" else "refused"
        yield Case(f"network/name {name[:14]}", {"n.tmap2.yaml": tmap2(name=name)}, verdict)
    for x in (".nan", ".inf", "1e999", "1.0e+300", "'east'", "[]", "null", "true", HUGE):
        yield Case(f"network/x {x[:12]}", {"n.tmap2.yaml": tmap2(x=x)}, "refused")
    for edges in ("5", "{}", "[5]", "[[]]", "[{}]", "[{edge_id: [], node: {}}]", "[null]", "'x'", "[{edge_id: e}]"):
        yield Case(f"network/edges {edges}", {"n.tmap2.yaml": tmap2(edges=edges)}, "any")
    for verts in ("5", "[5]", "[{x: .nan, y: 1}]", "[{x: a}]", "{}", "[{x: 1.0e+308, y: 1.0e+308}]", "[[1, 2]]"):
        yield Case(f"network/verts {verts}", {"n.tmap2.yaml": tmap2(verts=verts)}, "any")
    for nodes in ("5", "[5]", "[{}]", "{a: 1}", "[[]]", "[{node: 5}]", "[{node: {name: a}}]", "[{meta: {}, node: []}]"):
        yield Case(f"network/nodes {nodes}", {"n.tmap2.yaml": f"name: x\nnodes: {nodes}\n".encode()}, "any", "tmap2")


DOCTYPE = '<!DOCTYPE {root} [<!ENTITY a "x"><!ENTITY b SYSTEM "file:///etc/passwd">]>'
LAUGHS = (
    '<!DOCTYPE {root} [<!ENTITY a0 "lol">'
    + "".join(f'<!ENTITY a{k} "{f"&a{k - 1};" * 10}">' for k in range(1, 12))
    + "]>"
)


def xml_cases() -> Iterator[Case]:
    """Yield XML attacks in a drawing and in an OSM extract."""
    place = KML.format(name="&b;", at="7,50")
    extract = "<osm version='0.6'><node id='1' lat='50' lon='7'><tag k='name' v='&a;'/></node></osm>"
    for root, body, file in (("kml", place, "a.kml"), ("osm", extract, "a.osm")):
        for kind, doctype in (("entities", DOCTYPE), ("laughs", LAUGHS)):
            text = doctype.replace("{root}", root) + body
            space = " \t\r\n"
            forms = {
                "plain": text.encode(),
                "declared": f'<?xml version="1.0"?>{text}'.encode(),
                "with mark": b"\xef\xbb\xbf" + text.encode(),
                "after space": (space * 3 + text).encode(),
                "after comments": ("<!-- <kml> <osm> -->" * 300 + "<?x y?>" + text).encode(),
                "utf-16": ('<?xml version="1.0" encoding="UTF-16"?>' + text).encode("utf-16"),
                "utf-16 big": b"\xfe\xff" + text.encode("utf-16-be"),
                "utf-16 without mark": ('<?xml version="1.0" encoding="UTF-16LE"?>' + text).encode("utf-16-le"),
                "utf-32": ('<?xml version="1.0" encoding="UTF-32"?>' + text).encode("utf-32"),
                "utf-7": b'<?xml version="1.0" encoding="UTF-7"?>' + text.encode("utf-7"),
                "utf-7 escaped": b'<?xml version="1.0" encoding="UTF-7"?>'
                + text.replace("<!", "+ADwAIQ-").replace("&", "+ACY-").encode(),
                "ebcdic": '<?xml version="1.0" encoding="cp037"?>'.encode("cp037") + text.encode("cp037"),
                "late": (" " * 70_000 + text).encode(),
                "comment of a megabyte": ("<!--" + "x" * 2**20 + "-->" + text).encode(),
                "long comment, utf-16": ("<!--" + "x" * 2**20 + "-->" + text).encode("utf-16"),
            }
            for form, data in forms.items():
                yield Case(f"{root}/{kind} {form}", {file: data}, "refused", root)
        outside = f'<!DOCTYPE {root} SYSTEM "http://127.0.0.1:9/x.dtd">{body.replace("&b;", "x").replace("&a;", "x")}'
        yield Case(f"{root}/outer DTD", {file: outside.encode()}, "refused", root)
        attribute = " ".join(f"a{k}='x'" for k in range(100_000))
        yield Case(f"{root}/many attributes", {file: f"<{root} {attribute}></{root}>".encode()}, "any", root)
        yield Case(f"{root}/long attribute", {file: f"<{root} a='{'x' * 200_000}'></{root}>".encode()}, "refused", root)
        deep = f"<{root}>" + "<Folder>" * 20_000 + "</Folder>" * 20_000 + f"</{root}>"
        yield Case(f"{root}/deep", {file: deep.encode()}, "refused", root)
        yield Case(f"{root}/unclosed", {file: (f"<{root}>" + "<Folder>" * 20_000).encode()}, "refused", root)
        yield Case(f"{root}/cut", {file: body[: len(body) // 2].encode()}, "refused", root)
        yield Case(f"{root}/null byte", {file: body.replace("7", "7\0").encode()}, "refused", root)
        yield Case(f"{root}/character 0", {file: f"<{root}>&#0;</{root}>".encode()}, "refused", root)
        yield Case(f"{root}/surrogate", {file: f"<{root} a='&#xD800;'></{root}>".encode()}, "refused", root)
        yield Case(f"{root}/other root", {file: b"<html><body/></html>"}, "refused", root)
        yield Case(f"{root}/text", {file: b"hello"}, "refused", root)
        yield Case(f"{root}/two roots", {file: f"<{root}></{root}><{root}></{root}>".encode()}, "refused", root)
        yield Case(f"{root}/prefixes", {file: (f"<{root}>" + "<a:b/>" * 3 + f"</{root}>").encode()}, "refused", root)
        yield Case(
            f"{root}/unknown coding", {file: f"<?xml version='1.0' encoding='x-y'?><{root}/>".encode()}, "refused"
        )
    xinclude = '<xi:include xmlns:xi="http://www.w3.org/2001/XInclude" parse="text" href="file:///etc/passwd"/>'
    yield Case("kml/xinclude", {"a.kml": KML.format(name=xinclude, at="7,50").encode()}, "any")

    for at in ("nan,50", "7,inf", "1e999,0", "7,91", "181,0", "x,y", "7", "", ",", "7,50," + HUGE, HUGE + ",50"):
        verdict: Verdict = "any" if at in ("", "7", ",") else "refused"
        yield Case(f"kml/place {at[:12]}", {"a.kml": KML.format(name="x", at=at).encode()}, verdict)
    for inside in (
        "<LineString><coordinates>7,50</coordinates></LineString>",
        "<Polygon><outerBoundaryIs><LinearRing><coordinates>7,50 8,50</coordinates></LinearRing></outerBoundaryIs></Polygon>",
        "<Polygon/>",
        "<MultiGeometry>" * 200 + "</MultiGeometry>" * 200,
        "<Point><coordinates>7,50</coordinates><coordinates>8,51</coordinates></Point>",
    ):
        body = f"<kml><Placemark>{inside}</Placemark></kml>".encode()
        yield Case(f"kml/geometry {inside[:30]}", {"a.kml": body}, "any")
    overlay = (
        "<kml><GroundOverlay><Icon><href>{href}</href></Icon><LatLonBox><north>{n}</north><south>50</south>"
        "<east>7.1</east><west>7</west></LatLonBox></GroundOverlay></kml>"
    )
    for href in ("../../etc/passwd", "/etc/passwd", "file:///etc/passwd", "http://127.0.0.1:9/x.png", "x" * 10_000):
        yield Case(f"kml/href {href[:16]}", {"a.kml": overlay.format(href=href, n=50.1).encode()}, "any")
    for n in ("nan", "1e999", "x", "99", HUGE):
        yield Case(f"kml/north {n[:8]}", {"a.kml": overlay.format(href="x.png", n=n).encode()}, "any")
    values = ("nan", "{", "[" * 60_000, HUGE, '"\\ud800"', "1e999", '{"a": NaN}', str(2**70))
    for value in values:
        data = f"<ExtendedData><Data name='speed'><value>{value}</value></Data></ExtendedData>"
        body = f"<kml><Placemark>{data}<Point><coordinates>7,50</coordinates></Point></Placemark></kml>"
        yield Case(f"kml/value {value[:10]}", {"a.kml": body.encode()}, "any")
    words = ("layer", "level", "part", "kind", "id", "source", "target", "geometry", "fleet_map", "local", "place")
    for word in words:
        for value in ("topology", "[", "5", '{"a": 1}', "null", "", "location", HUGE):
            data = "".join(
                f"<Data name='{w}'><value>{value if w == word else o}</value></Data>"
                for w, o in (
                    ("layer", "topology"),
                    ("level", "ground"),
                    ("part", "network"),
                    ("kind", "edge"),
                    (word, ""),
                )
            )
            body = f"<kml><Placemark id='x'><ExtendedData>{data}</ExtendedData></Placemark></kml>"
            yield Case(f"kml/own {word} {value[:9]}", {"a.kml": body.encode()}, "any")

    for lat in ("nan", "inf", "1e999", "90.1", "-91", "x", "0x10", HUGE, "५०", "1_0", " "):
        yield Case(
            f"osm/lat {lat[:10]}",
            {"a.osm": OSM.format(id=1, lat=lat, lon=7).encode()},
            "any" if lat == " " else "refused",
        )
    for lon in ("nan", "-inf", "180.1", "1e400", HUGE):
        yield Case(f"osm/lon {lon[:10]}", {"a.osm": OSM.format(id=1, lat=50, lon=lon).encode()}, "refused")
    for id_ in (str(2**63), HUGE, "1.5", "x", "", "٣", "1 2", "--1", "0x1"):
        yield Case(f"osm/id {id_[:10]}", {"a.osm": OSM.format(id=id_, lat=50, lon=7).encode()}, "refused")
    yield Case("osm/smallest id", {"a.osm": OSM.format(id=-(2**63), lat=50, lon=7).encode()}, "read")
    node = "<node id='1' lat='50' lon='7'/>"
    for name, inside in {
        "reference beyond int64": f"<way id='1'><nd ref='{2**64}'/></way>",
        "member of no type": "<relation id='1'><member type='x' ref='1' role=''/></relation>",
        "member beyond int64": f"<relation id='1'><member type='way' ref='{HUGE}' role=''/></relation>",
        "unknown element": "<gpx/>",
        "nested": "<node id='2' lat='1' lon='1'><node id='3' lat='1' lon='1'/></node>",
        "bounds nan": "<bounds minlat='nan' minlon='0' maxlat='1' maxlon='1'/>",
        "bounds text": "<bounds minlat='x' minlon='0' maxlat='1' maxlon='1'/>",
        "bounds off earth": "<bounds minlat='-9000' minlon='0' maxlat='1' maxlon='1e300'/>",
        "bounds empty": "<bounds/>",
        "node twice": node,
        "way of itself": "<way id='1'><nd ref='1'/><nd ref='1'/><tag k='highway' v='x'/></way>",
        "relation of itself": "<relation id='1'><member type='relation' ref='1' role=''/></relation>",
        "tag without key": "<way id='1'><nd ref='1'/><tag v='x'/></way>",
    }.items():
        for quote in "'\"":
            body = f"<osm version='0.6'>{node}{inside}</osm>".replace("'", quote).encode()
            refused = name.startswith(("reference", "member", "unknown"))
            yield Case(f"osm/{name} {quote}", {"a.osm": body}, "refused" if refused else "any")
    extract = (SAMPLES / "osm" / "quarter.osm").read_bytes()
    yield Case("osm/gzip cut", {"a.osm.gz": gzip.compress(extract, mtime=0)[:-20]}, "refused", "osm")
    yield Case("osm/gzip wrong sum", {"a.osm.gz": gzip.compress(extract, mtime=0)[:-8] + bytes(8)}, "refused", "osm")
    yield Case("osm/gzip and more", {"a.osm.gz": gzip.compress(extract, mtime=0) + b"more"}, "refused", "osm")
    yield Case("osm/gzip of nothing", {"a.osm.gz": gzip.compress(b"", mtime=0)}, "refused", "osm")
    yield Case("osm/gzip in gzip", {"a.osm.gz": gzip.compress(gzip.compress(extract))}, "refused", "osm")
    yield Case("osm/bzip2 cut", {"a.osm.bz2": bz2.compress(extract)[:-20]}, "refused", "osm")
    yield Case("osm/many empty gzip streams", {"a.osm.gz": gzip.compress(b"", mtime=0) * 50_000}, "refused", "osm")
    yield Case("osm/many empty bzip2 streams", {"a.osm.bz2": bz2.compress(b"") * 20_000}, "refused", "osm")


def lanelet_cases() -> Iterator[Case]:
    """Yield lanelets with wrong points, bounds, attributes and companion files."""
    node = (
        "<node id='%d' lat='%s' lon='%s'><tag k='local_x' v='%s'/><tag k='local_y' v='%s'/><tag k='ele' v='%s'/></node>"
    )
    way = "<way id='%d'><nd ref='%d'/><nd ref='%d'/></way>"
    lane = "<relation id='%d'><member type='way' ref='%s' role='left'/><member type='way' ref='%s' role='right'/>%s<tag k='type' v='lanelet'/></relation>"

    def place(
        at: tuple[str, str] = ("0.0001", "0.0001"),
        metres: tuple[str, str, str] = ("1", "2", "3"),
        inside: str = "",
        more: str = "",
        left: str = "5",
        right: str = "6",
    ) -> bytes:
        nodes = [
            (1, *at, *metres),
            (2, "0.0001", "0.0002", "9", "2", "3"),
            (3, "0", "0.0001", "1", "0", "3"),
            (4, "0", "0.0002", "9", "0", "3"),
        ]
        body = (
            "".join(node % row for row in nodes) + way % (5, 1, 2) + way % (6, 3, 4) + lane % (7, left, right, inside)
        )
        return f"<osm version='0.6'>{body}{more}</osm>".encode()

    yield Case("lanelet/far point", {"a.osm": place(("0.0001", "179"))}, "refused")
    for value in ("nan", "inf", "1e999", "-1e300", "9" * 5000, "", "1;2"):
        yield Case(f"lanelet/elevation {value[:10]}", {"a.osm": place(metres=("1", "2", value))}, "read")
        beside = {"a.osm": place(metres=(value, "2", "3")), "map_projector_info.yaml": b"projector_type: Local"}
        yield Case(f"lanelet/metres {value[:10]}", beside, "read")
        tag = f"<tag k='speed_limit' v='{value}'/><tag k='width' v='{value}'/><tag k='one_way' v='{value}'/>"
        yield Case(f"lanelet/words {value[:10]}", {"a.osm": place(inside=tag)}, "read")
    for name, left, right in (
        ("itself", "7", "7"),
        ("one bound twice", "5", "5"),
        ("nothing", "8", "9"),
        ("points", "1", "2"),
    ):
        yield Case(f"lanelet/bounds are {name}", {"a.osm": place(left=left, right=right)}, "read")
    points = "<way id='5'><nd ref='1'/><nd ref='1'/></way><way id='6'><nd ref='1'/><nd ref='1'/></way>"
    yield Case("lanelet/without length", {"a.osm": place(more=points)}, "read")
    ring = "".join(
        lane % (10 + k, "5", "6", f"<member type='relation' ref='{10 + (k + 1) % 3}' role='regulatory_element'/>")
        for k in range(3)
    )
    yield Case("lanelet/relations in a ring", {"a.osm": place(more=ring)}, "read")
    many = "".join(lane % (10 + k, "5", "6", "") for k in range(3000))
    yield Case("lanelet/many on the same bounds", {"a.osm": place(more=many)}, "read")
    same = "<tag k='fleetmap:edge' v='x'/><tag k='fleetmap:source' v='n1:3'/><tag k='fleetmap:target' v='y'/>"
    alike = lane % (10, "5", "6", same) + lane % (11, "6", "5", same)
    yield Case("lanelet/our own words twice", {"a.osm": place(more=alike)}, "read")
    for name, text, verdict in (
        ("a list", b"[1, 2]", "read"),
        ("empty", b" ", "read"),
        ("no text", b"\xff\xfe\xff", "refused"),
        ("billion laughs", b"a: &a [x, x]\nb: &b [*a, *a]\nprojector_type: [*b, *b]", "any"),
        ("a tag", b"!!python/object/apply:os.system ['true']", "refused"),
        ("deep", b"[" * 5000, "refused"),
    ):
        yield Case(f"lanelet/projector is {name}", {"a.osm": place(), "map_projector_info.yaml": text}, verdict)  # type: ignore[arg-type]


def pbf_cases() -> Iterator[Case]:
    """Yield PBF blocks with wrong lengths and contents."""

    def blob(kind: bytes, body: bytes, size: int | None = None) -> bytes:
        inner = (
            b"\x10" + varint(len(body) if size is None else size) + b"\x1a" + varint(len(z := zlib.compress(body))) + z
        )
        head = b"\x0a" + varint(len(kind)) + kind + b"\x18" + varint(len(inner))
        return struct.pack(">I", len(head)) + head + inner

    header = blob(b"OSMHeader", b"\x22\x0eOsmSchema-V0.6\x22\x0aDenseNodes")
    for name, data in {
        "header alone": header,
        "header cut": header[:20],
        "data of noise": header + blob(b"OSMData", b"\xff" * 100),
        "size lie small": header + blob(b"OSMData", bytes(1000), 10),
        "size lie large": header + blob(b"OSMData", bytes(1000), 2**31 - 1),
        "bomb": header + blob(b"OSMData", bytes(40 * 2**20)),
        "many bombs": header + b"".join([blob(b"OSMData", bytes(30 * 2**20))] * 40),
        "unknown feature": blob(b"OSMHeader", b"\x22\x0fHistoricalInfos"),
        "length of 4 GB": header + b"\xff\xff\xff\xff" + b"x" * 100,
        "endless varint": header + blob(b"OSMData", b"\x0a" + b"\xff" * 50),
    }.items():
        yield Case(f"pbf/{name}", {"a.osm.pbf": data}, "any", "osm")
    strings = b"\x0a\x02" + b"\x0a\x00"
    dense_ids = b"".join(varint(zigzag(v)) for v in (2**62, 2**62, 2**62))
    places = b"".join(varint(zigzag(v)) for v in (2**40, 1, 1))
    dense = b"\x0a" + varint(len(dense_ids)) + dense_ids + b"\x42" + varint(len(places)) + places
    dense += b"\x4a" + varint(len(places)) + places
    group = b"\x12" + varint(len(dense)) + dense
    yield Case(
        "pbf/ids and places that overflow",
        {"a.osm.pbf": header + blob(b"OSMData", strings + b"\x12" + varint(len(group)) + group)},
        "any",
        "osm",
    )


def varint(value: int) -> bytes:
    out = b""
    while value > 127:
        out += bytes([value & 127 | 128])
        value >>= 7
    return out + bytes([value])


def zigzag(value: int) -> int:
    return value << 1 ^ value >> 63 & 0xFFFFFFFFFFFFFFFF


def json_cases() -> Iterator[Case]:
    """Yield JSON attacks in GeoJSON."""
    point = '{"type": "Point", "coordinates": [7, 50]}'
    for name, data in {
        "brackets": b'{"type": "FeatureCollection", "features": ' + b"[" * 60_000,
        "brackets closed": b'{"type": "FeatureCollection", "features": ' + b"[" * 900 + b"]" * 900 + b"}",
        "objects": b'{"type": "FeatureCollection", "x": ' + b'{"a":' * 60_000,
        "nested collections": geojson('{"type": "GeometryCollection", "geometries": [' * 300 + point + "]}" * 300),
        "NaN": geojson('{"type": "Point", "coordinates": [NaN, 50]}'),
        "Infinity": geojson('{"type": "Point", "coordinates": [7, Infinity]}'),
        "1e999": geojson('{"type": "Point", "coordinates": [1e999, 50]}'),
        "long number": geojson('{"type": "Point", "coordinates": [' + HUGE + ", 50]}"),
        "NaN property": geojson(point, '{"a": NaN}'),
        "1e999 property": geojson(point, '{"a": 1e999}'),
        "long number property": geojson(point, '{"a": ' + HUGE + "}"),
        "lone surrogate": geojson(point, '{"a": "\\ud800"}'),
        "surrogate bytes": geojson(point, '{"a": "x"}').replace(b"x", b"\xed\xa0\x80"),
        "off earth": geojson('{"type": "Point", "coordinates": [500000, 5000000]}'),
        "text place": geojson('{"type": "Point", "coordinates": ["7", "50"]}'),
        "true place": geojson('{"type": "Point", "coordinates": [true, false]}'),
        "null place": geojson('{"type": "Point", "coordinates": [null, 50]}'),
        "object place": geojson('{"type": "Point", "coordinates": {"lon": 7}}'),
        "line of one": geojson('{"type": "LineString", "coordinates": [[7, 50]]}'),
        "unknown geometry": geojson('{"type": "Circle", "coordinates": [7, 50]}'),
        "geometry list": geojson("[7, 50]"),
        "geometry number": geojson("7"),
        "depth of coordinates": geojson('{"type": "Polygon", "coordinates": [7, 50]}'),
        "ragged": geojson('{"type": "LineString", "coordinates": [[7, 50], [7]]}'),
        "properties list": geojson(point, "[1]"),
        "features object": b'{"type": "FeatureCollection", "features": {}}',
        "features of numbers": b'{"type": "FeatureCollection", "features": [1, 2]}',
        "no type": b'{"features": []}',
        "type list": b'{"type": ["FeatureCollection"], "features": []}',
        "array": b"[]",
        "empty": b"{}",
        "two documents": geojson(point) + geojson(point),
        "cut": geojson(point)[:-5],
        "utf-16": geojson(point).decode().encode("utf-16"),
        "other crs": geojson(point).replace(
            b'"features"', b'"crs": {"type": "name", "properties": {"name": "EPSG:25832"}}, "features"'
        ),
    }.items():
        yield Case(f"geojson/{name}", {"a.geojson": data}, "refused", "geojson")
    for name, data in {
        "64 bit and one property": geojson(point, '{"a": %d}' % 2**63),
        "70 bit property": geojson(point, '{"a": %d}' % 2**70),
        "key twice": geojson(point, '{"a": 1, "a": 2}'),
        "control in name": geojson(point, '{"name": "a\\u0000b\\u001b[31m"}'),
        "bidi name": geojson(point, '{"name": "a\\u202eb"}'),
        "id object": geojson(point, "{}", ', "id": {"a": 1}'),
        "id long": geojson(point, "{}", ', "id": "%s"' % ("x" * 5000)),
        "id huge": geojson(point, "{}", ', "id": 1e300'),
        "five dimensions": geojson('{"type": "Point", "coordinates": [7, 50, 1, 2, 3]}'),
        "empty key": geojson(point, '{"": 1}'),
        "null key": geojson(point, '{"\\u0000": 1}'),
        "ring of two": geojson('{"type": "Polygon", "coordinates": [[[7, 50], [8, 50]]]}'),
        "bow tie": geojson('{"type": "Polygon", "coordinates": [[[7, 50], [8, 51], [8, 50], [7, 51], [7, 50]]]}'),
        "altitude huge": geojson('{"type": "Point", "coordinates": [7, 50, 1e300]}'),
    }.items():
        yield Case(f"geojson/{name}", {"a.geojson": data}, "any")
    for word in ("layer", "level", "part", "kind", "source", "target", "more", "drawn_from"):
        for value in ("5", "[]", "{}", "null", '"topology"', '"' + "x" * 5000 + '"', '"a\\u0000"', '"\\n"'):
            members = {"layer": '"topology"', "level": '"ground"', "part": '"network"', "kind": '"edge"', word: value}
            text = "{" + ", ".join(f'"{k}": {v}' for k, v in members.items()) + "}"
            for geometry in (point, "null"):
                yield Case(
                    f"geojson/own {word} {value[:9]} {geometry[:4]}",
                    {"a.geojson": geojson(geometry, text, ', "id": "x"')},
                    "any",
                )
    for member in ("5", "[]", '{"datum": 5}', '{"datum": {"latitude": 1}}', '{"datum": {"latitude": 1e5, "longitude": 0}}',
                 '{"datum": {"latitude": "x", "longitude": []}}', '{"levels": 5}', '{"levels": [{"name": 5}]}',
                 '{"levels": [{"x": 5}]}', '{"documents": 5}', '{"documents": [{"layer": "topology", "document": {}}]}',
                 '{"documents": [{"layer": "topology", "level": [], "part": {}, "document": {"a": "\\u0000"}}]}',
                 '{"levels": [{"name": "ground", "elevation": 1e300}, {"name": "ground"}]}'):  # fmt: skip
        body = geojson(point).replace(b'"features"', f'"fleet_map": {member}, "features"'.encode())
        yield Case(f"geojson/fleet_map {member}", {"a.geojson": body}, "any")


def picture_cases() -> Iterator[Case]:
    """Yield images of grids with wrong headers, damage, or a large uncompressed size."""
    named = ROOM.replace(b"room.pgm", b"room.png")
    rows = b"".join(b"\0" + bytes(8) for _ in range(8))
    for name, data in {
        "png 100000 x 100000": png(100_000, 100_000, None),
        "png 2^31 x 2^31": png(2**31 - 1, 2**31 - 1, None),
        "png 0 x 0": png(0, 0, rows),
        "png 16000 x 16000 in 100 bytes": png(16_000, 16_000, None),
        "png rows missing": png(8, 8, rows[:30]),
        "png wrong filter": png(8, 8, b"\x09" + rows[1:]),
        "png depth 3": png(8, 8, rows, depth=3),
        "png colour 9": png(8, 8, rows, colour=9),
        "png palette missing": png(8, 8, rows, colour=3),
        "png unknown critical chunk": png(8, 8, rows, more=chunk(b"ABCD", b"x")),
        "png wrong sum": png(8, 8, rows).replace(b"IEND\xaeB`\x82", b"IEND\0\0\0\0"),
        "png no end": png(8, 8, rows)[:-12],
        "png cut": png(8, 8, rows)[:-20],
        "png no deflate": png(8, 8, rows).replace(zlib.compress(rows, 9), bytes(len(zlib.compress(rows, 9)))),
        "png chunk of 4 GB": png(8, 8, rows)[:33] + b"\xff\xff\xff\xff" + png(8, 8, rows)[37:],
        "jpeg cut": b"\xff\xd8\xff\xe0\x00\x10JFIF\0" + bytes(50),
        "gif": b"GIF89a" + bytes(100),
        "tiff": b"II*\0" + bytes(100),
        "webp": b"RIFF\x10\0\0\0WEBPVP8 " + bytes(100),
        "svg": b"<svg xmlns='http://www.w3.org/2000/svg'/>",
        "empty": b"",
        "bmp 1 GB": b"BM"
        + struct.pack("<IHHI", 100, 0, 0, 54)
        + struct.pack("<IiiHHIIiiII", 40, 20000, 20000, 1, 24, 0, 0, 0, 0, 0, 0),
        "bmp negative": b"BM"
        + struct.pack("<IHHI", 100, 0, 0, 54)
        + struct.pack("<IiiHHIIiiII", 40, -5, -(2**31), 1, 24, 0, 0, 0, 0, 0, 0),
        "bmp of odd header": b"BM" + bytes(50),
    }.items():
        yield Case(f"picture/{name}", room(named, data, "room.png"), "refused")
    for name, data in {
        "pgm 10 GB": b"P5 100000 100000 255\n" + bytes(900),
        "pgm 2^62": b"P5 2147483647 2147483647 255\n",
        "pgm huge numbers": b"P5 " + b"9" * 5000 + b" 1 255\n",
        "pgm 0 x 5": b"P5 0 5 255\n",
        "pgm negative": b"P5 -4 3 255\n" + bytes(12),
        "pgm highest 0": b"P5 4 3 0\n" + bytes(12),
        "pgm highest 65536": b"P5 4 3 65536\n" + bytes(24),
        "pgm cut": PGM[:-1],
        "pgm header cut": b"P5 4 3",
        "pgm endless comment": b"P5 #" + b"x" * 100_000,
        "pgm text in numbers": b"P5 4x 3 255\n" + bytes(12),
        "plain pgm too few": b"P2 4 3 255\n1 2 3",
        "plain pgm long number": b"P2 2 1 255\n1 " + b"9" * 5000,
        "plain pgm letters": b"P2 2 1 255\n1 x",
        "plain pgm negative": b"P2 2 1 255\n1 -2",
        "plain pgm above highest": b"P2 2 1 255\n1 300",
        "ppm 10 GB": b"P6 60000 60000 255\n" + bytes(900),
        "ppm 16 bit cut": b"P6 16000 16000 65535\n" + bytes(900),
        "pbm 10 GB": b"P4 300000 300000\n" + bytes(900),
        "pfm": b"Pf 4 3 -1.0\n" + bytes(48),
        "pam": b"P7\nWIDTH 4\nHEIGHT 3\nDEPTH 1\nMAXVAL 255\nENDHDR\n" + bytes(12),
        "yaml as picture": ROOM,
    }.items():
        yield Case(f"picture/{name}", room(ROOM, data), "refused")
    for name, data in {
        "png 16 bit": png(4, 2, b"".join(b"\0" + bytes(8) for _ in range(2)), depth=16),
        "png grey and alpha": png(4, 2, b"".join(b"\0" + bytes(8) for _ in range(2)), colour=4),
        "png palette": png(8, 8, rows, colour=3, more=chunk(b"PLTE", bytes(768)) + chunk(b"tRNS", bytes(256))),
        "png short palette": png(8, 2, (b"\0" + b"\xff" * 8) * 2, colour=3, more=chunk(b"PLTE", bytes(3))),
        "png long palette": png(8, 8, rows, colour=3, more=chunk(b"PLTE", bytes(3000))),
        "png odd palette": png(8, 8, rows, colour=3, more=chunk(b"PLTE", bytes(7))),
        "png two headers": png(8, 8, rows, more=chunk(b"IHDR", struct.pack(">IIBBBBB", 2**20, 2**20, 8, 0, 0, 0, 0))),
        "png text bomb": png(8, 8, rows, more=chunk(b"zTXt", b"a\0\0" + zlib.compress(bytes(50 * 2**20)))),
        "png profile bomb": png(8, 8, rows, more=chunk(b"iCCP", b"a\0\0" + zlib.compress(bytes(50 * 2**20)))),
        "png animation": png(8, 8, rows, more=chunk(b"acTL", struct.pack(">II", 2**31 - 1, 0))),
        "png more behind": png(8, 8, rows) + bytes(1000),
        "png more rows": png(8, 8, rows * 50),
        "png 8000 x 8000 of nothing": png(8000, 8000, bytes(8001 * 8000)),
    }.items():
        yield Case(f"picture/{name}", room(named, data, "room.png"), "any")
    from PIL import Image

    out = io.BytesIO()
    Image.effect_noise((64, 64), 50).save(out, "JPEG", progressive=True)
    jpeg = out.getvalue()
    scan = jpeg.rfind(b"\xff\xda")
    end = jpeg.rfind(b"\xff\xd9")
    many = jpeg[:end] + jpeg[scan:end] * 200 + jpeg[end:]
    yield Case("picture/jpeg of 200 scans", room(ROOM.replace(b"room.pgm", b"room.jpg"), many, "room.jpg"), "refused")
    size = jpeg.find(b"\xff\xc2")
    large = jpeg[: size + 5] + struct.pack(">HH", 65_500, 65_500) + jpeg[size + 9 :]
    yield Case("picture/jpeg 4 GB", room(ROOM.replace(b"room.pgm", b"room.jpg"), large, "room.jpg"), "refused")


def archive_cases() -> Iterator[Case]:
    """Yield archives with escaping names, wrong headers or decompression bombs; as a folder and as a KMZ."""
    doc = KML.format(name="x", at="7,50").encode()
    body = b"x" * 100
    plain = (b"doc.kml", doc, {})
    local = len(b"doc.kml") + 30 + len(doc)
    for name, data in {
        "slip": raw_zip([plain, (b"../../evil.kml", body, {})]),
        "absolute": raw_zip([plain, (b"/etc/evil", body, {})]),
        "backslash": raw_zip([plain, (b"..\\evil", body, {})]),
        "drive": raw_zip([plain, (b"C:/evil", body, {})]),
        "dot folder": raw_zip([plain, (b"a/./b", body, {})]),
        "null in name": raw_zip([plain, (b"a\0b", body, {})]),
        "newline in name": raw_zip([plain, (b"a\nb", body, {})]),
        "empty name": raw_zip([plain, (b"", body, {})]),
        "bad utf-8": raw_zip([plain, (b"\xff\xfe", body, {})]),
        "name of 60 kB": raw_zip([plain, (b"x" * 60_000, body, {})]),
        "symlink": raw_zip([plain, (b"link", b"/etc/passwd", {"mode": 0o120777})]),
        "device": raw_zip([plain, (b"dev", b"", {"mode": 0o020666})]),
        "pipe": raw_zip([plain, (b"fifo", b"", {"mode": 0o010666})]),
        "encrypted": raw_zip([plain, (b"secret", body, {"flags": 0x801})]),
        "method 99": raw_zip([plain, (b"odd", body, {"method": 99})]),
        "name twice": raw_zip([plain, plain]),
        "names by case": raw_zip([plain, (b"DOC.KML", doc, {})]),
        "names by normal form": raw_zip([plain, ("ä".encode(), body, {}), ("a\u0308".encode(), body, {})]),
        "file and folder": raw_zip([plain, (b"a", body, {}), (b"a/b", body, {})]),
        "overlap": raw_zip([plain, (b"doc.kml", doc, {"start": 0}), (b"b.kml", doc, {})]),
        "wrong sum": raw_zip([(b"doc.kml", doc, {"crc": 1})]),
        "sizes disagree": raw_zip([(b"doc.kml", doc, {"central_size": 5})]),
        "start beyond": raw_zip([(b"doc.kml", doc, {"start": 2**31})]),
        "start at end": raw_zip([(b"doc.kml", doc, {"start": local - 4})]),
        "declares 4 GB": raw_zip([(b"doc.kml", doc, {"size": 2**32 - 2})]),
        "zip64 mark without field": raw_zip([(b"doc.kml", doc, {"size": 2**32 - 1, "packed": 2**32 - 1})]),
        "cut": zipped({"doc.kml": doc})[:-10],
        "nothing": b"PK\5\6" + bytes(18),
        "only a head": b"PK\3\4",
        "many ends": zipped({"doc.kml": doc}) + b"PK\5\6" * 10_000,
        "count lie": zipped({"doc.kml": doc})[:-12] + b"\xff\xff" + zipped({"doc.kml": doc})[-10:],
        "11000 members": zipped({f"f{k}": b"" for k in range(11_000)}),
        "real bomb": raw_zip([plain, *((b"z%d" % k, *zeros(64)) for k in range(17))]),
    }.items():
        verdict: Verdict = "refused"
        yield Case(f"kmz/{name}", {"a.kmz": data}, verdict, "kmz")
        yield Case(f"zip/{name}", {"a.zip": data}, verdict)
    yield Case("kmz/no kml", {"a.kmz": zipped({"a.txt": body})}, "refused", "kmz")
    inner = zipped({"doc.kml": doc})
    for _ in range(20):
        inner = zipped({"a.zip": inner})
    yield Case("zip/zip in zip in zip", {"a.zip": inner}, "refused")
    yield Case("kmz/zip in it", {"a.kmz": zipped({"doc.kml": doc, "a.zip": inner})}, "read")
    yield Case("kmz/kmz in it", {"a.kmz": zipped({"doc.kml": doc, "b.kmz": zipped({"doc.kml": doc})})}, "read")
    yield Case("zip/two say the same name", {"a.zip": zipped({"b.kml": doc}), "b.kml": doc}, "refused")
    yield Case("zip/many bombs", {f"{k}.zip": raw_zip([(b"%d/z" % k, *zeros(200))]) for k in range(8)}, "refused")
    link = "<kml><GroundOverlay><Icon><href>{}</href></Icon></GroundOverlay></kml>"
    for href in ("../../../etc/passwd", "files/%2e%2e/%2e%2e/x.png", "doc.kml", "files/x.png"):
        files = {"doc.kml": link.format(href).encode(), "files/x.png": png(2**31 - 1, 2**31 - 1, None)}
        yield Case(f"kmz/href {href[:16]}", {"a.kmz": zipped(files)}, "any")


def folder_cases() -> Iterator[Case]:
    """Yield folders as on robots, with scripts."""
    datum = {"config/location/datum.yaml": DATUM.format(lat=53.0, lon=-0.5).encode()}
    scripts = {
        "command": b"export A=$(touch /tmp/evil)\nexport B=`id`\nC=1\n",
        "endless quote": b"export A='" + b"x" * 1_000_000,
        "many lines": b"export A=1\n" * 200_000,
        "backslashes": b"A=" + b"\\" * 1_000_000,
        "null": b"A=\0\n",
        "not text": bytes(range(256)) * 100,
        "dollar quotes": b"A=$'\\x41'\nB=${C:-x}\nD=$((1+1))\n",
        "here document": b"cat <<E\nA=1\nE\n",
    }
    for name, script in scripts.items():
        for file in ("properties.sh", "environment.sh"):
            yield Case(f"folder/{name} {file}", {**datum, file: script}, "any")
    for folder in ("location", "metric", "topological", "world"):
        yield Case(f"folder/noise in {folder}", {**datum, f"config/{folder}/a.yaml": bytes(range(256))}, "any")
        yield Case(f"folder/kml in {folder}", {**datum, f"config/{folder}/a.kml": b"<kml>"}, "refused")
    yield Case("folder/nothing in it", {"a.zip": zipped({})}, "refused")
    yield Case("folder/empty files", {"datum.yaml": b"", "a.kml": b""}, "refused")
    noise = random.Random(1).randbytes(20_000)
    for name in ("a.yaml", "a.osm", "a.kml", "a.kmz", "a.geojson", "a.pgm", "a.tmap2.yaml", "datum.yaml", "a.zip", "a"):
        yield Case(f"noise/{name}", {name: noise}, "refused")


# --- networks as YAML --------------------------------------------------------------------------------------------


PRM = (
    "nodes:\n- {{id: {id}, x: {x}, y: 1}}\n- {{id: 2, x: 5, y: 5}}\nedges:\n- {{from: {a}, to: 2, weight: {w}}}\n{more}"
)
FFR = "internal_points:\n- {{name: {name}, x: {x}, y: 0}}\n- {{name: b, x: 5, y: 0}}\nnetwork_lines:\n- {{start: {{x: {x}, y: 0}}, end: {end}}}\n"
PICTURE = "picture: {resolution: 0.1, origin: [0, 0, 0], height: 50}\n"
TMAP = "- meta: {{map: m, node: a, pointset: p}}\n  node:\n    name: {name}\n    edges: {edges}\n    pose: {{position: {{x: {x}, y: 0}}}}\n"
NAVGRAPH = "%YAML 1.2\n%TAG ! tag:fawkesrobotics.org,navgraph/\n---\ngraph-name: g\nnodes:\n  - name: {name}\n    pos: {pos}\n  - name: b\n    pos: [1, 1]\nconnections:\n  - {link}\n"
NAV_GRAPH = "building_name: b\nlevels:\n  L1:\n    vertices:\n    - [{x}, 0.0, {{name: {name}}}]\n    - [1.0, 1.0, {{}}]\n    lanes:\n    - {lane}\n"


def network_cases() -> Iterator[Case]:
    """Yield networks of topological_navigation (the older list), environment_common, Fawkes and Open-RMF."""
    bad_numbers = (
        ".nan",
        ".inf",
        "-.inf",
        "1.0e+400",
        HUGE,
        "true",
        "'1'",
        "null",
        "[1]",
        "{{a: 1}}",
        "1e3e3",
        "!!python/object:os.system 1",
    )
    names = (
        ('"a\\u202eb"', "read"),
        ('"a\\nb"', "refused"),
        ('"\\0"', "refused"),
        ("a" * 300, "refused"),
        ("[a]", "refused"),
    )
    for k, bad in enumerate(bad_numbers):
        number = bad.replace("{{", "{").replace("}}", "}")
        verdict: Verdict = "any" if bad in ("'1'", "null") else "refused"
        yield Case(
            f"prm/x {k}", {"p.yaml": PRM.format(id=1, x=number, a=1, w=1, more=PICTURE).encode()}, "refused", "prm"
        )
        weight: Verdict = "refused"
        yield Case(
            f"prm/weight {k}", {"p.yaml": PRM.format(id=1, x=1, a=1, w=number, more=PICTURE).encode()}, weight, "prm"
        )
        picture = PICTURE.replace("0.1", number)
        yield Case(
            f"prm/resolution {k}", {"p.yaml": PRM.format(id=1, x=1, a=1, w=1, more=picture).encode()}, "refused", "prm"
        )
        picture = PICTURE.replace("50", number)
        yield Case(
            f"prm/height {k}", {"p.yaml": PRM.format(id=1, x=1, a=1, w=1, more=picture).encode()}, "refused", "prm"
        )
        yield Case(
            f"ffr/x {k}",
            {"n.ffr.yaml": FFR.format(name="a", x=number, end="{x: 5, y: 0}").encode()},
            "refused",
            "ffr_network",
        )
        yield Case(f"tmap/x {k}", {"n.tmap": TMAP.format(name="a", edges="[]", x=number).encode()}, verdict, "tmap")
        yield Case(
            f"navgraph/pos {k}",
            {"navgraph.yaml": NAVGRAPH.format(name="a", pos=f"[{number}, 0]", link="[a, b]").encode()},
            verdict,
            "navgraph",
        )
        yield Case(
            f"nav graph/x {k}",
            {"0.yaml": NAV_GRAPH.format(name="a", x=number, lane="[0, 1, {}]").encode()},
            verdict,
            "rmf_nav_graph",
        )
    for k, (name, outcome) in enumerate(names):
        expected_verdict: Verdict = "read" if outcome == "read" else "refused"
        yield Case(
            f"ffr/name {k}",
            {"n.ffr.yaml": FFR.format(name=name, x=1, end="{x: 5, y: 0}").encode()},
            "any" if expected_verdict == "read" else expected_verdict,
            "ffr_network",
        )
        yield Case(
            f"prm/id {k}",
            {"p.yaml": PRM.format(id=name, x=1, a=2, w=1, more=PICTURE).encode()},
            "any" if expected_verdict == "read" else expected_verdict,
            "prm",
        )
        yield Case(
            f"tmap/name {k}", {"n.tmap": TMAP.format(name=name, edges="[]", x=1).encode()}, expected_verdict, "tmap"
        )
        yield Case(
            f"navgraph/name {k}",
            {"navgraph.yaml": NAVGRAPH.format(name=name, pos="[0, 0]", link="[b, b]").encode()},
            "any" if expected_verdict == "read" else expected_verdict,
            "navgraph",
        )
        yield Case(
            f"nav graph/name {k}",
            {"0.yaml": NAV_GRAPH.format(name=name, x=1, lane="[0, 1, {}]").encode()},
            "any",
            "rmf_nav_graph",
        )
    mask = "costmap_filter_info_server:\n  ros__parameters:\n    type: {t}\n    base: {b}\n    mask_topic: {m}\n"
    for k, (t, b, m) in enumerate(
        (
            ("9", "0.0", "a"),
            ("1", ".nan", "a"),
            ("1.5", "0.0", "a"),
            ("1", HUGE, "a"),
            ("1", "0.0", "[a]"),
            ("-1", "0.0", "a"),
            ("!!python/name:os.system 1", "0.0", "a"),
        )
    ):
        yield Case(
            f"mask/parameters {k}",
            {**room(), "room_filter_info.yaml": mask.format(t=t, b=b, m=m).encode()},
            "refused",
            "occupancy_grid",
        )
    for k, text in enumerate(
        (
            "",
            "[",
            "3",
            "[1]",
            "a: &a {b: *a}",
            "a: " * 200 + "1",
            "costmap_filter_info_server: 3\n",
            "costmap_filter_info_server: {ros__parameters: 3}\n",
        )
    ):
        yield Case(f"mask/file {k}", {**room(), "room_filter_info.yaml": text.encode()}, "any", "occupancy_grid")
    plain = PRM.format(id=1, x=1, a=1, w=1, more="")
    yield Case("prm/without its map", {"p.yaml": plain.encode()}, "refused", "prm")
    yield Case(
        "prm/map that is no map", {"p.yaml": plain.encode(), "map.yaml": b"image: ../../etc/passwd\n"}, "refused"
    )
    yield Case(
        "prm/map from elsewhere",
        {"p.yaml": plain.encode(), **room(ROOM.replace(b"room.pgm", b"/etc/passwd"), name="room.pgm")},
        "refused",
    )
    yield Case(
        "prm/huge map",
        {"p.yaml": plain.encode(), "map.yaml": ROOM, "room.pgm": b"P5 2000000000 2000000000 255\n"},
        "refused",
    )
    yield Case("prm/map is itself", {"map.yaml": (plain + "image: map.yaml\n").encode()}, "refused", "prm")
    yield Case(
        "prm/edge to nowhere", {"p.yaml": PRM.format(id=1, x=1, a=77, w=1, more=PICTURE).encode()}, "read", "prm"
    )
    yield Case("prm/self loop", {"p.yaml": PRM.format(id=1, x=1, a=2, w=1, more=PICTURE).encode()}, "read")
    yield Case("prm/id twice", {"p.yaml": PRM.format(id=2, x=1, a=2, w=1, more=PICTURE).encode()}, "read")
    for word in ("nodes", "edges"):
        for value in ("3", "null", "{}", "[null]", "[[]]", "[3]"):
            text = (plain + PICTURE).replace(f"{word}:\n", f"{word}: {value}\nold_{word}:\n")
            yield Case(f"prm/{word} {value}", {"p.yaml": text.encode()}, "any", "prm")
    many = "nodes:\n" + "".join(f"- {{id: {k}, x: {k % 9}, y: 1}}\n" for k in range(10000)) + "edges:\n"
    many += "".join(f"- {{from: 0, to: {k}, weight: 1}}\n" for k in range(10000))
    yield Case("prm/a star of 10 000", {"p.yaml": (many + PICTURE).encode()}, "read", "prm")
    same = "internal_points:\n" + "- {name: a, x: 1, y: 1}\n" * 10000 + "network_lines:\n"
    same += "- {start: {x: 1, y: 1}, end: {x: 1, y: 1}}\n" * 10000
    yield Case("ffr/10 000 points in one place", {"n.ffr.yaml": same.encode()}, "read", "ffr_network")
    for k, end in enumerate(("3", "null", "{}", "[5, 0]", "{x: 5}", "{x: 5, y: '0'}")):
        yield Case(
            f"ffr/end {k}", {"n.ffr.yaml": FFR.format(name="a", x=1, end=end).encode()}, "refused", "ffr_network"
        )
    yield Case("ffr/line to nowhere", {"n.ffr.yaml": FFR.format(name="a", x=1, end="{x: 9, y: 9}").encode()}, "read")
    for k, edges in enumerate(
        ("3", "{}", "[3]", "[[]]", "[{node: [a]}]", "[{}]", "[{node: a, edge_id: {}}]", "[null]")
    ):
        yield Case(f"tmap/edges {k}", {"n.tmap": TMAP.format(name="a", edges=edges, x=1).encode()}, "any", "tmap")
    yield Case("tmap/scalars", {"n.tmap": b"- 3\n- node\n"}, "refused", "tmap")
    yield Case("tmap/deep", {"n.tmap": b"- node:\n    name: a\n    verts: " + b"[" * 5000}, "refused", "tmap")
    yield Case(
        "tmap/alias bomb",
        {
            "n.tmap": b"- node: &a {name: x, pose: {position: {x: 1, y: 1}}, verts: [1, 2]}\n- node: &b [*a, *a]\n- node: &c [*b, *b]\n"
        },
        "refused",
        "tmap",
    )
    links = (
        "[a]",
        "[a, b, c]",
        "3",
        "!dir 3",
        "!dir [a]",
        "!sudo [a, b]",
        "!!python/name:os.system [a, b]",
        "{a: b}",
        "[[a], [b]]",
        "[a, nowhere]",
        "[a, a]",
        "*x",
        "&x [*x, *x]",
        "!split-intersection [a, b]",
    )
    for k, link in enumerate(links):
        yield Case(
            f"navgraph/connection {k}",
            {"navgraph.yaml": NAVGRAPH.format(name="a", pos="[0, 0]", link=link).encode()},
            "any",
            "navgraph",
        )
    for k, pos in enumerate(("[]", "[1]", "[1, 2, 3]", "3", "{x: 1}", "[[1], [2]]", "null")):
        yield Case(
            f"navgraph/position {k}",
            {"navgraph.yaml": NAVGRAPH.format(name="a", pos=pos, link="[a, b]").encode()},
            "refused",
            "navgraph",
        )
    graph = NAVGRAPH.format(name="a", pos="[0, 0]", link="[a, b]")
    yield Case(
        "navgraph/another tag prefix",
        {"navgraph.yaml": graph.replace("fawkesrobotics.org", "evil.example").encode()},
        "any",
        "navgraph",
    )
    yield Case(
        "navgraph/properties that are no list",
        {"navgraph.yaml": graph.replace("    pos: [0, 0]", "    pos: [0, 0]\n    properties: 3").encode()},
        "refused",
        "navgraph",
    )
    yield Case("navgraph/second document", {"navgraph.yaml": (graph + "---\na: 1\n").encode()}, "refused", "navgraph")
    lanes = (
        "[0]",
        "[0, 1]",
        "[0, 7, {}]",
        "[-1, 1, {}]",
        "[true, 1, {}]",
        "[0.5, 1, {}]",
        "['0', 1, {}]",
        "[0, 1, 3]",
        "3",
        "{}",
        "[0, 0, {}]",
        "[0, 1, {}, {}]",
        f"[0, {HUGE}, {{}}]",
        "[0, 1, {speed_limit: .nan}]",
        "[0, 1, {speed_limit: fast}]",
        "[0, 1, {mutex: [a]}]",
        "[18446744073709551616, 1, {}]",
    )
    for k, lane in enumerate(lanes):
        yield Case(
            f"nav graph/lane {k}",
            {"0.yaml": NAV_GRAPH.format(name="a", x=1, lane=lane).encode()},
            "any",
            "rmf_nav_graph",
        )
    for k, level in enumerate(
        (
            "3",
            "[]",
            "{vertices: 3}",
            "{vertices: [3], lanes: []}",
            "{vertices: [[1]], lanes: []}",
            "{lanes: [[0, 1, {}]]}",
            "{vertices: [[0, 0, 3]]}",
            "null",
        )
    ):
        text = f"building_name: b\nlevels:\n  L1: {level}\n"
        yield Case(f"nav graph/level {k}", {"0.yaml": text.encode()}, "any", "rmf_nav_graph")
    for k, more in enumerate(
        (
            "doors: 3\n",
            "doors: {d: 3}\n",
            "doors: {d: {endpoints: [1, 2]}}\n",
            "lifts: {l: {position: [a]}}\n",
            "lifts: [3]\n",
            "doors: {d: {endpoints: [[.nan, 0], [1, 1]], map: L1}}\n",
        )
    ):
        text = NAV_GRAPH.format(name="a", x=1, lane="[0, 1, {}]") + more
        yield Case(f"nav graph/more {k}", {"0.yaml": text.encode()}, "any", "rmf_nav_graph")
    star = "building_name: b\nlevels:\n  L1:\n    vertices:\n" + "    - [1.0, 1.0, {}]\n" * 10000 + "    lanes:\n"
    star += "".join(f"    - [0, {k}, {{}}]\n" for k in range(10000))
    yield Case("nav graph/a star of 10 000", {"0.yaml": star.encode()}, "read", "rmf_nav_graph")
    yield Case(
        "nav graph/500 of them",
        {f"{k}.yaml": NAV_GRAPH.format(name=f"n{k}", x=1, lane="[0, 1, {}]").encode() for k in range(500)},
        "read",
        "rmf_nav_graph",
    )


# --- georeferenced images ----------------------------------------------------------------------------------------


def tiff(
    tags: dict[int, tuple[int, int, int]], tail: bytes = b"", *, following: int = 0, count: int | None = None
) -> bytes:
    """Build a little-endian TIFF of one page: tag -> (type, count, value or offset), followed by the tail."""
    body = b"".join(struct.pack("<HHII", tag, *entry) for tag, entry in sorted(tags.items()))
    number = len(tags) if count is None else count
    return b"II*\0" + struct.pack("<IH", 8, number) + body + struct.pack("<I", following) + tail


def geotiff(
    changed: dict[int, tuple[int, int, int] | None] | None = None, pixels: bytes = bytes(12), **more: int
) -> bytes:
    """Build a GeoTIFF of 4 × 3 grey pixels, with other values of some tags (None: without the tag)."""
    tags: dict[int, tuple[int, int, int]] = {
        256: (3, 1, 4), 257: (3, 1, 3), 258: (3, 1, 8), 259: (3, 1, 1), 262: (3, 1, 1), 273: (4, 1, 0), 277: (3, 1, 1),
        278: (3, 1, 3), 279: (4, 1, len(pixels)), 33550: (12, 3, 0), 33922: (12, 6, 0),
    }  # fmt: skip
    changed = changed or {}
    entries = {t: e for t, e in ({**tags, **changed}).items() if e is not None}
    start = 8 + 2 + 12 * len(entries) + 4
    place = struct.pack("<3d", 0.5, 0.5, 0.0), struct.pack("<6d", 0, 0, 0, 100.0, 200.0, 0)
    for tag, offset in ((33550, start), (33922, start + 24), (273, start + 72)):
        if tag in entries and tag not in changed:
            entries[tag] = (*entries[tag][:2], offset)
    return tiff(entries, place[0] + place[1] + pixels, **more)


def satellite_cases() -> Iterator[Case]:
    """Yield TIFF with wrong tags, loops or bombs; world files with invalid numbers; slow images."""
    yield Case("satellite/as it should be", {"a.tif": geotiff()}, "read")
    packed = zlib.compress(bytes(2**24), 9)
    huge = (4, 1, 2**32 - 1)
    for name, data in {
        "2^32 wide": geotiff({256: huge}),
        "2^32 high": geotiff({257: huge}),
        "2^32 both ways": geotiff({256: huge, 257: huge}),
        "40000 x 40000": geotiff({256: (4, 1, 40_000), 257: (4, 1, 40_000), 278: (4, 1, 40_000)}),
        "0 wide": geotiff({256: (4, 1, 0)}),
        "no width": geotiff({256: None}),
        "65535 bands": geotiff({277: (3, 1, 65_535), 256: (4, 1, 4000), 257: (4, 1, 4000), 278: (4, 1, 4000)}),
        "pixels missing": geotiff(pixels=b"")[:-1],
        "pixels cut": geotiff()[:-6],
        "pixels beyond the end": geotiff({273: (4, 1, 2**31)}),
        "count of pixels lies": geotiff({279: (4, 1, 2**31)}, b""),
        "compression unknown": geotiff({259: (3, 1, 12345)}),
        "LZW of nothing": geotiff({259: (3, 1, 5)}),
        "deflate of nothing": geotiff({259: (3, 1, 8)}),
        "JPEG of nothing": geotiff({259: (3, 1, 7)}),
        "G4 fax of nothing": geotiff({259: (3, 1, 4), 258: (3, 1, 1)}),
        "ZSTD of nothing": geotiff({259: (3, 1, 50_000)}),
        "LERC of nothing": geotiff({259: (3, 1, 34_887)}),
        "WebP of nothing": geotiff({259: (3, 1, 50_001)}),
        "tiles of 2^31": geotiff(
            {322: (4, 1, 2**31), 323: (4, 1, 2**31), 324: (4, 1, 8), 325: (4, 1, 4), 273: None, 279: None}
        ),
        "tiles of 0": geotiff({322: (4, 1, 0), 323: (4, 1, 0), 324: (4, 1, 8), 325: (4, 1, 4), 273: None, 279: None}),
        "scale of NaN": geotiff().replace(struct.pack("<d", 0.5), struct.pack("<d", float("nan"))),
        "scale of 1e300": geotiff().replace(struct.pack("<d", 0.5), struct.pack("<d", 1e300)),
        "place of inf": geotiff().replace(struct.pack("<d", 100.0), struct.pack("<d", float("inf"))),
        "no page": b"II*\0" + bytes(4),
        "page beyond the end": b"II*\0" + struct.pack("<I", 2**31),
        "header only": b"II*\0",
        "pages in a loop": geotiff(following=8),
        "many pages": many_pages(60_000),
        "BigTIFF header only": b"II+\0\x08\0\0\0" + struct.pack("<Q", 2**63),
        "65535 tags": tiff(dict.fromkeys(range(5), (1, 1, 0)), count=65_535),
        "complex numbers": geotiff({339: (3, 1, 6), 258: (3, 1, 64)}, bytes(96)),
        "VRT": b"<VRTDataset rasterXSize='9' rasterYSize='9'><VRTRasterBand><SimpleSource><SourceFilename>/etc/passwd</SourceFilename></SimpleSource></VRTRasterBand></VRTDataset>",
        "not a picture": b"hello",
    }.items():
        yield Case(f"satellite/tiff {name}", {"a.tif": data}, "refused", "satellite")
    for name, data in {
        "page after itself": geotiff(following=9),
        "next page beyond the end": geotiff(following=2**32 - 1),
        "bomb of 16 MB": geotiff({256: (4, 1, 4096), 257: (4, 1, 4096), 278: (4, 1, 4096), 259: (3, 1, 8)}, packed),
        "all pixels left out": geotiff(
            {256: (4, 1, 16_000), 257: (4, 1, 16_000), 278: (4, 1, 16_000), 273: (4, 1, 0), 279: (4, 1, 0)}
        ),
        "text without an end": geotiff({270: (2, 2**30, 8)}),
        "GDAL's own words": geotiff({42112: (2, 40, 8)}),
        "keys that lie": geotiff({34735: (3, 60_000, 8)}),
        "keys in a ring": geotiff({34735: (3, 8, 8), 34737: (2, 30, 8)}),
        "colours of nothing": geotiff({262: (3, 1, 3)}),
        "samples of 3 bit": geotiff({258: (3, 1, 3)}),
        "samples of 0 bit": geotiff({258: (3, 1, 0)}),
        "nodata of text": geotiff({42113: (2, 4, 0x006E616E)}),
    }.items():
        yield Case(f"satellite/tiff {name}", {"a.tif": data}, "any", "satellite")
        yield Case(f"satellite/tiff {name}, unnamed", {"a.tif": data}, "any")
    small = png(4, 3, b"".join(b"\0" + bytes(4) for _ in range(3)))
    numbers = ["1", "0", "0", "-1", "0", "0"]
    for value in ("nan", "inf", "-inf", "1e999", "1,5", "0x10", "1_0", "", "one", HUGE, "\u0661", "1;"):
        for place in (0, 5):
            lines = [*numbers[:place], value, *numbers[place + 1 :]]
            text = "\n".join(lines).encode()
            yield Case(f"satellite/world {value[:9]!r} in line {place + 1}", {"a.pgw": text, "a.png": small}, "refused")
    for name, text in {
        "zeros": b"0\n" * 6,
        "flat": b"1\n1\n1\n1\n0\n0\n",
        "empty": b" ",
        "five lines": b"1\n0\n0\n-1\n0\n",
        "huge": b"1e300\n0\n0\n-1e300\n0\n0\n",
        "far away": b"1\n0\n0\n-1\n1e15\n0\n",
        "binary": bytes(range(256)),
        "a megabyte": b"1\n" * 2**19,
    }.items():
        yield Case(f"satellite/world {name}", {"a.pgw": text, "a.png": small}, "refused")
    good = "\n".join(numbers).encode()
    for name, data in {
        "a bomb": png(16_000, 16_000, None),
        "2^31 wide": png(2**31 - 1, 2**31 - 1, None),
        "a JPEG without an end": b"\xff\xd8\xff\xe0\x00\x10JFIF\0" + bytes(50),
        "a JPEG of 1000 scans": b"\xff\xd8\xff" + b"\xff\xda\0\x08\1\1\0\0\x3f\0" * 1000 + b"\xff\xd9",
        "a text": b"hello",
        "a GIF": b"GIF89a" + bytes(100),
    }.items():
        yield Case(f"satellite/world of {name}", {"a.wld": good, "a.png": data}, "refused")
    for name, text in {
        "entities": b"<!DOCTYPE a [<!ENTITY x 'y'>]><PAMDataset><SRS>&x;</SRS></PAMDataset>",
        "a path": b"<PAMDataset><SRS>/etc/passwd</SRS></PAMDataset>",
        "an address": b"<PAMDataset><SRS>http://127.0.0.1:1/x</SRS></PAMDataset>",
        "a grid file": b'<PAMDataset><SRS>GEOGCS["x",EXTENSION["PROJ4","+proj=longlat +nadgrids=/etc/passwd"]]</SRS></PAMDataset>',
        "deep WKT": b"<PAMDataset><SRS>" + b"PROJCS[" * 9000 + b"</SRS></PAMDataset>",
    }.items():
        yield Case(f"satellite/aux.xml of {name}", {"a.pgw": good, "a.png": small, "a.png.aux.xml": text}, "refused")
        lone = text.partition(b"<SRS>")[2].partition(b"</SRS>")[0]
        yield Case(f"satellite/prj of {name}", {"a.pgw": good, "a.png": small, "a.prj": lone}, "refused")


def many_pages(count: int) -> bytes:
    """Build pages of one pixel each, equal except for the offset of the next one."""
    out = [geotiff(following=0)]
    start = len(out[0])
    size = 2 + 12 * 9 + 4
    first = bytearray(out[0])
    (tags,) = struct.unpack_from("<H", first, 8)
    struct.pack_into("<I", first, 10 + 12 * tags, start)
    page = b"".join(
        struct.pack("<HHII", *entry)
        for entry in (
            (256, 3, 1, 1),
            (257, 3, 1, 1),
            (258, 3, 1, 8),
            (259, 3, 1, 1),
            (262, 3, 1, 1),
            (273, 4, 1, 8),
            (277, 3, 1, 1),
            (278, 3, 1, 1),
            (279, 4, 1, 1),
        )
    )
    pages = [
        struct.pack("<H", 9) + page + struct.pack("<I", start + size * (k + 1) if k + 1 < count else 0)
        for k in range(count)
    ]
    return bytes(first) + b"".join(pages)


# --- point clouds ------------------------------------------------------------------------------------------------


def pcd(fields: str = "x y z", size: str = "4 4 4", kind: str = "F F F", n: object = 1, data: str = "binary") -> bytes:
    """Build the header of a PCD."""
    lines = f"VERSION 0.7\nFIELDS {fields}\nSIZE {size}\nTYPE {kind}\nWIDTH {n}\nHEIGHT 1\nPOINTS {n}\nDATA {data}\n"
    return lines.encode()


def cloud_cases() -> Iterator[Case]:
    """Yield point clouds with wrong headers, decompression bombs and invalid numbers."""
    point = struct.pack("<3f", 1, 2, 3)

    def case(name: str, data: bytes, verdict: Verdict, end: str = "pcd") -> Case:
        return Case(f"cloud: {name}", {f"map.{end}": data}, verdict, {"laz": "las"}.get(end, end))

    for n in (-1, "1e9", "9" * 30, 2**31, 2**63, "true", "", "1 1", "\u0661"):
        yield case(f"pcd, {n} points", pcd(n=n) + point, "refused")
    yield case("pcd, more points than bytes", pcd(n=10**7) + point, "refused")
    yield case("pcd, text with fewer rows", pcd(n=10**7, data="ascii") + b"1 2 3\n" * 100, "refused")
    yield case("pcd, a record of gigabytes", pcd("x y z " + "a " * 5000, "8 " * 5003, "F " * 5003), "refused")
    yield case("pcd, a count of gigabytes", pcd().replace(b"WIDTH", b"COUNT 1 1 999999999\nWIDTH") + point, "refused")
    for value in ("nan", "inf", "-inf", "1e999", "1e38"):
        yield case(f"pcd, a coordinate {value}", pcd(n=2, data="ascii") + f"0 0 0\n{value} 0 0\n".encode(), "any")
    for value in ("0x10", "1_000", "\u0661", "1,5", "''", "None", "1" * 5000):
        yield case(
            f"pcd, a coordinate {value[:8]}", pcd(n=2, data="ascii") + f"0 0 0\n{value} 0 x\n".encode(), "refused"
        )
    yield case("pcd, all points without coordinates", pcd(n=3, data="ascii") + b"nan nan nan\n" * 3, "read")
    yield case(
        "pcd, at both ends of float64",
        pcd(size="8 8 8", n=2) + struct.pack("<6d", -1e308, 0, 0, 1e308, 0, 0),
        "read",
    )
    yield case("pcd, a header without end", b"VERSION 0.7\n" + b"# padding\n" * 20000, "refused")
    yield case("pcd, control characters in a name", pcd("x y z a\0b", "4 4 4 4", "F F F F") + point + bytes(4), "read")
    ten = "binary_compressed"
    yield case(
        "pcd, a stream that refers before its start",
        pcd(data=ten) + struct.pack("<II", 3, 12) + b"\xe0\xff\xff",
        "refused",
    )
    yield case("pcd, a stream that ends in a reference", pcd(data=ten) + struct.pack("<II", 1, 12) + b"\xff", "refused")
    bomb = b"\x00\x00" + b"\xe0\xff\x00" * 10**6
    wide = pcd("x y z w", "4 4 4 1", "F F F U", 1, ten)
    for count in (264 * 10**6 - 11, 2**32 - 13):
        head = wide.replace(b"WIDTH", b"COUNT 1 1 1 %d\nWIDTH" % count)
        yield case(f"pcd, a bomb of {count} bytes", head + struct.pack("<II", len(bomb), count + 12) + bomb, "refused")
    many = pcd(n=22 * 10**6, data=ten) + struct.pack("<II", len(bomb), 264 * 10**6) + bomb
    yield case("pcd, a bomb of points", many, "refused")
    vertex = "element vertex 1\nproperty float x\nproperty float y\nproperty float z\n"
    ply = f"ply\nformat binary_little_endian 1.0\n{vertex}"
    yield case("ply, two vertex elements", f"{ply}{vertex}end_header\n".encode() + 2 * point, "refused", "ply")
    yield case(
        "ply, faces that promise gigabytes",
        f"{ply}element face 9999999999\nproperty list uchar int i\nend_header\n".encode() + point,
        "refused",
        "ply",
    )
    yield case(
        "ply, a list longer than the file",
        f"{ply}element face 1\nproperty list uint int i\nend_header\n".encode() + point + b"\xff" * 4,
        "refused",
        "ply",
    )
    yield case(
        "ply, a list of negative length",
        f"{ply}element face 1\nproperty list int int i\nend_header\n".encode() + point + b"\xff" * 4,
        "refused",
        "ply",
    )
    yield case(
        "ply, an element without properties",
        f"{ply}element nothing 9999999\nend_header\n".encode() + point,
        "any",
        "ply",
    )
    yield case(
        "ply, ten thousand properties",
        (
            "ply\nformat ascii 1.0\nelement vertex 1\n"
            + "".join(f"property float p{k}\n" for k in range(3000))
            + "end_header\n"
        ).encode(),
        "refused",
        "ply",
    )
    yield case(
        "ply, ten thousand elements",
        f"{ply}{''.join(f'element e{k} 0{chr(10)}' for k in range(3000))}end_header\n".encode() + point,
        "any",
        "ply",
    )
    for name in ("field.las", "spiral.laz"):
        data, end = (SAMPLES / "las" / name).read_bytes(), name[-3:]
        for at, form in ((94, "<H"), (96, "<I"), (100, "<I"), (105, "<H"), (107, "<I")):
            for value in (0, 1, 2 ** (8 * struct.calcsize(form)) - 1):
                lie = data[:at] + struct.pack(form, value) + data[at + struct.calcsize(form) :]
                yield case(f"{name}, {value} at byte {at}", lie, "any", end)
        for at in range(0, len(data), 37):
            yield case(f"{name}, cut at {at}", data[:at], "any" if at > 1100 else "refused", end)
    laz = (SAMPLES / "las" / "spiral.laz").read_bytes()
    for at in range(375, len(laz) - 4, 29):
        yield case(f"laz, ones at byte {at}", laz[:at] + b"\xff" * 4 + laz[at + 4 :], "any", "laz")


def sdf_cases() -> Iterator[Case]:
    """Yield worlds with invalid includes, meshes, numbers and lists."""

    def upload(inner: str, more: dict[str, bytes] | None = None, version: str = "1.7") -> dict[str, bytes]:
        world = f'<sdf version="{version}"><world name="w">{inner}</world></sdf>'
        return {"a.world": world.encode(), **(more or {})}

    def body(geometry: str) -> str:
        part = f"<link name='l'><collision name='c'><geometry>{geometry}</geometry></collision></link>"
        return f"<model name='m'>{part}</model>"

    def model(inner: str) -> bytes:
        return f'<sdf version="1.7"><model name="m">{inner}</model></sdf>'.encode()

    for name, doctype in {
        "entity": "<!DOCTYPE sdf [<!ENTITY a 'aaaa'>]>",
        "outside entity": "<!DOCTYPE sdf [<!ENTITY a SYSTEM 'file:///etc/passwd'>]>",
        "parameter entity": "<!DOCTYPE sdf SYSTEM 'http://127.0.0.1:1/a.dtd'>",
    }.items():
        text = f"{doctype}<sdf version='1.7'><world name='w'><model name='m'>&a;</model></world></sdf>"
        yield Case(f"sdf/{name}", {"a.world": text.encode()}, "refused", "gazebo")
    many = "".join(f"<!ENTITY a{k} '{f'&a{k - 1};' * 10}'>" for k in range(1, 10))
    laughs = f"<!DOCTYPE sdf [<!ENTITY a0 'ha'>{many}]><sdf version='1.7'><world name='&a9;'/></sdf>"
    yield Case("sdf/billion laughs", {"a.world": laughs.encode()}, "refused", "gazebo")
    include = "<xi:include xmlns:xi='http://www.w3.org/2001/XInclude' href='file:///etc/passwd' parse='text'/>"
    yield Case("sdf/xinclude", upload(f"<model name='m'>{include}</model>"), "read")
    yield Case("sdf/deep models", upload("<model name='m'>" * 60 + "</model>" * 60), "refused")
    yield Case("sdf/deep elements", upload("<plugin name='p'>" + "<a>" * 5000 + "</a>" * 5000 + "</plugin>"), "refused")
    yield Case("sdf/deep plugin", upload("<plugin name='p'>" + "<a>" * 150 + "</a>" * 150 + "</plugin>"), "read")
    yield Case("sdf/many attributes", upload("<model %s/>" % " ".join(f"a{k}='1'" for k in range(300))), "any")
    yield Case("sdf/endless name", upload(f"<model name='{'a' * 100_000}'/>"), "refused")
    yield Case(
        "sdf/reserved names", upload("<model name='world'/><model name='__root__'/><model name='a::b'/>"), "read"
    )
    yield Case("sdf/no names", upload("<model/><model/><include/><light/>"), "read")
    yield Case("sdf/one name", upload("<model name='m'/>" * 300), "read")
    for number in ("nan", "inf", "-1e999", "1e300", HUGE, "1,5", "0x10", "١", "1_0", "--1"):
        short = number[:8]
        yield Case(f"sdf/pose {short}", upload(f"<model name='m'><pose>{number} 0 0 0 0 0</pose></model>"), "refused")
        yield Case(f"sdf/size {short}", upload(body(f"<box><size>{number} 1 1</size></box>")), "refused")
        place = f"<spherical_coordinates><latitude_deg>{number}</latitude_deg></spherical_coordinates>"
        yield Case(f"sdf/latitude {short}", upload(place), "refused")
    yield Case("sdf/huge angle", upload("<model name='m'><pose>0 0 0 1e7 -1e7 1e7</pose></model>"), "read")
    yield Case("sdf/negative size", upload(body("<box><size>-1 1 1</size></box>")), "any")
    yield Case("sdf/huge sphere", upload(body("<sphere><radius>9e6</radius></sphere>")), "any")
    yield Case("sdf/zero normal", upload(body("<plane><normal>0 0 0</normal><size>1 1</size></plane>")), "any")
    yield Case("sdf/many points", upload(body("<polyline>" + "<point>1 2</point>" * 100_000 + "</polyline>")), "any")
    chain = "".join(f"<model name='m{k}'><pose relative_to='m{k + 1}'>1 0 0 0 0 0</pose></model>" for k in range(5000))
    yield Case("sdf/long chain of frames", upload(chain), "read")
    yield Case("sdf/frames in a circle", upload(chain + "<frame name='m5000'><pose relative_to='m0'/></frame>"), "read")
    yield Case(
        "sdf/attached in a circle", upload("<frame name='a' attached_to='b'/><frame name='b' attached_to='a'/>"), "read"
    )
    again = "<include><uri>model://{}</uri></include>"
    yield Case("sdf/includes itself", upload(again.format("x"), {"x/model.sdf": model(again.format("x"))}), "refused")
    ring = {f"x{k}/model.sdf": model(again.format(f"x{(k + 1) % 20}")) for k in range(20)}
    yield Case("sdf/includes in a ring", upload(again.format("x0"), ring), "refused")
    yield Case("sdf/ring without a world", ring, "refused")
    line = {f"x{k}/model.sdf": model(again.format(f"x{k + 1}")) for k in range(100)}
    yield Case("sdf/includes in a long line", upload(again.format("x0"), line), "refused")
    tenfold = "".join(f"<include><name>n{j}</name><uri>model://x{{k}}</uri></include>" for j in range(10))
    bomb = {f"x{k}/model.sdf": model(tenfold.replace("{k}", str(k + 1))) for k in range(12)}
    ball = (
        "<link name='l'><collision name='c'><geometry><sphere><radius>1</radius></sphere></geometry></collision></link>"
    )
    yield Case("sdf/include bomb", upload(again.format("x0"), {**bomb, "x12/model.sdf": model(ball)}), "refused")
    yield Case(
        "sdf/include bomb of links",
        upload(again.format("x0"), {**bomb, "x12/model.sdf": model("<link name='l'/>")}),
        "any",
    )
    paths = (
        "file:///etc/passwd", "model://../../../etc/passwd", "../../../etc/passwd", "model://x/../../etc/passwd",
        "http://127.0.0.1:1/x", "https://example.org/x", "fuel://x", "package://x/y", "model://%2e%2e/x", "model://~/x",
        "model://x\\y", "model:////x", "model://" + "a/" * 3000, "model://\u202ex", "$(touch /tmp/evil)", "C:\\x",
    )  # fmt: skip
    for k, path in enumerate(paths):
        yield Case(f"sdf/path {k}", upload(again.format(path) + body(f"<mesh><uri>{path}</uri></mesh>")), "read")
    config = b"<model><sdf version='1.6'>../../secret/model.sdf</sdf><sdf version='1.7'>/etc/passwd</sdf></model>"
    outside = {"x/model.config": config, "secret/model.sdf": model(""), "x/model.sdf": model("")}
    yield Case("sdf/config that leaves its folder", upload(again.format("x"), outside), "read")
    yield Case(
        "sdf/broken model",
        upload(again.format("x"), {"x/model.sdf": b"<sdf version='1.7'><model name='m'>"}),
        "refused",
    )
    yield Case("sdf/model that is none", upload(again.format("x"), {"x/model.sdf": bytes(range(256))}), "read")
    entity = b"<!DOCTYPE a [<!ENTITY b 'c'>]>" + model("&b;")
    yield Case("sdf/model with an entity", upload(again.format("x"), {"x/model.sdf": entity}), "any")
    for kind in ("stl", "obj", "dae", "ply", "fbx"):
        mesh = body(f"<mesh><uri>model://m.{kind}</uri></mesh>")
        for name, data in {
            "noise": random.Random(3).randbytes(5000),
            "count": b"\0" * 80 + struct.pack("<I", 2**32 - 1) + bytes(500),
            "text": b"solid x\nfacet normal 0 0 1\nouter loop\nvertex nan 1e999 x\n",
            "faces": b"v 0 0 0\nf 1 2 3\nf 99999999999 -5 0\n",
            "entity": b"<!DOCTYPE COLLADA [<!ENTITY a 'b'>]><COLLADA>&a;</COLLADA>",
            "collada": b"<COLLADA xmlns='http://www.collada.org/2005/11/COLLADASchema' version='1.4.1'><asset><unit meter='1e300'/></asset></COLLADA>",
        }.items():
            yield Case(f"sdf/{kind} {name}", upload(mesh, {f"m.{kind}": data}), "read")
    heightmap = body("<heightmap><uri>model://h.png</uri><size>1 1 1</size></heightmap>")
    yield Case("sdf/heightmap bomb", upload(heightmap, {"h.png": png(2**31 - 1, 2**31 - 1, None)}), "any")
    yield Case(
        "sdf/state of strangers", upload("<state><model name='x'><pose>1 2 3 0 0 0</pose></model></state>" * 50), "read"
    )
    yield Case("sdf/blanks", {"a.world": b" " * 5_000_000 + b"<"}, "refused", "gazebo")
    yield Case("sdf/comments", {"a.world": b"<!--" * 200_000}, "refused", "gazebo")
    yield Case("sdf/open comments", {"a.world": b"<sdf version='1.7'>" + b"<!-- " * 200_000}, "refused", "gazebo")
    yield Case("sdf/many references", upload("".join(again.format(f"x{k}") for k in range(20_000))), "read")
    lists = {
        "anchor": b"components:\n- {type: {object: custom, reference: t.yaml}, anchor: {position: {x: .nan}}}\n",
        "number": b"components:\n- {type: {object: a, reference: sphere}, radius: 1e999}\n",
        "bool": b"components:\n- {type: {object: a, reference: sphere}, radius: true}\n",
        "itself": b"components:\n- {type: {object: custom, reference: a.yaml}}\n",
        "rows": b"a:\n  coordinates:\n  - x: 1\n    y: {}\n  orientation: 1\n",
    }
    for name, data in lists.items():
        yield Case(f"sdf/list {name}", {"a.yaml": data, "custom_models/t.yaml": data}, "refused", "gazebo")
    inner = b"components:\n" + b"".join(b"- {type: {object: custom, reference: t%d.yaml}}\n" % k for k in range(1, 9))
    tower = {f"custom_models/t{k}.yaml": inner.replace(b"t%d.yaml" % k, b"t0.yaml") for k in range(1, 9)}
    yield Case("sdf/list tower", {"objects.yaml": inner, **tower, "custom_models/t0.yaml": inner}, "refused")


def package_cases() -> Iterator[Case]:
    """Yield environment packages whose parts do not match their paths."""
    datum = b"datum_latitude: 53.2\ndatum_longitude: -0.5\n"
    for name, inside, verdict in (
        (
            "script that runs",
            {"config/environment.sh": b"export A=$(touch /tmp/owned)\nrm -rf /\n", "config/location/datum.yaml": datum},
            "read",
        ),
        (
            "grid without its picture",
            {
                "config/metric/map/map.yaml": b"image: ../../../etc/passwd\nresolution: 1\norigin: [0, 0, 0]\noccupied_thresh: 0.6\nfree_thresh: 0.2\nnegate: 0\n"
            },
            "refused",
        ),
        ("folder called as a file", {"config/location/datum.yaml/map.yaml": datum}, "read"),
        ("nothing but scripts", {"config/properties.sh": b"export A='1'\n"}, "read"),
        ("no map", {"config/location/notes.txt": b"hello"}, "refused"),
        ("empty files", {"config/location/datum.yaml": b""}, "refused"),
        ("damaged inner map", {"config/topological/network.tmap2.yaml": b"nodes: [" * 2000}, "refused"),
    ):
        for end in ("zip", "pkg"):
            yield Case(f"package/{name} {end}", {f"a.{end}": zipped(inside)}, verdict, "environment")  # type: ignore[arg-type]
    inner = {"config/location/datum.yaml": datum}
    for _ in range(6):
        inner = {"config/location/deeper.pkg": zipped(inner), "config/location/datum.yaml": datum}
    yield Case("package/in a package in a package", {"a.pkg": zipped(inner)}, "refused", "environment")


ACCORDING_TO_KIND = (
    yaml_cases,
    xml_cases,
    lanelet_cases,
    package_cases,
    pbf_cases,
    json_cases,
    picture_cases,
    satellite_cases,
    archive_cases,
    folder_cases,
    network_cases,
    cloud_cases,
    sdf_cases,
)


def cases() -> list[Case]:
    """List all cases."""
    return [case for kind in ACCORDING_TO_KIND for case in kind()]


# --- damage ------------------------------------------------------------------------------------------------------

VALUES = (
    b"nan", b".nan", b"-.inf", b"1e999", b"9" * 5000, b"18446744073709551616", b"-1", b"0", b"true", b"null", b"[]", b"{}",
    b"''", b'""', b"\xed\xa0\x80", b"\0", b"&", b"<", b"*a", b"&a", b"\xe2\x80\xae", b"91", b"-181", b"[" * 500, b"{" * 500,
)  # fmt: skip


def damaged(data: bytes, seed: int, count: int) -> Iterator[bytes]:
    """Yield ``count`` damaged copies: cut, flipped, doubled, with other values, with moved lines."""
    dice = random.Random(seed)
    for k in range(count):
        kind = k % 6
        if kind == 0:
            yield data[: dice.randrange(len(data))]
        elif kind == 1:
            flipped = bytearray(data)
            for _ in range(dice.choice([1, 1, 3, 20])):
                flipped[dice.randrange(len(flipped))] ^= 1 << dice.randrange(8)
            yield bytes(flipped)
        elif kind == 2:
            a, b = sorted(dice.sample(range(len(data) + 1), 2))
            yield data[:a] + data[b:] if dice.random() < 0.5 else data[:b] + data[a:b] + data[b:]
        elif kind == 3:
            start = dice.randrange(len(data))
            digits = [j for j in range(start, len(data)) if 48 <= data[j] <= 57] or [start]
            a = b = digits[0]
            while b < len(data) and data[b] in b"0123456789.":
                b += 1
            yield data[:a] + dice.choice(VALUES) + data[b:]
        elif kind == 4:
            at = dice.randrange(len(data))
            yield data[:at] + dice.choice(VALUES) + data[at:]
        else:
            lines = data.split(b"\n")
            a, b = dice.randrange(len(lines)), dice.randrange(len(lines))
            lines[a], lines[b] = lines[b], lines[a]
            yield b"\n".join(lines)


def sample_maps() -> list[tuple[str, dict[str, bytes]]]:
    """List (format, files) of each of our own samples."""
    out = []
    for folder in sorted(SAMPLES.iterdir()):
        for item in sorted(folder.iterdir()):
            if item.is_dir():
                paths = [p for p in sorted(item.rglob("*")) if p.is_file() and not p.name.endswith("facts.json")]
                out.append((folder.name, {p.relative_to(item).as_posix(): p.read_bytes() for p in paths}))
            elif not item.name.endswith("facts.json"):
                out.append((folder.name, {item.name: item.read_bytes()}))
    return out
