"""Consumer checks for KML and KMZ: Google Earth, GDAL and other readers.

Sources: OGC 12-007r2 (KML 2.3: ids are XML ids; coordinates are longitude, latitude; a style is found by its id), the
KMZ rules of Google's reference (the first .kml is the document; references are relative to it).
"""

from __future__ import annotations

import posixpath
import re
from collections.abc import Collection, Iterator, Mapping

from lxml import etree

from app.errors import Problem
from app.formats import Files
from app.formats._rules import HEAD_BYTES, LIMITS, duplicates, error_finding, is_brief, names, warning_finding
from app.syntax import archives, xml

SPACES = ("http://www.opengis.net/kml/", "http://earth.google.com/kml/")

PARTS = ("Document", "Folder", "Placemark", "GroundOverlay", "NetworkLink", "ScreenOverlay", "PhotoOverlay", "Tour")
"""Features that Google Earth accepts as root element; other readers require <kml> around them."""


def check(files: Files) -> Iterator[Problem]:
    """Check a drawing by its readers' rules."""
    main = next(iter(files))
    yield from _document(files[main], main, None)


def check_archive(files: Files) -> Iterator[Problem]:
    """Check an archive with a drawing and the files that it refers to."""
    main = next(iter(files))
    entries: Mapping[str, bytes] = archives.unpack(files[main], LIMITS)
    kml = [name for name in entries if name.lower().endswith(".kml")]
    if not kml:
        yield error_finding("the archive contains no .kml", main)
        return
    if len(kml) > 1:
        yield warning_finding(f"the archive contains {len(kml)} .kml files; readers use the first one, {kml[0]}", main)
    folder = posixpath.dirname(kml[0])
    entry_names = {posixpath.relpath(name, folder) if folder else name for name in entries}
    yield from _document(entries[kml[0]], main, entry_names)


def _document(data: bytes, main: str, entries: Collection[str] | None) -> Iterator[Problem]:
    if is_brief(data):
        if not re.search(
            rb"<(\w+:)?kml\b[^>]*opengis\.net/kml|<(\w+:)?kml\b[^>]*earth\.google\.com/kml", data[:HEAD_BYTES]
        ):
            yield error_finding("the root is not <kml> in its namespace", main)
        return
    root = xml.parse(data, LIMITS)
    name = etree.QName(root)
    if name.localname != "kml":
        one = error_finding if name.localname not in PARTS else warning_finding
        yield one(f"the root is <{name.localname}>, not <kml>", main, line=root.sourceline)
    elif not (name.namespace or "").startswith(SPACES):
        yield warning_finding(
            "the root is in no KML namespace; GDAL does not recognise the file as KML", main, line=root.sourceline
        )
    ids = [str(i) for i in root.xpath("//@*[local-name() = 'id']")]
    if repeats := duplicates(ids):
        yield warning_finding(f"{len(repeats)} duplicate ids; styles and updates refer to ids: {names(repeats)}", main)
    id_set = set(ids)
    urls = {(e.text or "").strip() for e in root.iter("{*}styleUrl")}
    if absent := sorted(u for u in urls if u.startswith("#") and u[1:] not in id_set):
        yield warning_finding(f"{len(absent)} styles are missing: {names(absent)}", main)
    bad_lines = [e.sourceline for e in root.iter("{*}coordinates") if not _is_on_earth(e.text)]
    if bad_lines:
        reason = f"{len(bad_lines)} coordinates do not begin with longitude and latitude; the first is on this line"
        yield error_finding(reason, main, line=bad_lines[0])
    if entries is not None:
        hrefs = {(e.text or "").strip() for e in root.iter("{*}href")}
        inside = {h.partition("#")[0] for h in hrefs if h and ":" not in h and not h.startswith("#")}
        if absent := sorted(h for h in inside if h and posixpath.normpath(h) not in entries):
            yield warning_finding(f"{len(absent)} referenced files are missing in the archive: {names(absent)}", main)


def _is_on_earth(text: str | None) -> bool:
    """Whether the first position, if there is one, is in degrees within bounds."""
    first = (text or "").split(None, 1)[:1]
    if not first:
        return True
    parts = first[0].split(",")
    try:
        return len(parts) > 1 and abs(float(parts[0])) <= 180.0 and (not parts[1] or abs(float(parts[1])) <= 90.0)
    except ValueError:
        return False
