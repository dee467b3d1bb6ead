"""Examination of an installation (``fleetmap doctor``): each check says what is wrong, where, and what to do.

A check is a function with ``@check`` in any module of this package; nothing else lists it. Checks change nothing: they
read, connect, and write probe files that they remove. A running server is not disturbed.
"""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Collection, Iterator, Mapping

from app.doctor.registry import CHECKS, Check, Finding, Result
from app.doctor.site import Site
from app.errors import FleetMapError, Unavailable, system_reason


def all_checks() -> Mapping[str, Check]:
    """Return all checks by name."""
    for module in pkgutil.iter_modules(__path__, f"{__name__}."):
        importlib.import_module(module.name)
    return CHECKS


def examine(site: Site, only: Collection[str] = ()) -> Iterator[Result]:
    """Run all checks, or those with these names, one after the other. A check that fails is an error itself."""
    for name, function in sorted(all_checks().items()):
        if only and name not in only:
            continue
        try:
            findings = list(function(site))
        except FleetMapError as error:
            findings = [_finding_of(error, site, only)]
        except OSError as error:
            findings = [Finding("error", system_reason(error), str(error.filename or ""))]
        except Exception as error:  # noqa: BLE001  a defect in one check must not hide the others
            defect = f"this check itself has failed ({type(error).__name__}: {error})"
            findings = [Finding("error", defect, "", "report it with this line")]
        for finding in findings:
            yield Result(name, finding)


def _finding_of(error: FleetMapError, site: Site, only: Collection[str]) -> Finding:
    """Return the result of a check that could not be made: its cause is reported once, by the check of the database."""
    is_reported = not only or "database" in only
    if isinstance(error, Unavailable) and not site.is_database_usable and is_reported:
        return Finding("ok", "not checked without a usable database: see the check database")
    return Finding("error", error.detail)


__all__ = ["CHECKS", "Finding", "Result", "Site", "all_checks", "examine"]
