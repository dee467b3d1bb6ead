"""Answers of worker processes: all kinds of values return, and no pickle changes anything where it is read."""

from __future__ import annotations

import builtins
import copyreg
import importlib
import os
import pickle
from collections import Counter, OrderedDict
from collections.abc import Callable
from datetime import UTC, date, datetime, time, timedelta, timezone
from typing import Any

import numpy as np
import pytest

from app import answers
from app.api.http.features import Position
from app.backup.packs import Kind
from app.errors import CannotDerive, FleetMapError, LostBlobs, NotFound, Problem
from app.model.frame import Datum
from app.store.audit import Caller
from app.store.changes import KEEP, Keep
from app.store.values import PartEntry
from app.syntax.yaml.scalars import PlainScalar

REFUSED = pickle.UnpicklingError


def text(value: str) -> bytes:
    """Encode a text as a pickle's instructions."""
    return pickle.BINUNICODE + len(value.encode()).to_bytes(4, "little") + value.encode()


def named(module: str, name: str) -> bytes:
    return text(module) + text(name) + pickle.STACK_GLOBAL


def function(name: str) -> bytes:
    return named("app.answers", name)


def instance(kind: type, *values: bytes) -> bytes:
    """Instructions that make an instance as workers do."""
    name = text(kind.__module__) + text(kind.__qualname__) + pickle.TUPLE2
    return function("_make") + pickle.MARK + name + b"".join(values) + pickle.TUPLE + pickle.REDUCE


def changed(target: bytes, attribute: str, value: bytes = pickle.NONE, *, slots: bool) -> bytes:
    """Instructions that set an attribute of what ``target`` leaves."""
    members = pickle.EMPTY_DICT + text(attribute) + value + pickle.SETITEM
    return target + ((pickle.NONE + members + pickle.TUPLE2) if slots else members) + pickle.BUILD


def load(instructions: bytes) -> Any:
    return answers.loads(pickle.PROTO + b"\x05" + instructions + pickle.STOP)


def returned(value: Any) -> Any:
    return answers.loads(bytes(answers.dumps(value)))


VALUES = [
    *(None, True, 2**70, -1.5, "é", b"x", bytearray(b"y"), 1j, slice(1, None, 2)),
    *([1, [2]], (3, ()), {"a": {"b": 4}}, {5}, frozenset({6}), Counter("aab"), OrderedDict(b=1, a=2)),
    *(date(2026, 1, 2), datetime(2026, 1, 2, 3, 4, 5, 6, UTC), time(1, 2), timedelta(days=3), UTC),
    *(timezone(timedelta(hours=2), "here"), datetime(2026, 1, 2)),
    *(np.float64(0.5), np.float32(0.5), np.int8(-3), np.bool_(True), np.str_(""), np.str_("é"), np.bytes_(b"z")),
    *(np.complex128(1 + 2j), np.datetime64("2026-01-02"), np.timedelta64(3, "s")),
    *(Problem("gone", line=3), Position("objects", "0", "a", "b"), KEEP, PlainScalar("true")),
]


@pytest.mark.parametrize("value", VALUES, ids=repr)
def test_values_return(value: Any) -> None:
    result = returned([value, value])
    assert result == [value, value]
    assert type(result[0]) is type(value)


ARRAYS = [
    *(np.arange(6).astype(kind).reshape(2, 3) for kind in ("u1", "<i2", ">i4", "f2", "f4", "f8", "c16", "bool")),
    *(np.array(["a", "éé"]), np.array([b"a", b"bb"]), np.array(["2026-01-02"], "M8[ns]"), np.array([3], "m8[25s]")),
    *(np.array(7.0), np.empty((0, 3)), np.empty((2, 0), bool), np.asfortranarray(np.arange(6).reshape(2, 3))),
    *(np.arange(20).reshape(4, 5)[::2, ::-1], np.broadcast_to(np.float32(2), (3, 4)), np.eye(3, dtype=bool).T),
]


@pytest.mark.parametrize("array", ARRAYS, ids=lambda a: f"{a.dtype.str}{a.shape}")
def test_arrays_return_and_can_be_changed(array: np.ndarray[Any, Any]) -> None:
    read_only = array.copy(order="K")
    read_only.flags.writeable = False
    for one in (array, read_only):
        result = returned({"a": one})["a"]
        assert type(result) is np.ndarray
        assert (result.dtype, result.shape) == (array.dtype, array.shape)
        assert np.array_equal(result, array)
        assert result.flags.writeable
        assert result.flags.f_contiguous == one.copy(order="A").flags.f_contiguous


def test_same_value_twice_returns_as_one() -> None:
    problem, array = Problem("gone"), np.arange(3)
    first = returned([problem, array, problem, array])
    assert first[0] is first[2]
    assert first[1] is first[3]


@pytest.mark.parametrize(
    "error",
    [
        NotFound("no", [Problem("gone", "a.yaml", 3)]),
        CannotDerive("no", [], "step", choose=True),
        LostBlobs("lost", (), ["a", "b"]),
    ],
    ids=lambda e: type(e).__name__,
)
def test_errors_return_with_their_attributes(error: FleetMapError) -> None:
    result = returned(error)
    assert type(result) is type(error)
    assert (result.args, str(result), vars(result)) == (error.args, str(error), vars(error))


@pytest.mark.parametrize(
    "value",
    [
        *(np.array([None]), np.zeros(2, "u1,f4"), np.void(b"abc"), np.dtype("f8"), np.ma.array([1])),
        *(len, os.getcwd, answers.loads, Problem, range(3), Kind.BLOB),
        *(object(), ValueError("no")),
    ],
    ids=lambda value: type(value).__name__,
)
def test_what_is_no_value_is_not_sent(value: Any) -> None:
    with pytest.raises(pickle.PicklingError):
        answers.dumps([value])


@pytest.mark.parametrize(
    "name",
    [
        *("os.system", "builtins.eval", "builtins.getattr", "builtins.range", "builtins.bytearray", "numpy.dtype"),
        *("numpy.ndarray", "numpy._core.multiarray.scalar", "numpy._core.multiarray._reconstruct"),
        *("collections.Counter", "app.errors.Problem", "app.errors.NotFound", "app.store.changes.Keep"),
        *("app.pool.Pool", "app.answers.importlib", "app.answers.loads", "app.answers._class_named"),
        *("app.answers._make.__globals__", "copyreg._reconstructor"),
    ],
)
def test_other_names_are_refused(name: str) -> None:
    module, _, last = name.rpartition(".")
    if "_make" in module:
        module, last = "app.answers", "_make.__globals__"
    with pytest.raises(REFUSED, match="no type of values"):
        load(named(module, last))


@pytest.mark.parametrize(
    ("module", "name"),
    [
        *(("app.pool", "os.system"), ("app.pool", "multiprocessing.Process"), ("app.pool", "BaseProcess")),
        *(("app.pool", "Pool"), ("app.pool", "log"), ("app.errors", "Problem.as_dict"), ("os", "system")),
        *(("app.cli.__main__", "main"), ("app.no_such_module", "X"), ("app.errors", "Problem.__class__")),
        *(("app.backup.packs", "Kind"), ("app.errors", "FleetMapError.__base__"), ("app.store.changes", "Problem")),
    ],
)
def test_make_makes_only_values_of_app(module: str, name: str) -> None:
    key = text(module) + text(name) + pickle.TUPLE2
    with pytest.raises(REFUSED):
        load(function("_make") + key + text("x") + pickle.TUPLE2 + pickle.REDUCE)


CLASSES: list[type] = [Caller, Problem, NotFound, Keep, PlainScalar, Position, PartEntry, Datum, Counter]


@pytest.mark.parametrize("slots", [False, True])
@pytest.mark.parametrize("kind", CLASSES, ids=lambda kind: kind.__name__)
def test_classes_are_not_changed(kind: type, slots: bool) -> None:
    before = dict(vars(kind))
    with pytest.raises(REFUSED):
        load(changed(named(kind.__module__, kind.__qualname__), "__init__", named("builtins", "slice"), slots=slots))
    assert dict(vars(kind)) == before


@pytest.mark.parametrize("slots", [False, True])
@pytest.mark.parametrize("kind", sorted(answers._FIXED_TYPES, key=str), ids=lambda kind: kind.__name__)
def test_named_types_and_functions_are_not_changed(kind: type, slots: bool) -> None:
    before = dict(vars(kind))
    with pytest.raises(REFUSED):
        load(changed(named(kind.__module__, kind.__qualname__), "extra", slots=slots))
    assert dict(vars(kind)) == before
    for name, target in answers._FUNCTIONS.items():
        with pytest.raises(REFUSED, match="change of a function"):
            load(changed(function(name), "__code__", slots=slots))
        assert vars(target) == {}


@pytest.mark.parametrize("slots", [False, True])
def test_members_of_enumerations_are_not_changed(slots: bool) -> None:
    assert load(instance(Keep, text("keep"))) is KEEP
    with pytest.raises(REFUSED):
        load(changed(instance(Keep, text("keep")), "_value_", slots=slots))
    assert (KEEP.value, KEEP.name) == ("keep", "KEEP")
    with pytest.raises(REFUSED):
        load(instance(Keep, text("other")))


def test_instances_are_not_of_other_classes() -> None:
    for kind in (Problem, Caller, NotFound):
        with pytest.raises(REFUSED):
            load(named(kind.__module__, kind.__qualname__) + pickle.EMPTY_TUPLE + pickle.NEWOBJ)
    with pytest.raises(REFUSED):
        load(function("_make") + pickle.EMPTY_TUPLE + pickle.NEWOBJ)


@pytest.mark.parametrize(
    "instructions",
    [
        instance(Problem, text("gone")),
        instance(Position),
        instance(PlainScalar, pickle.NONE),
        instance(PlainScalar, text("a"), text("b")),
        instance(NotFound, text("no")),
        instance(NotFound, pickle.EMPTY_DICT),
        *(
            instance(NotFound, pickle.EMPTY_DICT + pickle.MARK + text("detail") + text("no") + more + pickle.SETITEMS)
            for more in (
                text("__class__") + pickle.NONE,
                text("args") + pickle.NONE,
                text("with_traceback") + text("x"),
            )
        ),
        function("_make") + text("app.errors") + pickle.TUPLE1 + pickle.REDUCE,
        function("_counter") + text("aab") + pickle.TUPLE1 + pickle.REDUCE,
    ],
)
def test_values_with_other_fields_are_refused(instructions: bytes) -> None:
    with pytest.raises(REFUSED):
        load(instructions)


BAD_ARRAYS: list[tuple[Any, ...]] = [
    *(("|O", (1,), "C", bytes(8)), ("|V8", (1,), "C", bytes(8)), ("i4,O", (1,), "C", bytes(12))),
    *(("O8", (1,), "C", bytes(8)), ("<f8", (2,), "C", bytes(8)), ("<f8", (1,), "C", bytes(16))),
    *(("<f8", (-1,), "C", bytes(8)), ("<f8", [1], "C", bytes(8)), ("<f8", (2**62, 4), "C", bytes(8))),
    *(("<f8", (1,), "A", bytes(8)), ("<f8", (1,), "C", "12345678"), (b"<f8", (1,), "C", bytes(8))),
    *(("<U0", (2**40,), "C", b""), ("<f8", (True,), "C", bytes(8)), ("S9999999999", (1,), "C", b"")),
]


@pytest.mark.parametrize("arguments", BAD_ARRAYS, ids=repr)
def test_arrays_of_other_content_are_refused(arguments: tuple[Any, ...]) -> None:
    packed = pickle.dumps(arguments, 5)[2:-1]
    with pytest.raises(REFUSED):
        load(function("_array") + packed + pickle.REDUCE)
    scalar = pickle.dumps((arguments[0], b"AAAAAAA"), 5)[2:-1]
    with pytest.raises(REFUSED):
        load(function("_scalar") + scalar + pickle.REDUCE)


def test_booleans_are_0_or_1_whatever_is_sent() -> None:
    """NumPy adds them up to find how much memory a selection needs."""
    content = pickle.BYTEARRAY8 + (3).to_bytes(8, "little") + b"\x00\x02\xff" + pickle.MEMOIZE
    arguments = (
        pickle.MARK + text("|b1") + pickle.BININT1 + b"\x03" + pickle.TUPLE1 + text("C") + content + pickle.TUPLE
    )
    array = function("_array") + arguments + pickle.REDUCE
    later = pickle.BINGET + b"\x00" + pickle.BININT1 + b"\x00" + pickle.BININT1 + b"\x07" + pickle.SETITEM
    for instructions in (array, array + later + pickle.TUPLE2):
        result = load(instructions)
        selection = result[0] if isinstance(result, tuple) else result
        assert selection.view(np.uint8).tolist() == [0, 1, 1]


class _Call:
    """What a pickle calls where it is read."""

    def __init__(self, *call: Any) -> None:
        self.call = call

    def __reduce__(self) -> Any:
        return self.call


def test_forged_element_type_is_refused() -> None:
    """An element type of bytes that was told to be one of objects: its scalar is an object at any address."""
    state = (3, "|", None, ("f",), {"f": (np.dtype("O"), 0)}, 8, 1, 0)
    forged = _Call(np.dtype, ("V8", False, True), state)
    scalar = importlib.import_module("numpy._core.multiarray").scalar
    for value in (
        forged,
        _Call(scalar, (forged, b"AAAAAAAA")),
        _Call(PlainScalar, (_Call(scalar, (forged, b"A" * 8)),)),
    ):
        with pytest.raises(REFUSED, match="no type of values"):
            answers.loads(pickle.dumps((True, value), 4))


@pytest.mark.parametrize("call", [eval, builtins.getattr, copyreg.pickle, os.system, Problem, Caller, NotFound])
def test_nothing_else_is_called(call: Callable[..., Any]) -> None:
    with pytest.raises(REFUSED, match="no type of values"):
        answers.loads(pickle.dumps(_Call(call, ("1 + 1",))))


def test_damaged_answers_are_refused() -> None:
    good = bytes(answers.dumps((True, [Problem("gone"), np.arange(3)])))
    for end in range(len(good)):
        with pytest.raises(REFUSED):
            answers.loads(good[:end])
