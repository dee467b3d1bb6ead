"""The coverage table matches downloads: direct and derivable formats are served, missing ones name what to supply.

Runs over all registered formats, so that new ones are included.
"""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from app import formats
from tests.api.conftest import Api, running, settings_for
from tests.formats.test_every_format import cases

SHARED = Path(__file__).resolve().parents[2] / "shared" / "data" / "environment_template"
SUPPLY = re.compile(r"upload|supply|PATCH|needs|ask for|option", re.IGNORECASE)
JOB_SECONDS = 300.0
SLOW_SECONDS = 2.0


def environments() -> list[Any]:
    """List every environment_template folder, and the first sample of each kind."""
    out: list[Any] = []
    for root in sorted(p for p in SHARED.iterdir() if p.is_dir()) if SHARED.is_dir() else []:
        files = {p.relative_to(root).as_posix(): p.read_bytes() for p in sorted(root.rglob("*")) if p.is_file()}
        out.append(pytest.param(files, None, id=root.name))
    seen = set()
    for name, case, files in cases():
        if name not in seen:
            seen.add(name)
            out.append(pytest.param(files, name, id=case))
    return out


@pytest.fixture(scope="module")
def api(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Api]:
    with running(settings_for(tmp_path_factory.mktemp("server"))) as server:
        yield server


@pytest.mark.parametrize(("files", "kind"), environments())
def test_coverage_matches_downloads(
    api: Api, files: dict[str, bytes], kind: str | None, request: pytest.FixtureRequest
) -> None:
    env = re.sub(r"[^a-z0-9]+", "-", request.node.callspec.id.lower()).strip("-")[:60]
    api.http.timeout = httpx.Timeout(JOB_SECONDS)  # the table runs derivations, maybe on a busy machine
    api.post("environments", {"name": env})
    api.upload(env, files, **({"format": kind} if kind else {}))
    rows = api.get(f"environments/{env}/versions/latest/maps").json()
    assert {row["format"] for row in rows} == {f.name for f in formats.all_formats().values() if f.write}
    slow: set[str] = set()
    states = {row["format"]: row["state"] for row in rows}
    if kind is not None and kind in states:
        assert states[kind] == "direct", "an uploaded map is available in its format"
    for row in rows:
        label = f"{env} as {row['format']}"
        if row["state"] == "missing":
            assert row["missing"], f"{label}: nothing to supply is named"
            assert any(SUPPLY.search(text) for text in row["missing"]), f"{label}: {row['missing']}"
            refused = api.get(f"environments/{env}/versions/latest/maps/{row['format']}", None)
            assert 400 <= refused.status_code < 500, f"{label}: {refused.status_code}"
            continue
        assert row["state"] in ("direct", "derivable"), label
        assert bool(row["chain"]) == (row["state"] == "derivable"), label
        steps = str([step["step"] for step in row["chain"]])
        if steps in slow:
            continue  # same derivation for another writer, which faster samples cover
        start = time.monotonic()
        answer = api.get(f"environments/{env}/versions/latest/maps/{row['format']}", None)
        if row["chain"] and time.monotonic() - start > SLOW_SECONDS:
            slow.add(steps)
        if row.get("choose"):
            assert answer.status_code == 409, f"{label}: {answer.status_code}"
            continue
        if answer.status_code == 409 and row["chain"] and "name one" in answer.json()["detail"]:
            continue  # a derivation gave several, unknown without running it
        if answer.status_code == 422 and "too far from the datum" in answer.text:
            continue  # one feature of a sample is outside any local frame, unknown without reading it
        assert answer.status_code in (200, 202), f"{label}: {answer.status_code} {answer.text[:500]}"
        if answer.status_code == 202:
            job = api.finished(answer.json())
            assert job["state"] == "done", f"{label}: {job}"
        else:
            assert answer.content, label
