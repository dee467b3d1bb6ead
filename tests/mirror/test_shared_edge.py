"""An edge with several servers: the mirror on PostgreSQL and S3, its processes of which one works."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from app.backends.blob_s3 import S3Files
from app.store.store import Store
from tests.api.conftest import Api, create_farm
from tests.events.conftest import eventually
from tests.mirror.conftest import mirror_token
from tests.mirror.test_mirror import rows
from tests.preloaded import PreloadedProcess

Start = Callable[[str], PreloadedProcess]


@pytest.fixture
def start(centre: Api, postgres_url: str, s3_url: str, tmp_path: Path) -> Iterator[Start]:
    """Function that starts ``fleetmap mirror`` with a data folder of its own on the shared database and bucket."""
    token = tmp_path / "token"
    token.write_text(mirror_token(centre))
    clean = {name: value for name, value in os.environ.items() if not name.startswith("FLEETMAP_")}
    shared = {"FLEETMAP_DATABASE_URL": postgres_url, "FLEETMAP_BLOB_URL": s3_url}
    started: list[PreloadedProcess] = []

    def launch(name: str) -> PreloadedProcess:
        arguments = ["mirror", centre.url, "--token-file", str(token), "-e", "shared-*"]
        environment = {**clean, **shared, "FLEETMAP_DATA_DIR": str(tmp_path / name)}
        with (tmp_path / f"{name}.log").open("w") as log:
            started.append(PreloadedProcess(arguments, env=environment, cwd=tmp_path, output=log))
        return started[-1]

    yield launch
    for process in started:
        process.kill()
        process.wait(60)


def test_second_process_goes_on_when_the_first_is_killed(
    centre: Api, start: Start, postgres_url: str, s3_url: str, tmp_path: Path
) -> None:
    farm = create_farm(centre, "shared-farm")
    edge = Store(postgres_url, tmp_path / "edge" / "blobs", files=S3Files(s3_url, tmp_path / "edge" / "blobs"))
    edge.initialise()

    def head() -> int:
        return next((one.head for one in edge.mirror_target.environments().values()), -1)

    try:
        processes = [start("one"), start("two")]
        eventually(lambda: head() == 3)

        def leader() -> str:
            with edge.transaction() as connection:
                holder = connection.exec_driver_sql("SELECT holder FROM lead WHERE name = 'mirror'").scalar()
            return str(holder or "")

        working = 0 if leader().endswith("/one") else 1
        processes[working].send_signal(signal.SIGKILL)
        centre("PATCH", f"environments/{farm}", 200, json={"datum": {"latitude": 53.2, "longitude": 0.5}})
        eventually(lambda: head() == 4)
        assert leader().endswith(("/one", "/two")[1 - working])
        there = centre.app.state.services.store
        assert rows(edge, farm) == rows(there, farm)
        uploads = {source.sha256 for number in range(5) for source in edge.versions.get(farm, number).sources}
        assert uploads
        assert all(edge.blobs.get(name) == there.blobs.get(name) for name in uploads), "from the bucket"
        processes[1 - working].terminate()
        assert processes[1 - working].wait(60) == 0
    finally:
        edge.close()
