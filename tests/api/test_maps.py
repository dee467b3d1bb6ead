"""Map downloads: complete, by file, by short URL, conditional, partial; and reports."""

from __future__ import annotations

import contextlib
import io
import json
import threading
import time
import zipfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any
from urllib.parse import quote

import pytest
import yaml
from lxml import etree

from app.clock import seconds_since_boot
from app.convert.recipe import Recipe
from app.pool import CancelHandle, Cancelled, Pool
from app.progress import Progress
from tests.api import samples
from tests.api.conftest import Api, problem, running, settings_for
from tests.events.conftest import eventually


def test_map_with_one_file_is_served_as_file(api: Api, farm: str) -> None:
    answer = api.get(f"environments/{farm}/versions/3/maps/tmap2")
    assert {n["node"]["name"] for n in yaml.safe_load(answer.content)["nodes"]} == set(samples.NODES)
    headers = answer.headers
    assert headers["content-disposition"] == 'attachment; filename="network.tmap2.yaml"'
    assert headers["cache-control"] == "no-cache"
    assert headers["accept-ranges"] == "bytes"
    assert headers["fleetmap-version"] == "3"
    assert headers["fleetmap-root"] == api.get(f"environments/{farm}/versions/3").json()["root"]
    assert headers["content-length"] == str(len(answer.content))
    assert headers["x-content-type-options"] == "nosniff"
    assert headers["etag"].startswith('"')
    link = answer.links["describedby"]["url"]
    assert link == f"/api/v1/environments/{farm}/versions/3/reports/tmap2"
    report = api.get(link).json()
    assert (report["format"], report["version"]) == ("tmap2", 3)
    assert {"layers", "template", "dropped", "warnings"} <= set(report)
    (topology,) = [line for line in report["layers"] if line["layer"] == "topology"]
    assert topology["information"] == "raw"
    assert topology["sources"] == ["network.tmap2.yaml"]
    assert "occupancy" in {line["what"] for line in report["dropped"]}


def test_map_with_several_files_is_served_as_zip(api: Api, farm: str) -> None:
    base = f"environments/{farm}/versions/latest/maps/occupancy_grid"
    answer = api.get(base)
    assert answer.headers["content-type"] == "application/zip"
    with zipfile.ZipFile(io.BytesIO(answer.content)) as archive:
        assert sorted(archive.namelist()) == ["map.pgm", "map.yaml"]
        for name in archive.namelist():
            single = api.get(f"{base}/{name}")
            assert single.content == archive.read(name)
            assert single.headers["etag"] != answer.headers["etag"]
    assert "map" in api.problem("GET", f"{base}/other.yaml", 404)["detail"]
    other = api.problem("GET", f"environments/{farm}/versions/latest/maps/tmap2/other.yaml", 404)
    assert "network.tmap2.yaml" in other["detail"]
    api.problem("GET", f"{base}/{quote('../map.yaml', safe='')}", 404)


def test_repeated_request_returns_304(api: Api, farm: str) -> None:
    for path in (
        f"environments/{farm}/versions/latest/maps/tmap2",
        f"/maps/{farm}/tmap2",
        f"/maps/{farm}/occupancy_grid/map.pgm",
    ):
        etag = api.get(path).headers["etag"]
        for tags in (etag, f"W/{etag}", f'"x", {etag}', "*"):
            again = api.get(path, 304, headers={"If-None-Match": tags})
            assert again.content == b""
            assert again.headers["etag"] == etag
            assert again.headers["fleetmap-version"] == "3"
        assert api.get(path, headers={"If-None-Match": '"other"'}).content


def test_repeated_requests_are_served_from_memory(api: Api, farm: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """For a second neither database nor disk is read; then the response must be confirmed."""
    from app.errors import Unavailable
    from app.store.channels import Channels
    from app.store.tokens import Tokens

    def away(*_: object) -> None:
        raise Unavailable("the database is away")

    path = f"/maps/{farm}/tmap2"
    api.get(path)
    time.sleep(1.1)
    first = api.get(path)
    monkeypatch.setattr(Channels, "target", away)
    monkeypatch.setattr(Tokens, "find", away)
    for _ in range(5):
        again = api.get(path)
        assert again.content == first.content
        assert {*again.headers, "x-request-id"} == set(first.headers)  # only ids that the log accepts are used
        api.get(path, 304, headers={"If-None-Match": first.headers["etag"]})
    time.sleep(1.1)
    api.problem("GET", path, 503)
    monkeypatch.undo()
    assert api.get(path).content == first.content


def test_answer_in_memory_is_old_when_a_suspended_host_wakes_up(
    api: Api, farm: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = f"environments/{farm}/versions/3/maps/kml"
    clock = [seconds_since_boot()]
    for module in ("app.api.maps", "app.api.http.response_cache"):
        monkeypatch.setattr(f"{module}.seconds_since_boot", lambda: clock[0])
    etag = api.get(path).headers["etag"]
    hot, key = api.app.state.services.response_cache, (f"/api/v1/{path}".encode(), b"")
    assert hot.get_fresh(key) is not None
    clock[0] += 3600
    assert hot.get_fresh(key) is None
    api.get(path, 304, headers={"If-None-Match": etag})
    assert hot.get_fresh(key) is not None


def test_matching_etag_returns_304_without_conversion(api: Api, farm: str) -> None:
    """A robot that has the map causes no conversion, not even after a restart of the server."""
    path = f"environments/{farm}/versions/3/maps/kml"
    etag = api.get(path).headers["etag"]
    hot = api.app.state.services.response_cache
    hot._entries.clear()
    api.get(path, 304, headers={"If-None-Match": etag})
    api.get(path, 304, headers={"If-None-Match": etag})
    assert api.get(path).headers["etag"] == etag


def test_head_returns_headers_only(api: Api, farm: str) -> None:
    path = f"/maps/{farm}/tmap2"
    for _ in range(2):
        answer = api("HEAD", path, 200)
        assert answer.content == b""
        assert answer.headers["content-length"] == str(len(api.get(path).content))
    etag = answer.headers["etag"]
    assert api("HEAD", path, 304, headers={"If-None-Match": etag}).content == b""
    assert api("HEAD", f"environments/{farm}", 200).content == b""
    assert api("HEAD", "environments/nowhere", 404).content == b""


def test_ranges_return_parts(api: Api, farm: str) -> None:
    path = f"/maps/{farm}/tmap2"
    response = api.get(path)
    etag, size = response.headers["etag"], len(response.content)
    part = api.get(path, 206, headers={"Range": "bytes=10-19"})
    assert part.content == response.content[10:20]
    assert part.headers["content-range"] == f"bytes 10-19/{size}"
    assert part.headers["etag"] == etag
    assert api.get(path, 206, headers={"Range": "bytes=-7"}).content == response.content[-7:]
    assert api.get(path, 206, headers={"Range": "bytes=5-", "If-Range": etag}).content == response.content[5:]
    assert api.get(path, 200, headers={"Range": "bytes=5-", "If-Range": '"old"'}).content == response.content
    beyond = api.get(path, 416, headers={"Range": f"bytes={size}-"})
    assert beyond.headers["content-range"] == f"bytes */{size}"
    problem(beyond)
    api.get(path, 304, headers={"Range": "bytes=5-", "If-None-Match": etag})


def test_short_url_follows_production(api: Api, farm: str) -> None:
    path = f"/maps/{farm}/tmap2"
    assert api.get(path).headers["fleetmap-version"] == "3"
    api("PUT", f"environments/{farm}/channels/production", 200, json={"version": 2})
    assert api.get(path).headers["fleetmap-version"] == "2"
    api.upload(
        farm, {"network.tmap2.yaml": samples.tmap2({"gate": (0.0, 0.0), "barn": (11.0, 0.0), "field": (10.0, 8.0)})}
    )
    assert api.get(path).headers["fleetmap-version"] == "2"
    assert api.get(f"environments/{farm}/versions/latest/maps/tmap2").headers["fleetmap-version"] == "4"
    api("PUT", f"environments/{farm}/channels/production", 200, json={"version": "latest"})
    assert api.get(path).headers["fleetmap-version"] == "4"
    assert api.get(f"environments/{farm}/versions/production/maps/tmap2").headers["fleetmap-version"] == "4"


def test_commit_is_visible_at_once(api: Api, farm: str) -> None:
    path = f"/maps/{farm}/tmap2"
    for k in range(5):
        assert api.get(path).headers["fleetmap-version"] == str(3 + k)
        nodes = {**samples.NODES, "field": (10.0, 8.5 + k)}
        api.upload(farm, {"network.tmap2.yaml": samples.tmap2(nodes)})
        answer = api.get(path)
        assert answer.headers["fleetmap-version"] == str(4 + k)
        places = {
            n["node"]["name"]: n["node"]["pose"]["position"]["y"] for n in yaml.safe_load(answer.content)["nodes"]
        }
        assert places["field"] == 8.5 + k


def test_other_layers_do_not_change_the_etag(api: Api, farm: str) -> None:
    """The ETag depends only on the inputs, so a robot downloads nothing if only the grid has changed."""
    before = api.get(f"/maps/{farm}/tmap2")
    api.upload(farm, samples.grid(width=9))
    after = api.get(f"/maps/{farm}/tmap2")
    assert after.headers["etag"] == before.headers["etag"]
    assert after.headers["fleetmap-version"] == "4"
    assert after.headers["fleetmap-root"] != before.headers["fleetmap-root"]


def test_parameters_change_the_map(api: Api, farm: str) -> None:
    base = f"environments/{farm}/versions/3/maps/occupancy_grid"
    with zipfile.ZipFile(io.BytesIO(api.get(f"{base}?file_type=png").content)) as archive:
        assert sorted(archive.namelist()) == ["map.png", "map.yaml"]
    body = api.problem("GET", f"{base}?file_type=bmp", 422)
    assert body["errors"][0]["where"] == "file_type"
    api.problem("GET", f"{base}?colour=red", 422)
    api.problem("GET", f"{base}?derive=perhaps", 422)
    api.problem("GET", f"{base}?file_type=png&file_type=pgm", 422)
    api.problem("GET", f"{base}?grid=other", 404)
    link = api.get(f"{base}?file_type=png").links["describedby"]["url"]
    assert link.endswith("/reports/occupancy_grid?file_type=png")
    assert api.get(link).json()["format"] == "occupancy_grid"


def test_unavailable_maps_return_problems(api: Api, bare: str) -> None:
    base = f"environments/{bare}/versions/latest/maps"
    assert "supply" in api.problem("GET", f"{base}/tmap2", 422)["detail"]
    api.problem("GET", f"{base}/datum", 422)
    api.problem("GET", f"{base}/nosuch", 404)
    api.problem("GET", f"/maps/{bare}/nosuch", 404)
    api.problem("GET", f"/maps/{bare}", 404)
    api.problem("POST", f"/maps/{bare}/kml", 405, json={})
    api.problem("GET", f"environments/{bare}/versions/9/maps/kml", 404)


def test_derive_false_uses_stored_layers_only(api: Api, bare: str) -> None:
    api.upload(bare, {"drawing.kml": samples.KML})
    base = f"environments/{bare}/versions/1"
    coverage = {line["format"]: line for line in api.get(f"{base}/maps").json()}
    assert coverage["tmap2"]["state"] == "derivable"
    (step,) = coverage["tmap2"]["chain"]
    assert (step["from"], step["to"]) == (["objects"], "topology")
    assert {"step", "from", "to", "parameters"} <= set(step)
    answer = api.get(f"{base}/maps/tmap2")
    assert len(yaml.safe_load(answer.content)["nodes"]) == 3
    report = api.get(answer.links["describedby"]["url"]).json()
    assert [line["information"] for line in report["layers"] if line["layer"] == "topology"] == ["derived"]
    api.problem("GET", f"{base}/maps/tmap2?derive=false", 422)
    api.problem("GET", f"{base}/reports/tmap2?derive=false", 422)


def test_reports_contain_credits(api: Api, bare: str) -> None:
    api.upload(bare, {"area.osm": samples.OSM})
    credit = ["Some Mappers", "https://example.org/copyright"]
    for name in ("osm", "kml", "tmap2"):
        report = api.get(f"environments/{bare}/versions/1/reports/{name}").json()
        members = {"format", "version", "layers", "attribution", "template", "dropped", "warnings", "closures"}
        assert set(report) == members
        assert report["attribution"] == credit
        summary = {line["layer"]: line["attribution"] for line in report["layers"]}
        assert summary["topology"] == credit
        assert summary["location"] == []
    files = [("files", ("area.osm", samples.OSM))]
    summary = api("POST", "convert", 200, files=files, data={"to": "tmap2", "report": "true"}).json()
    assert summary["attribution"] == credit


def test_merge_keeps_documents_of_both_uploads(api: Api, bare: str) -> None:
    api.upload(bare, {"area.osm": samples.OSM})
    api.upload(bare, {"more.osm": samples.MORE_OSM}, mode="merge")
    root = etree.fromstring(api.get(f"/maps/{bare}/osm").content)
    assert root.get("copyright") == "Some Mappers"
    assert {way.get("id") for way in root.iter("way")} == {"3", "6"}
    box = root.find("bounds")
    assert box is not None
    assert [float(box.get(side, "nan")) for side in ("minlat", "minlon", "maxlat", "maxlon")] == [
        53.268, -0.525, 53.27, -0.523,
    ]  # fmt: skip
    assert "Some Mappers" in api.get(f"environments/{bare}/versions/2/reports/osm").json()["attribution"]


def test_merging_keeps_two_drawings_of_one_name(api: Api, bare: str) -> None:
    style = '<Style id="s"><LineStyle><color>%s</color></LineStyle></Style>'
    point = "<styleUrl>#s</styleUrl><Point><coordinates>-0.5,53.2</coordinates></Point>"
    mark = f"<Placemark><name>%s</name>{point}</Placemark>"
    text = '<kml xmlns="http://www.opengis.net/kml/2.2"><Document><name>%s</name>%s%s</Document></kml>'
    for name, colour, mode in (("first", "ff0000ff", "replace"), ("second", "ff00ff00", "merge")):
        api.upload(bare, {"d.kml": (text % (name, style % colour, mark % name)).encode()}, mode=mode)
    kml = api.get(f"/maps/{bare}/kml").text
    for fragment in ("first", "second", "ff0000ff", "ff00ff00"):
        assert f">{fragment}<" in kml
    again = {"d.kml": (text % ("second", style % "ff00ff00", mark % "second")).encode()}
    assert api.upload(bare, again, expect=None, mode="merge").status_code in (200, 201)


def test_coverage_lists_all_formats(api: Api, farm: str) -> None:
    lines = {line["format"]: line for line in api.get(f"environments/{farm}/versions/3/maps").json()}
    assert all(set(line) == {"format", "state", "chain", "missing"} for line in lines.values())
    assert lines["tmap2"]["state"] == "direct"
    assert lines["osm"]["state"] in ("direct", "derivable")
    for name, line in lines.items():
        answer = api.get(f"environments/{farm}/versions/3/maps/{name}", None)
        assert answer.status_code == (422 if line["state"] == "missing" else 200), (name, answer.text[:300])
        assert bool(line["missing"]) == (line["state"] == "missing")


def test_formats_survive_a_round_trip(api: Api, farm: str) -> None:
    geojson = json.loads(api.get(f"/maps/{farm}/geojson").content) if "geojson" in _formats(api) else None
    if geojson is not None:
        kinds = [f["properties"].get("kind") for f in geojson["features"]]
        assert kinds.count("node") == 3
        assert kinds.count("edge") == 3
    kml = api.get(f"/maps/{farm}/kml").content
    assert all(name.encode() in kml for name in samples.NODES)


def _formats(api: Api) -> set[str]:
    return {f["id"] for f in api.get("formats").json()}


def test_concurrent_requests_run_one_conversion(api: Api, farm: str) -> None:
    """Concurrent requests cause one conversion, and all get the same bytes."""
    api.upload(farm, {"network.tmap2.yaml": samples.tmap2({**samples.NODES, "field": (77.0, 7.0)})})
    path = f"{api.url}/maps/{farm}/kml"
    count = api.app.state.services.metrics.conversions.labels("kml", "made")._value.get
    before, answers = count(), []

    def ask() -> None:
        answers.append(api.as_(api.token).http.get(path))

    threads = [threading.Thread(target=ask) for _ in range(12)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert {a.status_code for a in answers} == {200}
    assert len({a.content for a in answers}) == 1
    assert count() - before == 1


def test_large_file_is_streamed_from_disk(api: Api, farm: str, monkeypatch: pytest.MonkeyPatch) -> None:
    from app.api import maps
    from app.api.http import streams

    small = api.get(f"/maps/{farm}/tmap2")
    monkeypatch.setattr(maps, "IN_MEMORY", 100)
    monkeypatch.setattr(streams, "CHUNK", 1000)
    api.app.state.services.response_cache._entries.clear()
    for _ in range(2):
        large = api.get(f"/maps/{farm}/tmap2")
        assert large.content == small.content
        assert large.headers["etag"] == small.headers["etag"]
        assert large.headers["content-length"] == str(len(small.content))
    part = api.get(f"/maps/{farm}/tmap2", 206, headers={"Range": "bytes=10-2999"})
    assert part.content == small.content[10:3000]
    api.get(f"/maps/{farm}/tmap2", 416, headers={"Range": "bytes=9999999-"})
    api.get(f"/maps/{farm}/tmap2", 304, headers={"If-None-Match": small.headers["etag"]})
    head = api("HEAD", f"/maps/{farm}/tmap2", 200)
    assert head.headers["content-length"] == str(len(small.content))
    assert api.get(f"environments/{farm}/versions/2/sources/network.tmap2.yaml").content == samples.tmap2()
    api.app.state.services.response_cache._entries.clear()


def test_response_cache_is_bounded(tmp_path: Path) -> None:
    with running(settings_for(tmp_path, memory_cache_bytes=10_000)) as api:
        api.post("environments", {"name": "farm"})
        api.upload("farm", {"datum.yaml": samples.DATUM, "n.tmap2.yaml": samples.tmap2(), **samples.grid()})
        hot = api.app.state.services.response_cache
        for _ in range(2):
            for name in ("tmap2", "kml", "datum", "occupancy_grid", "kmz"):
                api.get(f"/maps/farm/{name}")
                assert hot._size <= 10_000 or len(hot._entries) == 1


def test_long_conversion_becomes_a_job(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from app.convert.maps import Maps

    quick, gate = Maps.get_or_convert, threading.Event()

    def slow(self: Maps, recipe: Recipe, stop: CancelHandle) -> object:
        stop.note(Progress(0.4, "objects_to_topology"))
        assert gate.wait(60)
        return quick(self, recipe, stop)

    monkeypatch.setattr(Maps, "get_or_convert", slow)
    with running(settings_for(tmp_path, job_seconds=0.2)) as api:
        api.post("environments", {"name": "farm"})
        api.upload("farm", {"n.tmap2.yaml": samples.tmap2()})
        with ThreadPoolExecutor(4) as threads:
            answers = list(threads.map(lambda _: api.get("/maps/farm/tmap2?", 202), range(4)))
        answer = answers[0]
        location = answer.headers["location"]
        assert {one.headers["location"] for one in answers} == {location}, "so do those at once"
        job = answer.json()
        assert location == f"/api/v1/jobs/{job['id']}"
        assert job["state"] == "running"
        assert api.get("/maps/farm/tmap2", 202).headers["location"] == location, "repeated requests share one job"
        assert api.get(location).json()["state"] == "running"
        other = api.token_for("viewer")
        api_other = other.get("/maps/farm/tmap2", 202).headers["location"]
        assert api_other != location
        other.problem("GET", location, 404)
        job_id, others = (path.rpartition("/")[2] for path in (location, api_other))
        listed = [[job["id"] for job in client.get("jobs").json()] for client in (api, other)]
        assert listed == [[others, job_id], [others]], "newest first"
        assert api.token_for("admin", environments="farm").get("jobs").json() == []
        assert [job["id"] for job in api.get("jobs?state=running&limit=1").json()] == [others]
        assert api.get("jobs?state=done").json() == []
        shown = eventually(lambda: (job := api.get(location).json())["progress"] and job)
        assert (shown["state"], shown["progress"], shown["step"]) == ("running", 0.4, "objects_to_topology")
        gate.set()
        deadline = time.monotonic() + 30
        while (job := api.get(location).json())["state"] == "running":
            assert time.monotonic() < deadline
            time.sleep(0.05)
        assert (job["state"], job["progress"], job.get("step")) == ("done", 1.0, None)
        assert api.get(job["result"]["location"]).content == api.get("/maps/farm/tmap2").content
        api("DELETE", location, 204)
        api.problem("GET", location, 404)


def test_job_is_cancelled_or_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from app.convert.maps import Maps
    from app.errors import CannotConvert

    gate = threading.Event()

    def broken(self: Maps, recipe: object, stop: object) -> object:
        assert gate.wait(30)
        raise CannotConvert("it cannot be done")

    monkeypatch.setattr(Maps, "get_or_convert", broken)
    with running(settings_for(tmp_path, job_seconds=0.1)) as api:
        api.post("environments", {"name": "farm"})
        api.upload("farm", {"n.tmap2.yaml": samples.tmap2(), "datum.yaml": samples.DATUM})
        cancelled = api.get("/maps/farm/tmap2", 202).headers["location"]
        failing = api.get("/maps/farm/kml", 202).headers["location"]
        api("DELETE", cancelled, 204)
        assert api.get(cancelled).json()["state"] == "cancelled"
        gate.set()
        deadline = time.monotonic() + 30
        while (job := api.get(failing).json())["state"] == "running":
            assert time.monotonic() < deadline
            time.sleep(0.05)
        assert job["state"] == "failed"
        assert job["problem"]["status"] == 422
        assert job["problem"]["detail"] == "it cannot be done"
        assert api.get(cancelled).json()["state"] == "cancelled"
        api.problem("GET", "/maps/farm/tmap2", 422)


def _linger(seconds: float) -> None:
    time.sleep(seconds)


def test_cancel_stops_the_conversion_unless_others_wait(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from app.pool import Pool

    quick, slow, begun = Pool.run, [60.0], []

    def run(self: Pool, function: Any, *args: Any, **more: Any) -> Any:
        """The worker is busy with a long task in its process, which only a kill can stop."""
        if "stop" in more and slow:
            begun.append(more["stop"])
            quick(self, _linger, slow[0], stop=more["stop"])
        return quick(self, function, *args, **more)

    monkeypatch.setattr(Pool, "run", run)
    with running(settings_for(tmp_path, job_seconds=0.2, conversion_workers=1)) as api:
        api.post("environments", {"name": "farm"})
        api.upload("farm", {"n.tmap2.yaml": samples.tmap2()})
        location = api.get("/maps/farm/tmap2", 202).headers["location"]
        other = api.token_for("viewer")
        theirs = other.get("/maps/farm/tmap2", 202).headers["location"]
        assert len(begun) == 1
        api("DELETE", location, 204)
        assert api.get(location).json()["state"] == "cancelled"
        assert not begun[0].is_cancelled, "another request waits for it"
        assert other.get(theirs).json()["state"] == "running"
        again = api.get("/maps/farm/tmap2", 202).headers["location"]
        assert again != location
        other("DELETE", theirs, 204)
        assert not begun[0].is_cancelled
        begin = time.monotonic()
        api("DELETE", again, 204)
        assert begun[0].is_cancelled
        slow.clear()
        deadline = begin + 50
        while api.get("/maps/farm/tmap2", None).status_code == 202:
            assert time.monotonic() < deadline, "the worker continued an unwanted conversion"
            time.sleep(0.1)
        assert [api.get(url).json()["state"] for url in (location, theirs, again)] == ["cancelled"] * 3
        assert 'fleetmap_conversions_total{format="tmap2",result="cancelled"} 1.0' in api.get("/metrics").text


def test_job_cancelled_in_another_process_is_stopped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from app.convert.maps import Maps

    stopped = threading.Event()

    def endless(self: Maps, recipe: object, stop: CancelHandle) -> object:
        for _ in range(600):
            if stop.is_cancelled:
                stopped.set()
            stop.check()
            time.sleep(0.05)
        raise AssertionError("the conversion was not stopped")

    monkeypatch.setattr(Maps, "get_or_convert", endless)
    with running(settings_for(tmp_path, job_seconds=0.1)) as api:
        api.post("environments", {"name": "farm"})
        api.upload("farm", {"n.tmap2.yaml": samples.tmap2()})
        job = api.get("/maps/farm/tmap2", 202).json()["id"]
        services = api.app.state.services
        services.store.jobs.update(job, state="cancelled", detail="cancelled")
        assert not stopped.is_set()
        services.jobs.send_heartbeats()
        assert stopped.wait(10)


def test_coverage_does_not_wait_for_busy_workers(api: Api, farm: str) -> None:
    """Coverage of unread content is requested while the only worker is busy."""
    services = api.app.state.services
    stop = CancelHandle()
    working = threading.Thread(target=_outlast, args=(services.pool, stop))
    working.start()
    try:
        until = time.monotonic() + 60
        while not services.pool.is_busy:
            assert time.monotonic() < until
            time.sleep(0.01)
        rows = api.get(f"environments/{farm}/versions/3/maps").json()
        assert any(row["state"] == "derivable" for row in rows)
        assert services.pool.is_busy, "the worker's task ended before the response"
    finally:
        stop()
        working.join(60)


def _outlast(pool: Pool, stop: CancelHandle) -> None:
    with contextlib.suppress(Cancelled):
        pool.run(time.sleep, 300, stop=stop)


def test_map_has_the_root_of_its_own_environment_after_a_purge(api: Api, fresh: Any) -> None:
    """The new environment has the same name, number and network, but a grid, too."""
    env = fresh()
    network, roots = {"n.tmap2.yaml": samples.tmap2()}, []
    for files in (network, {**network, **samples.grid()}):
        api.post("environments", {"name": env})
        api.upload(env, files)
        root = api.get(f"environments/{env}/versions/latest").json()["root"]
        headers = api.get(f"/maps/{env}/tmap2").headers
        assert (headers["fleetmap-version"], headers["fleetmap-root"]) == ("1", root)
        roots.append(root)
        api("DELETE", f"environments/{env}", 204)
        api.post(f"environments/{env}/purge", expect=204)
    assert roots[0] != roots[1]
