"""Multipart uploads, streamed to disk while they arrive: counted, hashed, limited.

The name of a file may be a relative path and is stored as sent; it is never used as a name on disk. The files of a
request are in a directory of the spool, which is removed with the request. The next start removes leftovers of a
killed server (``UploadSpool``).
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import shutil
import threading
from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any
from uuid import uuid4

from fastapi import Request
from python_multipart.exceptions import FormParserError
from python_multipart.multipart import MultipartParser, parse_options_header
from starlette.concurrency import run_in_threadpool

from app.api.http.problems import MalformedBody
from app.backends.room import check_room
from app.backends.workspaces import Workspaces
from app.errors import DISK_FULL_ERRNOS, Invalid, NoRoom, Problem, TooLarge, Unavailable
from app.ingest import SpooledFile
from app.limits import Limits

BATCH = 2**20
"""Size of a batch that a thread parses, hashes and writes, in bytes."""

MAX_FIELD = 64 * 2**10
MAX_FIELDS = 100
MAX_HEADERS = 8
MAX_HEADER = 8 * 2**10

FILES = "files"


@dataclass(slots=True)
class UploadForm:
    """Content of an upload: files in order, and the other fields."""

    files: list[SpooledFile] = field(default_factory=list)
    fields: dict[str, str] = field(default_factory=dict)


class UploadSpool:
    """Spool directory for uploads: limits concurrent uploads, and removes leftovers of ended processes."""

    def __init__(self, spool: Path, limits: Limits, *, at_once: int) -> None:
        self._limits, self._at_once = limits, at_once
        self._active = 0
        self._lock = threading.Lock()
        self._workspaces, self._opened = Workspaces(spool), contextlib.ExitStack()
        self._folder: Path | None = None
        with contextlib.suppress(OSError):  # a full disk must not prevent the server's start
            self._workspaces.recover()
            self._open()

    def _open(self) -> Path:
        """Return the directory of this process, which a later start removes if this process has ended."""
        with self._lock:
            if self._folder is None:
                self._folder = self._opened.enter_context(self._workspaces.create())
            return self._folder

    def check(self) -> None:
        """Raise NoRoom or Unavailable if an upload could not be spooled."""
        try:
            check_room(self._open())
        except OSError as error:
            kind = NoRoom if error.errno in DISK_FULL_ERRNOS else Unavailable
            raise kind(f"the upload directory cannot be written: {error.strerror}") from error

    def close(self) -> None:
        """Remove the directory of this process."""
        self._opened.close()

    @contextlib.asynccontextmanager
    async def receive(self, request: Request) -> AsyncIterator[UploadForm]:
        """Receive the form of a multipart request; its files exist until the end of the block.

        Raises Unavailable (too many concurrent uploads), MalformedBody, Invalid, TooLarge.
        """
        with self._lock:
            if self._active >= self._at_once:
                raise Unavailable("too many concurrent uploads: try again in a few seconds")
            self._active += 1
        folder: Path | None = None
        try:
            boundary = _boundary(request.headers.get("content-type", ""))
            folder = self._open() / uuid4().hex
            folder.mkdir()
            receiver = _MultipartReceiver(boundary, folder, self._limits)
            try:
                await _feed(request, receiver)
            finally:
                receiver.close()
            yield receiver.form
        finally:
            with self._lock:
                self._active -= 1
            if folder is not None:
                await run_in_threadpool(shutil.rmtree, folder, True)


def _boundary(content_type: str) -> bytes:
    """Return the boundary of a multipart body. Raises MalformedBody if there is none."""
    _, options = parse_options_header(content_type)
    boundary = options.get(b"boundary", b"")
    if not 1 <= len(boundary) <= 200:
        raise MalformedBody("missing or invalid boundary in the Content-Type of the multipart body")
    return boundary


async def _feed(request: Request, receiver: _MultipartReceiver) -> None:
    batch: list[bytes] = []
    size = 0
    async for chunk in request.stream():
        batch.append(chunk)
        size += len(chunk)
        if size >= BATCH:
            await run_in_threadpool(receiver.write, b"".join(batch))
            batch, size = [], 0
    await run_in_threadpool(receiver.finish, b"".join(batch))


class _MultipartReceiver:
    """Parser of one body: files to disk, fields to memory."""

    def __init__(self, boundary: bytes, folder: Path, limits: Limits) -> None:
        self.form = UploadForm()
        self._folder, self._limits = folder, limits
        self._total = 0
        self._ended = False
        self._header_name, self._header_value = bytearray(), bytearray()
        self._disposition = b""
        self._file: IO[bytes] | None = None
        self._file_name = ""
        self._file_size = 0
        self._hash = hashlib.sha256()
        self._field: str | None = None
        self._value = bytearray()
        callbacks: dict[str, Callable[..., Any]] = {
            "on_part_begin": self._part_begin,
            "on_header_field": lambda data, start, end: self._header_name.extend(data[start:end]),
            "on_header_value": lambda data, start, end: self._header_value.extend(data[start:end]),
            "on_header_end": self._header_end,
            "on_headers_finished": self._part_starts,
            "on_part_data": self._part_data,
            "on_part_end": self._part_end,
            "on_end": self._end,
        }
        self._parser = MultipartParser(
            boundary,
            callbacks,  # type: ignore[arg-type]
            max_header_count=MAX_HEADERS,
            max_header_size=MAX_HEADER,
        )

    def write(self, data: bytes) -> None:
        """Parse the next bytes of the body."""
        try:
            self._parser.write(data)
        except FormParserError as error:
            raise MalformedBody(f"malformed multipart body: {error}") from error

    def finish(self, data: bytes) -> None:
        """Parse the last bytes of the body, which must be complete."""
        self.write(data)
        if not self._ended:
            raise MalformedBody("the multipart body ends before its closing boundary: send it again")

    def close(self) -> None:
        """Close an incomplete file."""
        if self._file is not None:
            self._file.close()
            self._file = None

    def _part_begin(self) -> None:
        self._disposition = b""
        self._header_name.clear()
        self._header_value.clear()

    def _header_end(self) -> None:
        name, value = bytes(self._header_name).lower(), bytes(self._header_value)
        if name == b"content-disposition":
            self._disposition = value
        plain = value.strip().lower() in (b"binary", b"8bit", b"7bit")
        if name == b"content-transfer-encoding" and not plain:
            raise MalformedBody("unsupported Content-Transfer-Encoding: send parts without it")
        self._header_name.clear()
        self._header_value.clear()

    def _part_starts(self) -> None:
        kind, options = parse_options_header(self._disposition.decode("latin-1"))
        if kind != b"form-data" or b"name" not in options:
            raise MalformedBody("a part has no field name: send Content-Disposition: form-data; name=…")
        name = _text(options[b"name"], "field name")
        file_name = options.get(b"filename")
        if file_name is None and name != FILES:
            if len(self.form.fields) >= MAX_FIELDS:
                raise TooLarge(f"the form has more than {MAX_FIELDS} fields")
            if name in self.form.fields:
                raise Invalid(f"duplicate field {name!r}: give it once", [Problem("duplicate", where=name)])
            self._field, self._value = name, bytearray()
            return
        if name != FILES:
            raise Invalid(
                f"unexpected file field {name[:80]!r}: send files in the field '{FILES}'",
                [Problem("not a file field", where=name)],
            )
        if not file_name:
            raise Invalid("a file has no name: send filename=… in its Content-Disposition")
        if len(self.form.files) >= self._limits.files:
            raise TooLarge(
                f"the upload has more than {self._limits.files} files: send fewer, or ask the operator to raise "
                "the limit"
            )
        self._file_name = _text(file_name, "file name")
        self._file_size, self._hash = 0, hashlib.sha256()
        self._file = (self._folder / str(len(self.form.files))).open("wb")

    def _part_data(self, data: bytes, start: int, end: int) -> None:
        if self._file is not None:
            self._total += end - start
            if self._total > self._limits.upload_bytes:
                raise TooLarge(
                    f"the files are larger than {self._limits.upload_bytes} bytes: send less, or ask the "
                    "operator to raise the limit"
                )
            chunk = memoryview(data)[start:end]
            self._file.write(chunk)
            self._hash.update(chunk)
            self._file_size += end - start
        elif self._field is not None:
            self._value += data[start:end]
            if len(self._value) > MAX_FIELD:
                raise TooLarge(f"the field {self._field[:80]!r} is longer than {MAX_FIELD} bytes")

    def _part_end(self) -> None:
        if self._file is not None:
            self._file.close()
            path = Path(os.fspath(self._file.name))
            self._file = None
            self.form.files.append(SpooledFile(self._file_name, path, self._file_size, self._hash.hexdigest()))
        elif self._field is not None:
            self.form.fields[self._field] = _text(bytes(self._value), f"field {self._field[:80]!r}")
            self._field = None

    def _end(self) -> None:
        self._ended = True


def _text(data: bytes, label: str) -> str:
    """Decode UTF-8 without NUL. Raises Invalid with the label of the part."""
    try:
        text = data.decode()
    except UnicodeDecodeError:
        raise Invalid(f"a {label} of the form is not UTF-8") from None
    if "\0" in text:
        raise Invalid(f"a {label} of the form has a NUL character")
    return text
