"""Fixtures for all tests: the shared real data and its independent readers, beside the checkout."""

from __future__ import annotations

import importlib
import json
import os
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from tests.postgres import postgres_cluster, postgres_url  # noqa: F401  fixtures

SHARED = Path(__file__).resolve().parents[2] / "shared"


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder with real maps; where it is absent CI fails and a developer's run leaves these tests out."""
    if not (SHARED / "data" / "facts.json").is_file():
        message = "../shared/data is absent: these tests need the real maps beside the checkout"
        if os.environ.get("CI"):
            pytest.fail(message)
        pytest.skip(message)
    return SHARED


@pytest.fixture(scope="session")
def facts(shared: Path) -> ModuleType:
    """The independent readers that count facts of a file."""
    return _tool(shared, "facts")


@pytest.fixture(scope="session")
def same(shared: Path) -> Callable[[str, dict[str, bytes], dict[str, bytes]], list[str]]:
    """same(format, original, served): what information two maps do not share."""
    function: Callable[[str, dict[str, bytes], dict[str, bytes]], list[str]] = _tool(shared, "same").same
    return function


@pytest.fixture(scope="session")
def facts_json(shared: Path) -> dict[str, Any]:
    """Facts of every real file, counted by tools that share no code with ours; key = path below data/."""
    known: dict[str, Any] = json.loads((shared / "data" / "facts.json").read_text())["files"]
    return known


def _tool(shared: Path, name: str) -> ModuleType:
    folder = str(shared / "tools")
    if folder not in sys.path:
        sys.path.append(folder)
    return importlib.import_module(name)
