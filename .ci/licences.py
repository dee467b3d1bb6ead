"""Check the licences of all packages that a server's installation contains, against a list of accepted ones.

``python .ci/licences.py``: exit status 1 if a package has another licence, or none that can be read. Needs no network.
"""

from __future__ import annotations

import re
import sys
from importlib.metadata import Distribution, PackageNotFoundError, distribution

from packaging.markers import default_environment
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = "fleet-map-server[server]"
ACCEPTED = re.compile(
    r"\b(MIT|MIT-0|MIT-CMU|BSD|0BSD|BSD-[23]-Clause|ISC|Apache|Apache-2\.0|PSF|PSF-2\.0|Python Software Foundation"
    r"|Zlib|Unlicense|HPND|CC0-1\.0|MPL[- ]2\.0|Mozilla Public License 2\.0|EPL-2\.0|LGPL|LGPL-3\.0-only"
    r"|Lesser General Public|Boost|BSL-1\.0)\b",
    re.IGNORECASE,
)
"""Licences that let others use, change and pass on the server. LGPL: packages that are imported, not copied."""

REFUSED = re.compile(
    r"\b(AGPL|Affero|SSPL|BUSL|Proprietary|Commercial)|(?<!L)GPL|(?<!Lesser )General Public", re.IGNORECASE
)


def main() -> int:
    """Print what is not accepted; returns the exit status."""
    packages = installed(ROOT)
    wrong = {name: text for name, text in packages.items() if not is_accepted(text)}
    for name, text in sorted(wrong.items()):
        print(f"licence not accepted: {name}: {text or 'none stated'}")
    print(f"licences: {len(packages)} packages, {len(wrong)} not accepted")
    return 1 if wrong or len(packages) < 50 else 0


def is_accepted(text: str) -> bool:
    """Return whether one of several alternatives is accepted. Of a nested expression, all parts must be."""
    alternatives = [text] if " AND " in text and "(" in text else re.split(r"\s+OR\s+", text)
    return any(ACCEPTED.search(part) and not REFUSED.search(part) for part in alternatives)


def installed(root: str) -> dict[str, str]:
    """Return the licences by name of a package and of all that it requires here."""
    out: dict[str, str] = {}
    waiting = [Requirement(root)]
    seen: set[tuple[str, frozenset[str]]] = set()
    while waiting:
        wanted = waiting.pop()
        key = (canonicalize_name(wanted.name), frozenset(wanted.extras))
        if key in seen:
            continue
        seen.add(key)
        try:
            package = distribution(wanted.name)
        except PackageNotFoundError:
            continue  # of another platform
        out[key[0]] = licence(package)
        for line in package.requires or ():
            requirement = Requirement(line)
            contexts = [{**default_environment(), "extra": extra} for extra in (wanted.extras or {""})]
            if requirement.marker is None or any(requirement.marker.evaluate(c) for c in contexts):
                waiting.append(requirement)
    return out


def licence(package: Distribution) -> str:
    """Return what a package states: an SPDX expression, else classifiers, else the first line of a text of its own."""
    metadata = package.metadata
    if expression := metadata.get("License-Expression"):
        return str(expression)
    classifiers = [c.rpartition(" :: ")[2] for c in metadata.get_all("Classifier", []) if c.startswith("License :: ")]
    named = [c for c in classifiers if c != "OSI Approved"]
    texts = [str(metadata.get("License") or "")]
    for name in metadata.get_all("License-File", []):
        texts += [package.read_text(f"licenses/{name}") or package.read_text(name) or ""]
    lines = [text.strip().partition("\n")[0] for text in texts if text.strip()]
    return " OR ".join(named) or next(iter(lines), "")


if __name__ == "__main__":
    sys.exit(main())
