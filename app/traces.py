"""Traces by OpenTelemetry, in the extra ``traces``: off, and without cost, unless an endpoint for them is set.

The usual variables ``OTEL_…`` configure them. Spans: requests, calls of worker processes, commits, tasks of the queue,
published events. They contain names, formats and numbers, never tokens, queries, bodies or messages of errors.
"""

from __future__ import annotations

import contextlib
import logging
import threading
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager
from typing import Any, Final

log = logging.getLogger(__name__)

ENDPOINTS: Final = ("OTEL_EXPORTER_OTLP_TRACES_ENDPOINT", "OTEL_EXPORTER_OTLP_ENDPOINT")
SERVICE: Final = "fleetmap"
STOP_SECONDS: Final = 3.0

_NO_SPAN: Final[AbstractContextManager[Any]] = contextlib.nullcontext(None)


class _Tracing:
    """State of this process. tracer, provider: None while traces are off."""

    tracer: Any = None
    provider: Any = None


def is_wanted(environment: Mapping[str, str]) -> bool:
    """Return whether the variables ask for traces."""
    off = environment.get("OTEL_SDK_DISABLED", "").strip().lower() == "true"
    none = environment.get("OTEL_TRACES_EXPORTER", "otlp").strip().lower() == "none"
    return not off and not none and any(environment.get(name, "").strip() for name in ENDPOINTS)


def start(environment: Mapping[str, str], version: str) -> bool:
    """Start to trace in this process if the variables ask for it; return whether it traces."""
    if is_on() or not is_wanted(environment):
        return is_on()
    try:
        from opentelemetry.exporter.otlp.proto.http.trace_exporter import OTLPSpanExporter
        from opentelemetry.sdk.resources import OTELResourceDetector, Resource
        from opentelemetry.sdk.trace import TracerProvider
        from opentelemetry.sdk.trace.export import BatchSpanProcessor
    except ImportError:
        log.warning(
            "traces: OTEL_EXPORTER_OTLP_ENDPOINT is set, but OpenTelemetry is not installed: "
            "pip install 'fleet-map-server[server,traces]', or unset it"
        )
        return False
    resource = Resource({"service.name": SERVICE, "service.version": version}).merge(OTELResourceDetector().detect())
    _Tracing.provider = TracerProvider(resource=resource)  # not the global one: other libraries keep theirs
    _Tracing.provider.add_span_processor(BatchSpanProcessor(OTLPSpanExporter()))
    _Tracing.tracer = _Tracing.provider.get_tracer(SERVICE, version)
    log.info("traces: sent to the endpoint of OTEL_EXPORTER_OTLP_ENDPOINT")
    return True


def stop(seconds: float = STOP_SECONDS) -> None:
    """Send what is left and stop, within so many seconds: an endpoint that is away must not hold up a shutdown."""
    provider, _Tracing.provider, _Tracing.tracer = _Tracing.provider, None, None
    if provider is not None:
        sending = threading.Thread(target=provider.shutdown, name="fleetmap-traces", daemon=True)
        sending.start()
        sending.join(seconds)


def is_on() -> bool:
    """Return whether this process traces."""
    return _Tracing.tracer is not None


def span(name: str, **attributes: str | int | float | bool | None) -> AbstractContextManager[Any]:
    """Begin a span that ends with the block, within the current one. Attributes that are None are left out."""
    if _Tracing.tracer is None:
        return _NO_SPAN
    values = {f"{SERVICE}.{key}": value for key, value in attributes.items() if value is not None}
    started: AbstractContextManager[Any] = _Tracing.tracer.start_as_current_span(
        name, attributes=values, record_exception=False, set_status_on_exception=False
    )
    return started


def request_span(method: str, path: str, headers: Mapping[bytes, bytes]) -> AbstractContextManager[Any]:
    """Begin the span of a request, within that of its client if it sends a ``traceparent``; None while off."""
    if _Tracing.tracer is None:
        return _NO_SPAN
    from opentelemetry.trace import SpanKind
    from opentelemetry.trace.propagation.tracecontext import TraceContextTextMapPropagator

    names = ("traceparent", "tracestate")
    carrier = {name: headers[name.encode()].decode("latin-1") for name in names if name.encode() in headers}
    started: AbstractContextManager[Any] = _Tracing.tracer.start_as_current_span(
        method,
        context=TraceContextTextMapPropagator().extract(carrier),
        kind=SpanKind.SERVER,
        attributes={"http.request.method": method, "url.path": path},
        record_exception=False,
        set_status_on_exception=False,
    )
    return started


def end_request(current: Any, method: str, route: str, status: int) -> None:
    """Note route and status of a request in its span. current: as yielded by ``request_span``."""
    if current is None:
        return
    from opentelemetry.trace import StatusCode

    current.update_name(f"{method} {route}")
    current.set_attributes({"http.route": route, "http.response.status_code": status})
    if status >= 500:
        current.set_status(StatusCode.ERROR)


def trace_id() -> str:
    """Return the id of the current trace as 32 hexadecimal digits, empty without one."""
    if _Tracing.tracer is None:
        return ""
    from opentelemetry.trace import get_current_span

    context = get_current_span().get_span_context()
    return f"{context.trace_id:032x}" if context.is_valid else ""


def parent() -> str:
    """Return the current span for a task that is carried out elsewhere (``traceparent``), empty without one."""
    if _Tracing.tracer is None:
        return ""
    from opentelemetry.trace.propagation.tracecontext import TraceContextTextMapPropagator

    carrier: dict[str, str] = {}
    TraceContextTextMapPropagator().inject(carrier)
    return carrier.get("traceparent", "")


def task_span(
    name: str, parent_span: str, **attributes: str | int | float | bool | None
) -> AbstractContextManager[None]:
    """Begin a span within that of another thread or server. parent_span: result of ``parent`` there."""
    return _NO_SPAN if _Tracing.tracer is None else _task_span(name, parent_span, attributes)


@contextlib.contextmanager
def _task_span(
    name: str, parent_span: str, attributes: Mapping[str, str | int | float | bool | None]
) -> Iterator[None]:
    from opentelemetry import context
    from opentelemetry.trace.propagation.tracecontext import TraceContextTextMapPropagator

    token = context.attach(TraceContextTextMapPropagator().extract({"traceparent": parent_span}))
    try:
        with span(name, **attributes):
            yield
    finally:
        context.detach(token)
