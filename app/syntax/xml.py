"""Safe XML for readers: no DOCTYPE, no entities, no network, bounded depth and attributes."""

from __future__ import annotations

import re
from collections.abc import Callable, Set

from lxml import etree

from app.errors import Problem, TooLarge, UnreadableFile
from app.limits import Limits
from app.model.names import did_you_mean
from app.model.xml_prolog import check_prolog

__all__ = ["MAX_ATTRIBUTES", "attributes", "check_bounds", "check_prolog", "parse"]

MAX_ATTRIBUTES = 256
"""Maximum number of attributes of an element. Real ones have about ten; lxml lists them in quadratic time."""


def parse(
    data: bytes, limits: Limits, *, keep_comments: bool = False, remove_blank_text: bool = False
) -> etree._Element:
    """Parse XML and return the root element. Raises TooLarge, UnreadableFile with the line, or XMLSyntaxError.

    remove_blank_text: drop white space used for indentation (saves a third of time and memory for such files).
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


_SCRIPT = "a script"
_ACTIVE: tuple[tuple[str, re.Pattern[bytes]], ...] = (
    ("a processing instruction", re.compile(rb"<\?(?!xml\s)[a-z_][\w.-]*")),
    ("XInclude", re.compile(rb"http://www\.w3\.org/2001/xinclude")),
    ("XSLT", re.compile(rb"http://www\.w3\.org/1999/xsl/transform")),
    (_SCRIPT, re.compile(rb"(?:<|&lt;|&#60;|&#x3c;)(?:[\w-]+:)?script[\s>/&]|javascript:")),
)
_ACTIVE_WORDS = (b"<?", b"/2001/xinclude", b"/xsl/transform", b"script")


def report_active_content(data: bytes, warn: Callable[..., None], *, has_scripts: bool = False) -> None:
    """Report active content that this server ignores but a viewer may run or fetch: each kind once, by name.

    has_scripts: the format has its own elements of that name (SDFormat's materials).
    """
    low = data.lower()
    if b"\0" in low[:4]:  # UTF-16 or UTF-32: the words are ASCII
        low = low.replace(b"\0", b"")
    if not any(marker in low[5:] for marker in _ACTIVE_WORDS):
        return
    for noun, pattern in _ACTIVE:
        positions = [m.start() for m in pattern.finditer(low)] if not (has_scripts and noun == _SCRIPT) else []
        if positions:
            shown = pattern.match(low, positions[0])
            name = "" if shown is None else f" {shown.group()[:60].decode('latin-1').strip()!r}"
            often = f" ({len(positions)} times)" if len(positions) > 1 else ""
            line = low.count(b"\n", 0, positions[0]) + 1
            warn(f"{noun}{name}{often} is ignored; a viewer may run or fetch it", line=line)


def report_unknown_elements(
    data: bytes,
    root: etree._Element,
    format_names: Set[str],
    warn: Callable[..., None],
    *,
    free: Set[str],
    namespace: str = "",
) -> None:
    """Report elements that a format does not define, with their counts, in one warning.

    Args:
        data: the text of ``root``.
        format_names: names of the format's elements, without a namespace.
        free: names of elements that may contain anything.
        namespace: common part of the format's own namespaces; elements of others are extensions. Empty: the format
            has none.
    """
    plain = data.replace(b"\0", b"") if b"\0" in data[:4] else data  # UTF-16 or UTF-32
    names = {name.decode("utf-8", "replace").rpartition(":")[2] for name in set(_TAG.findall(plain))}
    unknown = names - format_names
    elements_by_name: dict[str, list[etree._Element]] = {}
    for element in root.iter("*") if unknown else ():
        space, _, name = str(element.tag).rpartition("}")
        ours = name in unknown and (not space or bool(namespace and namespace in space))
        if ours and not any(etree.QName(above).localname in free for above in element.iterancestors()):
            elements_by_name.setdefault(name, []).append(element)
    if not elements_by_name:
        return
    first = min((elements[0] for elements in elements_by_name.values()), key=lambda e: e.sourceline or 0)
    texts = [
        f"<{name[:80]}>{did_you_mean(name, format_names)}{f' ({len(elements)} times)' if len(elements) > 1 else ''}"
        for name, elements in sorted(elements_by_name.items())[:_SHOWN]
    ]
    texts += [f"and {len(elements_by_name) - _SHOWN} more"] if len(elements_by_name) > _SHOWN else []
    warn(f"unknown elements: {', '.join(texts)}; they are stored without effect", line=first.sourceline)


_TAG = re.compile(rb"<([^\s<>/!?=\"']+)")
_SHOWN = 10
"""Maximum number of unknown elements that a warning names."""


def attributes(element: etree._Element) -> dict[str, str]:
    """Return an element's attributes. Raises UnreadableFile if there are more than ``MAX_ATTRIBUTES``."""
    count = len(element.attrib)
    if count > MAX_ATTRIBUTES:
        reason = f"<{element.tag}> has {count} attributes; the limit is {MAX_ATTRIBUTES}"
        raise UnreadableFile(reason, [Problem(reason, line=element.sourceline, where=f"<{element.tag}>")])
    return {str(k): str(v) for k, v in element.attrib.items()}


def check_bounds(root: etree._Element, limits: Limits, data: bytes | None = None) -> None:
    """Reject attributes longer than those of real maps; libxml2 itself stops at depth 256 and texts of 10 MB.

    data: the source bytes, if available: without a long quoted run in them the tree has no long attribute.
    """
    if data is not None and not _long_quote(data, limits.xml_attribute_bytes):
        return
    for long in root.xpath("//@*[string-length() > $most]", most=limits.xml_attribute_bytes):
        reason = f"an attribute is longer than {limits.xml_attribute_bytes} characters"
        raise UnreadableFile(reason, [Problem(reason, line=long.getparent().sourceline, where=long.attrname)])


def _long_quote(data: bytes, limit: int) -> bool:
    """Return whether an attribute value may be longer than ``limit`` bytes (``=``, a quote, then no such quote).

    With entities or longer encodings an attribute has more bytes than characters, never fewer.
    """
    if len(data) <= limit:
        return False
    return re.search(rb"""=\s*(?:"[^"]{%d}|'[^']{%d})""" % (limit, limit), data) is not None
