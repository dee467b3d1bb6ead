"""Blob store in an S3 bucket, by obstore. The usual ``AWS_*`` environment variables configure the access."""

from __future__ import annotations

import builtins
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Final
from urllib.parse import urlsplit

import obstore
from obstore import exceptions
from obstore.store import S3Store

from app.backends.blobs import BLOCK, StoredFile, Unreadable, unwritable_error
from app.backends.s3_faults import Fault, check_endpoint, fault_of
from app.backends.workspaces import Workspaces
from app.errors import Invalid, NoRoom, Unavailable

if TYPE_CHECKING:
    from obstore.store import ClientConfig, RetryConfig, S3Config

CONNECT_SECONDS: Final = 3
STALL_SECONDS: Final = 10
"""Seconds without a byte after which a request is given up."""
REQUEST_SECONDS: Final = 600
RETRIES: Final = 2
PROBE: Final = "probe"
AT_ONCE: Final = 8
DELETED_AT_ONCE: Final = 500

_BEYOND: Final = "416 Range Not Satisfiable"


class S3Files:
    """Files in a bucket, below the URL ``s3://bucket[/prefix]``.

    Args:
        folder: for workspaces on this machine.
        access_key, secret_key: instead of those of the ``AWS_*`` variables.

    Raises Invalid if the address of the server (``AWS_ENDPOINT_URL``) is unusable.
    """

    remote = True

    def __init__(self, url: str, folder: Path, *, access_key: str | None = None, secret_key: str | None = None) -> None:
        if (fault := check_endpoint()) is not None:
            raise Invalid(str(fault))
        parts = urlsplit(url)
        self._place = f"s3://{parts.netloc}{parts.path.rstrip('/')}"
        self._workspaces = Workspaces(folder / "tmp")
        keys: S3Config = {}
        if access_key is not None and secret_key is not None:
            keys = {"access_key_id": access_key, "secret_access_key": secret_key}
        self._store = _open(parts.netloc, parts.path, keys, retries=RETRIES, stall=STALL_SECONDS)
        self._probing = _open(parts.netloc, parts.path, keys, retries=0, stall=CONNECT_SECONDS)
        self._threads = ThreadPoolExecutor(AT_ONCE, thread_name_prefix="fleetmap-s3")

    def prepare(self) -> None:
        """Create the folder for workspaces; the bucket must exist."""
        self._workspaces.folder.mkdir(parents=True, exist_ok=True)

    def workspace(self) -> AbstractContextManager[Path]:
        """Create a folder for temporary files."""
        return self._workspaces.create()

    def write(self, files: Mapping[str, bytes | Path]) -> None:
        """Store files, several at once."""

        def put(item: tuple[str, bytes | Path]) -> None:
            obstore.put(self._store, item[0], item[1])

        try:
            list(self._threads.map(put, files.items()))
        except exceptions.BaseError as error:
            raise self._unwritable(error) from error
        except OSError as error:
            raise self._unwritable(error) if _is_of_store(error) else unwritable_error(error) from error

    def stream(self, key: str, start: int = 0, size: int | None = None) -> Iterator[bytes]:
        """Read a file in pieces."""
        if size == 0:
            return
        try:
            got = obstore.get(self._store, key) if size is None and not start else self._range(key, start, size)
            for block in got.stream(min_chunk_size=BLOCK):
                yield bytes(block)
        except FileNotFoundError as error:
            if "NoSuchBucket" in str(error):
                raise Unreadable(f"{self._place} cannot be read (no such bucket): create it") from error
            raise
        except (exceptions.BaseError, OSError) as error:
            if _BEYOND in str(error):  # the file was cut off
                return
            raise Unreadable(f"{self._place} cannot be read ({fault_of(error)}): try again later") from error

    def _range(self, key: str, start: int, size: int | None) -> obstore.GetResult:
        if size is None:
            return obstore.get(self._store, key, options={"range": {"offset": start}})
        return obstore.get(self._store, key, options={"range": (start, start + size)})

    def delete(self, keys: Iterable[str]) -> None:
        """Remove files. One that does not exist is no error, also for a server that reports it as one."""
        names = list(keys)
        try:
            for start in range(0, len(names), DELETED_AT_ONCE):
                self._delete_some(names[start : start + DELETED_AT_ONCE])
        except (exceptions.BaseError, OSError) as error:
            raise self._unwritable(error) from error

    def _delete_some(self, names: builtins.list[str]) -> None:
        """Remove files in one request; if the server misses one of them, each by itself: others may still exist."""
        try:
            obstore.delete(self._store, names)
        except (exceptions.BaseError, OSError) as error:
            if not _is_absent_file(error):
                raise
            if len(names) > 1:
                list(self._threads.map(self._delete_some, ([name] for name in names)))

    def list(self, prefix: str = "") -> Iterator[StoredFile]:
        """List files."""
        try:
            for some in obstore.list(self._store, prefix.rstrip("/") or None):
                for one in some:
                    if not one["path"].startswith(PROBE):
                        yield StoredFile(one["path"], one["size"], one["last_modified"].timestamp())
        except (exceptions.BaseError, OSError) as error:
            raise Unreadable(f"{self._place} cannot be listed ({fault_of(error)}): try again later") from error

    def check(self, *, readonly: bool = False) -> None:
        """Raise Unavailable unless a small file can be written (``readonly``: the bucket listed) within seconds."""
        try:
            if readonly:
                next(iter(obstore.list(self._probing, chunk_size=1)), None)
            else:
                obstore.put(self._probing, PROBE, b"fleetmap")
        except (exceptions.BaseError, OSError) as error:
            raise self._unwritable(error) from error

    def find_faults(self) -> Iterator[tuple[str, Fault]]:
        """Try all that a server does with a small file, within seconds; yield what it cannot do, and why."""
        key = f"{PROBE}-{os.getpid()}"
        steps: dict[str, Callable[[], object]] = {
            "written": lambda: obstore.put(self._probing, key, b"fleetmap"),
            "read": lambda: obstore.get(self._probing, key).bytes(),
            "listed": lambda: next(iter(obstore.list(self._probing, chunk_size=1)), None),
            "emptied": lambda: obstore.delete(self._probing, [key]),
        }
        is_written = False
        for done, step in steps.items():
            try:
                step()
                is_written |= done == "written"
            except (exceptions.BaseError, OSError) as error:
                if is_written or "NoSuchKey" not in str(error):  # a file that could not be written is no second fault
                    yield done, fault_of(error)

    def recover(self) -> int:
        """Remove the workspaces of ended processes."""
        self.prepare()
        return self._workspaces.recover()

    def _unwritable(self, error: Exception) -> Unavailable:
        fault = fault_of(error)
        if fault.is_full:
            return NoRoom(
                f"{self._place} has no space left ({fault.reason}), and nothing was stored: try again when its "
                "operator has freed space"
            )
        return Unavailable(f"{self._place} cannot be written ({fault}), and nothing was stored: try again later")


def _open(bucket: str, prefix: str, keys: S3Config, *, retries: int, stall: int) -> S3Store:
    client: ClientConfig = {
        "allow_http": True,  # if the endpoint's address says so
        "connect_timeout": timedelta(seconds=CONNECT_SECONDS),
        "read_timeout": timedelta(seconds=stall),
        "timeout": timedelta(seconds=REQUEST_SECONDS if retries else stall),
    }
    retry: RetryConfig = {"max_retries": retries, "retry_timeout": timedelta(seconds=2 * STALL_SECONDS)}
    folder = prefix.strip("/") or None
    return S3Store(bucket, prefix=folder, config=keys, client_options=client, retry_config=retry)


def _is_absent_file(error: Exception) -> bool:
    """Whether a request failed since a file does not exist; not since its bucket does not."""
    text = str(error)
    return "NoSuchBucket" not in text and (isinstance(error, FileNotFoundError) or "NoSuchKey" in text)


def _is_of_store(error: OSError) -> bool:
    """Whether an OSError is the store's answer (obstore uses FileNotFoundError), not one of a local file."""
    return "Object at location" in str(error) or "S3" in str(error)
