"""Compile functions to native code with numba, and cache the code between processes.

Compiling takes seconds, loading compiled code milliseconds. Worker processes may not write (``app.sandbox``), so a
process that only compiles and reads no input fills the folder (``fill``). If the folder cannot be read or written,
functions are compiled in memory: the folder never makes a derivation fail. numba is imported with the first kernel, so
that it does not delay the start of the server.
"""

from __future__ import annotations

import contextlib
import ctypes
import hashlib
import importlib
import os
import platform
import shutil
import signal
import tempfile
from collections.abc import Callable
from contextvars import ContextVar
from importlib import metadata
from pathlib import Path
from typing import Any, ClassVar, TypeVar, cast

F = TypeVar("F", bound=Callable[..., Any])

FOLDER = "NUMBA_CACHE_DIR"
"""Variable of numba for the folder. Unset: the user's cache folder."""

_base: ContextVar[Path | None] = ContextVar("base", default=None)
"""Folder to compile into, before what ``FOLDER`` names."""

_KERNELS = "_kernels_"
"""Name prefix of modules that contain only kernels; they are imported on first use."""

_PACKAGES = ("derive", "generate")
"""Packages below ``app`` with such modules."""

_PREFIX = "fleetmap-native-"
_PARENT_DEATH_SIGNAL = 1
"""Option PR_SET_PDEATHSIG of prctl (linux/prctl.h)."""


def folder() -> Path:
    """Return the folder for compiled code of this release, machine and user; it need not exist."""
    setting = _base.get() or os.environ.get(FOLDER)
    base = Path(setting) if setting else Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "fleetmap"
    return base / _key()


def native(function: F) -> F:
    """Compile a function to native code that releases the GIL, on the first call or from the folder."""
    import numba

    compiled: Any = numba.njit(nogil=True)(function)
    with contextlib.suppress(Exception):  # numba's internals may change: then without a folder
        compiled._cache = _cache(function)
    return cast(F, compiled)


def is_filled(directory: Path) -> bool:
    """Return whether ``fill`` has nothing to do."""
    return (directory / _key()).is_dir()


def fill(directory: Path) -> None:
    """Compile all kernels into ``directory`` (the value of ``NUMBA_CACHE_DIR``), unless this was done before.

    It never reads existing files, and creates the new folder atomically: no incomplete file is ever loaded.
    """
    if is_filled(directory):
        return
    directory.mkdir(parents=True, exist_ok=True)
    for old in directory.glob(f"{_PREFIX}*"):  # of other releases
        shutil.rmtree(old, ignore_errors=True)
    with tempfile.TemporaryDirectory(dir=directory, prefix=f"{_PREFIX}part-") as scratch:
        token = _base.set(Path(scratch))
        try:
            for module in _modules():
                importlib.import_module(module).compile_all()
        finally:
            _base.reset(token)
        build = Path(scratch) / _key()
        if build.is_dir():
            with contextlib.suppress(OSError):  # another process was quicker
                build.rename(directory / _key())


def fill_quietly(directory: Path) -> None:
    """Run ``fill`` in a separate process, with low priority and without errors."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # on Ctrl-C the server ends this process
    with contextlib.suppress(Exception):
        ctypes.CDLL(None).prctl(_PARENT_DEATH_SIGNAL, signal.SIGKILL)  # end with the server, even if it is killed
        os.nice(19)
        fill(directory)


def _modules() -> list[str]:
    app = __name__.split(".", maxsplit=1)[0]
    return [f"{app}.{file.parent.name}.{file.stem}" for file in _files()]


def _files() -> list[Path]:
    """List the kernel modules."""
    app = Path(__file__).parent
    return sorted(file for package in _PACKAGES for file in (app / package).glob(f"{_KERNELS}*.py"))


def _key() -> str:
    """Hash the dependencies of compiled code, except the processor, which numba checks itself."""
    digest = hashlib.blake2b(digest_size=8)
    for file in _files():
        digest.update(file.read_bytes())
    parts = (metadata.version("numba"), metadata.version("numpy"), platform.python_version(), platform.machine())
    digest.update(repr(parts).encode())
    return f"{_PREFIX}{digest.hexdigest()}"


def _cache(function: Callable[..., Any]) -> Any:
    """Create numba's cache of one function in our folder, even if that is not writable."""
    from numba.core import caching

    place = folder()

    class Locator(caching.UserProvidedCacheLocator):
        def get_cache_path(self) -> str:
            return str(place)

        def ensure_cache_path(self) -> None:
            with contextlib.suppress(OSError):
                place.mkdir(mode=0o700, parents=True, exist_ok=True)

        @classmethod
        def from_function(cls, py_func: Any, py_file: str) -> Any:
            locator = cls(py_func, py_file)
            locator.ensure_cache_path()
            return locator

    class Stored(caching.CompileResultCacheImpl):
        _locator_classes: ClassVar[Any] = [Locator]  # type: ignore[misc]

    class Cache(caching.FunctionCache):
        _impl_class = Stored

        def load_overload(self, sig: Any, target_context: Any) -> Any:
            with contextlib.suppress(Exception):  # damaged: compile again
                return super().load_overload(sig, target_context)  # type: ignore[no-untyped-call]
            return None

        def save_overload(self, sig: Any, data: Any) -> None:
            with contextlib.suppress(Exception):  # not writable, or damaged
                super().save_overload(sig, data)  # type: ignore[no-untyped-call]

    return Cache(function)  # type: ignore[no-untyped-call]
