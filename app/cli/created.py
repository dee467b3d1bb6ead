"""Create the environment of an import or a generated site if needed; remove it again if the command fails."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from app.cli.client import MAX_NAMES, Client, quote_path
from app.cli.problems import RequestFailed
from app.errors import FleetMapError, Invalid
from app.model.frame import Datum

LABEL = 2
"""Maximum number of characters of a word that distinguishes names on purpose (``hall-a``, ``hall-b``)."""

MIN_LONG_WORD_CHARACTERS = 8
"""Number of characters from which two misspellings in a word are tolerated instead of one."""


@contextmanager
def ensure_environment(
    client: Client,
    name: str,
    *,
    datum: Datum | None,
    title: str | None = None,
    create: bool | None = True,
    dry_run: bool = False,
) -> Iterator[bool]:
    """Provide an environment with a datum for the ``with`` block; undo both if the block fails.

    Args:
        create: whether to create a missing environment; None: unless its name looks like a misspelling.
        dry_run: create and change nothing.

    Yields whether the environment was created. Raises RequestFailed or Invalid if it must not be created.
    """
    datum_values = datum.as_dict() if datum else None
    try:
        environment = client.get(quote_path("environments", name))
    except RequestFailed as refused:
        if refused.status != 404 or str(refused.problem.get("type")).endswith(":gone"):
            raise
        if dry_run:
            detail = f"unknown environment {name!r}: a dry run does not create it"
            raise RequestFailed(
                {"title": "No such environment", "detail": detail}, status=404, hint=refused.hint
            ) from None
        _check_new_name(client, name, create, refused)
        new_environment = client.post("/environments", {"name": name, "title": title, "datum": datum_values})
        with _undo_on_error(
            lambda: _remove(client, new_environment), f"The new environment {name} could not be removed"
        ):
            yield True
        return
    if datum_values is None or (environment.get("datum") or {}) == datum_values or dry_run:
        yield False
        return
    client.patch(quote_path("environments", name), {"datum": datum_values})
    with _undo_on_error(lambda: _undo_datum(client, environment), f"The new datum of {name} could not be reset"):
        yield False


def _check_new_name(client: Client, name: str, create: bool | None, refused: RequestFailed) -> None:
    """Raise RequestFailed or Invalid unless an environment of this name may be created."""
    if create is False:
        raise refused
    if create is None:
        near = slip(name, (row["name"] for row in client.pages("/environments", {}, limit=MAX_NAMES)))
        if near is not None:
            raise Invalid(f"unknown environment {name!r} (did you mean {near}?): use --create if the name is right")


@contextmanager
def _undo_on_error(undo: Any, failure: str) -> Iterator[None]:
    """Call ``undo`` if the block fails or is interrupted; add a failure of ``undo`` to the error."""
    try:
        yield
    except BaseException as error:
        try:
            undo()
        except (RequestFailed, FleetMapError) as second:
            if isinstance(error, RequestFailed):
                error.hint = f"{error.hint}\n{failure}: {second}".strip()
        raise


def _remove(client: Client, environment: Mapping[str, Any]) -> None:
    """Remove an environment permanently, unless another client has changed it since."""
    place = quote_path("environments", environment["name"])
    if client.get(place)["version"] == environment["version"]:
        client.delete(place)
        client.post(f"{place}/purge", {})


def _undo_datum(client: Client, environment: Mapping[str, Any]) -> None:
    """Return to the version before the datum was set, unless another client has made a version since."""
    place = quote_path("environments", environment["name"])
    if client.get(place)["version"] == environment["version"] + 1:
        message = "reset the datum: the import failed"
        client.post(f"{place}/versions", {"revert_to": environment["version"], "message": message}, repeat=True)


def slip(name: str, existing: Iterable[str]) -> str | None:
    """Return the existing name that a new one probably misspells; None if it differs on purpose.

    ``fram-7`` misspells ``farm-7``; ``farm-8`` and ``hall-b`` differ on purpose from ``farm-7`` and ``hall-a``.
    """
    return next((other for other in existing if _is_slip(_words(name), _words(other))), None)


def _words(name: str) -> list[str]:
    return re.findall(r"[a-z]+|[0-9]+", name)


def _is_slip(words: list[str], others: list[str]) -> bool:
    if len(words) != len(others) or words == others:
        return "".join(words) == "".join(others)
    pairs = [(a, b) for a, b in zip(words, others, strict=True) if a != b]
    return all(max(len(a), len(b)) > LABEL and not (a + b).isdigit() and _is_similar(a, b) for a, b in pairs)


def _is_similar(a: str, b: str) -> bool:
    return _slips(a, b) <= (1 if max(len(a), len(b)) < MIN_LONG_WORD_CHARACTERS else 2)


def _slips(a: str, b: str) -> int:
    """Count letters added, missing, changed or swapped between two words (optimal string alignment)."""
    before: list[int] = []
    row = list(range(len(b) + 1))
    for i, x in enumerate(a, 1):
        older, before, row = before, row, [i] + [0] * len(b)
        for j, y in enumerate(b, 1):
            row[j] = min(before[j] + 1, row[j - 1] + 1, before[j - 1] + (x != y))
            if i > 1 and j > 1 and x == b[j - 2] and y == a[i - 2]:
                row[j] = min(row[j], older[j - 2] + 1)
    return row[-1]
