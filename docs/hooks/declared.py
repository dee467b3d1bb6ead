"""What a format's code declares: the calls that report losses, filled-in values and findings, read from its source.

Only what can be reached from the format's ``write`` or ``check`` counts: functions and classes of ``app.formats`` that
use each other by name. Values that are known at run time only are shown as ``…``.
"""

from __future__ import annotations

import ast
import functools
import importlib
import inspect
import re
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import Any

PACKAGE = "app.formats"
LEVELS = {"error_finding": "error", "warning_finding": "warning"}
NAMES = frozenset({"drop", "fill", "lose", *LEVELS})


@dataclass(frozen=True, slots=True)
class Unit:
    """A function or class at the top of a module."""

    module: ModuleType
    node: ast.stmt


@functools.cache
def _units(name: str) -> tuple[dict[str, Unit], dict[str, tuple[str, str]]]:
    """A module's functions and classes, and what it imports from the package: name -> (module, name or empty)."""
    module = importlib.import_module(name)
    units: dict[str, Unit] = {}
    imported: dict[str, tuple[str, str]] = {}
    for node in ast.parse(inspect.getsource(module)).body:
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
            units[node.name] = Unit(module, node)
        elif isinstance(node, ast.ImportFrom) and f"{node.module}.".startswith(f"{PACKAGE}."):
            imported |= {a.asname or a.name: _target(str(node.module), a.name) for a in node.names}
    return units, imported


def _target(module: str, name: str) -> tuple[str, str]:
    """What ``from module import name`` names: (module, name or empty)."""
    is_module = isinstance(getattr(importlib.import_module(module), name, None), ModuleType)
    return (f"{module}.{name}", "") if is_module else (module, name)


@functools.cache
def reachable(function: Callable[..., Any]) -> list[Unit]:
    """The functions and classes that a function of a format may use, itself included."""
    while isinstance(function, functools.partial):
        function = function.func
    todo = [(function.__module__, function.__qualname__.split(".")[0])]
    seen: dict[tuple[str, str], Unit] = {}
    while todo:
        place = todo.pop()
        if place in seen or not place[0].startswith(f"{PACKAGE}."):
            continue
        units, imported = _units(place[0])
        unit = units.get(place[1])
        if unit is None:
            if place[1] in imported and imported[place[1]][1]:
                todo.append(imported[place[1]])
            continue
        seen[place] = unit
        todo += _references(place)
    return [seen[place] for place in sorted(seen)]


@functools.cache
def _references(place: tuple[str, str]) -> list[tuple[str, str]]:
    """What a function or class uses, by name."""
    units, imported = _units(place[0])
    out = []
    for node in ast.walk(units[place[1]].node):
        if isinstance(node, ast.Name):
            target = imported.get(node.id, (place[0], node.id))
            out += [target] if target[1] else []
        elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            module, name = imported.get(node.value.id, ("", "x"))
            out += [] if name else [(module, node.attr)]
    return list(dict.fromkeys(out))


def drops(write: Callable[..., Any]) -> list[tuple[str, str]]:
    """(what, why) of each loss that a writer can report."""
    units = reachable(write)
    out: dict[tuple[str, str], None] = {}
    for unit, scope, call in _calls(units, {"drop"}):
        if len(call.args) != 3:
            continue
        for item in _texts(call.args[0], scope, unit) or _counted(unit):
            for why in _texts(call.args[2], scope, unit) or [""]:
                out[item, why] = None
    for unit, scope, index in _pairs(units):
        for item in _texts(index.elts[0], scope, unit):
            out |= dict.fromkeys((item, why) for why in _texts(index.elts[1], scope, unit) or ["…"])
    return sorted((item, why) for item, why in out if item.strip("… "))


def fills(write: Callable[..., Any]) -> list[tuple[str, str, str]]:
    """(what, why, parameter that sets it or empty) of each value that a writer can fill in."""
    out: dict[tuple[str, str, str], None] = {}
    for unit, scope, call in _calls(reachable(write), {"fill"}):
        if not 3 <= len(call.args) <= 4:
            continue
        option = (_texts(call.args[3], scope, unit) or [""])[0] if len(call.args) > 3 else ""
        for item in _texts(call.args[0], scope, unit):
            for why in _texts(call.args[2], scope, unit) or [""]:
                out[item, why, option] = None
    return sorted((item, why, option) for item, why, option in out if item.strip("… "))


def findings(check: Callable[..., Any]) -> list[tuple[str, str, str]]:
    """(level, place in the file or empty, problem) of each rule of a map's consumers."""
    out: dict[tuple[str, str, str], None] = {}
    for unit, scope, call in _calls(reachable(check), LEVELS):
        location = next((k.value for k in call.keywords if k.arg == "where"), None)
        place = (_texts(location, scope, unit) or [""])[0].strip("… .") if location is not None else ""
        out |= dict.fromkeys((LEVELS[_called(call)], place, text) for text in _texts(call.args[0], scope, unit))
    return sorted(out)


@functools.cache
def _marks(unit: Unit) -> list[tuple[ast.AST, ast.AST]]:
    """What may declare something, with the function that it stands in: calls by name, subscripts of losses."""
    out: list[tuple[ast.AST, ast.AST]] = []
    todo: list[tuple[ast.AST, ast.AST]] = [(unit.node, unit.node)]
    while todo:
        scope, node = todo.pop()
        is_call = isinstance(node, ast.Call) and _called(node) in NAMES and bool(node.args)
        if is_call or (isinstance(node, ast.Subscript) and re.search("lost|dropped", ast.unparse(node.value))):
            out.append((scope, node))
        inner = node if isinstance(node, ast.FunctionDef) else scope
        todo += [(inner, child) for child in ast.iter_child_nodes(node)]
    return out


def _called(call: ast.Call) -> str:
    return call.func.attr if isinstance(call.func, ast.Attribute) else getattr(call.func, "id", "")


def _calls(units: Sequence[Unit], names: Collection[str]) -> Iterator[tuple[Unit, ast.AST, ast.Call]]:
    """Each call of these names, with the function that it stands in."""
    for unit in units:
        for scope, node in _marks(unit):
            if isinstance(node, ast.Call) and _called(node) in names:
                yield unit, scope, node


def _texts(node: ast.AST, scope: ast.AST, unit: Unit, depth: int = 3) -> list[str]:
    """The texts that an expression can be; none where nothing of it is known."""
    if isinstance(node, ast.Constant):
        return [str(node.value)] if isinstance(node.value, str) else []
    if isinstance(node, ast.JoinedStr):
        parts = [str(v.value) if isinstance(v, ast.Constant) else _value(v, unit) for v in node.values]
        return ["".join(parts)]
    if isinstance(node, ast.IfExp):
        return _texts(node.body, scope, unit, depth) + _texts(node.orelse, scope, unit, depth)
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
        left, right = (_texts(side, scope, unit, depth) or ["…"] for side in (node.left, node.right))
        return [a + b for a in left for b in right]
    if isinstance(node, ast.Name) and depth:
        bound = _binding(node, scope)
        if isinstance(bound, (ast.Assign, ast.AnnAssign)):
            return _texts(bound.value, scope, unit, depth - 1) if bound.value else []
        if bound is not None:
            return _looped(bound, node.id, scope, unit, depth - 1)
        constant = getattr(unit.module, node.id, None)
        return [constant] if isinstance(constant, str) else []
    return []


def _binding(name: ast.Name, scope: ast.AST) -> ast.Assign | ast.AnnAssign | ast.For | None:
    """The last statement before a use that gives a local name its value."""
    bound: list[ast.Assign | ast.AnnAssign | ast.For] = []
    for one in ast.walk(scope):
        if isinstance(one, (ast.Assign, ast.AnnAssign, ast.For)) and one.lineno <= name.lineno:
            targets = one.targets if isinstance(one, ast.Assign) else [one.target]
            if name.id in {n.id for t in targets for n in ast.walk(t) if isinstance(n, ast.Name)}:
                bound.append(one)
    return max(bound, key=lambda one: one.lineno, default=None)


def _looped(loop: ast.For, name: str, scope: ast.AST, unit: Unit, depth: int) -> list[str]:
    """The texts that a loop over a literal gives a variable."""
    names = loop.target.elts if isinstance(loop.target, ast.Tuple) else [loop.target]
    place = next((k for k, t in enumerate(names) if isinstance(t, ast.Name) and t.id == name), None)
    if place is None:
        return []
    rows: list[ast.expr] = []
    items: ast.expr | None = loop.iter
    if isinstance(items, ast.Name):
        bound = _binding(items, scope)
        items = bound.value if isinstance(bound, (ast.Assign, ast.AnnAssign)) else items
    if isinstance(items, (ast.Tuple, ast.List, ast.Set)):
        rows = list(items.elts)
    elif isinstance(loop.iter, ast.Call) and isinstance(loop.iter.func, ast.Attribute):
        table = loop.iter.func.value
        if isinstance(table, ast.Dict) and place == 0:
            return [text for key in table.keys if key for text in _texts(key, scope, unit, depth)]
    out = []
    for row in rows:
        one = row.elts[place] if isinstance(row, ast.Tuple) and len(names) > 1 else row
        out += _texts(one, scope, unit, depth)
    return out


def _value(node: ast.AST, unit: Unit) -> str:
    """A value within a text: a constant of the module, else ``…``."""
    inner = node.value if isinstance(node, ast.FormattedValue) else node
    constant = getattr(unit.module, inner.id, None) if isinstance(inner, ast.Name) else None
    return f"{constant}" if isinstance(constant, (int, float, str)) else "…"


def _counted(unit: Unit) -> list[str]:
    """Losses that a writer counts by name while it writes: ``self.lost["…"] += 1`` or ``self.lose("…")``."""
    out = []
    for one in reachable(getattr(unit.module, unit.node.name)):  # type: ignore[attr-defined]
        for scope, node in _marks(one):
            if isinstance(node, ast.Subscript) and not isinstance(node.slice, ast.Tuple):
                out += _texts(node.slice, scope, one)
            elif isinstance(node, ast.Call) and _called(node) == "lose":
                out += _texts(node.args[0], scope, one)
    return out


def _pairs(units: Sequence[Unit]) -> Iterator[tuple[Unit, ast.AST, ast.Tuple]]:
    """Losses that are counted by (what, why)."""
    for unit in units:
        for scope, node in _marks(unit):
            if isinstance(node, ast.Subscript) and isinstance(node.slice, ast.Tuple) and len(node.slice.elts) == 2:
                yield unit, scope, node.slice
