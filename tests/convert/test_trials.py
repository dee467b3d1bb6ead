"""Trial results survive a restart; damaged ones are ignored."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from app import derive
from app.convert import trials
from app.convert.maps import Maps
from app.convert.recipe import DerivationChain
from app.convert.trials import Trials, is_lasting, trial_key
from app.derive import ChainFailure
from app.limits import Limits
from app.pool import WorkerDied
from tests.api import samples
from tests.api.conftest import Api

FAILED = ChainFailure("occupancy_to_topology", "name one\nwith grid=", choose=True)


def test_trial_results_survive_restart(tmp_path: Path) -> None:
    first = Trials(tmp_path / "trials")
    first.add("works", None, lasting=True)
    first.add("fails", ChainFailure("a", "first"), lasting=True)
    first.add("fails", FAILED, lasting=True)
    first.add("for now", FAILED, lasting=False)
    assert first["for now"] == FAILED
    again = Trials(tmp_path / "trials")
    assert again["works"] is None
    assert again["fails"] == FAILED
    for key in ("for now", "never"):
        with pytest.raises(KeyError):
            again[key]


@pytest.mark.parametrize(
    "damage",
    [
        lambda raw: raw[:-30],
        lambda raw: raw.replace(b"null", b"true"),
        lambda raw: raw.replace(b"works", b"fails"),
        lambda raw: b"\x00" * len(raw),
        lambda raw: raw.replace(b"\n", b" "),
        lambda raw: b"\xff\xfe\n" + raw[3:],
    ],
)
def test_damaged_lines_are_skipped(tmp_path: Path, damage: Callable[[bytes], bytes]) -> None:
    path = tmp_path / "trials"
    Trials(path).add("works", None, lasting=True)
    path.write_bytes(damage(path.read_bytes()))
    again = Trials(path)
    for key in ("works", "fails"):
        with pytest.raises(KeyError):
            again[key]
    again.add("works", None, lasting=True)
    again.add("next", None, lasting=True)
    assert Trials(path)["next"] is None


def test_fields_of_another_release_are_skipped(tmp_path: Path) -> None:
    path = tmp_path / "trials"
    for text in (b'["key",{"other":1}]', b'["key"]', b"7"):
        path.write_bytes(trials._digest(text) + b" " + text + b"\n")
        with pytest.raises(KeyError):
            Trials(path)["key"]


def test_trials_in_memory_and_file_are_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trials, "MAX_TRIALS", 5)
    path = tmp_path / "trials"
    trial_record = Trials(path)
    for number in range(100):
        trial_record.add(str(number), None, lasting=True)
        assert len(path.read_bytes().splitlines()) <= 10
    again = Trials(path)
    assert again["99"] is None
    with pytest.raises(KeyError):
        again["90"]
    assert [p.name for p in tmp_path.iterdir()] == ["trials"]


def test_trials_stay_in_memory_when_disk_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "trials").mkdir()
    trial_record = Trials(tmp_path / "trials")
    trial_record.add("works", None, lasting=True)
    assert trial_record["works"] is None


class Runs:
    """Runner that runs jobs immediately and counts them."""

    def __init__(self) -> None:
        self.count = 0

    def __call__(self, function: Callable[..., Any], *args: Any, **_: Any) -> Any:
        self.count += 1
        return function(*args)


def open_maps(api: Api, folder: Path, run: Any) -> Maps:
    return Maps(api.app.state.services.store, run, folder, Limits())


@pytest.fixture
def version(api: Api, fresh: Callable[[], str]) -> Any:
    env = fresh()
    api.post("environments", {"name": env})
    api.upload(env, samples.grid())
    return api.app.state.services.store.versions.get(env, 1)


def test_coverage_after_restart_runs_no_trial(api: Api, version: Any, tmp_path: Path) -> None:
    run, again = Runs(), Runs()
    before = open_maps(api, tmp_path, run).coverage(version)
    assert run.count
    assert open_maps(api, tmp_path, again).coverage(version) == before
    assert again.count == 0


def test_coverage_after_damage_repeats_trials(api: Api, version: Any, tmp_path: Path) -> None:
    run, again = Runs(), Runs()
    before = open_maps(api, tmp_path, run).coverage(version)
    path = tmp_path / "trials"
    path.write_bytes(path.read_bytes().replace(b"null", b"nul1"))
    assert open_maps(api, tmp_path, again).coverage(version) == before
    assert 0 < again.count <= run.count


def test_result_of_dead_worker_is_not_stored(api: Api, version: Any, tmp_path: Path) -> None:
    def die(*_: Any, **__: Any) -> Any:
        raise WorkerDied("out of memory")

    run = Runs()
    dead = open_maps(api, tmp_path, die).coverage(version)
    well = open_maps(api, tmp_path, run).coverage(version)
    assert run.count
    assert dead != well


def test_trial_result_with_a_model_is_not_stored(version: Any) -> None:
    step = derive.all_derivations()["imagery_to_objects"].step()
    plain = DerivationChain((step,), ())
    assert is_lasting(plain)
    with_model = derive.with_parameters([step], {"model": "trees"})
    assert not is_lasting(DerivationChain(with_model, ()))
    assert trial_key(version, plain) != trial_key(version, DerivationChain(with_model, ()))


def test_trials_do_not_wait_for_maps(api: Api, version: Any, tmp_path: Path) -> None:
    def busy(*_: Any, **__: Any) -> Any:
        raise AssertionError("it waits for a worker that makes maps")

    maps = Maps(api.app.state.services.store, busy, tmp_path, Limits(), run_trial=Runs())
    assert any(line["state"] == "derivable" for line in maps.coverage(version))
