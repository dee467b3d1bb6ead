"""Server log as text lines or JSON: time, level, request, trace if there is one, message.

Callers must not log tokens, bodies, or paths of this machine.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping
from contextvars import ContextVar
from datetime import UTC, datetime
from typing import Any, Literal

from app import traces

LogFormat = Literal["text", "json"]

REQUEST_ID: ContextVar[str] = ContextVar("request_id", default="")
"""Id of the current request, as in the ``X-Request-Id`` response header."""


def config(level: str, form: LogFormat) -> dict[str, Any]:
    """Build the settings for ``logging.config``: standard error; libraries only from WARNING.

    The root logger is not changed: a program that embeds the server may use it.
    """
    formatter = {"text": TextFormatter, "json": JsonFormatter}[form]
    levels = {"app": level.upper(), "uvicorn": level.upper(), "asyncio": "WARNING", "sqlalchemy": "WARNING"}
    levels["opentelemetry"] = "WARNING"
    return {
        "version": 1,
        "disable_existing_loggers": False,
        "formatters": {"chosen": {"()": f"{formatter.__module__}.{formatter.__qualname__}"}},
        "handlers": {"stderr": {"class": "logging.StreamHandler", "formatter": "chosen", "stream": "ext://sys.stderr"}},
        "loggers": {name: {"level": chosen, "handlers": ["stderr"]} for name, chosen in levels.items()},
    }


def log_request(log: logging.Logger, level: int, fields: Mapping[str, Any]) -> None:
    """Log a completed request; JSON has its fields as members."""
    caller = f"{fields['token']} ({fields['role']})" if fields.get("role") else "no token"
    reason = f": {fields['reason']}" if fields.get("reason") else ""
    text = (
        f"{fields['method']} {fields['path']} {fields['status']} {fields['ms']:.1f} ms, {caller}, {fields['address']}"
    )
    log.log(level, "%s%s", text, reason, extra={"fields": fields})


class TextFormatter(logging.Formatter):
    """``2030-01-31T06:00:00.000Z INFO    4f2c… app.api.http.middleware: text``."""

    def format(self, record: logging.LogRecord) -> str:
        """Format a record as one line, with control characters escaped, and a traceback below it."""
        trace = f" trace={traces.trace_id()}" if traces.trace_id() else ""
        head = f"{_time(record)} {record.levelname:<7} {REQUEST_ID.get() or '-'}{trace} {record.name}: "
        text = record.getMessage()
        if not text.isprintable():
            text = "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)
        return head + text + (f"\n{self.formatException(record.exc_info)}" if record.exc_info else "")


class JsonFormatter(logging.Formatter):
    """One JSON object per line."""

    def format(self, record: logging.LogRecord) -> str:
        """Format time, level, logger, message, request, and the fields of a request."""
        entry: dict[str, Any] = {
            "time": _time(record),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
        }
        if REQUEST_ID.get():
            entry["request"] = REQUEST_ID.get()
        if traces.trace_id():
            entry["trace_id"] = traces.trace_id()
        entry |= getattr(record, "fields", {})
        if record.exc_info:
            entry["trace"] = self.formatException(record.exc_info)
        return json.dumps(entry, ensure_ascii=True, default=str)


def _time(record: logging.LogRecord) -> str:
    return datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
