"""What the server logs, as lines for people or JSON for machines: time, level, request, what.

No line has a token, a body, or a path of this machine: callers see to it.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping
from contextvars import ContextVar
from datetime import UTC, datetime
from typing import Any, Literal

LogFormat = Literal["text", "json"]

REQUEST_ID: ContextVar[str] = ContextVar("request_id", default="")
"""The request that is being answered, as its answer's ``X-Request-Id`` names it."""


def config(level: str, form: LogFormat) -> dict[str, Any]:
    """Settings for ``logging.config``: to standard error; libraries only when something is wrong.

    The root logger is left as it is: a program that embeds the server may use it.
    """
    formatter = {"text": TextFormatter, "json": JsonFormatter}[form]
    levels = {"app": level.upper(), "uvicorn": level.upper(), "asyncio": "WARNING", "sqlalchemy": "WARNING"}
    return {
        "version": 1,
        "disable_existing_loggers": False,
        "formatters": {"chosen": {"()": f"{formatter.__module__}.{formatter.__qualname__}"}},
        "handlers": {"stderr": {"class": "logging.StreamHandler", "formatter": "chosen", "stream": "ext://sys.stderr"}},
        "loggers": {name: {"level": chosen, "handlers": ["stderr"]} for name, chosen in levels.items()},
    }


def log_request(log: logging.Logger, level: int, fields: Mapping[str, Any]) -> None:
    """One answered request; JSON gets the fields one by one."""
    caller = f"{fields['token']} ({fields['role']})" if fields.get("role") else "no token"
    reason = f": {fields['reason']}" if fields.get("reason") else ""
    text = (
        f"{fields['method']} {fields['path']} {fields['status']} {fields['ms']:.1f} ms, {caller}, {fields['address']}"
    )
    log.log(level, "%s%s", text, reason, extra={"fields": fields})


class TextFormatter(logging.Formatter):
    """``2030-01-31T06:00:00.000Z INFO    4f2c… app.api.http.middleware: text``."""

    def format(self, record: logging.LogRecord) -> str:
        """One line, whatever the message has in it; a trace below it."""
        head = f"{_time(record)} {record.levelname:<7} {REQUEST_ID.get() or '-'} {record.name}: "
        text = record.getMessage()
        if not text.isprintable():
            text = "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)
        return head + text + (f"\n{self.formatException(record.exc_info)}" if record.exc_info else "")


class JsonFormatter(logging.Formatter):
    """One JSON object in a line."""

    def format(self, record: logging.LogRecord) -> str:
        """Time, level, logger, message, request, and the fields of a request."""
        entry: dict[str, Any] = {
            "time": _time(record),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
        }
        if REQUEST_ID.get():
            entry["request"] = REQUEST_ID.get()
        entry |= getattr(record, "fields", {})
        if record.exc_info:
            entry["trace"] = self.formatException(record.exc_info)
        return json.dumps(entry, ensure_ascii=True, default=str)


def _time(record: logging.LogRecord) -> str:
    return datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
