"""Typed parameters of formats and derivations: a frozen dataclass declares name, type, default, bounds and meaning.

OpenAPI, the command line and the coverage table are generated from the same declaration::

    @dataclass(frozen=True, slots=True)
    class Options:
        resolution: float = parameter(0.05, "metres a cell", minimum=1e-3, maximum=100.0)
        file_type: Literal["pgm", "png"] = parameter("pgm", "image format")
"""

from __future__ import annotations

import dataclasses
import math
import types
from collections.abc import Callable, Mapping
from functools import cache
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from app.errors import Invalid, Problem
from app.model.names import did_you_mean

T = TypeVar("T")

_hints: Callable[[Any], dict[str, Any]] = cache(get_type_hints)


def parameter(
    default: Any, doc: str, *, minimum: float | None = None, maximum: float | None = None, unit: str = ""
) -> Any:
    """Declare a dataclass field with its description and bounds (both inclusive)."""
    return dataclasses.field(
        default=default, metadata={"doc": doc, "minimum": minimum, "maximum": maximum, "unit": unit}
    )


def parse(cls: type[T], values: Mapping[str, Any], label: str = "parameter") -> T:
    """Parse strings (of a query, form or command line) or JSON values into the dataclass.

    Raises Invalid with every parameter that is unknown, of the wrong type or out of bounds, and the accepted values.
    """
    hints = _hints(cls)
    fields_by_name = {f.name: f for f in dataclasses.fields(cls)}  # type: ignore[arg-type]
    problems, out = [], {}
    for name, value in values.items():
        if name not in fields_by_name:
            accepted = ", ".join(fields_by_name) or "none"
            problems.append(
                Problem(f"unknown {label}{did_you_mean(name, fields_by_name)}; accepted: {accepted}", where=name)
            )
            continue
        try:
            out[name] = _convert(hints[name], value)
            _check_bounds(out[name], fields_by_name[name].metadata)
        except ValueError as error:
            problems.append(Problem(str(error), where=name))
    if problems:
        raise Invalid("; ".join(f"{p.where}: {p.problem}" for p in problems), problems)
    return cls(**out)


def describe(cls: type[Any]) -> list[dict[str, Any]]:
    """Describe each parameter as ``{name, schema, default, description}`` with a JSON schema, in declared order."""
    hints = _hints(cls)
    out = []
    for f in dataclasses.fields(cls):
        schema = _schema(hints[f.name])
        for bound in ("minimum", "maximum"):
            if f.metadata.get(bound) is not None:
                schema[bound] = f.metadata[bound]
        unit = f" [{f.metadata['unit']}]" if f.metadata.get("unit") else ""
        out.append(
            {"name": f.name, "schema": schema, "default": f.default, "description": f.metadata.get("doc", "") + unit}
        )
    return out


def canonical(options: Any) -> dict[str, Any]:
    """Return the parameters that differ from their defaults, sorted: part of a recipe's key."""
    if options is None:
        return {}
    fields = sorted(dataclasses.fields(options), key=lambda f: f.name)
    return {f.name: getattr(options, f.name) for f in fields if getattr(options, f.name) != f.default}


def _convert(hint: Any, value: Any) -> Any:
    origin, args = get_origin(hint), get_args(hint)
    if origin in (Union, types.UnionType):
        if value is None or value == "":
            return None
        return _convert(next(a for a in args if a is not type(None)), value)
    if origin is Literal:
        if value not in args:
            raise ValueError(f"must be one of {', '.join(map(str, args))}, got {value!r:.80}")
        return value
    if origin is tuple:
        if not isinstance(value, (str, list, tuple)):
            raise ValueError(f"must be comma-separated values, got {value!r:.80}")
        parts = value.split(",") if isinstance(value, str) else list(value)
        if len(args) == 2 and args[1] is Ellipsis:
            return tuple(_convert(args[0], p) for p in parts)
        if len(parts) != len(args):
            raise ValueError(f"must be {len(args)} comma-separated values, got {value!r:.80}")
        return tuple(_convert(a, p) for a, p in zip(args, parts, strict=True))
    if hint is bool:
        if isinstance(value, bool):
            return value
        text = str(value).strip().lower()
        if text in ("1", "true", "yes", "on"):
            return True
        if text in ("0", "false", "no", "off"):
            return False
        raise ValueError(f"must be true or false, got {value!r:.80}")
    if hint is int:
        if isinstance(value, bool) or (isinstance(value, float) and not value.is_integer()):
            raise ValueError(f"must be a whole number, got {value!r:.80}")
        try:
            integer = int(_digits(value))
        except (TypeError, ValueError):
            raise ValueError(f"must be a whole number, got {value!r:.80}") from None
        if not -(2**63) <= integer < 2**63:
            raise ValueError("must be a whole number of at most 64 bits")
        return integer
    if hint is float:
        try:
            number = float(_digits(value))
        except (TypeError, ValueError, OverflowError):
            raise ValueError(f"must be a number, got {value!r:.80}") from None
        if isinstance(value, bool) or not math.isfinite(number):
            raise ValueError(f"must be a finite number, got {value!r:.80}")
        return number
    if hint is str:
        if not isinstance(value, (str, int, float)):
            raise ValueError(f"must be a string, got {value!r:.80}")
        return str(value)
    raise TypeError(f"parameters of type {hint} are not supported")


def _digits(value: Any) -> Any:
    """Reject strings that are not plain ASCII numbers: Python also accepts other scripts' digits and underscores."""
    if isinstance(value, str) and (not value.isascii() or "_" in value):
        raise ValueError("not a number")
    return value


def _check_bounds(value: Any, metadata: Mapping[str, Any]) -> None:
    low, high = metadata.get("minimum"), metadata.get("maximum")
    for number in value if isinstance(value, tuple) else (value,):
        if isinstance(number, (int, float)) and not isinstance(number, bool):
            if low is not None and number < low:
                raise ValueError(f"must be at least {low:g}, got {number:g}")
            if high is not None and number > high:
                raise ValueError(f"must be at most {high:g}, got {number:g}")


def _schema(hint: Any) -> dict[str, Any]:
    origin, args = get_origin(hint), get_args(hint)
    if origin in (Union, types.UnionType):
        return _schema(next(a for a in args if a is not type(None)))
    if origin is Literal:
        return {"type": "string", "enum": list(args)}
    if origin is tuple:
        return {"type": "string", "description": "comma-separated values"}
    names = {bool: "boolean", int: "integer", float: "number", str: "string"}
    return {"type": names[hint]}
