"""OpenStreetMap files -> nodes, ways and relations as columns, whatever the container: XML, compressed XML, PBF.

Two ways through XML. Files as the OSM tools write them (double quotes, one attribute order, no comments) are checked
by expat, which needs no memory, and scanned by regular expressions whose matches are counted against the tags that
are there. Anything else goes through lxml's event parser, which is slower and authoritative: whatever the quick way
does not understand, it leaves to that one.
"""

from __future__ import annotations

import bz2
import re
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from io import BytesIO
from itertools import chain
from typing import Any, NoReturn
from xml.parsers import expat

import numpy as np
from lxml import etree
from numpy.typing import NDArray

from app.errors import Problem, TooLarge, UnreadableFile
from app.limits import Limits
from app.model.features import shared_key_dict
from app.syntax import xml

Attributes = dict[str, str]
Tags = dict[str, str]

INT64 = 2**63

EXTRAS = frozenset({"note", "meta", "remark", "MetaInfo", "changeset"})
"""Elements beside the data that Overpass, JOSM and Autoware's editor write. Any other is refused, as osmcode's tests
ask."""

DATA = frozenset({"node", "way", "relation"})

MAX_UNKNOWN_DEPTH = 8
"""Levels of unknown elements inside each other."""

Unknown = list[Any]
"""An element that is kept as it is: [name, attributes, text, elements in it], without empty ones at the end."""


@dataclass(slots=True)
class Way:
    """A way: its nodes by id, in order. children: elements that OSM does not know."""

    id: int
    refs: list[int]
    tags: Tags
    attributes: Attributes
    children: list[Unknown] = field(default_factory=list)


@dataclass(slots=True)
class Relation:
    """A relation: members as (type, id, role)."""

    id: int
    members: list[tuple[str, int, str]]
    tags: Tags
    attributes: Attributes
    children: list[Unknown] = field(default_factory=list)


@dataclass(slots=True)
class Data:
    """What an OSM file says.

    ids: of the nodes, in the file's order. lonlat: float64 [n, 2] degrees, NaN where a node has no place. tags: by the
    node's place in ``ids``, only for those that have any. attributes(k): the further attributes of node k, one shared
    mapping for equal ones. root, bounds, elements: what the file says as a whole.
    """

    ids: list[int]
    lonlat: NDArray[np.float64]
    tags: dict[int, Tags]
    attributes: Callable[[int], Attributes]
    ways: list[Way]
    relations: list[Relation]
    root: Attributes
    bounds: list[Attributes]
    elements: list[Unknown]
    node_children: dict[int, list[Unknown]] = field(default_factory=dict)
    problems: list[tuple[str, int | None, str]] = field(default_factory=list)


def parse(data: bytes, limits: Limits, *, highways_only: bool = False) -> Data:
    """Any OSM container. highways_only: leave out ways without a ``highway`` tag, and relations.

    Raises UnreadableFile (with a line where there is one) or TooLarge.
    """
    if is_pbf(data):
        return _pbf(data, limits)
    data = unpack(data, limits)
    if is_pbf(data):
        return _pbf(data, limits)
    if not data.strip():
        raise UnreadableFile("the file is empty", [Problem("empty file", line=1)])
    xml.check_prolog(data)
    return _scan(data, limits, highways_only) or _events(data, limits)


def unpack(data: bytes, limits: Limits, limit: int | None = None) -> bytes:
    """The content of a ``.gz`` or ``.bz2``, else the bytes as they are; most: stop there (to look at the beginning)."""
    if data[:2] == b"\x1f\x8b":
        new: Callable[[], Any] = lambda: zlib.decompressobj(wbits=31)  # noqa: E731
    elif data[:3] == b"BZh":
        new = bz2.BZ2Decompressor
    else:
        return data
    out, remainder, size = [], data, 0
    bound = limits.max_unpacked(len(data)) if limit is None else limit
    try:
        while remainder:
            stream = new()
            while not stream.eof:
                piece = stream.decompress(remainder, 2**20)
                out.append(piece)
                size += len(piece)
                if size > bound:
                    if limit is not None:
                        return b"".join(out)[:limit]
                    limits.check_unpacked(size, len(data))
                remainder = stream.unconsumed_tail if hasattr(stream, "unconsumed_tail") else b""
                if not piece and not remainder and not stream.eof:
                    if limit is not None:
                        return b"".join(out)
                    raise UnreadableFile("the compressed file ends before its end", [Problem("truncated")])
            remainder = stream.unused_data
    except (zlib.error, OSError) as error:
        if limit is not None:
            return b"".join(out)
        raise UnreadableFile(f"the file cannot be decompressed: {error}", [Problem(str(error))]) from error
    return b"".join(out)


def is_pbf(data: bytes) -> bool:
    """Whether these bytes begin like a ``.pbf``: a length and the type of its first block."""
    return data[4:6] == b"\x0a\x09" and data[6:15] == b"OSMHeader"


def unescape(text: bytes) -> str:
    """An attribute's value as text."""
    return _ENTITY.sub(_character, text.decode()) if b"&" in text else text.decode()


_ENTITY = re.compile(r"&(?:(lt|gt|amp|quot|apos)|#(\d{1,7})|#x([0-9a-fA-F]{1,6}));")
_NAMED = {"lt": "<", "gt": ">", "amp": "&", "quot": '"', "apos": "'"}


def _character(match: re.Match[str]) -> str:
    name, decimal, hexadecimal = match.groups()
    return _NAMED[name] if name else chr(int(decimal) if decimal else int(hexadecimal, 16))


# --- the quick way through XML -----------------------------------------------------------------------------------

_ROOT = re.compile(
    rb'(?:\xef\xbb\xbf)?\s*+(?:<\?xml(?:[^>"\']|"[^"<>]*"|\'[^\'<>]*\')*\?>\s*+)?<osm((?>(?:\s+[\w:.-]+="[^"<]*")*))\s*+>'
)
_ENCODING = re.compile(rb"<\?xml[^>]*encoding\s*=\s*[\"']([\w.-]+)[\"']")
_ATTRIBUTE = re.compile(rb'([\w:.-]+)="([^"<\t\r\n]*)"')
_MORE = rb'((?>(?: (?!id="|lat="|lon=")[A-Za-z_][\w:.-]*+="[^"<\t\r\n]*+")*))'
_DEGREES = rb'"(-?\d+(?:\.\d+)?)"'
_NODE = re.compile(
    rb'<node id="(-?\d{1,19})"' + _MORE + b" lat=" + _DEGREES + b" lon=" + _DEGREES + _MORE + rb" ?(/?)>"
)
_HEAD = re.compile(rb'id="(-?\d{1,19})"' + _MORE + rb" ?(/?)>")
_ND = re.compile(rb'<nd ref="(-?\d{1,19})" ?/>')
_TAG = re.compile(rb'<tag k="([^"<\t\r\n]*)" v="([^"<\t\r\n]*)" ?/>')
_MEMBER = re.compile(
    rb'<member type="(node|way|relation)" (?:ref="(-?\d{1,19})" role="([^"<\t\r\n]*)"'
    rb'|role="([^"<\t\r\n]*)" ref="(-?\d{1,19})") ?/>'  # as Autoware's editors write it
)
_BOUNDS = re.compile(rb'<bounds((?>(?: [\w:.-]+="[^"<\t\r\n]*")*)) ?/>')


def _pair(two: bytes) -> int:
    return two[0] * 256 + two[1]


SCAN_BYTES = 2**20
"""Bytes of nodes that are looked at together."""

MAX_CACHED_TEXTS, PATTERNS = 2**14, 64
"""Attribute values, and lists of attribute names, that are kept for the next element."""

_KNOWN = {_pair(p) for p in (b"?x", b"os", b"/o", b"bo", b"no", b"/n", b"wa", b"/w", b"re", b"/r", b"nd", b"ta", b"me")}


def _scan(data: bytes, limits: Limits, highways_only: bool) -> Data | None:
    """The quick way, or None where the file is not regular. Raises where it is not well-formed or holds bad numbers."""
    encoding = _ENCODING.search(data[:256])
    root = _ROOT.match(data)
    if not root or (encoding and encoding[1].lower() not in (b"utf-8", b"utf8", b"us-ascii", b"ascii")):
        return None
    buffer = np.frombuffer(data, np.uint8)
    opened = np.flatnonzero(buffer[:-2] == ord("<"))
    # No "<" stands inside an attribute, so the longest stretch without one bounds them all.
    if len(opened) and int(np.diff(opened, append=len(data)).max()) > limits.xml_attribute_bytes:
        return None
    if len(opened) > 8 * limits.features:
        raise TooLarge(
            f"the file has {len(opened)} elements; with {limits.features} features as the limit that is too much"
        )
    codes = np.bincount(buffer[opened + 1].astype(np.int32) * 256 + buffer[opened + 2], minlength=65536)
    if not {int(c) for c in np.flatnonzero(codes)} <= _KNOWN or codes[_pair(b"os")] != 1 or codes[_pair(b"?x")] > 1:
        return None
    del buffer, opened
    _check_well_formed(data)
    count = {p: int(codes[_pair(p)]) for p in (b"no", b"/n", b"wa", b"re", b"nd", b"ta", b"me", b"bo")}
    ids: list[int] = []
    places: list[NDArray[np.float64]] = []
    texts: list[bytes] = []
    tagged: list[int] = []
    at = 0
    while at < len(data):  # a piece at a time: the matches take far more memory than what is kept of them
        end = data.find(b"<node ", at + SCAN_BYTES)
        end = len(data) if end < 0 else end
        rows = _NODE.findall(data, at, end)
        tagged += [k for k, row in enumerate(rows, len(ids)) if not row[5]]
        ids += [int(row[0]) for row in rows]
        texts += [row[1] + row[4] for row in rows]
        places.append(np.array([(float(row[3]), float(row[2])) for row in rows]).reshape(-1, 2))
        at = end
    del rows
    bounds = _BOUNDS.findall(data, root.end()) if count[b"bo"] else []
    if len(ids) != count[b"no"] or len(bounds) != count[b"bo"]:
        return None
    children = _Children()
    tags: dict[int, Tags] = {}
    if count[b"/n"]:
        pieces = data.split(b"</node>")
        pieces.pop()
        if len(pieces) != len(tagged):
            return None
        seen = 0
        for k, piece in zip(tagged, pieces, strict=True):
            seen += piece.count(b"<node ")
            if seen != k + 1:
                # A node inside another one: the careful way tells of it.
                return None
            body = piece[piece.rfind(b"<node ") :]
            tags[k] = children.tags(body, 1)
    ways = _scan_ways(data, children, highways_only)
    relations = _scan_relations(data, children) if count[b"re"] and not highways_only else []
    if ways is None or relations is None or not children.regular:
        return None
    if not highways_only and (children.nds, children.members, children.tagged) != (
        count[b"nd"],
        count[b"me"],
        count[b"ta"],
    ):
        return None
    if not highways_only and (len(ways), len(relations)) != (count[b"wa"], count[b"re"]):
        return None
    cache: dict[bytes, Attributes] = {}

    def attributes(k: int) -> Attributes:
        text = texts[k]
        cached = cache.get(text)
        if cached is None:
            cached = cache[text] = children.attributes(text)
        return cached

    osm_data = Data(
        ids,
        np.concatenate(places),
        tags,
        attributes,
        ways,
        relations,
        _attributes(root[1]),
        [_attributes(b) for b in bounds],
        [],
    )
    _check(osm_data, lambda k: _line_of_node(data, k))
    return osm_data


def _check_well_formed(data: bytes) -> None:
    parser = expat.ParserCreate()

    def refuse(*_: object) -> NoReturn:
        reason = "DOCTYPE and entity declarations are not accepted: remove them"
        raise UnreadableFile(reason, [Problem(reason, line=parser.CurrentLineNumber)])

    parser.StartDoctypeDeclHandler = refuse
    try:
        parser.Parse(data, True)
    except expat.ExpatError as error:
        reason = expat.errors.messages[error.code]
        raise UnreadableFile(f"not well-formed XML: {reason}", [Problem(reason, line=error.lineno)]) from error


class _Texts(dict[bytes, str]):
    """Raw attribute values -> text, the repeated ones worked out once: keys and values of tags repeat a lot."""

    def __missing__(self, raw: bytes) -> str:
        if len(self) >= MAX_CACHED_TEXTS:
            self.clear()  # times and changesets hardly repeat
        text = self[raw] = unescape(raw)
        return text


class _Children:
    """Reads the elements inside nodes, ways and relations, counting them; ``regular`` falls at the first odd one."""

    __slots__ = ("alike", "members", "nds", "regular", "tagged", "texts")

    def __init__(self) -> None:
        self.nds = self.members = self.tagged = 0
        self.regular = True
        self.texts = _Texts()
        self.alike: dict[tuple[bytes, ...], Attributes] = {}

    def attributes(self, text: bytes) -> Attributes:
        """The attributes in this part of a tag."""
        return self.mapping(_ATTRIBUTE.findall(text))

    def mapping(self, pairs: list[tuple[bytes, bytes]]) -> dict[str, str]:
        """Keys and values as texts. Mappings of the same keys share their table of keys."""
        texts = self.texts
        keys = tuple([k for k, _ in pairs])
        pattern = self.alike.get(keys)
        if pattern is None:
            if len(self.alike) >= PATTERNS or len(set(keys)) != len(keys):
                return {texts[k]: texts[v] for k, v in pairs}
            pattern = self.alike[keys] = shared_key_dict(*[texts[k] for k in keys])
        out = pattern.copy()
        for name, (_, v) in zip(pattern, pairs, strict=True):
            out[name] = texts[v]
        return out

    def tags(self, body: bytes, other_count: int) -> Tags:
        """The tags in an element's body that has ``other_count`` further elements."""
        pairs = _TAG.findall(body)
        self.tagged += len(pairs)
        if body.count(b"<") != len(pairs) + other_count:
            self.regular = False
        out = self.mapping(pairs)
        if len(out) != len(pairs):
            # A key twice: the careful way tells of it.
            self.regular = False
        return out


def _scan_ways(data: bytes, children: _Children, highways_only: bool) -> list[Way] | None:
    out = []
    for part in _parts(data, b"way", b'k="highway"' if highways_only else b""):
        head = _HEAD.match(part)
        if head is None:
            return None
        end = head.end()
        refs = [int(r) for r in _ND.findall(part, end)]
        children.nds += len(refs)
        tags = children.tags(part[end:], len(refs))
        # For the network alone it matters only whether the way is still there.
        needed = not highways_only or b'action="delete"' in head[2] or b'visible="false"' in head[2]
        out.append(Way(int(head[1]), refs, tags, children.attributes(head[2]) if needed else {}))
    return out


def _scan_relations(data: bytes, children: _Children) -> list[Relation] | None:
    out = []
    for part in _parts(data, b"relation"):
        head = _HEAD.match(part)
        if head is None:
            return None
        end = head.end()
        rows = _MEMBER.findall(part, end)
        members = [(t.decode(), int(r or other), unescape(role or named)) for t, r, role, named, other in rows]
        children.members += len(members)
        tags = children.tags(part[end:], len(members))
        out.append(Relation(int(head[1]), members, tags, children.attributes(head[2])))
    return out


def _parts(data: bytes, name: bytes, holding: bytes = b"") -> Iterator[bytes]:
    """What stands after each ``<name `` up to its end: its attributes and body; only those with ``holding`` in them."""
    close = b"</" + name + b">"
    for part in data.split(b"<" + name + b" ")[1:]:
        tag = part.find(b">")
        if part[tag - 1 : tag] == b"/":
            cut = part[: tag + 1]
        elif close not in part:
            # One inside another: nothing that this way can read.
            yield b""
            continue
        elif holding not in part:
            continue
        else:
            cut = part[: part.find(close, tag)]
        if holding in cut:
            yield cut


def _attributes(text: bytes) -> Attributes:
    return {k.decode(): unescape(v) for k, v in _ATTRIBUTE.findall(text)}


def _line_of_node(data: bytes, k: int) -> int | None:
    for n, match in enumerate(_NODE.finditer(data)):
        if n == k:
            return data.count(b"\n", 0, match.start()) + 1
    return None


# --- the careful way ---------------------------------------------------------------------------------------------

_INTEGER = re.compile(r"\s*[+-]?\d{1,19}\s*", re.ASCII)
_DECIMAL = re.compile(r"\s*[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d{1,3})?\s*", re.ASCII)


def _events(data: bytes, limits: Limits) -> Data:
    """Event by event with lxml: any legal XML, and every odd thing that real files have."""
    reader = _StrictParser(limits)
    events = etree.iterparse(
        BytesIO(data.lstrip(b"\xef\xbb\xbf \t\r\n")),
        events=("start", "end"),
        resolve_entities=False,
        no_network=True,
        load_dtd=False,
        huge_tree=False,
        remove_comments=True,
        remove_pis=True,
    )
    depth = 0
    for event, element in events:
        if event == "start":
            depth += 1
            if depth == 1:
                reader.read_root(element)
            elif depth == 2:
                reader.check_name(element)
        else:
            if depth == 2:
                reader.read_element(element)
                element.clear()
                while element.getprevious() is not None:
                    del element.getparent()[0]
            depth -= 1
    return reader.finish()


class _StrictParser:
    def __init__(self, limits: Limits) -> None:
        self.limits = limits
        self.root: Attributes = {}
        self.bounds: list[Attributes] = []
        self.elements: list[Unknown] = []
        self.ids: list[int] = []
        self.lonlat: list[tuple[float, float]] = []
        self.lines: list[int] = []
        self.tags: dict[int, Tags] = {}
        self.raw: list[Attributes] = []
        self.shared: dict[tuple[tuple[str, str], ...], Attributes] = {}
        self.ways: list[Way] = []
        self.relations: list[Relation] = []
        self.node_children: dict[int, list[Unknown]] = {}
        self.problems: list[tuple[str, int | None, str]] = []

    def read_root(self, root: etree._Element) -> None:
        if root.tag != "osm":
            _raise_unreadable(f"this is not an OSM file: its root is <{root.tag}>, not <osm>", root)
        if root.getroottree().docinfo.internalDTD is not None:
            _raise_unreadable("DOCTYPE and entity declarations are not accepted: remove them", root)
        self.root = self.attributes(root)

    def check_name(self, element: etree._Element) -> None:
        if element.tag not in DATA | EXTRAS | {"bounds", "bound"}:
            _raise_unreadable(f"<{element.tag}> is no element of an OSM file", element)

    def attributes(self, element: etree._Element) -> Attributes:
        out = xml.attributes(element)
        limit = self.limits.xml_attribute_bytes
        if any(len(v) > limit for v in out.values()):
            _raise_unreadable(f"an attribute is longer than {limit} characters", element)
        return out

    def read_element(self, element: etree._Element) -> None:
        attributes = self.attributes(element)
        if element.tag in ("bounds", "bound"):
            self.bounds.append(attributes)
            return
        if element.tag in EXTRAS:
            row = self.unknown(element)
            self.elements.append([*row, ""] if len(row) == 2 else row)
            return
        identity = _integer(attributes.pop("id", None), element, "id")
        tags: Tags = {}
        refs: list[int] = []
        members: list[tuple[str, int, str]] = []
        children: list[Unknown] = []
        for child in element:
            child_attributes = self.attributes(child)
            if child.tag == "tag" and "k" in child_attributes:
                if child_attributes["k"] in tags:
                    self.warn(
                        f"the tag {child_attributes['k']} stands twice; the last one counts", child, element, identity
                    )
                tags[child_attributes["k"]] = child_attributes.get("v", "")
            elif child.tag == "nd" and element.tag == "way":
                refs.append(_integer(child_attributes.get("ref"), child, "ref"))
            elif child.tag == "member" and element.tag == "relation":
                kind = child_attributes.get("type", "")
                if kind not in ("node", "way", "relation"):
                    _raise_unreadable(f"a member's type must be node, way or relation, not {kind!r}", child)
                members.append(
                    (kind, _integer(child_attributes.get("ref"), child, "ref"), child_attributes.get("role", ""))
                )
            else:
                children.append(self.unknown(child))
                self.warn(f"<{child.tag}> inside <{element.tag}> is not known to OSM", child, element, identity)
        if element.tag == "node":
            self.node(element, identity, attributes, tags, children)
        elif element.tag == "way":
            self.ways.append(Way(identity, refs, tags, attributes, children))
        else:
            self.relations.append(Relation(identity, members, tags, attributes, children))
        if len(self.ids) + len(self.ways) + len(self.relations) > self.limits.features:
            raise TooLarge(f"the file has more than {self.limits.features} elements, which is the limit")

    def unknown(self, element: etree._Element, depth: int = 1) -> Unknown:
        """An element as it stands, and those in it. Data inside other data is refused."""
        if (element.tag in DATA and len(element)) or depth > MAX_UNKNOWN_DEPTH:
            _raise_unreadable(f"<{element.tag}> inside <{element.getparent().tag}> is no part of an OSM file", element)
        inner = [self.unknown(child, depth + 1) for child in element]
        row: Unknown = [str(element.tag), self.attributes(element), (element.text or "").strip(), inner]
        while not row[-1] and len(row) > 2:
            row.pop()
        return row

    def node(
        self,
        element: etree._Element,
        identity: int,
        attributes: Attributes,
        tags: Tags,
        children: list[Unknown],
    ) -> None:
        lat, lon = attributes.get("lat", ""), attributes.get("lon", "")
        if lat and lon:
            at = _degrees(lon, element), _degrees(lat, element)
            del attributes["lat"], attributes["lon"]
        else:
            at = float("nan"), float("nan")
        k = len(self.ids)
        self.ids.append(identity)
        self.lonlat.append(at)
        self.lines.append(element.sourceline or 0)
        self.raw.append(self.shared.setdefault(tuple(attributes.items()), attributes))
        if tags:
            self.tags[k] = tags
        if children:
            self.node_children[k] = children

    def warn(self, problem: str, at: etree._Element, owner: etree._Element, identity: int) -> None:
        self.problems.append((problem, at.sourceline, f"{owner.tag} {identity}"))

    def finish(self) -> Data:
        osm_data = Data(
            self.ids,
            np.array(self.lonlat, np.float64).reshape(-1, 2),
            self.tags,
            self.raw.__getitem__,
            self.ways,
            self.relations,
            self.root,
            self.bounds,
            self.elements,
            self.node_children,
            self.problems,
        )
        _check(osm_data, self.lines.__getitem__)
        return osm_data


def _raise_unreadable(reason: str, element: etree._Element) -> NoReturn:
    raise UnreadableFile(reason, [Problem(reason, line=element.sourceline, where=f"<{element.tag}>")])


def _integer(text: str | None, element: etree._Element, name: str) -> int:
    if text is None or not _INTEGER.fullmatch(text):
        _raise_unreadable(f"<{element.tag}> needs a whole number as its {name}, not {str(text)[:40]!r}", element)
    return int(text)


def _degrees(text: str, element: etree._Element) -> float:
    if len(text) > 64 or not _DECIMAL.fullmatch(text):
        _raise_unreadable(f"a node's place must be a finite number of degrees, not {text[:40]!r}", element)
    return float(text)


def _check(osm_data: Data, line: Callable[[int], int | None]) -> None:
    """Ids within 64 bits, places on earth."""
    refs = chain.from_iterable(way.refs for way in osm_data.ways)
    other_ids = chain((w.id for w in osm_data.ways), (r.id for r in osm_data.relations))
    members = (m[1] for r in osm_data.relations for m in r.members)
    for noun, values in (
        ("node", osm_data.ids),
        ("way's reference", refs),
        ("way or relation", other_ids),
        ("member", members),
    ):
        try:
            np.fromiter(values, np.int64)
        except OverflowError:
            reason = f"the id of a {noun} does not fit into 64 bits"
            raise UnreadableFile(reason, [Problem(reason)]) from None
    bad = (np.abs(osm_data.lonlat) > [180.0, 90.0]).any(axis=1) | np.isinf(osm_data.lonlat).any(axis=1)
    if bad.any():
        k = int(np.flatnonzero(bad)[0])
        lon, lat = osm_data.lonlat[k].tolist()
        reason = f"lat {lat:g}, lon {lon:g} is no place on earth: latitude must be within ±90, longitude within ±180"
        raise UnreadableFile(
            f"node {osm_data.ids[k]}: {reason}", [Problem(reason, line=line(k), where=f"node {osm_data.ids[k]}")]
        )


# --- PBF ---------------------------------------------------------------------------------------------------------


def _pbf(data: bytes, limits: Limits) -> Data:
    """A ``.pbf`` through the OSM project's own library, which bounds each block to 32 MiB; we bound their number."""
    import osmium

    out = _StrictParser(limits)
    try:
        file = osmium.FileProcessor(osmium.io.FileBuffer(data, "pbf"))
        header = file.header
        out.root = {"version": "0.6"}
        if header.get("generator"):
            out.root["generator"] = header.get("generator")
        box = header.box()
        if box.valid():
            low, high = box.bottom_left, box.top_right
            out.bounds.append(
                {"minlat": repr(low.lat), "minlon": repr(low.lon), "maxlat": repr(high.lat), "maxlon": repr(high.lon)}
            )
        size, bound = 0, limits.max_unpacked(len(data))
        for item in file:
            size += _read_pbf_object(out, item)
            if size > bound:
                limits.check_unpacked(size, len(data))
            if len(out.ids) + len(out.ways) + len(out.relations) > limits.features:
                raise TooLarge(f"the file has more than {limits.features} elements, which is the limit")
    except (RuntimeError, ValueError) as error:
        raise UnreadableFile(f"not a readable PBF file: {error}", [Problem(str(error))]) from error
    return out.finish()


def _read_pbf_object(out: _StrictParser, item: Any) -> int:
    """Keep one object; roughly how many bytes it takes."""
    attributes: Attributes = {}
    if item.version:
        attributes["version"] = str(item.version)
    if item.timestamp.timestamp() > 0:
        attributes["timestamp"] = item.timestamp.strftime("%Y-%m-%dT%H:%M:%SZ")
    if item.uid or item.user:
        attributes["uid"] = str(item.uid)
        attributes["user"] = item.user
    if item.changeset:
        attributes["changeset"] = str(item.changeset)
    if not item.visible:
        attributes["visible"] = "false"
    tags = {tag.k: tag.v for tag in item.tags}
    size = 100 + sum(len(k) + len(v) for k, v in tags.items())
    if item.is_node():
        k = len(out.ids)
        out.ids.append(item.id)
        at = item.location
        out.lonlat.append((at.lon, at.lat) if at.valid() else (float("nan"), float("nan")))
        out.lines.append(0)
        out.raw.append(out.shared.setdefault(tuple(attributes.items()), attributes))
        if tags:
            out.tags[k] = tags
        return size
    if item.is_way():
        refs = [node.ref for node in item.nodes]
        out.ways.append(Way(item.id, refs, tags, attributes))
        return size + 8 * len(refs)
    names = {"n": "node", "w": "way", "r": "relation"}
    members = [(names[m.type], m.ref, m.role) for m in item.members]
    out.relations.append(Relation(item.id, members, tags, attributes))
    return size + 32 * len(members)
