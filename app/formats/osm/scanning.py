"""Fast parser for OSM XML in the form of the OSM tools."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import NoReturn
from xml.parsers import expat

import numpy as np
from numpy.typing import NDArray

from app.errors import Problem, TooLarge, UnreadableFile
from app.formats.osm.elements import Attributes, Data, Relation, Tags, Way, check_values
from app.limits import Limits
from app.model.features import shared_key_dict


def unescape(text: bytes) -> str:
    """Attribute value as text."""
    return _ENTITY.sub(_character, text.decode()) if b"&" in text else text.decode()


_ENTITY = re.compile(r"&(?:(lt|gt|amp|quot|apos)|#(\d{1,7})|#x([0-9a-fA-F]{1,6}));")
_NAMED = {"lt": "<", "gt": ">", "amp": "&", "quot": '"', "apos": "'"}


def _character(match: re.Match[str]) -> str:
    name, decimal, hexadecimal = match.groups()
    return _NAMED[name] if name else chr(int(decimal) if decimal else int(hexadecimal, 16))


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
    rb'|role="([^"<\t\r\n]*)" ref="(-?\d{1,19})") ?/>'  # form of Autoware's editors
)
_BOUNDS = re.compile(rb'<bounds((?>(?: [\w:.-]+="[^"<\t\r\n]*")*)) ?/>')


def _pair(two: bytes) -> int:
    return two[0] * 256 + two[1]


SCAN_BYTES = 2**20
"""Number of bytes of nodes that are scanned at once."""

MAX_CACHED_TEXTS, PATTERNS = 2**14, 64
"""Maximum number of attribute values, and of lists of attribute names, that are cached for the next elements."""

_TAG_STARTS = {
    _pair(p) for p in (b"?x", b"os", b"/o", b"bo", b"no", b"/n", b"wa", b"/w", b"re", b"/r", b"nd", b"ta", b"me")
}


def scan(data: bytes, limits: Limits, highways_only: bool) -> Data | None:
    """Parse regular OSM XML fast; return None for irregular files. Raises if not well-formed or numbers are invalid."""
    encoding = _ENCODING.search(data[:256])
    root = _ROOT.match(data)
    if not root or (encoding and encoding[1].lower() not in (b"utf-8", b"utf8", b"us-ascii", b"ascii")):
        return None
    count = _count_elements(data, limits)
    if count is None:
        return None
    _check_well_formed(data)
    nodes = _scan_nodes(data)
    bounds = _BOUNDS.findall(data, root.end()) if count[b"bo"] else []
    if len(nodes.ids) != count[b"no"] or len(bounds) != count[b"bo"]:
        return None
    children = _Children()
    tags = _scan_node_tags(data, nodes.tagged, children) if count[b"/n"] else {}
    ways = None if tags is None else _scan_ways(data, children, highways_only)
    if tags is None or ways is None:
        return None
    relations = _scan_relations(data, children) if count[b"re"] and not highways_only else []
    if relations is None or not children.regular:
        return None
    seen = (children.nds, children.members, children.tagged, len(ways), len(relations))
    if not highways_only and seen != tuple(count[p] for p in (b"nd", b"me", b"ta", b"wa", b"re")):
        return None
    osm_data = Data(
        nodes.ids,
        np.concatenate(nodes.lonlat),
        tags,
        children.cached_attributes(nodes.texts),
        ways,
        relations,
        _attributes(root[1]),
        [_attributes(b) for b in bounds],
        [],
    )
    check_values(osm_data, lambda k: _line_of_node(data, k))
    return osm_data


def _count_elements(data: bytes, limits: Limits) -> dict[bytes, int] | None:
    """Count elements by the first two bytes of their names; None if the file is irregular."""
    buffer = np.frombuffer(data, np.uint8)
    opened = np.flatnonzero(buffer[:-2] == ord("<"))
    # No attribute contains "<", so the longest stretch without one bounds the length of all attributes.
    if len(opened) and int(np.diff(opened, append=len(data)).max()) > limits.xml_attribute_bytes:
        return None
    if len(opened) > 8 * limits.features:
        raise TooLarge(f"the file has {len(opened)} elements, too many for the limit of {limits.features} features")
    codes = np.bincount(buffer[opened + 1].astype(np.int32) * 256 + buffer[opened + 2], minlength=65536)
    if (
        not {int(c) for c in np.flatnonzero(codes)} <= _TAG_STARTS
        or codes[_pair(b"os")] != 1
        or codes[_pair(b"?x")] > 1
    ):
        return None
    return {p: int(codes[_pair(p)]) for p in (b"no", b"/n", b"wa", b"re", b"nd", b"ta", b"me", b"bo")}


@dataclass(slots=True)
class _Nodes:
    """Columns of nodes.

    lonlat: [k, 2] per piece of the file. texts: further attributes. tagged: indexes of nodes with tags.
    """

    ids: list[int] = field(default_factory=list)
    lonlat: list[NDArray[np.float64]] = field(default_factory=list)
    texts: list[bytes] = field(default_factory=list)
    tagged: list[int] = field(default_factory=list)


def _scan_nodes(data: bytes) -> _Nodes:
    nodes = _Nodes()
    at = 0
    while at < len(data):  # by pieces: matches need far more memory than their results
        end = data.find(b"<node ", at + SCAN_BYTES)
        end = len(data) if end < 0 else end
        rows = _NODE.findall(data, at, end)
        nodes.tagged += [k for k, row in enumerate(rows, len(nodes.ids)) if not row[5]]
        nodes.ids += [int(row[0]) for row in rows]
        nodes.texts += [row[1] + row[4] for row in rows]
        nodes.lonlat.append(np.array([(float(row[3]), float(row[2])) for row in rows]).reshape(-1, 2))
        at = end
    return nodes


def _scan_node_tags(data: bytes, tagged: list[int], children: _Children) -> dict[int, Tags] | None:
    """Return the tags of these nodes, by index; None if the file is irregular."""
    pieces = data.split(b"</node>")
    pieces.pop()
    if len(pieces) != len(tagged):
        return None
    tags: dict[int, Tags] = {}
    seen = 0
    for k, piece in zip(tagged, pieces, strict=True):
        seen += piece.count(b"<node ")
        if seen != k + 1:
            # A node inside another one: the strict parser reports it.
            return None
        body = piece[piece.rfind(b"<node ") :]
        tags[k] = children.tags(body, 1)
    return tags


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
    """Cache of raw attribute values decoded to text: keys and values of tags repeat a lot."""

    def __missing__(self, raw: bytes) -> str:
        if len(self) >= MAX_CACHED_TEXTS:
            self.clear()  # times and changesets hardly repeat
        text = self[raw] = unescape(raw)
        return text


class _Children:
    """Reader and counter of the elements inside nodes, ways and relations.

    ``regular`` becomes False at the first irregular element.
    """

    __slots__ = ("alike", "members", "nds", "regular", "tagged", "texts")

    def __init__(self) -> None:
        self.nds = self.members = self.tagged = 0
        self.regular = True
        self.texts = _Texts()
        self.alike: dict[tuple[bytes, ...], Attributes] = {}

    def attributes(self, text: bytes) -> Attributes:
        """Return the attributes in this part of a tag."""
        return self.mapping(_ATTRIBUTE.findall(text))

    def cached_attributes(self, texts: list[bytes]) -> Callable[[int], Attributes]:
        """Return the attributes in each of these texts, by index; equal texts share one mapping."""
        cache: dict[bytes, Attributes] = {}

        def attributes(k: int) -> Attributes:
            text = texts[k]
            cached = cache.get(text)
            if cached is None:
                cached = cache[text] = self.attributes(text)
            return cached

        return attributes

    def mapping(self, pairs: list[tuple[bytes, bytes]]) -> dict[str, str]:
        """Return keys and values as texts. Mappings with equal keys share their key table."""
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
        """Return the tags in an element's body that has ``other_count`` further elements."""
        pairs = _TAG.findall(body)
        self.tagged += len(pairs)
        if body.count(b"<") != len(pairs) + other_count:
            self.regular = False
        out = self.mapping(pairs)
        if len(out) != len(pairs):
            # A repeated key: the strict parser reports it.
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
        # For the network alone only the deletion mark matters.
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
    """Return attributes and body of each ``<name `` element; only of those that contain ``holding``."""
    close = b"</" + name + b">"
    for part in data.split(b"<" + name + b" ")[1:]:
        tag = part.find(b">")
        if part[tag - 1 : tag] == b"/":
            cut = part[: tag + 1]
        elif close not in part:
            # Nested elements are irregular.
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
