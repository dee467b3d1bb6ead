"""Traces: spans of requests, worker processes, commits and events reach a receiver of OTLP over HTTP."""

from __future__ import annotations

import json
import logging
import sys
import threading
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from types import SimpleNamespace
from typing import Any

import pytest
from opentelemetry.proto.collector.trace.v1.trace_service_pb2 import ExportTraceServiceRequest

from app import logs, traces
from app.backends.queue import LocalQueue, Task
from app.events.relay import Relay
from tests.api import samples
from tests.api.conftest import Api, create_farm

TRACE, SPAN = "0af7651916cd43dd8448eb211c80319c", "b7ad6b7169203331"


class Receiver:
    """Server for OTLP over HTTP. spans: all that came, by name; resource: attributes of their sender."""

    def __init__(self) -> None:
        receiver = self
        self.spans: dict[str, list[Any]] = {}
        self.resource: dict[str, str] = {}
        self.paths: set[str] = set()

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                import gzip

                data = self.rfile.read(int(self.headers["content-length"]))
                data = gzip.decompress(data) if self.headers.get("content-encoding") == "gzip" else data
                receiver.paths.add(self.path)
                receiver.take(data)
                self.send_response(200)
                self.send_header("content-length", "0")
                self.end_headers()

            def log_message(self, *_: Any) -> None:
                """Print nothing."""

        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self._server.server_address[1]}"
        threading.Thread(target=self._server.serve_forever, args=(0.01,), daemon=True).start()

    def take(self, data: bytes) -> None:
        for group in ExportTraceServiceRequest.FromString(data).resource_spans:
            self.resource = {one.key: one.value.string_value for one in group.resource.attributes}
            for span in (span for scope in group.scope_spans for span in scope.spans):
                self.spans.setdefault(span.name, []).append(span)

    def close(self) -> None:
        self._server.shutdown()
        self._server.server_close()


def attributes(span: Any) -> dict[str, Any]:
    return {one.key: getattr(one.value, one.value.WhichOneof("value")) for one in span.attributes}


@pytest.fixture
def receiver(monkeypatch: pytest.MonkeyPatch) -> Iterator[Receiver]:
    """Trace in this process until the test stops it."""
    for name in ("HTTP_PROXY", "http_proxy", "ALL_PROXY", "all_proxy"):
        monkeypatch.delenv(name, raising=False)
    running = Receiver()
    environment = {"OTEL_EXPORTER_OTLP_ENDPOINT": running.url}
    monkeypatch.setenv("OTEL_EXPORTER_OTLP_ENDPOINT", running.url)
    assert traces.start(environment, "1.2.3")
    yield running
    traces.stop(60)
    running.close()


def test_upload_and_conversion_are_one_trace_each(
    api: Api, fresh: Callable[[], str], receiver: Receiver, caplog: pytest.LogCaptureFixture
) -> None:
    name = fresh()
    api.post("environments", {"name": name})
    lines = []
    handler = logging.Handler()
    handler.emit = lambda record: lines.append(logs.JsonFormatter().format(record))  # type: ignore[method-assign]
    log = logging.getLogger("app.requests")
    log.addHandler(handler)
    level = log.level
    log.setLevel(logging.INFO)
    try:
        api.upload(name, {"n.tmap2.yaml": samples.tmap2()}, headers={"traceparent": f"00-{TRACE}-{SPAN}-01"})
    finally:
        log.removeHandler(handler)
        log.setLevel(level)
    api.get(f"environments/{name}/versions/1/maps/geojson")
    api.get("environments?q=text-of-a-query")
    api.problem("GET", "environments/none/versions/1", 404)
    traces.stop(60)

    route = "/api/v1/environments/{env}/versions"
    (request,) = receiver.spans[f"POST {route}"]
    assert (request.trace_id.hex(), request.parent_span_id.hex()) == (TRACE, SPAN), "the client's trace goes on"
    described = attributes(request)
    assert described == {
        "http.request.method": "POST",
        "url.path": f"/api/v1/environments/{name}/versions",
        "http.route": route,
        "http.response.status_code": 201,
    }
    (commit,) = (span for span in receiver.spans["commit"] if span.trace_id == request.trace_id)
    assert attributes(commit)["fleetmap.environment"] == name
    workers = [s for n, spans in receiver.spans.items() if n.startswith("worker ") for s in spans]
    assert {s.trace_id for s in workers if s.trace_id == request.trace_id}, "files are read in a worker process"
    for span in (commit, *(s for s in workers if s.trace_id == request.trace_id)):
        assert span.start_time_unix_nano >= request.start_time_unix_nano
        assert span.end_time_unix_nano <= request.end_time_unix_nano
    (entry,) = (json.loads(line) for line in lines if "/versions" in line)
    assert entry["trace_id"] == TRACE

    (conversion,) = (s for n, spans in receiver.spans.items() if n.endswith("/maps/{format}") for s in spans)
    assert conversion.trace_id != request.trace_id
    assert [s for s in workers if s.trace_id == conversion.trace_id], "the map is made in a worker process"
    assert "environments" in str(receiver.spans)
    assert "text-of-a-query" not in str(receiver.spans)
    assert receiver.resource["service.name"] == "fleetmap"
    assert receiver.resource["service.version"] == "1.2.3"
    assert receiver.paths == {"/v1/traces"}


def test_tasks_of_the_queue_and_events_have_spans(receiver: Receiver) -> None:
    done = threading.Event()
    seen = []

    class Performer:
        def perform(self, task: Task) -> None:
            seen.append(traces.trace_id())
            done.set()

        def stop(self, task: Task) -> None:
            """Nothing runs for long."""

    queue = LocalQueue(Performer(), threads=1, waiting=9)
    with traces.span("request"):
        trace = traces.trace_id()
        queue.submit(Task("convert", "key", "farm"))
        assert done.wait(60)
    queue.close()
    event = SimpleNamespace(environment="farm", body={"type": "version.created"}, sequence=7)
    published: list[Any] = []
    Relay._publish(SimpleNamespace(_outlet=SimpleNamespace(publish=lambda *one: published.append(one))), event)  # type: ignore[arg-type]
    queue._threads.shutdown(wait=True)
    traces.stop(60)
    assert seen == [trace], "the thread goes on with the trace of the request"
    (task,) = receiver.spans["task convert"]
    (request,) = receiver.spans["request"]
    assert (task.trace_id.hex(), task.parent_span_id) == (trace, request.span_id)
    (publish,) = receiver.spans["publish"]
    expected = {"fleetmap.environment": "farm", "fleetmap.type": "version.created", "fleetmap.sequence": 7}
    assert attributes(publish) == expected
    assert published == [("farm", {"type": "version.created"})]


def test_nothing_is_traced_by_default(api: Api, fresh: Callable[[], str]) -> None:
    assert not traces.is_on()
    with traces.span("one") as nothing:
        assert nothing is None
    assert traces.span("one", a=1) is traces.span("two") is traces.request_span("GET", "/", {})
    assert traces.task_span("three", "") is traces.span("one")
    assert (traces.trace_id(), traces.parent()) == ("", "")
    record = logging.LogRecord("app", logging.INFO, "", 0, "text", None, None)
    assert "trace" not in logs.TextFormatter().format(record)
    assert "trace_id" not in json.loads(logs.JsonFormatter().format(record))
    create_farm(api, fresh())


@pytest.mark.parametrize(
    ("environment", "wanted"),
    [
        ({}, False),
        ({"OTEL_EXPORTER_OTLP_ENDPOINT": " "}, False),
        ({"OTEL_EXPORTER_OTLP_ENDPOINT": "http://127.0.0.1:9"}, True),
        ({"OTEL_EXPORTER_OTLP_TRACES_ENDPOINT": "http://127.0.0.1:9/v1/traces"}, True),
        ({"OTEL_EXPORTER_OTLP_ENDPOINT": "http://127.0.0.1:9", "OTEL_SDK_DISABLED": "true"}, False),
        ({"OTEL_EXPORTER_OTLP_ENDPOINT": "http://127.0.0.1:9", "OTEL_TRACES_EXPORTER": "none"}, False),
    ],
)
def test_variables_decide(environment: dict[str, str], wanted: bool) -> None:
    assert traces.is_wanted(environment) == wanted
    if not wanted:
        assert not traces.start(environment, "1")


def test_missing_packages_are_reported(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    monkeypatch.setitem(sys.modules, "opentelemetry.sdk.trace", None)
    assert not traces.start({"OTEL_EXPORTER_OTLP_ENDPOINT": "http://127.0.0.1:9"}, "1")
    assert not traces.is_on()
    assert "pip install 'fleet-map-server[server,traces]'" in caplog.text


def test_log_lines_have_the_trace(receiver: Receiver) -> None:
    record = logging.LogRecord("app", logging.INFO, "", 0, "text", None, None)
    with traces.span("one"):
        assert f" - trace={traces.trace_id()} app: text" in logs.TextFormatter().format(record)
        assert json.loads(logs.JsonFormatter().format(record))["trace_id"] == traces.trace_id()
