"""Write map files to the local disk: atomically, and never outside the chosen folder."""

from __future__ import annotations

import contextlib
import io
import os
import shutil
import sys
import tempfile
import zipfile
from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import IO

from app.errors import Invalid
from app.model.names import name_problem

STDOUT = Path("-")


def wants_folder(output: str | None) -> bool:
    """Whether the output is a folder: an existing one, or a name with a trailing slash."""
    return output is not None and (output.endswith("/") or Path(output).is_dir())


def to_stdout(stream: IO[bytes]) -> None:
    """Copy all bytes to standard output. Raises Invalid if that is a terminal."""
    if sys.stdout.isatty():
        raise Invalid("binary output to a terminal: redirect it, or write a file with -o")
    shutil.copyfileobj(stream, sys.stdout.buffer)
    sys.stdout.buffer.flush()


def to_file(path: Path, stream: IO[bytes]) -> None:
    """Write all bytes to a file atomically: to a temporary file, which is then renamed. Raises Invalid.

    A device or pipe, such as ``/dev/stdout``, is written to, not replaced.
    """
    if path.exists() and not path.is_dir() and (not path.is_file() or path.parts[:2] in (("/", "dev"), ("/", "proc"))):
        try:
            with path.open("wb") as target:
                shutil.copyfileobj(stream, target)
        except OSError as error:
            raise Invalid(f"could not write {path}: {error.strerror or error}") from error
        return
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name[:100]}.")
    except OSError as error:
        raise Invalid(f"could not write {path}: {error.strerror or error}") from error
    try:
        with os.fdopen(handle, "wb") as target:
            shutil.copyfileobj(stream, target)
        mask = os.umask(0)
        os.umask(mask)
        Path(temporary).chmod(0o666 & ~mask)
        Path(temporary).replace(path)
    except BaseException as error:
        with contextlib.suppress(OSError):
            Path(temporary).unlink()
        if isinstance(error, OSError):
            raise Invalid(f"could not write {path}: {error.strerror or error}") from error
        raise


def unpack(archive: Path, folder: Path) -> list[str]:
    """Unpack an archive from the server to a folder. Return the file names. Raises Invalid for unsafe names."""
    names = []
    with zipfile.ZipFile(archive) as opened:
        members = [m for m in opened.infolist() if not m.is_dir()]
        targets = [inside(folder, member.filename) for member in members]
        for member, target in zip(members, targets, strict=True):
            with opened.open(member) as stream:
                to_file(target, stream)
            names.append(member.filename)
    return names


def inside(folder: Path, name: str) -> Path:
    """Return the path of a file below a folder. Raises Invalid for names that would leave it."""
    reason = name_problem(name)
    if reason:
        raise Invalid(f"unsafe file name {name[:80]!r} in the map: it {reason}")
    return folder.joinpath(*PurePosixPath(name).parts)


def bundle(files: Mapping[str, bytes], output: Path, *, folder: bool) -> list[str]:
    """Write a map as a folder, a file (several files as a ZIP) or to standard output. Return the file names."""
    from app.syntax.archives import pack

    targets = {name: inside(output, name) for name in files}
    if folder:
        for name, data in files.items():
            to_file(targets[name], io.BytesIO(data))
        return list(files)
    content = next(iter(files.values())) if len(files) == 1 else pack(files, next(iter(files)))
    if output == STDOUT:
        to_stdout(io.BytesIO(content))
    else:
        to_file(output, io.BytesIO(content))
    return list(files)
