"""Commit counter: changes seen in this process and in another one."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from app.backends.notify import CommitCounter
from app.store.store import Store


def test_commit_counter_changes_with_writes_only(tmp_path: Path) -> None:
    store = Store(f"sqlite:///{tmp_path}/a.sqlite", tmp_path / "blobs")
    store.migrate()
    before = store.generation()
    assert store.environments.page() == ([], None)
    assert store.generation() == before
    store.environments.create("farm")
    after = store.generation()
    assert after != before
    store.tokens.create("somebody", "viewer")
    assert store.generation() != after
    store.close()


def test_commit_counter_is_shared_between_processes(tmp_path: Path) -> None:
    counter = CommitCounter(tmp_path)
    before = counter()
    code = "from pathlib import Path; from app.backends.notify import CommitCounter; "
    code += f"CommitCounter(Path({str(tmp_path)!r})).change()"
    subprocess.run([sys.executable, "-c", code], check=True)
    assert counter() != before
    counter.close()


def test_commit_counter_without_folder_counts_in_process(tmp_path: Path) -> None:
    counter = CommitCounter(tmp_path / "absent")
    before = counter()
    counter.change()
    assert counter() != before
