"""Number of places to change for a new format, setting, route noun and event: one each, two for a setting.

Each is added to a copy of the package, only by its own module, field or dataclass, and then appears in every list of
its kind.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[1]

FORMAT = '''"""Paper: a format that keeps nothing."""

from app.formats import Files, Format, LayerRequirements, ReadContext, WriteContext, register
from app.model.layers import Layers


def read(files: Files, context: ReadContext) -> Layers:
    return Layers()


def write(layers: Layers, context: WriteContext) -> dict[str, bytes]:
    return {"map.paper": b"paper"}


register(
    Format(
        name="paper",
        title="Paper",
        files={"map.paper": "text/plain"},
        layers=frozenset({"objects"}),
        detect=lambda name, data: data == b"paper",
        read=read,
        write=write,
        needs=LayerRequirements(one_of=(frozenset({"objects"}),)),
        extensions=(".paper",),
    )
)
'''
NOUN = '''"""Papers: a noun that lists nothing."""

from app.api.http.responses import api_router

router = api_router("papers", "/papers")


@router.get("")
def list_papers() -> list[str]:
    """List papers."""
    return []
'''
EVENT = '''

@event("paper.folded")
class PaperFolded:
    """A paper is folded."""

    folds: int = member(2)
'''
SETTING = """    paper_size: int = Field(default=4, ge=0, description="Size of a paper.")
"""
CONSUMER = """

def paper_area(settings: Settings) -> float:
    return 1 / 2**settings.paper_size
"""

FACTS = """
import json, pickle, sys, tempfile
from pathlib import Path
import app
from app import catalogue, event_types, main
from app.config import Settings
from app.events.messages import Event
sys.path.insert(0, "docs/hooks")
import reference

settings = Settings(_env_file=None, data_dir=Path(tempfile.mkdtemp()), zenoh_mode="off", insecure_no_auth=True)
schema = main.create_app(settings).openapi()
body = {"type": "paper.folded", "environment": "e", "sequence": 1, "version": 1, "root": "0" * 64}
event_types.check_members("paper.folded", ["folds"])
print(json.dumps({
    "app": app.__file__,
    "formats": [fmt["id"] for fmt in catalogue.describe_formats()],
    "paths": list(schema["paths"]),
    "settings": reference.settings(),
    "area": main.paper_area(pickle.loads(pickle.dumps(settings))),
    "event": Event.from_json(json.dumps(body)).type,
    "events": reference.events(),
    "coverage": reference.formats_table(),
}))
"""


def insert(path: Path, text: str, before: str) -> None:
    head, match, tail = path.read_text().partition(before)
    assert match, before
    path.write_text(head + text + match + tail)


@pytest.fixture(scope="module")
def facts(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Collect the lists of a copy of the package with all four additions."""
    copy = tmp_path_factory.mktemp("copy")
    shutil.copytree(ROOT / "app", copy / "app", ignore=shutil.ignore_patterns("__pycache__", "node_modules"))
    shutil.copytree(ROOT / "docs" / "hooks", copy / "docs" / "hooks")
    for name in ("pyproject.toml", "migrations"):
        (copy / name).symlink_to(ROOT / name)
    (copy / "app" / "formats" / "paper.py").write_text(FORMAT)
    (copy / "app" / "api" / "papers.py").write_text(NOUN)
    insert(copy / "app" / "event_types.py", EVENT.lstrip("\n") + "\n\n", "EVENT_TYPES:")
    insert(copy / "app" / "config.py", SETTING, "    host: str = Field(")
    main = copy / "app" / "main.py"
    main.write_text(main.read_text() + CONSUMER)
    environment = {**os.environ, "PYTHONPATH": str(copy)}
    command = [sys.executable, "-W", "ignore", "-c", FACTS]
    result = subprocess.run(command, cwd=copy, env=environment, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    found: dict[str, Any] = json.loads(result.stdout.splitlines()[-1])
    assert Path(found["app"]).is_relative_to(copy)
    return found


def test_format_is_one_module(facts: dict[str, Any]) -> None:
    assert "paper" in facts["formats"]
    assert "/maps/{env}/paper" in facts["paths"]
    assert "paper" in facts["coverage"]


def test_route_noun_is_one_module(facts: dict[str, Any]) -> None:
    assert "/api/v1/papers" in facts["paths"]


def test_setting_is_a_field_and_its_consumer(facts: dict[str, Any]) -> None:
    assert "FLEETMAP_PAPER_SIZE" in facts["settings"]
    assert facts["area"] == 1 / 16


def test_event_is_one_dataclass(facts: dict[str, Any]) -> None:
    assert facts["event"] == "paper.folded"
    assert "## paper.folded" in facts["events"]
    assert '"folds": 2' in facts["events"]
