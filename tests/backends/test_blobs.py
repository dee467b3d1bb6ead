"""Conformance of the blob store's adapters: a folder, and a bucket of a real S3 server."""

from __future__ import annotations

import os
import random
import re
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from app.backends.blob_folder import FolderFiles
from app.backends.blob_s3 import S3Files
from app.backends.blobs import BlobFiles, Unreadable
from app.backends.local_copies import LocalCopies
from app.errors import NoRoom, Unavailable
from tests.seaweed import ACCESS, Fault, FaultyStore, Seaweed

LARGE = random.Random(5).randbytes(12_000_000)


@pytest.fixture(params=["folder", "s3"])
def files(request: pytest.FixtureRequest, tmp_path: Path) -> BlobFiles:
    """An empty blob store of each kind."""
    made: BlobFiles
    if request.param == "folder":
        made = FolderFiles(tmp_path / "blobs")
    else:
        made = S3Files(request.getfixturevalue("s3_url"), tmp_path / "blobs")
    made.prepare()
    return made


def read(files: BlobFiles, key: str, start: int = 0, size: int | None = None) -> bytes:
    return b"".join(files.stream(key, start, size))


def test_files_are_read_as_written(files: BlobFiles) -> None:
    with files.workspace() as workspace:
        (workspace / "large").write_bytes(LARGE)
        files.write({"ab/large": workspace / "large", "packs/one": b"0123456789", "ab/empty": b""})
    assert read(files, "ab/large") == LARGE
    assert read(files, "packs/one", 3, 4) == b"3456"
    assert read(files, "packs/one", 8) == b"89"
    assert read(files, "packs/one", 4, 0) == b""
    assert read(files, "ab/empty") == b""
    assert all(len(piece) <= 4 * 2**20 for piece in files.stream("ab/large")), "in pieces"


def test_pieces_beyond_the_end_are_empty(files: BlobFiles) -> None:
    """So what was in a file that was cut off counts as damaged, which a repair mends, and not as away for a while."""
    files.write({"packs/one": b"0123456789"})
    assert read(files, "packs/one", 8, 4) == b"89"
    assert read(files, "packs/one", 10, 4) == b""
    assert read(files, "packs/one", 20, 4) == b""
    assert read(files, "packs/one", 20) == b""


def test_absent_file_is_told_from_an_unreadable_one(files: BlobFiles) -> None:
    with pytest.raises(FileNotFoundError):
        read(files, "ab/none")
    files.write({"ab/one": b"1"})
    files.delete(["ab/one", "ab/none"])
    with pytest.raises(FileNotFoundError):
        read(files, "ab/one")


def test_file_is_replaced_and_becomes_young_again(files: BlobFiles) -> None:
    files.write({"ab/one": b"wrong"})
    (before,) = files.list()
    time.sleep(1.1)  # S3 counts whole seconds
    files.write({"ab/one": b"right"})
    assert read(files, "ab/one") == b"right"
    (after,) = files.list()
    assert after.modified > before.modified


def test_list_has_keys_and_sizes(files: BlobFiles) -> None:
    files.write({"ab/one": b"1", "packs/two": b"22", "made/ab/three": b"333"})
    assert sorted((f.key, f.size) for f in files.list()) == [("ab/one", 1), ("made/ab/three", 3), ("packs/two", 2)]
    assert [f.key for f in files.list("packs/")] == ["packs/two"]
    assert all(abs(f.modified - time.time()) < 60 for f in files.list())


def test_workspaces_are_removed_but_those_in_use(files: BlobFiles) -> None:
    with files.workspace() as workspace:
        (workspace / "half").write_bytes(b"x")
        assert files.recover() == 0
        assert (workspace / "half").exists()
    assert not workspace.exists()
    workspace.mkdir()
    (workspace / ".lock").touch()
    assert files.recover() == 1


def test_store_that_works_passes_the_check(files: BlobFiles) -> None:
    files.check()
    files.check(readonly=True)
    assert list(files.list()) == [], "the check leaves nothing to collect"


def test_folder_that_is_gone_is_unreadable(tmp_path: Path) -> None:
    """Such as one that several servers mount: nothing is concluded from its files not being there."""
    files = FolderFiles(tmp_path / "blobs")
    with pytest.raises(Unreadable):
        list(files.list())
    with pytest.raises(Unavailable):
        files.check(readonly=True)


def test_refused_access_says_what_to_check(s3_url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "another")
    files = S3Files(s3_url, tmp_path)
    files.prepare()
    for use in (lambda: files.write({"ab/x": b"x"}), files.check, lambda: files.delete(["ab/x"])):
        with pytest.raises(Unavailable, match="AWS_SECRET_ACCESS_KEY"):
            use()
    for look in (lambda: read(files, "ab/x"), lambda: list(files.list())):
        with pytest.raises(Unreadable, match="AWS_SECRET_ACCESS_KEY"):
            look()


def test_store_that_is_gone_comes_back(seaweed: Seaweed, s3_url: str, tmp_path: Path) -> None:
    files = S3Files(s3_url, tmp_path)
    files.prepare()
    files.write({"ab/x": b"x"})
    seaweed.stop()
    try:
        began = time.monotonic()
        with pytest.raises(Unavailable, match="does not answer"):
            files.check()
        assert time.monotonic() - began < 10
        with pytest.raises(Unreadable, match="does not answer"):
            read(files, "ab/x")
        with pytest.raises(Unavailable, match="nothing was stored"):
            files.write({"ab/y": b"y"})
    finally:
        seaweed.start()
    assert read(files, "ab/x") == b"x"
    assert [f.key for f in files.list()] == ["ab/x"]


@pytest.fixture
def faulty(monkeypatch: pytest.MonkeyPatch) -> Iterator[FaultyStore]:
    """A store that answers every request as its ``fault`` says."""
    store = FaultyStore(0)
    for name, value in {**ACCESS, "AWS_ENDPOINT_URL": store.endpoint}.items():
        monkeypatch.setenv(name, value)
    yield store
    store.close()


@pytest.mark.parametrize(
    ("status", "seconds", "error", "reason"),
    [
        (507, 0.0, NoRoom, "space"),
        (403, 0.0, Unavailable, "AWS_SECRET_ACCESS_KEY"),
        (500, 0.0, Unavailable, "500"),
        (200, 5.0, Unavailable, "slow"),
    ],
)
def test_failing_store_is_named_with_its_reason(
    faulty: FaultyStore,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    status: int,
    seconds: float,
    error: type[Exception],
    reason: str,
) -> None:
    faulty.fault = Fault(status, seconds)
    if seconds:
        monkeypatch.setattr("app.backends.blob_s3.STALL_SECONDS", 1)
        monkeypatch.setattr("app.backends.blob_s3.CONNECT_SECONDS", 1)
    failing = S3Files("s3://maps/x", tmp_path)
    failing.prepare()
    with pytest.raises(error, match=reason) as caught:
        failing.check()
    assert "127.0.0.1" not in str(caught.value)
    with pytest.raises(error, match=reason):
        failing.write({"ab/x": b"x"})
    with pytest.raises(Unreadable):
        read(failing, "ab/x")


GONE = b"<?xml version='1.0'?><Error><Code>NoSuchKey</Code><Message>gone</Message></Error>"


def absent_keys(request: bytes) -> bytes:
    """The answer to a request to delete files that reports each as absent."""
    failures = (
        b"<Error>%s<Code>NoSuchKey</Code><Message/></Error>" % key for key in re.findall(rb"<Key>.*?</Key>", request)
    )
    return b"<?xml version='1.0'?><DeleteResult>%s</DeleteResult>" % b"".join(failures)


@pytest.mark.parametrize(("status", "body"), [(404, GONE), (200, absent_keys)])
def test_files_are_deleted_although_a_server_reports_absent_ones_as_errors(
    seaweed: Seaweed, s3_url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, status: int, body: Any
) -> None:
    """Some servers do, unlike S3. The first request has absent files only, the second one of each kind."""
    store = FaultyStore(seaweed.ports["s3"])
    try:
        monkeypatch.setenv("AWS_ENDPOINT_URL", store.endpoint)
        monkeypatch.setattr("app.backends.blob_s3.DELETED_AT_ONCE", 2)
        files = S3Files(s3_url, tmp_path)
        files.prepare()
        files.write({f"ab/{name}": b"x" for name in "vwxyz"})
        store.fault = Fault(status, body=body, methods=("POST",), containing=b"gone-")
        files.delete(["ab/gone-1", "ab/gone-2", "ab/v", "ab/gone-3", "ab/gone-4", "ab/w", "ab/x", "ab/y"])
        assert [f.key for f in files.list()] == ["ab/z"]
    finally:
        store.close()


def test_deleting_from_a_bucket_that_does_not_exist_fails(s3_url: str, tmp_path: Path) -> None:
    """What is not deleted must be tried again: its rows stay."""
    with pytest.raises(Unavailable, match="no such bucket"):
        S3Files("s3://none/x", tmp_path).delete(["ab/x", "ab/y"])


def test_copies_are_bounded_and_checked(tmp_path: Path) -> None:
    import hashlib

    copies = LocalCopies(tmp_path, 100_000)
    contents = [random.Random(k).randbytes(30_000) for k in range(5)]
    names = [hashlib.sha256(data).hexdigest() for data in contents]
    for k, (name, data) in enumerate(zip(names, contents, strict=True)):
        copies.add(name, iter([data]))
        os.utime(copies.path(name), (k + 1, k + 1))
    assert [copies.get(name) is not None for name in names] == [False, False, True, True, True]
    copies.path(names[4]).write_bytes(b"damaged")
    assert copies.get(names[4]) is None
    assert not copies.path(names[4]).exists()
    opened = copies.open(names[3])
    assert opened is not None
    with opened as file:
        assert file.read() == contents[3]
