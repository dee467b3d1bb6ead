"""HTML pages: built as a tree of elements, which escapes all content. No scripts, nothing from other hosts."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Iterable, Mapping, Sequence
from typing import Any
from xml.etree.ElementTree import Element, SubElement, tostring

from starlette.responses import Response

from app.api.page import HEADERS
from app.ogc.service import Link, Service

STYLE = """
:root { color-scheme: light dark; --text: #1b1f23; --back: #fff; --soft: #5b6570; --line: #d5dae0; --accent: #0b57d0;
  --fill: #0b57d022; }
@media (prefers-color-scheme: dark) { :root { --text: #e6e8eb; --back: #14171a; --soft: #9aa4af; --line: #353c44;
  --accent: #8ab4f8; --fill: #8ab4f833; } }
body { margin: 0 auto; padding: 1rem; max-width: 72rem; font: 1rem/1.5 system-ui, sans-serif; color: var(--text);
  background: var(--back); overflow-wrap: anywhere; }
a { color: var(--accent); }
h1 { font-size: 1.5rem; margin: .5rem 0; }
nav, .soft, caption { color: var(--soft); text-align: left; }
table { border-collapse: collapse; display: block; overflow-x: auto; }
th, td { border: 1px solid var(--line); padding: .25rem .5rem; text-align: left; vertical-align: top;
  font-variant-numeric: tabular-nums; max-width: 24rem; overflow-wrap: break-word; }
img { display: block; max-width: 100%; max-height: 26rem; border: 1px solid var(--line); margin: .5rem 0; }
pre { overflow-x: auto; border: 1px solid var(--line); padding: .5rem; white-space: pre-wrap; }
svg { width: 100%; max-height: 26rem; border: 1px solid var(--line); margin: .5rem 0; }
svg path { fill: none; stroke: var(--accent); stroke-width: 1.5; vector-effect: non-scaling-stroke; }
svg path.area { fill: var(--fill); }
svg path.point { stroke-width: 6; stroke-linecap: round; }
"""

_HASH = base64.b64encode(hashlib.sha256(STYLE.encode()).digest()).decode()
POLICY = (
    f"default-src 'none'; style-src 'sha256-{_HASH}'; img-src 'self'; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'"
)


def page_headers() -> dict[str, str]:
    """Return the headers of a page: it runs no script and loads nothing but maps of this server."""
    return {**HEADERS, "content-security-policy": POLICY}


def add(parent: Element, tag: str, text: str | None = None, **attributes: str) -> Element:
    """Add an element; a trailing underscore of an attribute's name is dropped."""
    child = SubElement(parent, tag, {name.rstrip("_"): value for name, value in attributes.items()})
    child.text = text
    return child


def page(title: str, trail: Iterable[tuple[str, str]] = ()) -> tuple[Element, Element]:
    """Start a page; returns its root and its body. trail: (title, URL) of the pages above."""
    root = Element("html", {"lang": "en"})
    head = add(root, "head")
    add(head, "meta", charset="utf-8")
    add(head, "meta", name="viewport", content="width=device-width, initial-scale=1")
    add(head, "title", title)
    add(head, "style", STYLE)
    body = add(root, "body")
    nav = add(body, "nav")
    for number, (text, href) in enumerate(trail):
        if number:
            nav[-1].tail = " / "
        add(nav, "a", text, href=href)
    add(body, "h1", title)
    return root, body


def render(root: Element) -> bytes:
    """Write a page."""
    return b"<!DOCTYPE html>" + bytes(tostring(root, encoding="utf-8", method="html"))


def respond_page(service: Service, root: Element) -> Response:
    """Build the response of a page."""
    return service.respond_page(render(root), page_headers())


def link_list(parent: Element, links: Sequence[Link]) -> None:
    """List links, but not those of this document."""
    items = add(parent, "ul")
    for one in links:
        if one["rel"] in ("self", "alternate"):
            continue
        item = add(items, "li")
        add(item, "a", one["title"], href=one["href"]).tail = f" ({one['type'].partition(';')[0]})"


def representations(parent: Element, links: Sequence[Link]) -> None:
    """Add a line with the other representations of this document."""
    line = add(parent, "p", "Also as: ", class_="soft")
    for one in links:
        if one["rel"] == "alternate":
            add(line, "a", one["type"].partition(";")[0], href=one["href"]).tail = " "


def table(parent: Element, names: Sequence[str], rows: Iterable[Sequence[object]]) -> Element:
    """Add a table; a cell that is an element is added as it is."""
    out = add(parent, "table")
    head = add(add(out, "thead"), "tr")
    for name in names:
        add(head, "th", name)
    body = add(out, "tbody")
    for row in rows:
        line = add(body, "tr")
        for value in row:
            cell = add(line, "td")
            if isinstance(value, Element):
                cell.append(value)
            else:
                cell.text = str(value)
    return out


def anchor(text: str, href: str) -> Element:
    """Build a link for a table."""
    element = Element("a", {"href": href})
    element.text = text
    return element


def draw_map_picture(parent: Element, service: Service, *collection: str) -> None:
    """Show a map of the service or of one of its collections. collection: parts of its path."""
    url = service.url(*collection, "map", width="640")
    add(add(parent, "a", href=service.url(*collection, "map")), "img", src=url, alt="Map")


def linked(text: str) -> Element | str:
    """Return a cell or item: a link if the text is a web address."""
    return anchor(text, text) if text.startswith(("http://", "https://")) and " " not in text else text


def url_list(parent: Element, urls: Iterable[str]) -> None:
    """List web addresses."""
    items = add(parent, "ul")
    for url in urls:
        add(items, "li").append(anchor(url, url))


def error_page(problem: Mapping[str, Any]) -> bytes:
    """Write the page of a problem."""
    root, body = page(f"{problem['status']} {problem['title']}")
    add(body, "p", str(problem["detail"]))
    errors = problem.get("errors", ())
    if errors:
        table(body, ("parameter", "problem"), [(item.get("where", ""), item["problem"]) for item in errors])
    return render(root)
