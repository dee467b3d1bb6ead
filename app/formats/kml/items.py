"""Placemarks and overlays of a KML tree."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

from lxml import etree

from app.formats.kml.words import CONTAINERS, GEOMETRIES, ITEMS, child, local_name, unspell
from app.model.features import MAX_ID


@dataclass(slots=True)
class Item:
    """Placemark or overlay of a KML tree that is being read."""

    element: etree._Element
    title: etree._Element | None = None
    data: list[tuple[str, etree._Element]] = field(default_factory=list)
    geometries: list[etree._Element] = field(default_factory=list)
    sequences: list[tuple[str, int, etree._Element]] = field(default_factory=list)
    shape: str = ""


def find_items(root: etree._Element) -> list[Item]:
    """Return the placemarks and overlays of the document that are only inside containers.

    Elsewhere, such as in an Update or an unknown element, they are part of that element.
    """
    usable: dict[etree._Element, bool] = {}

    def contained(element: etree._Element) -> bool:
        chain = []
        while element is not None and element not in usable:
            chain.append(element)
            if local_name(element) not in CONTAINERS:
                usable[element] = False
                break
            element = element.getparent()
        answer = True if element is None else usable[element]
        usable.update(dict.fromkeys(chain, answer))
        return answer

    items: list[Item] = []
    index: dict[etree._Element, Item] = {}
    for element in root.iter(*(f"{{*}}{name}" for name in sorted(ITEMS))):
        parent = element.getparent()
        if parent is None or usable.get(parent) or contained(parent):
            item = Item(element)
            items.append(item)
            index[element] = item
    for g in root.iter(*(f"{{*}}{name}" for name in sorted(GEOMETRIES))):
        owner = index.get(g.getparent())
        if owner is not None:
            owner.geometries.append(g)
    for tag in root.iter("{*}name"):
        owner = index.get(tag.getparent())
        if owner is not None and owner.title is None:
            owner.title = tag
    for extended in root.iter("{*}ExtendedData"):
        owner = index.get(extended.getparent())
        if owner is not None:
            owner.data += extended_values(extended)
    return items


def extended_values(extended: etree._Element) -> list[tuple[str, etree._Element]]:
    """Return the plain values of an ExtendedData as (name, element with the value), the first of each name."""
    out: dict[str, etree._Element] = {}
    for entry in extended.iter("{*}Data", "{*}SimpleData"):
        name = entry.get("name")
        if local_name(entry) == "SimpleData":
            value = entry
        else:
            value = entry[0] if len(entry) == 1 and local_name(entry[0]) == "value" else child(entry, "value")
        if name and value is not None and not len(value) and name not in out:
            out[name] = value
    return list(out.items())


def own_words(data: Iterable[tuple[str, etree._Element]], names: frozenset[str]) -> dict[str, str]:
    """Return the values by name as texts; for these names without the quotes that ``spell`` adds around numbers."""
    values = {name: value.text or "" for name, value in data}
    for name in names & values.keys():
        value = unspell(values[name])
        values[name] = value if isinstance(value, str) else values[name]
    return values


def usable_text(text: str) -> str:
    """Return a text as an id: printable and not too long."""
    if text.isprintable() and 0 < len(text) <= MAX_ID - 12 and text[0] != " " != text[-1]:
        return text
    clean = "".join(c if c.isprintable() else " " for c in text).strip()
    return clean[: MAX_ID - 12] or "_"
