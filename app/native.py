"""Functions compiled to native code by numba, kept compiled between processes.

Compiling takes seconds, loading what was compiled milliseconds. Worker processes may not write (``app.sandbox``), so
the folder is filled by a process that only compiles (``fill``) and reads nothing; where nothing can be read or written,
a function is compiled in memory: a folder never makes a derivation fail. numba is imported with the first kernel, so
that starting the server does not pay for it.
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
"""numba's own variable for the folder; without it the user's cache folder is taken."""

_base: ContextVar[Path | None] = ContextVar("base", default=None)
"""Folder to compile into, before what ``FOLDER`` names."""

_KERNELS = "_kernels_"
"""Modules of this name hold kernels and nothing else; they are imported when first needed."""

_PACKAGES = ("derive", "generate")
"""Folders beside and including this one's that have such modules."""

_PREFIX = "fleetmap-native-"
_PARENT_DEATH_SIGNAL = 1
"""prctl's, linux/prctl.h."""


def folder() -> Path:
    """Where compiled code of this release, machine and user is kept; it need not exist."""
    setting = _base.get() or os.environ.get(FOLDER)
    base = Path(setting) if setting else Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "fleetmap"
    return base / _key()


def native(function: F) -> F:
    """The function as native code that holds no lock; compiled when first called, or loaded from the folder."""
    import numba

    compiled: Any = numba.njit(nogil=True)(function)
    with contextlib.suppress(Exception):  # another numba may look otherwise inside: then without a folder
        compiled._cache = _cache(function)
    return cast(F, compiled)


def is_filled(directory: Path) -> bool:
    """Whether ``fill`` has nothing to do."""
    return (directory / _key()).is_dir()


def fill(directory: Path) -> None:
    """Compile all kernels into ``directory`` (what ``NUMBA_CACHE_DIR`` names), unless this was done before.

    It never reads what stands there, and the new folder appears in one step: nothing half-written is ever loaded.
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
    """``fill`` for a process of its own: politely, and without a word where it cannot be done."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the server, which ends this process
    with contextlib.suppress(Exception):
        ctypes.CDLL(None).prctl(_PARENT_DEATH_SIGNAL, signal.SIGKILL)  # it ends with the server, however that ends
        os.nice(19)
        fill(directory)


def _modules() -> list[str]:
    app = __name__.split(".", maxsplit=1)[0]
    return [f"{app}.{file.parent.name}.{file.stem}" for file in _files()]


def _files() -> list[Path]:
    """The modules that hold kernels."""
    app = Path(__file__).parent
    return sorted(file for package in _PACKAGES for file in (app / package).glob(f"{_KERNELS}*.py"))


def _key() -> str:
    """A name for what compiled code depends on besides the processor, which numba itself looks at."""
    digest = hashlib.blake2b(digest_size=8)
    for file in _files():
        digest.update(file.read_bytes())
    parts = (metadata.version("numba"), metadata.version("numpy"), platform.python_version(), platform.machine())
    digest.update(repr(parts).encode())
    return f"{_PREFIX}{digest.hexdigest()}"


def _cache(function: Callable[..., Any]) -> Any:
    """numba's cache of one function in our folder, whether or not it can be written."""
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
            with contextlib.suppress(Exception):  # damaged: compiled again
                return super().load_overload(sig, target_context)  # type: ignore[no-untyped-call]
            return None

        def save_overload(self, sig: Any, data: Any) -> None:
            with contextlib.suppress(Exception):  # not ours to write, or damaged
                super().save_overload(sig, data)  # type: ignore[no-untyped-call]

    return Cache(function)  # type: ignore[no-untyped-call]
