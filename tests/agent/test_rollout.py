"""Real agents in a roll-out: they fetch, they are counted, they move together, and go back where one cannot take it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from tests.agent.conftest import Start, network
from tests.api.conftest import Api
from tests.events.conftest import eventually


def test_fleet_follows_rollout_and_rollback(api: Api, place: str, robot: Start, tmp_path: Path) -> None:
    url = f"environments/{place}/channels/production"

    def channel() -> Any:
        return next(c for c in api.get(f"environments/{place}/channels").json() if c["channel"] == "production")

    api("PUT", url, 200, json={"version": 1})
    for k in (2, 3):
        api.upload(place, {"n.tmap2.yaml": network(float(k))})
    hook = f'[ ! -e {tmp_path}/bad ] || [ "$FLEETMAP_VERSION" != 3 ]'
    names = [f"{place}-{k}" for k in range(3)]
    fleet = [robot("--on-change", hook, name=name) for name in names]

    def all_here() -> bool:  # the fleet is who has told so far: not all start in the same moment
        robots = channel()["robots"]
        return (robots["total"], robots["holding"], robots["online"]) == (3, 3, 3) and bool(robots["since"])

    eventually(all_here, 60)

    api("PUT", url, 200, json={"version": 2, "rollout": {"ready": 1, "failed": 0.3}})
    for agent in fleet:
        agent.wait("ready", 60, version=2)
    moved = eventually(lambda: (c := channel())["version"] == 2 and c["robots"]["since"] and c, 60)
    assert moved["rollout"]["state"] == "watching"
    assert [agent.standing["version"] for agent in fleet] == [2, 2, 2]
    lags = {r["robot"]: r["lag"] for r in api.get(f"robots?environment={place}").json()}
    assert lags == {name: {"events": 0, "differs": False, "since": None} for name in names}

    (tmp_path / "bad").touch()
    api("PUT", url, 200, json={"version": 3, "rollout": {"ready": 1, "failed": 0.3}})
    back = eventually(lambda: (c := channel())["rollout"]["state"] == "rolled_back" and c, 60)
    assert (back["version"], back["rollout"]["before"]) == (2, 2)
    assert "robots failed" in back["rollout"]["detail"]
    settled = eventually(lambda: (c := channel())["robots"]["since"] and c, 60)
    assert (settled["robots"]["holding"], settled["robots"]["total"]) == (3, 3)
    eventually(lambda: [agent.standing["version"] for agent in fleet] == [2, 2, 2], 60)
    history = [(h["state"], h["version"], h["time"]) for h in api.get(f"robots/{names[0]}?limit=200").json()["history"]]
    assert len(history) == len(set(history)), "what came over Zenoh and over HTTP counts once"
    assert {("ready", 2), ("active", 2), ("ready", 3)} <= {line[:2] for line in history}
