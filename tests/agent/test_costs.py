"""Number of bytes that an agent receives for a change on a real site, including the manifest."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.api.conftest import ADMIN, Api, running, settings_for
from tests.bench import changes


@pytest.fixture(scope="module")
def api(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Api]:
    with running(settings_for(tmp_path_factory.mktemp("server"))) as api:
        yield api


@pytest.fixture(scope="module")
def upload(api: Api) -> changes.Upload:
    def upload(env: str, files: dict[str, bytes]) -> None:
        api.post("environments", {"name": env}, None)
        api.upload(env, files)

    return upload


def test_delta_of_moved_node_is_below_one_kilobyte(api: Api, shared: Path, upload: changes.Upload) -> None:
    assert changes.moved_node(shared, upload, str(api.http.base_url), ADMIN) <= 1000


def test_delta_of_large_grid_is_small_for_changed_block(api: Api, shared: Path, upload: changes.Upload) -> None:
    cost, picture = changes.changed_block(shared, upload, str(api.http.base_url), ADMIN)
    assert cost <= 0.15 * picture
