"""The client against a server that misbehaves on purpose: lost answers, busy times, jobs, problems."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest

from app.cli import client as clients
from app.cli.client import Client, LocalFile
from app.cli.output_files import inside, unpack
from app.cli.problems import RequestFailed
from app.errors import Invalid

Answer = tuple[int, dict[str, str], bytes] | None
"""Status, headers and body; None closes the connection without an answer."""


@dataclass
class Script:
    """What the server answers, in order (the last one again and again), and what it was asked."""

    answers: list[Answer] = field(default_factory=list)
    asked: list[tuple[str, str, dict[str, str], bytes]] = field(default_factory=list)


def reply(status: int, value: Any, media_type: str = "application/json", **headers: str) -> Answer:
    body = value if isinstance(value, bytes) else json.dumps(value).encode()
    return status, {"Content-Type": media_type} | {k.replace("_", "-"): v for k, v in headers.items()}, body


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[Script, str]]:
    new_script = Script()

    class Handler(BaseHTTPRequestHandler):
        def answer(self) -> None:
            body = self.rfile.read(int(self.headers.get("Content-Length") or 0))
            new_script.asked.append((self.command, self.path, dict(self.headers), body))
            answer = new_script.answers.pop(0) if len(new_script.answers) > 1 else new_script.answers[0]
            if answer is None:
                self.close_connection = True
                return
            status, headers, content = answer
            self.send_response(status)
            for name, value in {**headers, "Content-Length": str(len(content))}.items():
                self.send_header(name, value)
            self.end_headers()
            self.wfile.write(content)

        do_GET = do_POST = do_PUT = do_DELETE = answer

        def log_message(self, format: str, *args: Any) -> None:
            pass

    monkeypatch.setattr(clients, "RETRY_SECONDS", 0.01)
    monkeypatch.setattr(clients, "POLL_SECONDS", 0.01)
    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever, args=(0.01,))
    thread.start()
    yield new_script, f"http://127.0.0.1:{server.server_port}"
    server.shutdown()
    thread.join()
    server.server_close()


@pytest.fixture
def talk(script: tuple[Script, str]) -> Iterator[Callable[..., tuple[Client, Script]]]:
    opened: list[Client] = []

    def start(*answers: Answer, token: str | None = None) -> tuple[Client, Script]:
        script[0].answers[:] = answers
        opened.append(Client(script[1], token))
        return opened[-1], script[0]

    yield start
    for one in opened:
        one.close()


def local(tmp_path: Path, name: str, content: bytes) -> LocalFile:
    path = tmp_path / name.replace("/", "_")
    path.write_bytes(content)
    return LocalFile(name, path, len(content))


Talk = Callable[..., tuple[Client, Script]]


def test_upload_with_lost_response_is_repeated_with_same_key(talk: Talk, tmp_path: Path) -> None:
    client, script = talk(None, None, reply(201, {"version": 1}))
    files = [local(tmp_path, "a/b.yaml", b"x" * 100_000), local(tmp_path, "ü.kml", b"y")]
    assert client.upload("/environments/e/versions", files, {"mode": "merge"}) == (201, {"version": 1})
    assert len(script.asked) == 3
    assert len({headers["Idempotency-Key"] for _, _, headers, _ in script.asked}) == 1
    bodies = [body.split(b"\r\n", 1)[1].replace(body.split(b"\r\n", 1)[0], b"") for *_, body in script.asked]
    assert bodies[0] == bodies[1] == bodies[2]
    assert b'filename="a/b.yaml"' in bodies[0]
    assert 'filename="ü.kml"'.encode() in bodies[0]
    assert b"x" * 100_000 in bodies[0]
    assert b'name="mode"\r\n\r\nmerge' in bodies[0]
    assert all(file._stream is None for file in files)


def test_client_reports_lost_response_after_all_attempts(talk: Talk, tmp_path: Path) -> None:
    client, script = talk(None)
    with pytest.raises(RequestFailed, match="no response from"):
        client.upload("/environments/e/versions", [local(tmp_path, "a", b"1")], {})
    assert len(script.asked) == clients.MAX_ATTEMPTS


def test_request_without_key_is_not_repeated(talk: Talk) -> None:
    client, script = talk(None)
    with pytest.raises(RequestFailed, match="no response"):
        client.post("/environments", {"name": "farm"})
    assert len(script.asked) == 1


def test_client_waits_for_retry_after(talk: Talk) -> None:
    busy = reply(503, {"title": "Unavailable", "detail": "too much"}, Retry_After="0")
    client, script = talk(busy, busy, reply(200, [1]))
    assert client.get("/formats") == [1]
    assert len(script.asked) == 3


def test_client_waits_for_job_and_requests_map_again(talk: Talk) -> None:
    client, script = talk(
        reply(202, {"id": "7"}, Location="/api/v1/jobs/7"),
        reply(200, {"id": "7", "state": "running", "progress": 0.5, "detail": "deriving"}),
        reply(200, {"id": "7", "state": "done", "progress": 1}),
        reply(
            200, b"<kml/>", "application/vnd.google-earth.kml+xml", Content_Disposition='attachment; filename="map.kml"'
        ),
    )
    with client.download("/environments/e/versions/1/maps/kml", {"grid": "map"}) as got:
        assert got.path.read_bytes() == b"<kml/>"
        assert got.name == "map.kml"
        assert not got.is_zip
    map_path = "/api/v1/environments/e/versions/1/maps/kml?grid=map"
    assert [path for _, path, _, _ in script.asked] == [map_path, "/api/v1/jobs/7", "/api/v1/jobs/7", map_path]
    assert not got.path.exists()


def test_client_waits_for_work_and_returns_its_result(talk: Talk) -> None:
    done = {"id": "7", "state": "done", "progress": 1, "detail": "derive: e"}
    running = {**done, "state": "running", "progress": 0.5, "step": "objects_to_topology"}
    client, script = talk(
        reply(202, {"id": "7"}, Location="/api/v1/jobs/7"), reply(200, running), reply(200, done),
        reply(200, {"version": 3}),
    )  # fmt: skip
    assert client.post_work("/environments/e/derivations", {"method": "m"}, "deriving") == {"version": 3}
    first, *_, last = script.asked
    assert (first[2]["Prefer"], "Prefer" in last[2]) == ("respond-async", False)
    assert first[2]["Idempotency-Key"] == last[2]["Idempotency-Key"], "the result of the same work"
    client, script = talk(reply(201, {"version": None}))
    client.post_work("/environments/e/derivations", {"method": "m", "dry_run": True}, "deriving")
    assert "Prefer" not in script.asked[-1][2], "a dry run would be made twice"


def test_client_raises_problem_of_failed_job(talk: Talk) -> None:
    problem = {"title": "Missing layer", "status": 422, "detail": "there is no network"}
    client, _ = talk(
        reply(202, {"id": "7"}, Location="/api/v1/jobs/7"),
        reply(200, {"id": "7", "state": "failed", "progress": 0.1, "problem": problem}),
    )
    with pytest.raises(RequestFailed, match="there is no network"), client.download("/x"):
        pass


def test_missing_token_gets_hint(talk: Talk) -> None:
    client, script = talk(reply(401, {"title": "Token required", "detail": "give a token"}, "application/problem+json"))
    with pytest.raises(RequestFailed) as caught:
        client.get("/formats")
    assert "FLEETMAP_TOKEN" in caught.value.hint
    client, script = talk(reply(401, {"detail": "x"}, "application/problem+json"), token="secret-token")
    with pytest.raises(RequestFailed) as caught:
        client.get("/formats")
    assert "another" in caught.value.hint
    assert script.asked[-1][2]["Authorization"] == "Bearer secret-token"


def test_missing_environment_gets_hint(talk: Talk) -> None:
    problem = {"title": "Not found", "detail": "unknown environment 'x'"}
    client, _ = talk(reply(404, problem, "application/problem+json"), reply(200, [{"name": "other"}]))
    with pytest.raises(RequestFailed) as caught:
        client.get("/environments/x")
    assert caught.value.hint == "List all with `fleetmap environment list`."


def test_missing_environment_proposes_the_nearest_one_the_token_sees(talk: Talk) -> None:
    problem = {"title": "Not found", "detail": "unknown environment 'fram-7'"}
    names = reply(200, [{"name": name} for name in ("orchard", "farm-7")])
    client, _ = talk(reply(404, problem, "application/problem+json"), names)
    with pytest.raises(RequestFailed) as caught:
        client.get("/environments/fram-7/versions/latest")
    assert caught.value.hint.startswith("Did you mean farm-7?")
    client, _ = talk(reply(404, problem, "application/problem+json"))
    with pytest.raises(RequestFailed, match="unknown environment 'fram-7'"):
        client.get("/environments/fram-7")  # the list is refused as well: the first error is told


def test_foreign_server_is_recognised(talk: Talk) -> None:
    client, _ = talk(reply(200, b"<html>", "text/html"))
    with pytest.raises(RequestFailed, match="not JSON"):
        client.get("/formats")
    client, _ = talk(reply(404, b"<html>", "text/html"))
    with pytest.raises(RequestFailed, match="returned status 404"):
        client.get("/formats")
    client, _ = talk(reply(200, b"<html>", "text/html"))
    with pytest.raises(RequestFailed, match="no stream of events"):
        list(client.stream("/events", {}))


def test_token_is_sent_without_line_end_and_never_shown(talk: Talk) -> None:
    client, script = talk(reply(200, {}), token="secret-of-a-file\r\n")
    client.get("/formats")
    assert script.asked[0][2]["Authorization"] == "Bearer secret-of-a-file"
    for token in ("two secrets", "sec\nret", "secrét", " \n"):
        with pytest.raises(Invalid, match="copy it again") as caught:
            talk(reply(200, {}), token=token)
        assert "sec" not in str(caught.value).removeprefix("the token")


def test_pages_are_followed_up_to_limit(talk: Talk) -> None:
    def pages() -> list[Answer]:
        first = reply(200, [1, 2], Link='</api/v1/versions?before=2>; rel="next"')
        return [first, reply(200, [3])]

    client, script = talk(*pages())
    assert list(client.pages("/versions", {"limit": 2})) == [1, 2, 3]
    assert [path for _, path, _, _ in script.asked] == ["/api/v1/versions?limit=2", "/api/v1/versions?before=2"]
    client, script = talk(*pages())
    assert list(client.pages("/versions", {"limit": 2}, limit=1)) == [1]


@pytest.mark.parametrize("given", ['attachment; filename="../../etc/passwd"', "attachment; filename=..", "attachment"])
def test_file_name_of_server_has_no_folder(talk: Talk, given: str) -> None:
    client, _ = talk(reply(200, b"x", "text/plain", Content_Disposition=given))
    with client.download("/maps/farm/kml") as got:
        assert "/" not in got.name
        assert got.name not in ("", ".", "..")


def test_archive_is_unpacked_only_below_its_folder(tmp_path: Path) -> None:
    import zipfile

    with zipfile.ZipFile(tmp_path / "good.zip", "w") as archive:
        archive.writestr("map.yaml", "image: map.pgm")
        archive.writestr("models/shelf/model.sdf", "<sdf/>")
    assert unpack(tmp_path / "good.zip", tmp_path / "out") == ["map.yaml", "models/shelf/model.sdf"]
    assert (tmp_path / "out/models/shelf/model.sdf").read_text() == "<sdf/>"
    with zipfile.ZipFile(tmp_path / "bad.zip", "w") as archive:
        archive.writestr("map.yaml", "x")
        archive.writestr("../escaped", "x")
    with pytest.raises(Invalid, match="escaped"):
        unpack(tmp_path / "bad.zip", tmp_path / "other")
    assert not (tmp_path / "other").exists()
    assert not (tmp_path / "escaped").exists()


@pytest.mark.parametrize("name", ["/etc/x", "a/../../x", "C:\\x", "a\x00b", ""])
def test_names_that_leave_the_folder_are_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(Invalid):
        inside(tmp_path, name)
