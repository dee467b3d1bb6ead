"""Store elements as texts, with slots in place of names and coordinates."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from typing import Any
from urllib.parse import quote

from lxml import etree

from app.errors import Problem, UnreadableFile
from app.formats.kml.items import Item
from app.formats.kml.words import CONTAINERS, COORDINATES, END, FAMILY, ITEMS, NAME, local_name

# Stand-ins for slots while libxml2 holds the tree: four C1 controls in a row, which occur in no text, not even in UTF-8
# misread as Latin-1 (and they keep a Python text at one byte per character). A file that contains them is rejected.
_MARK = "\x91\x9c\x82"
_M_ITEM, _M_COORDINATES, _M_NAME, _M_OPEN, _M_CLOSE, _M_END = (_MARK + chr(0x86 + k) for k in range(6))
_SLOTS = {
    m[-1]: s
    for m, s in ((_M_COORDINATES, COORDINATES), (_M_NAME, NAME), (_M_OPEN, "<?d "), (_M_CLOSE, "?>"), (_M_END, END))
}


def keep_element_text(
    root: etree._Element,
    items: Sequence[Item],
    titles: Sequence[etree._Element | None],
    properties: Sequence[dict[str, Any]],
) -> str:
    """Store each item's element as text with slots in its properties; return the rest of the document."""
    names = values = coordinates = 0
    for item, title, item_properties in zip(items, titles, properties, strict=True):
        if title is not None:
            title.text = _M_NAME
            names += 1
        for label, value in item.data:
            value.text = f"{_M_OPEN}{quote(label)}{_M_CLOSE}"
            values += 1
        if item.shape:
            item_properties[FAMILY]["shape"] = item.shape
            for _, _, c in item.sequences:
                c.text = _M_COORDINATES
            coordinates += len(item.sequences)
    text, begins = _serialise(root, [item.element for item in items])
    pieces, counts = _cut_into_slots(text)
    marks = (_M_ITEM, _M_NAME, _M_COORDINATES, _M_OPEN, _M_CLOSE)
    expected = [len(items) + sum(begins), names, coordinates, values, values]
    if [counts.pop(m[-1], 0) for m in marks] != expected or counts.pop(_M_END[-1], 0) > 1 or counts:
        reason = "the file contains control characters that are reserved here (U+0091 U+009C U+0082 …): remove them"
        raise UnreadableFile(reason, [Problem(reason)])
    skeleton = []
    for k, (item_properties, first) in enumerate(zip(properties, begins, strict=True)):
        if first:
            skeleton += [next(pieces), f"<?items {k}?>"]
        item_properties[FAMILY]["xml"] = next(pieces)
    return "".join([*skeleton, *pieces])


def _cut_into_slots(text: str) -> tuple[Iterator[str], Counter[str]]:
    """Cut the text at its item marks, replace other marks by slots, and count the marks of each item."""
    first, *chunks = text.split(_MARK)
    pieces: list[str] = []
    current = [first]
    counts = Counter(c[:1] for c in chunks)
    item = _M_ITEM[-1]
    for chunk in chunks:
        code = chunk[:1]
        if code == item:
            pieces.append("".join(current))
            current = [chunk[1:]]
        else:
            current += (_SLOTS.get(code, ""), chunk[1:])
    pieces.append("".join(current))
    return iter(pieces), counts


def _serialise(root: etree._Element, items: Sequence[etree._Element]) -> tuple[str, list[bool]]:
    """Serialise the tree with a mark behind each item, and where more can be added.

    A mark also precedes each item that does not directly follow another one (True in the list).
    """
    top = [c for c in root if local_name(c) in CONTAINERS | ITEMS]
    if local_name(root) == "kml" and len(top) == 1 and local_name(top[0]) in CONTAINERS:
        last = top[0][-1] if len(top[0]) else None
        if last is None:
            top[0].text = (top[0].text or "") + _M_END
        else:
            last.tail = (last.tail or "") + _M_END
    begins = []
    previous = None
    for element in items:
        before = element.getprevious()
        first = before is None or before is not previous
        if before is None:
            parent = element.getparent()
            if parent is not None:
                parent.text = (parent.text or "") + _M_ITEM
        elif first:
            before.tail = (before.tail or "") + _M_ITEM
        tail = element.tail
        if element is not root:
            element.tail = _M_ITEM + tail if tail else _M_ITEM
        begins.append(first)
        previous = None if tail else element
    text: str = etree.tostring(root, encoding="unicode")
    return (f"{_M_ITEM}{text}{_M_ITEM}" if items and items[0] is root else text), begins
