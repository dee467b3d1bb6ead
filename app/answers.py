"""Encode and decode what worker processes answer: values, and nothing that does something where it is read.

A hostile file may have taken over a worker, so any bytes may arrive. They are a pickle, which reads lists, dicts, texts
and numbers fast, but can also call what it names and change what it reaches. So an answer may name only types whose
classes cannot be changed, and the functions of this module that check what they get. Other classes are texts in an
answer: it never reaches them.
"""

from __future__ import annotations

import dataclasses
import functools
import importlib
import io
import logging
import pickle
import re
from collections import Counter, OrderedDict
from collections.abc import Callable
from datetime import date, datetime, time, timedelta, timezone
from enum import Enum
from operator import attrgetter
from types import FunctionType
from typing import TYPE_CHECKING, Any, Final, NamedTuple, NoReturn

from app.errors import FleetMapError

if TYPE_CHECKING:  # imported where it is needed: the server begins to prepare workers before it loads NumPy
    import numpy as np
    from numpy.typing import NDArray

log = logging.getLogger(__name__)

PROTOCOL: Final = 5

_FIXED_TYPES: Final[frozenset[type]] = frozenset(
    {complex, slice, OrderedDict, date, datetime, time, timedelta, timezone}
)
"""Types in C that answers name as they are: neither the classes nor what they make can do anything."""

_FIXED_NAMES: Final = {(kind.__module__, kind.__qualname__): kind for kind in _FIXED_TYPES}

_ELEMENT_TYPE: Final = re.compile(r"[<>|=]?(b1|[iufcSU][1-9][0-9]{0,9}|[mM]8(\[[0-9]{0,9}[A-Za-z]{1,7}\])?)")
"""NumPy's element types without fields and objects, as in ``dtype.str``."""

ClassName = tuple[str, str]
"""Module and qualified name of a class."""


def dumps(value: object) -> memoryview:
    """Encode a value, in a worker. Raises PicklingError for what the server would refuse."""
    buffer = io.BytesIO()
    _Writer(buffer, PROTOCOL).dump(value)
    return buffer.getbuffer()


def loads(data: bytes) -> Any:
    """Decode a value from a worker. Raises UnpicklingError for anything else, and nothing has happened then."""
    try:
        return _Reader(io.BytesIO(data)).load()
    except MemoryError:
        raise
    except Exception as error:
        # A forged answer has no place in our code: its traceback would tell nothing.
        log.error("pool: the answer of a worker is refused (reason=%s)", error)  # noqa: TRY400
        if isinstance(error, pickle.UnpicklingError):
            raise
        raise pickle.UnpicklingError(f"the answer of a worker is no value: {error}") from error


class _Writer(pickle.Pickler):
    """Writes values; all but builtin types become calls of this module's functions."""

    def reducer_override(self, value: Any) -> Any:
        """Return the call that makes a value. Builtin lists, dicts, sets, texts and numbers do not come here."""
        kind = type(value)
        if kind in _FIXED_TYPES or (kind is type and value in _FIXED_TYPES):
            return NotImplemented
        if kind is FunctionType and value in _FUNCTIONS.values():
            return NotImplemented
        if kind is Counter:
            return _counter, (dict(value),)
        if kind.__module__ == "numpy":
            return _numpy_call(value)
        try:
            make = _class_named((kind.__module__, kind.__qualname__))
        except pickle.UnpicklingError as error:
            raise pickle.PicklingError(str(error)) from error
        return _make, (make.name, *make.values(value))


class _Reader(pickle.Unpickler):
    """Reads values. The instructions of a pickle reach only what ``find_class`` returns, and what that makes."""

    def find_class(self, module: str, name: str) -> Any:
        """Return a type in C or a function of this module. Raises UnpicklingError for any other name."""
        fixed = _FIXED_NAMES.get((module, name))
        if fixed is not None:
            return fixed
        if module == __name__ and name in _FUNCTIONS:
            return _Unchangeable(_FUNCTIONS[name])
        raise _no_value(module, name)


class _Unchangeable:
    """A function that a pickle can call and not change: functions have attributes that its instructions can set."""

    __slots__ = ("_function",)

    def __init__(self, function: Callable[..., Any]) -> None:
        self._function = function

    def __call__(self, *args: Any) -> Any:
        return self._function(*args)

    def __setstate__(self, _: object) -> NoReturn:
        raise pickle.UnpicklingError("a worker sent a change of a function")


def _no_value(module: str, name: str) -> pickle.UnpicklingError:
    return pickle.UnpicklingError(f"a worker sent {module}.{name}, which is no type of values")


def _counter(counts: dict[Any, int]) -> Counter[Any]:
    if type(counts) is not dict:
        raise pickle.UnpicklingError("a worker sent a counter without counts")
    return Counter(counts)


def _numpy_call(value: Any) -> tuple[Callable[..., Any], tuple[Any, ...]]:
    """Return the call that makes an array or a scalar of NumPy. Raises PicklingError for other types."""
    import numpy as np

    if type(value) is np.str_:
        return _scalar, ("U", str(value))
    if type(value) is np.bytes_:
        return _scalar, ("S", bytes(value))
    if type(value) is not np.ndarray and not isinstance(value, np.generic):
        raise pickle.PicklingError(f"{type(value)} is no type of values")
    text = value.dtype.str
    if not _ELEMENT_TYPE.fullmatch(text):
        raise pickle.PicklingError(f"arrays of {value.dtype} are no values: send their columns, or lists")
    if isinstance(value, np.generic):
        return _scalar, (text, value.tobytes())
    order = "F" if value.flags.f_contiguous and not value.flags.c_contiguous else "C"
    flat = np.ascontiguousarray(value.T if order == "F" else value).reshape(-1).view(np.uint8)
    return _array, (text, value.shape, order, pickle.PickleBuffer(flat.data))


def _array(text: str, shape: tuple[int, ...], order: str, data: bytes | bytearray) -> NDArray[Any]:
    """Make an array that can be changed. text: element type as in ``dtype.str``."""
    import numpy as np

    if not (type(shape) is tuple and all(type(n) is int and n >= 0 for n in shape) and order in ("C", "F")):
        raise pickle.UnpicklingError("a worker sent an array without a shape")
    dtype = _element_type(text)
    if type(data) not in (bytes, bytearray):
        raise pickle.UnpicklingError("a worker sent an array without content")
    array: NDArray[Any] = np.ndarray(shape, dtype, buffer=data, order="F" if order == "F" else "C")
    if array.nbytes != len(data):
        raise pickle.UnpicklingError("a worker sent an array whose content has another size")
    if dtype.kind == "b":  # NumPy counts on 0 and 1; in memory of its own, as the answer can still change ``data``
        ones: NDArray[Any] = np.not_equal(array.view(np.uint8), 0, out=np.empty_like(array))
        return ones
    return array.copy(order="K") if type(data) is bytes else array


def _element_type(text: str) -> np.dtype[Any]:
    import numpy as np

    if type(text) is not str or not _ELEMENT_TYPE.fullmatch(text):
        raise pickle.UnpicklingError("a worker sent an array of no type of values")
    return np.dtype(text)


def _scalar(text: str, data: str | bytes) -> np.generic:
    """Make a scalar of NumPy. text: ``U`` and ``S`` for texts and bytes of any length, else as in ``dtype.str``."""
    import numpy as np

    if type(text) is str and text == "U" and type(data) is str:
        return np.str_(data)
    if type(text) is str and text == "S" and type(data) is bytes:
        return np.bytes_(data)
    if type(data) is not bytes:
        raise pickle.UnpicklingError("a worker sent a number without content")
    scalar: np.generic = _array(text, (1,), "C", data)[0]
    return scalar


def _make(name: ClassName, *values: Any) -> Any:
    """Make an instance of one of app's types of values, without calling its constructor."""
    if not (type(name) is tuple and len(name) == 2 and type(name[0]) is str and type(name[1]) is str):
        raise pickle.UnpicklingError("a worker sent a value without a type")
    return _class_named(name).build(values)


_FUNCTIONS: Final = {function.__name__: function for function in (_array, _counter, _make, _scalar)}
"""What an answer may call."""


class _ValueClass(NamedTuple):
    """How a class is sent. values: what is sent of an instance. build: makes one of that."""

    name: ClassName
    values: Callable[[Any], tuple[Any, ...]]
    build: Callable[[tuple[Any, ...]], Any]


@functools.lru_cache(maxsize=1024)
def _class_named(name: ClassName) -> _ValueClass:
    """Return how a class of app is sent. Raises UnpicklingError unless it is a type of values that app defines."""
    kind = _find_class(*name)
    if issubclass(kind, FleetMapError):
        return _ValueClass(name, _error_values, functools.partial(_build_error, kind))
    if issubclass(kind, Enum):
        if "__setstate__" not in vars(kind):
            raise pickle.UnpicklingError(f"{kind} needs a __setstate__ that raises: answers could change its members")
        return _ValueClass(name, lambda one: (one.value,), functools.partial(_find_member, kind))
    if issubclass(kind, tuple) and hasattr(kind, "_fields"):
        return _ValueClass(name, tuple, functools.partial(_build_tuple, kind, len(kind._fields)))
    if issubclass(kind, str):
        return _ValueClass(name, lambda one: (str(one),), functools.partial(_build_text, kind))
    if dataclasses.is_dataclass(kind):
        fields = tuple(field.name for field in dataclasses.fields(kind))
        return _ValueClass(name, _reader_of(fields), functools.partial(_build_dataclass, kind, fields))
    raise _no_value(*name)


def _find_class(module: str, name: str) -> type:
    """Return a class that a module of app defines; nothing else is even looked at."""
    if not module.startswith("app.") or module.endswith("__main__"):
        raise _no_value(module, name)
    try:
        target: Any = importlib.import_module(module)
        for part in name.split("."):
            target = vars(target)[part]
    except (ImportError, KeyError, TypeError) as error:
        raise _no_value(module, name) from error
    if not isinstance(target, type) or (target.__module__, target.__qualname__) != (module, name):
        raise _no_value(module, name)
    return target


def _reader_of(fields: tuple[str, ...]) -> Callable[[Any], tuple[Any, ...]]:
    if len(fields) > 1:
        return attrgetter(*fields)
    return lambda one: tuple(getattr(one, name) for name in fields)


def _build_dataclass(kind: type, fields: tuple[str, ...], values: tuple[Any, ...]) -> Any:
    if len(values) != len(fields):
        raise pickle.UnpicklingError(f"a worker sent {kind.__name__} with other fields")
    value: Any = object.__new__(kind)
    set_field = object.__setattr__
    for name, one in zip(fields, values, strict=True):
        set_field(value, name, one)
    return value


def _build_tuple(kind: type[tuple[Any, ...]], length: int, values: tuple[Any, ...]) -> Any:
    if len(values) != length:
        raise pickle.UnpicklingError(f"a worker sent {kind.__name__} with other fields")
    return tuple.__new__(kind, values)


def _build_text(kind: type[str], values: tuple[Any, ...]) -> str:
    (text,) = values
    if type(text) is not str:
        raise pickle.UnpicklingError(f"a worker sent {kind.__name__} without a text")
    return str.__new__(kind, text)


def _find_member(kind: type[Enum], values: tuple[Any, ...]) -> Enum:
    (value,) = values
    if type(value) not in (str, int):
        raise pickle.UnpicklingError(f"a worker sent no {kind.__name__}")
    return kind(value)


def _error_values(error: FleetMapError) -> tuple[dict[str, Any]]:
    return ({name: value for name, value in vars(error).items() if not name.startswith("_")},)


def _build_error(kind: type[FleetMapError], values: tuple[Any, ...]) -> FleetMapError:
    """Make an error with its own attributes, which hide none of its class."""
    (attributes,) = values
    if type(attributes) is not dict or type(attributes["detail"]) is not str:
        raise pickle.UnpicklingError(f"a worker sent {kind.__name__} without a text")
    error = kind.__new__(kind, attributes["detail"])
    for name, value in attributes.items():
        if type(name) is not str or name.startswith("_") or hasattr(kind, name):
            raise pickle.UnpicklingError(f"a worker sent {kind.__name__} with other attributes")
        object.__setattr__(error, name, value)
    return error
