"""Safe XML for readers: no DOCTYPE, no entities, no network, bounded depth and attributes (security, reading 5)."""

from __future__ import annotations

import re

from lxml import etree

from app.errors import Problem, TooLarge, UnreadableFile
from app.formats import Limits
from app.model.prolog import check_prolog

__all__ = ["MAX_ATTRIBUTES", "attributes", "check_bounds", "check_prolog", "parse"]

MAX_ATTRIBUTES = 256
"""Of one element. Real ones have about ten; lxml takes quadratic time to list them."""


def parse(
    data: bytes, limits: Limits, *, keep_comments: bool = False, remove_blank_text: bool = False
) -> etree._Element:
    """The root element. Raises TooLarge, UnreadableFile with the line, or XMLSyntaxError.

    remove_blank_text: leave out the white space that only indents (a third of the time and memory of such files).
    """
    if len(data) > limits.text_bytes:
        reason = f"{len(data)} bytes of XML; the limit for a text is {limits.text_bytes}"
        raise TooLarge(reason, [Problem(reason)])
    check_prolog(data)
    parser = etree.XMLParser(
        resolve_entities=False,
        no_network=True,
        load_dtd=False,
        dtd_validation=False,
        huge_tree=False,
        remove_comments=not keep_comments,
        remove_pis=True,
        remove_blank_text=remove_blank_text,
    )
    root = etree.fromstring(data.lstrip(b"\xef\xbb\xbf \t\r\n"), parser)
    if root.getroottree().docinfo.internalDTD is not None:
        raise UnreadableFile("a DOCTYPE is not accepted: remove it", [Problem("DOCTYPE is not accepted", line=1)])
    check_bounds(root, limits, None if data[:2] in (b"\xff\xfe", b"\xfe\xff") or b"\0" in data[:4] else data)
    return root


def attributes(element: etree._Element) -> dict[str, str]:
    """An element's attributes. Raises UnreadableFile where there are more than any real file has."""
    count = len(element.attrib)
    if count > MAX_ATTRIBUTES:
        reason = f"<{element.tag}> has {count} attributes; the limit is {MAX_ATTRIBUTES}"
        raise UnreadableFile(reason, [Problem(reason, line=element.sourceline, where=f"<{element.tag}>")])
    return {str(k): str(v) for k, v in element.attrib.items()}


def check_bounds(root: etree._Element, limits: Limits, data: bytes | None = None) -> None:
    """Refuse attributes longer than a real map's; libxml2 itself stops at depth 256 and texts of 10 MB.

    data: the bytes that the tree was read from, where they are at hand: without a long quoted run in them there is no
    long attribute to look for.
    """
    if data is not None and not _long_quote(data, limits.xml_attribute_bytes):
        return
    for long in root.xpath("//@*[string-length() > $most]", most=limits.xml_attribute_bytes):
        reason = f"an attribute is longer than {limits.xml_attribute_bytes} characters"
        raise UnreadableFile(reason, [Problem(reason, line=long.getparent().sourceline, where=long.attrname)])


def _long_quote(data: bytes, most: int) -> bool:
    """Whether an attribute value of more than this many bytes may stand in it (``=``, a quote, no such quote for long).

    An entity or a longer encoding makes the bytes more than the characters, never fewer.
    """
    if len(data) <= most:
        return False
    return re.search(rb"""=\s*(?:"[^"]{%d}|'[^']{%d})""" % (most, most), data) is not None
