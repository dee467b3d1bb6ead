"""``fleetmap template``: the sets, what holds in an environment, and changing it."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.cli.conftest import Fleetmap

LANE = """<kml xmlns="http://www.opengis.net/kml/2.2"><Document><name>lanes</name><Placemark><name>Lane</name>
<LineString><coordinates>-0.5245,53.2686 -0.5244,53.2686</coordinates></LineString></Placemark></Document></kml>"""


@pytest.fixture
def farm(fleetmap: Fleetmap, tmp_path: Path, request: pytest.FixtureRequest) -> str:
    name = f"tf-{abs(hash(request.node.name)) % 10**9}"
    (tmp_path / "lanes.kml").write_text(LANE)
    result = fleetmap("import", tmp_path / "lanes.kml", "-e", name, "--layer", "topology", "--datum", "53.2686,-0.5245")
    assert result.status == 0, result.err
    return name


def version(fleetmap: Fleetmap, name: str) -> int:
    return int(fleetmap("versions", name, "--json").json[0]["version"])


def test_template_sets_need_no_server(offline: Fleetmap) -> None:
    assert "outdoor" in offline("template").out
    sets = {s["name"]: s for s in offline("template", "--json").json}
    assert sets["outdoor"]["formats"]["tmap2"]["verts_radius"] == 1.5


def test_template_sets_and_values_are_stored_and_reset(fleetmap: Fleetmap, farm: str, tmp_path: Path) -> None:
    first = version(fleetmap, farm)
    result = fleetmap("template", farm, "--set", "outdoor", "-m", "it is a field")
    assert (result.status, result.out.splitlines()) == (
        0,
        [f"{farm}: version {first + 1}", "  templates: set: default → outdoor"],
    )
    assert "no changes" in fleetmap("template", farm, "--set", "outdoor").out
    result = fleetmap("template", farm, "tmap2", "-O", "action=NavigateToPose", "--option", "xy_goal_tolerance=0.4")
    assert result.status == 0, result.err
    assert "tmap2 action: none → NavigateToPose, tmap2 xy_goal_tolerance: none → 0.4" in result.out
    more = fleetmap("template", farm, "tmap2", "-O", "xy_goal_tolerance=0.6", "--json")
    assert more.json["changes"]["templates"] == {"tmap2": {"xy_goal_tolerance": {"from": 0.4, "to": 0.6}}}
    shown = fleetmap("template", farm)
    assert shown.out.startswith(f"{farm}, version {first + 3}: template set outdoor")
    words = [line.split() for line in shown.out.splitlines()]
    assert ["tmap2", "action", "NavigateToPose", "environment"] in words
    assert ["tmap2", "verts_radius", "1.5", "set", "outdoor"] in words
    assert ["osm", "False", "default"] in [
        line.split() for line in fleetmap("template", farm, "tmap2").out.splitlines()
    ]
    out = tmp_path / "network.yaml"
    exported = fleetmap("export", farm, "tmap2", "-o", out, "-v")
    assert "action: NavigateToPose" in out.read_text()
    assert "filled in: edges: action = NavigateToPose (environment): " in exported.err
    assert "~ templates tmap2 action: none → NavigateToPose" in fleetmap("diff", farm, str(first)).out
    assert "outdoor" in fleetmap("versions", farm).out


def test_template_unset_resets_values(fleetmap: Fleetmap, farm: str) -> None:
    first = fleetmap("versions", farm, "--json").json[0]
    fleetmap("template", farm, "tmap2", "-O", "action=a", "-O", "osm=true", "--set", "ros2")
    dry = fleetmap("template", farm, "tmap2", "--unset", "-O", "action", "--dry-run")
    assert dry.out.splitlines() == [f"{farm}: this would create a version", "  templates: tmap2 action: a → none"]
    fleetmap("template", farm, "tmap2", "--unset", "-O", "action")
    template = fleetmap("template", farm, "tmap2", "--json").json
    assert (template["values"], template["set"]) == ({"osm": True}, "ros2")
    assert template["effective"]["action"] == {"value": "NavigateToPose", "from": "set ros2"}
    assert fleetmap("template", farm, "tmap2", "--unset").status == 0
    fleetmap("template", farm, "--set", "indoor")
    assert fleetmap("template", farm, "--unset", "-m", "as it was").status == 0
    assert fleetmap("versions", farm, "--json").json[0]["root"] == first["root"]
    assert "no changes" in fleetmap("template", farm, "--unset").out
    old = fleetmap("template", farm, "tmap2", "--version", str(first["version"] + 1), "--json").json
    assert old["values"] == {"action": "a", "osm": True}


def test_template_errors_are_reported(fleetmap: Fleetmap, farm: str) -> None:
    wrong = fleetmap("template", farm, "tmap2", "-O", "colour=red")
    assert wrong.status == 1
    assert "colour: unknown parameter of tmap2" in wrong.err
    assert "available: default, outdoor" in fleetmap("template", farm, "--set", "moon").err
    assert fleetmap("template", farm, "-O", "action=x").status == 2
    assert fleetmap("template", farm, "--unset", "--set", "outdoor").status == 2
    assert fleetmap("template", farm, "moon").status == 1
    assert version(fleetmap, farm) <= 2
