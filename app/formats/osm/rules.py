"""Consumer checks for OSM XML: osmium, GDAL, JOSM and OpenStreetMap editors.

Sources: libosmium's XML input (``version`` 0.6, nodes, ways, relations), osmium-tool's manual (files are sorted by type
and id; ids and versions are positive in data of the database), GDAL's OSM driver (negative ids need
OSM_USE_CUSTOM_INDEXING=NO; nodes before ways before relations), the OSM API 0.6.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import pairwise

from lxml import etree

from app.errors import Problem
from app.formats import Files
from app.formats._rules import HEAD_BYTES, LIMITS, duplicates, error_finding, is_brief, names, warning_finding
from app.formats.osm import parsing
from app.syntax import xml

KINDS = ("node", "way", "relation")
MAX_WAY_NODES = 2000
"""Maximum number of nodes of a way: the API's limit."""


def check(files: Files) -> Iterator[Problem]:
    """Check an XML file, also compressed, by its readers' rules; PBF has a strict layout and is not checked."""
    main = next(iter(files))
    if parsing.is_pbf(files[main]):
        return
    if is_brief(files[main]):
        if not re.search(rb"""<osm\b[^>]*\bversion=["']0\.6["']""", files[main][:HEAD_BYTES]):
            yield error_finding("must be 0.6", main, where="version")
        return
    root = xml.parse(parsing.unpack(files[main], LIMITS), LIMITS)
    if root.tag not in ("osm", "osmChange"):
        yield error_finding(f"the root is <{root.tag}>, not <osm>", main, line=root.sourceline)
        return
    if root.get("version") != "0.6":
        yield error_finding(f"must be 0.6, got {root.get('version')!r}", main, line=root.sourceline, where="version")
    elements = _ElementScan()
    try:
        elements.read_element(root)
    except (TypeError, ValueError):
        yield error_finding("an id or ref is missing or not an integer", main, line=elements.line)
        return
    for kind, ids in elements.ids.items():
        if repeats := duplicates(ids):
            yield warning_finding(f"{len(repeats)} duplicate {kind} ids: {names(repeats)}", main)
        if new := [i for i in ids if i < 0]:
            reason = (
                f"{len(new)} new {kind}s have negative ids, as in JOSM; GDAL reads them only with "
                "OSM_USE_CUSTOM_INDEXING=NO"
            )
            yield warning_finding(reason, main)
        if bare := elements.bare[kind]:
            yield warning_finding(
                f"{bare} {kind}s have no version of at least 1, which osmium needs to merge changes", main
            )
    if elements.nowhere:
        yield error_finding(f"{len(elements.nowhere)} nodes have no position: {names(elements.nowhere)}", main)
    if absent := sorted(elements.refs - set(elements.ids["node"])):
        yield warning_finding(f"{len(absent)} nodes of ways are missing in the file: {names(absent)}", main)
    if elements.long:
        yield warning_finding(
            f"{len(elements.long)} ways have more than {MAX_WAY_NODES} nodes: {names(elements.long)}", main
        )
    if root.tag == "osm":
        yield from _order(elements, main)


@dataclass(slots=True)
class _ElementScan:
    """Findings of one pass over the elements. kinds: in order of occurrence, once per run."""

    ids: dict[str, list[int]] = field(default_factory=lambda: {kind: [] for kind in KINDS})
    bare: Counter[str] = field(default_factory=Counter)
    refs: set[int] = field(default_factory=set)
    nowhere: list[int] = field(default_factory=list)
    long: list[int] = field(default_factory=list)
    kinds: list[str] = field(default_factory=list)
    line: int | None = None

    def read_element(self, parent: etree._Element) -> None:
        """Collect all elements below the root; a change file has blocks of them.

        Raises TypeError or ValueError for values that are not numbers.
        """
        for element in parent:
            kind = element.tag
            if kind not in self.ids:
                if kind in ("create", "modify", "delete"):
                    self.read_element(element)
                continue
            attributes = element.attrib
            self.line = element.sourceline
            i = int(str(attributes["id"]) if "id" in attributes else "")
            self.ids[str(kind)].append(i)
            if not self.kinds or self.kinds[-1] != kind:
                self.kinds.append(str(kind))
            if i > 0 and not str(attributes.get("version", "")).isdigit():
                self.bare[str(kind)] += 1
            if kind == "node":
                is_deleted = (
                    attributes.get("action") == "delete"
                    or attributes.get("visible") == "false"
                    or parent.tag == "delete"
                )
                if not is_deleted and ("lat" not in attributes or "lon" not in attributes):
                    self.nowhere.append(i)
            elif kind == "way":
                refs = [int(nd.get("ref", "")) for nd in element.iterchildren("nd")]
                self.refs.update(refs)
                if len(refs) > MAX_WAY_NODES:
                    self.long.append(i)


def _order(elements: _ElementScan, main: str) -> Iterator[Problem]:
    if elements.kinds != [kind for kind in KINDS if kind in elements.kinds]:
        yield warning_finding(
            "types are mixed; GDAL and osmium require all nodes, then all ways, then all relations", main
        )
        return
    for kind, ids in elements.ids.items():
        if any(b < a for a, b in pairwise(i for i in ids if i > 0)):
            yield warning_finding(f"{kind}s are not sorted by id; some osmium commands need `osmium sort` first", main)
            return
