"""Strict parser for OSM: any valid XML with the irregularities of real files, and PBF."""

from __future__ import annotations

import re
from io import BytesIO
from typing import Any, NoReturn

import numpy as np
from lxml import etree

from app.errors import Problem, TooLarge, UnreadableFile
from app.formats.osm.elements import (
    DATA,
    EXTRAS,
    MAX_UNKNOWN_DEPTH,
    Attributes,
    Data,
    Relation,
    Tags,
    Unknown,
    Way,
    check_values,
)
from app.limits import Limits
from app.syntax import xml

_INTEGER = re.compile(r"\s*[+-]?\d{1,19}\s*", re.ASCII)
_DECIMAL = re.compile(r"\s*[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d{1,3})?\s*", re.ASCII)


def read_events(data: bytes, limits: Limits) -> Data:
    """Parser for any valid OSM XML, event by event with lxml."""
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
            _raise_unreadable(f"not an OSM file: its root is <{root.tag}>, not <osm>", root)
        if root.getroottree().docinfo.internalDTD is not None:
            _raise_unreadable("DOCTYPE and entity declarations are not accepted: remove them", root)
        self.root = self.attributes(root)

    def check_name(self, element: etree._Element) -> None:
        if element.tag not in DATA | EXTRAS | {"bounds", "bound"}:
            _raise_unreadable(f"<{element.tag}> is not an element of OSM files", element)

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
                    self.warn(f"duplicate tag {child_attributes['k']}; the last one is used", child, element, identity)
                tags[child_attributes["k"]] = child_attributes.get("v", "")
            elif child.tag == "nd" and element.tag == "way":
                refs.append(_integer(child_attributes.get("ref"), child, "ref"))
            elif child.tag == "member" and element.tag == "relation":
                kind = child_attributes.get("type", "")
                if kind not in ("node", "way", "relation"):
                    _raise_unreadable(f"a member's type must be node, way or relation, got {kind!r}", child)
                members.append(
                    (kind, _integer(child_attributes.get("ref"), child, "ref"), child_attributes.get("role", ""))
                )
            else:
                children.append(self.unknown(child))
                self.warn(f"<{child.tag}> inside <{element.tag}> is not defined by OSM", child, element, identity)
        if element.tag == "node":
            self.node(element, identity, attributes, tags, children)
        elif element.tag == "way":
            self.ways.append(Way(identity, refs, tags, attributes, children))
        else:
            self.relations.append(Relation(identity, members, tags, attributes, children))
        if len(self.ids) + len(self.ways) + len(self.relations) > self.limits.features:
            raise TooLarge(f"the file has more elements than the limit of {self.limits.features}")

    def unknown(self, element: etree._Element, depth: int = 1) -> Unknown:
        """Return an element as stored, with its children. Raises UnreadableFile for data inside other data."""
        if (element.tag in DATA and len(element)) or depth > MAX_UNKNOWN_DEPTH:
            _raise_unreadable(
                f"<{element.tag}> inside <{element.getparent().tag}> is not allowed in an OSM file", element
            )
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
        check_values(osm_data, self.lines.__getitem__)
        return osm_data


def _raise_unreadable(reason: str, element: etree._Element) -> NoReturn:
    raise UnreadableFile(reason, [Problem(reason, line=element.sourceline, where=f"<{element.tag}>")])


def _integer(text: str | None, element: etree._Element, name: str) -> int:
    if text is None or not _INTEGER.fullmatch(text):
        _raise_unreadable(f"<{element.tag}> needs an integer as its {name}, got {str(text)[:40]!r}", element)
    return int(text)


def _degrees(text: str, element: etree._Element) -> float:
    if len(text) > 64 or not _DECIMAL.fullmatch(text):
        _raise_unreadable(f"a node's position must be a finite number of degrees, got {text[:40]!r}", element)
    return float(text)


def read_pbf(data: bytes, limits: Limits) -> Data:
    """Parser for ``.pbf``, based on the OSM project's library, which limits blocks to 32 MiB; we limit the elements."""
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
                raise TooLarge(f"the file has more elements than the limit of {limits.features}")
    except (RuntimeError, ValueError) as error:
        raise UnreadableFile(f"not a readable PBF file: {error}", [Problem(str(error))]) from error
    return out.finish()


def _read_pbf_object(out: _StrictParser, item: Any) -> int:
    """Store one object and return its approximate size in bytes."""
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
