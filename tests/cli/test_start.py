"""What the start of a server on SQLite loads, and what runs beside it."""

from __future__ import annotations

import gc
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from app.cli import server
from app.config import Settings
from app.errors import Unavailable
from app.pool import PRELOADED_MODULES

LATE = ("geoalchemy2", "alembic", "httpx", "numba", "cv2", "scipy")


def loaded(statement: str) -> list[str]:
    """Which modules of LATE are there after a statement in an interpreter of its own."""
    script = f"import sys\n{statement}\nprint(*[name for name in {LATE!r} if name in sys.modules])"
    root = Path(__file__).resolve().parents[2]
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, cwd=root, check=True)
    return done.stdout.split()


@pytest.mark.parametrize(
    "statement",
    [
        "import app.cli.server, app.main\nfrom app.config import Settings\napp.main.create_app(Settings())",
        f"import {', '.join(PRELOADED_MODULES)}",
    ],
    ids=["server", "workers"],
)
def test_start_imports_only_required_modules(statement: str) -> None:
    assert loaded(statement) == []


def test_postgresql_driver_is_imported_on_use() -> None:
    compiled = (
        "from sqlalchemy.dialects import postgresql\n"
        "from app.store import tables\n"
        "print(tables.area.c.geometry.type.compile(postgresql.dialect()))"
    )
    assert loaded(compiled) == ["geometry(GEOMETRY,4326)", "geoalchemy2"]


@pytest.fixture
def collecting() -> Iterator[None]:
    yield
    gc.enable()


@pytest.mark.parametrize("workers", ["1", "2"])
@pytest.mark.usefixtures("collecting")
def test_workers_are_prepared_in_background(workers: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    done: list[str] = []

    def check(_: Any) -> None:
        done.append("check")
        raise Unavailable("the database is away")

    monkeypatch.setattr("app.pool.preload_in_background", lambda: done.append("beside"))
    monkeypatch.setattr(server, "check", check)
    with pytest.raises(Unavailable, match="away"):
        server.serve(data_dir=str(tmp_path), port="0", workers=workers)
    # Servers of several workers are processes of their own, which have their own conversion workers.
    assert done == (["beside", "check"] if workers == "1" else ["check"])
    assert gc.isenabled()


@pytest.mark.usefixtures("collecting")
def test_application_reenables_garbage_collection(tmp_path: Path) -> None:
    gc.disable()
    server.application(Settings(data_dir=tmp_path))
    assert gc.isenabled()
