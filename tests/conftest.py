"""Fixtures of all tests: the real data beside the checkout with its independent readers, and shared caches."""

from __future__ import annotations

import gc
import hashlib
import importlib
import itertools
import json
import os
import pickle
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Generator, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import yaml
from hypothesis import settings

from app import native
from tests.api.conftest import Api, running, settings_for
from tests.api.ogc_sites import create_sites
from tests.postgres import postgres_cluster, postgres_url  # noqa: F401  fixtures
from tests.preloaded import SHARED_FORKER, Forker
from tests.seaweed import s3_url, seaweed  # noqa: F401  fixtures

SHARED = Path(__file__).resolve().parents[2] / "shared"
TOP = Path(__file__).resolve().parents[1]
MEMORY = Path("/dev/shm")
ROOM = 6 << 30
"""Free bytes with which a whole run keeps its files in memory."""

COMPILE = """
import importlib
from app import native
for name in native._modules():
    importlib.import_module(name).compile_all()
"""


settings.register_profile("test", max_examples=60, deadline=None)
settings.register_profile("fuzz", max_examples=2000, deadline=None)  # make fuzz
settings.load_profile("test")


@pytest.hookimpl(tryfirst=True)  # before pytest reads where temporary files go
def pytest_configure(config: pytest.Config) -> None:
    """Share compiled code between processes: tests start hundreds of them, each of which imports the server.

    Bytecode: if the environment forbids to write it beside the sources, it goes to pytest's cache, also for the next
    run; this saves each worker half a minute. Native code: servers use the user's folder, like the tests' processes,
    not one in each data folder.
    """
    gc.set_threshold(50_000, 10, 100)  # the default spends a third of reading a large document on garbage collection
    if yaml.__with_libyaml__:  # ``safe_load`` and ``safe_dump`` of the tests take a tenth of the time
        yaml.SafeLoader, yaml.SafeDumper = yaml.CSafeLoader, yaml.CSafeDumper
    if hasattr(config, "workerinput"):  # pytest-xdist: inherits the environment of the main process
        return
    if os.environ.pop("PYTHONDONTWRITEBYTECODE", None) and "PYTHONPYCACHEPREFIX" not in os.environ:
        sys.dont_write_bytecode, sys.pycache_prefix = False, str(TOP / ".pytest_cache" / "bytecode")
        os.environ["PYTHONPYCACHEPREFIX"] = sys.pycache_prefix
    os.environ.setdefault("NUMBA_CACHE_DIR", str(native.folder().parent))
    if config.getoption("numprocesses", None):  # many tests: workers of servers may not write compiled code
        _keep_files_in_memory(config)
        process = subprocess.Popen([sys.executable, "-c", COMPILE], cwd=TOP)
        config.add_cleanup(process.wait)
        config.add_cleanup(process.kill)
        forker = Forker()
        os.environ[SHARED_FORKER] = forker.address
        config.add_cleanup(forker.stop)


def _keep_files_in_memory(config: pytest.Config) -> None:
    """Keep all temporary files of the run in memory, if it has room: writing databases to a disk takes a third longer.

    They go with the run. A few tests without workers, such as one that failed, leave theirs where pytest has them.
    """
    if "TMPDIR" in os.environ or config.option.basetemp:
        return
    if not MEMORY.is_dir() or shutil.disk_usage(MEMORY).free < ROOM:
        return
    folder = Path(tempfile.mkdtemp(prefix="fleetmap-", dir=MEMORY))
    folder.chmod(0o1777)  # as /tmp: PostgreSQL's user has a folder there
    os.environ["TMPDIR"] = tempfile.tempdir = str(folder)
    config.option.basetemp = str(folder / "t")  # short: a socket's path has at most 107 characters
    config.add_cleanup(lambda: shutil.rmtree(folder, ignore_errors=True))


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers() -> int:
    """Run two workers more than there are processors: many tests wait for agents, routers, browsers and timeouts."""
    return len(os.sched_getaffinity(0)) + 2


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(
    collector: pytest.Collector,
) -> Generator[None, pytest.CollectReport, pytest.CollectReport]:
    """Let each worker begin to read the test files at another one.

    Compiling takes the most time, and a worker need not compile what others have compiled.
    """
    report = yield
    if (worker := getattr(collector.config, "workerinput", None)) and isinstance(collector, pytest.Directory):
        first = len(report.result) * int(worker["workerid"].removeprefix("gw")) // worker["workercount"]
        report.result = report.result[first:] + report.result[:first]
    return report


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the longest tests: at the end, one worker would wait alone. Others take what is left of its part.

    The page's tests stay together, so that few workers need a browser and a server for them. All workers must have the
    same order, though each begins to read at another file.
    """
    folders = [TOP / "tests" / name for name in ("chaos", "web")]
    items.sort(key=lambda item: ([not item.path.is_relative_to(folder) for folder in folders], item.path))


def pytest_collection_finish() -> None:
    """Freeze imported and collected objects, so that the garbage collector ignores them."""
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="session")
def api(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Api]:
    """Server that most tests share; each uses its own environments."""
    with running(settings_for(tmp_path_factory.mktemp("server"))) as api:
        yield api


@pytest.fixture(scope="session")
def ogc_sites(tmp_path_factory: pytest.TempPathFactory, shared: Path) -> Iterator[Api]:
    """Server with the sites of `tests/api/ogc_sites.py`, for tests that only read."""
    with running(settings_for(tmp_path_factory.mktemp("sites"))) as api:
        create_sites(api, shared)
        yield api


_count = itertools.count(1)


@pytest.fixture
def fresh() -> Callable[[], str]:
    """Return a name that no environment has."""
    return lambda: f"env-{next(_count)}"


@pytest.fixture(scope="session")
def shared() -> Path:
    """Folder with real maps. If it is missing, CI fails and a developer's run skips these tests."""
    if not (SHARED / "data" / "facts.json").is_file():
        message = "../shared/data is absent: these tests need the real maps beside the checkout"
        if os.environ.get("CI"):
            pytest.fail(message)
        pytest.skip(message)
    return SHARED


@pytest.fixture(scope="session")
def facts(shared: Path) -> ModuleType:
    """Independent readers that count facts of a file."""
    module = _tool(shared, "facts")
    vars(module)["load_yaml"] = _with_cache(module.load_yaml)
    return module


def _with_cache(load: Callable[[bytes], Any]) -> Callable[[bytes], Any]:
    """Parse large files once, as several tests compare each with what is served. Each caller gets a copy."""
    contents: dict[bytes, bytes] = {}

    def load_copy(data: bytes) -> Any:
        if len(data) < 100_000:
            return load(data)
        key = hashlib.sha256(data).digest()
        if key not in contents:
            contents[key] = pickle.dumps(load(data), pickle.HIGHEST_PROTOCOL)
        return pickle.loads(contents[key])

    return load_copy


@pytest.fixture(scope="session")
def same(shared: Path, facts: ModuleType) -> Callable[[str, dict[str, bytes], dict[str, bytes]], list[str]]:
    """Function same(format, original, served): the differences between the information of two maps, by `facts`.

    The comparator reads large maps for seconds: it compares the same bytes once, also if two databases serve them.
    """
    function: Callable[[str, dict[str, bytes], dict[str, bytes]], list[str]] = _tool(shared, "same").same
    results: dict[tuple[object, ...], list[str]] = {}

    def compare(kind: str, original: dict[str, bytes], served: dict[str, bytes]) -> list[str]:
        key = (kind, _digest(original), _digest(served))
        if key not in results:
            results[key] = function(kind, original, served)
        return list(results[key])

    return compare


def _digest(files: dict[str, bytes]) -> str:
    return hashlib.sha256(
        repr([(n, hashlib.sha256(d).digest()) for n, d in sorted(files.items())]).encode()
    ).hexdigest()


@pytest.fixture(scope="session")
def facts_json(shared: Path) -> dict[str, Any]:
    """Facts of every real file, counted by tools that share no code with ours; key = path below data/."""
    facts: dict[str, Any] = json.loads((shared / "data" / "facts.json").read_text())["files"]
    return facts


def _tool(shared: Path, name: str) -> ModuleType:
    folder = str(shared / "tools")
    if folder not in sys.path:
        sys.path.append(folder)
    return importlib.import_module(name)
