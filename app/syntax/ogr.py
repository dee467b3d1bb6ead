"""Read and write vector files with GDAL, in memory only.

GDAL has no drivers here but those of the formats that are read, so no file can name another file, a URL or a VRT.
"""

from __future__ import annotations

import ctypes
import io
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from app.errors import Problem, TooLarge, UnreadableFile
from app.limits import Limits

Driver = Literal["DXF", "ESRI Shapefile", "FlatGeobuf", "GML"]

_DRIVERS = frozenset({b"DXF", b"ESRI Shapefile", b"FlatGeobuf", b"GML", b"MEM"})
"""Drivers that stay; MEM is in memory by definition, and GDAL needs it for others."""

_COUNTED = ("ESRI Shapefile", "FlatGeobuf")
"""Drivers that believe the number of features in a header, for which memory is allocated."""

_SETTINGS = {
    "CPL_VSIL_CURL_ALLOWED_EXTENSIONS": "{none}",
    "GDAL_DISABLE_READDIR_ON_OPEN": "EMPTY_DIR",
    "GDAL_NUM_THREADS": "1",
    "GML_DOWNLOAD_SCHEMA": "NO",
    "GML_SKIP_RESOLVE_ELEMS": "ALL",
}

MAX_LAYERS = 100
"""Maximum number of layers of a file: GDAL parses it again for each."""

MAX_REPORTED = 5
"""Maximum number of GDAL's warnings that are reported."""


@dataclass(frozen=True, slots=True, eq=False)
class VectorLayer:
    """Layer of a file: columns by name, each with n values or None; n geometries as WKB or None; CRS as code or WKT."""

    name: str
    columns: Mapping[str, list[Any]]
    geometry: list[bytes | None]
    crs: str | None


@cache
def _pyogrio() -> Any:
    """Return pyogrio, after removing all other drivers. Raises RuntimeError if that fails: nothing is read then."""
    import pyogrio
    import pyogrio._io

    gdal = ctypes.CDLL(pyogrio._io.__file__)  # finds the functions of the GDAL that it is linked to
    gdal.GDALGetDriver.argtypes, gdal.GDALGetDriver.restype = [ctypes.c_int], ctypes.c_void_p
    gdal.GDALGetDescription.argtypes, gdal.GDALGetDescription.restype = [ctypes.c_void_p], ctypes.c_char_p
    gdal.GDALDeregisterDriver.argtypes = [ctypes.c_void_p]
    for driver in [gdal.GDALGetDriver(k) for k in range(gdal.GDALGetDriverCount())]:
        if gdal.GDALGetDescription(driver) not in _DRIVERS:
            gdal.GDALDeregisterDriver(driver)
    left = {gdal.GDALGetDescription(gdal.GDALGetDriver(k)) for k in range(gdal.GDALGetDriverCount())}
    if not left <= _DRIVERS:
        raise RuntimeError(f"GDAL has further drivers: {sorted(left - _DRIVERS)}")
    pyogrio.set_gdal_config_options(_SETTINGS)
    return pyogrio


def read_layers(
    data: bytes, driver: Driver, limits: Limits, *, encoding: str | None = None, **options: str
) -> tuple[list[VectorLayer], list[str]]:
    """Read all layers; also return GDAL's warnings.

    encoding: of a DXF's texts; None: as its header says. options: GDAL's open options of the driver.

    Raises UnreadableFile with GDAL's reason, or TooLarge.
    """
    pyogrio = _pyogrio()
    pyogrio.set_gdal_config_options({"DXF_ENCODING": encoding})
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            info = pyogrio.read_info(data, layer=0, **options)
            if info["driver"] != driver:
                _raise_unreadable(f"not a file of GDAL's driver {driver}")
            if driver in _COUNTED and info["features"] > len(data):
                _raise_unreadable(f"its header states {info['features']} features, more than the file has bytes")
            names = [str(name) for name, _ in pyogrio.list_layers(data)]
            if len(names) > MAX_LAYERS:
                raise TooLarge(f"the file has {len(names)} layers; the limit is {MAX_LAYERS}")
            layers = list(_read(pyogrio, data, names, limits, options))
        except _errors(pyogrio) as error:
            _raise_unreadable(_shorten(str(error)))
    return layers, list(dict.fromkeys(_shorten(str(w.message)) for w in caught))[:MAX_REPORTED]


def _errors(pyogrio: Any) -> tuple[type[Exception], ...]:
    """Return what pyogrio raises for damaged files: its own errors, and NameError for a CRS that is no text."""
    names = ("DataSourceError", "DataLayerError", "CRSError", "FeatureError", "FieldError", "GeometryError")
    classes = [getattr(pyogrio.errors, name) for name in names]
    return (*classes, ValueError, TypeError, LookupError, ArithmeticError, OSError, NameError)


def _raise_unreadable(reason: str) -> Any:
    raise UnreadableFile(reason, [Problem(reason)])


def _shorten(text: str) -> str:
    """Return GDAL's message without the names of files in memory."""
    words = [
        word
        for word in text.split("; It might help", maxsplit=1)[0].split()
        if "vsimem" not in word and "vsizip" not in word
    ]
    return " ".join(words)[:200] or "GDAL cannot read it"


def _read(
    pyogrio: Any, data: bytes, names: Sequence[str], limits: Limits, options: Mapping[str, str]
) -> Iterator[VectorLayer]:
    left = limits.features
    for name in names:
        # Counted first: pyogrio allocates memory for as many features as it may read.
        left -= pyogrio.read_info(data, layer=name, force_feature_count=True, **options)["features"]
        if left < 0:
            raise TooLarge(f"the file has more than {limits.features} features: split it")
        meta, _, geometry, values = pyogrio.raw.read(data, layer=name, datetime_as_string=True, **options)
        count = len(geometry) if geometry is not None else len(values[0]) if values else 0
        columns = {
            str(field): _plain_values(column, kind, subtype)
            for field, column, kind, subtype in zip(
                meta["fields"], values, meta["ogr_types"], meta["ogr_subtypes"], strict=True
            )
        }
        shapes = [None] * count if geometry is None else geometry.tolist()
        yield VectorLayer(name, columns, shapes, meta["crs"])


def _plain_values(column: NDArray[Any], kind: str, subtype: str) -> list[Any]:
    """Return Python's values: None for an absent one, and integers and truth values even in columns with such ones."""
    values: list[Any] = column.tolist()
    if kind == "OFTBinary":
        return [None] * len(values)
    if column.dtype.kind == "f" and kind in ("OFTInteger", "OFTInteger64"):
        number = bool if subtype == "OFSTBoolean" else int
        return [None if value != value else number(value) for value in values]  # noqa: PLR0124  NaN
    return [value.tolist() if isinstance(value, np.ndarray) else value for value in values]


def write_layer(
    driver: Driver,
    name: str,
    columns: Mapping[str, tuple[type, Sequence[Any]]],
    geometry: NDArray[np.object_],
    crs: str,
) -> bytes:
    """Write one layer of any geometries (WKB). columns: type and values, None for an absent one. crs: code or WKT."""
    pyogrio = _pyogrio()
    arrays, masks = [], []
    for kind, values in columns.values():
        absent = np.array([value is None for value in values], bool)
        if kind is str:
            arrays.append(np.array(values, object))
        else:
            arrays.append(np.array([kind() if value is None else value for value in values], kind))
        masks.append(absent)
    out = io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        pyogrio.raw.write(
            out, geometry, arrays, list(columns), masks, layer=name, driver=driver, geometry_type="Unknown", crs=crs
        )  # fmt: skip
    return out.getvalue()
