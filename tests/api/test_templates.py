"""Templates: named sets, values of an environment, and the versions that they create."""

from __future__ import annotations

import io
import zipfile
from typing import Any

import pytest
import yaml

from app.model.templates import FormatTemplate, Templates
from tests.api import samples
from tests.api.conftest import Api

LANE = b"""<kml xmlns="http://www.opengis.net/kml/2.2"><Document><name>lanes</name><Placemark><name>Lane</name>
<LineString><coordinates>-0.5245,53.2686 -0.5244,53.2686 -0.5244,53.2687</coordinates></LineString></Placemark>
</Document></kml>"""


@pytest.fixture
def env(api: Api, request: pytest.FixtureRequest) -> str:
    """Create an environment of the test's own, as ``draw`` does."""
    return draw(api, f"t-{abs(hash(request.node.name)) % 10**9}")


@pytest.fixture(scope="module")
def unchanged(api: Api) -> str:
    """Return the environment of tests whose requests are refused."""
    return draw(api, "t-unchanged")


def draw(api: Api, name: str) -> str:
    """Create a datum (version 1) and a drawn network (2) without action, tolerances and influence zones."""
    datum = {"latitude": samples.LATITUDE, "longitude": samples.LONGITUDE}
    api.post("environments", {"name": name, "datum": datum})
    api.upload(name, {"lanes.kml": LANE}, layer="topology")
    return name


def put(api: Api, env: str, suffix: str = "", expect: int = 201, headers: Any = None, **body: Any) -> Any:
    place = f"environments/{env}/templates{suffix}"
    return api("PUT", place, expect, json=body, headers=headers or {}).json()


def filled(api: Api, env: str, version: Any = "latest", query: str = "", format: str = "tmap2") -> dict[str, Any]:
    """Return the report's template lines by parameter: (value, from)."""
    report = api.get(f"environments/{env}/versions/{version}/reports/{format}{query}").json()
    return {line["option"]: (line["value"], line["from"]) for line in report["template"] if "option" in line}


def tolerance(api: Api, env: str, version: Any = "latest", query: str = "") -> float:
    text = api.get(f"environments/{env}/versions/{version}/maps/tmap2{query}").content
    (value,) = {n["node"]["properties"]["xy_goal_tolerance"] for n in yaml.safe_load(text)["nodes"]}
    return float(value)


def etag(api: Api, env: str, format: str = "tmap2", version: Any = "latest", query: str = "") -> str:
    return str(api.get(f"environments/{env}/versions/{version}/maps/{format}{query}").headers["etag"])


def files(api: Api, env: str, version: Any = "latest") -> dict[str, str]:
    """Return the hashes of a signed manifest, by format."""
    manifest = api.get(f"environments/{env}/versions/{version}/manifest?formats=tmap2,kml").json()
    return {file["format"]: file["sha256"] for file in manifest["files"]}


def test_template_values_create_a_version_and_change_maps(api: Api, env: str) -> None:
    assert filled(api, env)["xy_goal_tolerance"] == (0.3, "default")
    before, kml = etag(api, env), etag(api, env, "kml")
    listed = files(api, env)
    version = put(
        api, env, "/tmap2", values={"xy_goal_tolerance": 0.4, "action": "NavigateToPose"}, message="for ROS 2"
    )
    assert (version["version"], version["parent"], version["message"]) == (3, 2, "for ROS 2")
    old = api.get(f"environments/{env}/versions/2").json()
    assert version["root"] != old["root"], "the maps changed, and so does the root"
    assert version["changes"] == {
        "templates": {
            "tmap2": {
                "action": {"from": None, "to": "NavigateToPose"},
                "xy_goal_tolerance": {"from": None, "to": 0.4},
            }
        }
    }
    assert api.get(f"environments/{env}/diff?from=2&to=3").json()["layers"] == version["changes"]
    assert tolerance(api, env) == 0.4
    assert api.get(f"/maps/{env}/tmap2").content.count(b"action: NavigateToPose") == 4
    assert etag(api, env) != before
    assert etag(api, env, "kml") == kml, "other maps do not change"
    after = files(api, env)
    assert after["kml"] == listed["kml"]
    assert after["tmap2"] != listed["tmap2"], "the manifest matches the downloads"
    assert files(api, env, 2) == listed
    assert (tolerance(api, env, 2), etag(api, env, version=2)) == (0.3, before), "old versions do not change"
    values = filled(api, env)
    assert values["xy_goal_tolerance"] == (0.4, "environment")
    assert values["action"] == ("NavigateToPose", "environment")
    assert values["verts_radius"][1] == "default"
    event = api.get(f"events?environment={env}&since=0&follow=false").text
    assert '"message":"for ROS 2"' in event.replace('": ', '":')


def test_template_precedence(api: Api, env: str) -> None:
    assert put(api, env, set="outdoor")["message"] == "Templates: the set outdoor"
    assert filled(api, env)["xy_goal_tolerance"] == (0.5, "set outdoor")
    put(api, env, "/tmap2", values={"xy_goal_tolerance": 0.4})
    assert filled(api, env)["xy_goal_tolerance"] == (0.4, "environment")
    assert filled(api, env)["verts_radius"][1] == "set outdoor"
    assert filled(api, env, query="?xy_goal_tolerance=0.2")["xy_goal_tolerance"] == (0.2, "request")
    assert tolerance(api, env, query="?xy_goal_tolerance=0.2") == 0.2
    assert filled(api, env, query="?xy_goal_tolerance=0.4")["xy_goal_tolerance"] == (0.4, "request")
    assert filled(api, env)["xy_goal_tolerance"] == (0.4, "environment"), "the same bytes, with a report per request"
    assert filled(api, env)["action"] == ("move_base", "default")
    put(api, env, "/tmap2", set="ros2", values={"xy_goal_tolerance": 0.4})
    assert filled(api, env)["action"] == ("NavigateToPose", "set ros2"), "a format may have a set of its own"
    assert filled(api, env, format="tmap")["xy_goal_tolerance"] == (0.5, "set outdoor")


def test_equal_template_values_give_equal_bytes_and_hashes(api: Api, env: str) -> None:
    query_etag = etag(api, env, query="?xy_goal_tolerance=0.4")
    before = etag(api, env)
    put(api, env, "/tmap2", values={"xy_goal_tolerance": 0.4})
    assert etag(api, env) == query_etag
    put(api, env, "/tmap2", values={"xy_goal_tolerance": 0.3})
    assert etag(api, env) == before, "stated although it equals the format's default"
    assert filled(api, env)["xy_goal_tolerance"] == (0.3, "environment")


def test_effective_templates_are_listed_with_origin(api: Api, env: str) -> None:
    put(api, env, set="warehouse", formats={"tmap2": {"values": {"yaw_goal_tolerance": 0.2}}})
    answer = api.get(f"environments/{env}/templates")
    templates = answer.json()
    assert answer.headers["etag"].removeprefix("W/") == '"3"'  # weak if the body is compressed
    assert (templates["version"], templates["set"]) == (3, "warehouse")
    assert {"default", "outdoor", "indoor", "warehouse"} <= set(templates["sets"])
    lines = {line["format"]: line for line in templates["formats"]}
    tmap2 = lines["tmap2"]
    assert tmap2["values"] == {"yaw_goal_tolerance": 0.2}
    assert tmap2["effective"]["yaw_goal_tolerance"] == {"value": 0.2, "from": "environment"}
    assert tmap2["effective"]["xy_goal_tolerance"] == {"value": 0.1, "from": "set warehouse"}
    assert tmap2["effective"]["action"] == {"value": "move_base", "from": "default"}
    one = api.get(f"environments/{env}/templates/tmap2").json()
    assert one == {"environment": env, "version": 3, **tmap2}
    assert api.get(f"environments/{env}/templates/tmap2?version=2").json()["values"] == {}
    sets = {line["name"]: line for line in api.get("templates").json()}
    assert sets["default"]["formats"] == {}
    assert sets["warehouse"]["formats"]["tmap2"]["xy_goal_tolerance"] == 0.1
    viewer = api.token_for("viewer", environments=env)
    viewer.get(f"environments/{env}/templates")
    viewer.problem("PUT", f"environments/{env}/templates/tmap2", 403, json={"values": {}})
    viewer.problem("DELETE", f"environments/{env}/templates/tmap2", 403)


def test_templates_are_reset_reverted_and_cloned(api: Api, env: str) -> None:
    first = api.get(f"environments/{env}/versions/2").json()
    version = put(api, env, "/tmap2", values={"xy_goal_tolerance": 0.4})
    moved = LANE.replace(b"53.2687", b"53.2688")
    later = api.upload(env, {"lanes.kml": moved}, layer="topology").json()
    assert "templates" not in later["changes"]
    assert tolerance(api, env) == 0.4, "another change keeps them"
    api("PATCH", f"environments/{env}", 200, json={"datum": {"latitude": 53.0, "longitude": -0.5}})
    assert tolerance(api, env) == 0.4
    back = api.post(f"environments/{env}/versions", {"revert_to": 2}).json()
    assert back["root"] == first["root"]
    assert back["changes"]["templates"] == {"tmap2": {"xy_goal_tolerance": {"from": 0.4, "to": None}}}
    assert tolerance(api, env) == 0.3
    again = api.post(f"environments/{env}/versions", {"revert_to": version["version"]}).json()
    assert again["root"] == version["root"]
    copied = api.post("environments", {"name": f"{env}-b", "clone": {"environment": env}}).json()
    assert copied["root"] == version["root"]
    assert tolerance(api, f"{env}-b") == 0.4
    put(api, env, set="indoor")
    deletion = api("DELETE", f"environments/{env}/templates/tmap2?message=no+more", 201).json()
    assert (deletion["message"], filled(api, env)["xy_goal_tolerance"]) == ("no more", (0.2, "set indoor"))
    assert api("DELETE", f"environments/{env}/templates/tmap2", 200).json()["version"] == deletion["version"]
    bare = api("DELETE", f"environments/{env}/templates", 201).json()
    assert bare["root"] == first["root"], "without templates the root is as before"


def test_templates_honour_if_match_keys_and_dry_run(api: Api, env: str) -> None:
    values = {"xy_goal_tolerance": 0.4}
    dry = put(api, env, "/tmap2", 200, values=values, dry_run=True)
    assert (dry["version"], dry["parent"]) == (None, 2)
    assert dry["changes"]["templates"]["tmap2"] == {"xy_goal_tolerance": {"from": None, "to": 0.4}}
    assert api.get(f"environments/{env}").json()["version"] == 2
    put(api, env, "/tmap2", 412, {"if-match": '"1"'}, values=values)
    version = put(api, env, "/tmap2", 201, {"if-match": '"2"', "idempotency-key": "k"}, values=values)
    assert version["root"] == dry["root"]
    assert put(api, env, "/tmap2", 201, {"idempotency-key": "k"}, values=values) == version
    put(api, env, "/tmap2", 409, {"idempotency-key": "k"}, values={})
    assert put(api, env, "/tmap2", 200, values=values)["version"] == version["version"], "no new version"
    dry = api("DELETE", f"environments/{env}/templates?dry_run=true", 200).json()
    assert dry["changes"]["templates"]["tmap2"] == {"xy_goal_tolerance": {"from": 0.4, "to": None}}
    assert put(api, env, "", 200)["version"] == version["version"]


@pytest.mark.parametrize(
    ("what", "body", "status", "where"),
    [
        ("/tmap2", {"values": {"colour": "red"}}, 422, "body.values.colour"),
        ("/tmap2", {"values": {"xy_goal_tolerance": -1}}, 422, "body.values.xy_goal_tolerance"),
        ("/tmap2", {"values": {"xy_goal_tolerance": "wide"}}, 422, "body.values.xy_goal_tolerance"),
        ("/tmap2", {"values": {"action": "a\x00b"}}, 422, "body.values.action"),
        ("/tmap2", {"values": {"action": "x" * 3000}}, 422, "body.values.action"),
        ("/tmap2", {"values": {"action": {"name": 1}}}, 422, "body.values.action"),
        ("/tmap2", {"set": "moon"}, 422, "body.set"),
        ("/tmap2", {"value": {}}, 422, "body.value"),
        ("/geojson", {"values": {"anything": 1}}, 422, "body.values.anything"),
        ("/moon", {"values": {}}, 404, None),
        ("", {"set": "moon"}, 422, "body.set"),
        ("", {"formats": {"tmap2": {"values": {"action": []}}}}, 422, "body.formats.tmap2.values.action"),
        ("", {"formats": {"moon": {}}}, 404, None),
    ],
)
def test_invalid_templates_name_the_member(
    api: Api, unchanged: str, what: str, body: Any, status: int, where: str | None
) -> None:
    problem = api.problem("PUT", f"environments/{unchanged}/templates{what}", status, json=body)
    if where is not None:
        assert [e["where"] for e in problem["errors"]] == [where]
    assert api.get(f"environments/{unchanged}").json()["version"] == 2


def test_environment_package_uses_templates(api: Api, env: str) -> None:
    before = etag(api, env, "environment")
    put(api, env, "/lif", values={"creator": "somebody"})
    other = etag(api, env, "environment")
    put(api, env, "/tmap2", values={"xy_goal_tolerance": 0.4})
    assert etag(api, env, "environment") not in (before, other)
    data = zipfile.ZipFile(io.BytesIO(api.get(f"/maps/{env}/environment").content))
    text = data.read("config/topological/network.tmap2.yaml")
    assert {n["node"]["properties"]["xy_goal_tolerance"] for n in yaml.safe_load(text)["nodes"]} == {0.4}
    assert text == api.get(f"/maps/{env}/tmap2").content
    values = filled(api, env, format="environment")
    assert values["xy_goal_tolerance"] == (0.4, "environment")
    assert values["action"] == ("move_base", "default")


def test_unknown_stored_templates_warn_and_are_ignored(api: Api, env: str) -> None:
    from app.store.changes import Changes

    store = api.app.state.services.store
    templates = Templates("of-tomorrow", {"tmap2": FormatTemplate(None, {"colour": "red", "xy_goal_tolerance": 0.4})})
    store.versions.commit(
        env, store.versions.prepare(store.versions.get(env), Changes(templates=templates)), author="", message=""
    )
    assert tolerance(api, env) == 0.4
    report = api.get(f"environments/{env}/versions/latest/reports/tmap2").json()
    problems = [w["problem"] for w in report["warnings"]]
    assert any("'of-tomorrow' is unknown" in p for p in problems)
    assert any("colour: unknown parameter of tmap2" in p for p in problems)
    line = api.get(f"environments/{env}/templates/tmap2").json()
    assert len(line["ignored"]) == 2
    assert "colour" not in line["effective"]


def test_coverage_uses_templates(api: Api, env: str) -> None:
    api.upload(env, samples.grid("north"))
    api.upload(env, samples.grid("south"))
    rows = {row["format"]: row for row in api.get(f"environments/{env}/versions/latest/maps").json()}
    assert "choose" in rows["occupancy_grid"]
    put(api, env, "/occupancy_grid", values={"grid": "south"})
    rows = {row["format"]: row for row in api.get(f"environments/{env}/versions/latest/maps").json()}
    assert "choose" not in rows["occupancy_grid"]
    assert api.get(f"/maps/{env}/occupancy_grid/south.yaml").content
    assert api.get(f"/maps/{env}/occupancy_grid/north.yaml").content, "the name of a file takes precedence"
