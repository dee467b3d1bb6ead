"""las, laz: values computed by hand, laspy reads written files, CRS and datum, wrong headers are rejected before
anything is allocated."""

from __future__ import annotations

import io
import random
import struct
import tracemalloc
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest
from pyproj import CRS, Transformer

from app import formats
from app.convert.files import offline
from app.errors import BadUpload, TooLarge, UnreadableFile
from app.formats import FileGroup, ReadContext, get_format
from app.limits import Limits
from app.model.frame import Datum
from app.model.geodesy import local_frame
from app.model.layers import Layers, PartKey
from app.model.voxels import VoxelMap
from app.upload_reader import EnvironmentContext, UploadHints
from app.upload_reader import read as read_bundle
from tests.formats import clouds

FORMAT = get_format("las")
SAMPLES = Path(__file__).resolve().parents[1] / "samples"
FIELD = (SAMPLES / "las" / "field.las").read_bytes()
SPIRAL = (SAMPLES / "las" / "spiral.laz").read_bytes()
POINTS = struct.unpack_from("<I", SPIRAL, 96)[0]
"""Where they start: with the offset of the table of chunks."""


def read(data: bytes, options: dict[str, str] | None = None, **more: Any) -> tuple[VoxelMap, ReadContext, Layers]:
    context = ReadContext(options=formats.read_options(FORMAT, options or {}), **more)
    layers = formats.read(FileGroup(FORMAT, "map.las", {"map.las": data}), context)
    voxels = layers.parts[PartKey("voxels")]
    assert isinstance(voxels, VoxelMap)
    return voxels, context, layers


def written(files: dict[str, bytes], to: str = "las", **options: str) -> bytes:
    (out,) = offline(files, to, options=options).files.values()
    return out


def points(data: bytes) -> Any:
    return laspy.read(io.BytesIO(data))


def test_points_are_placed_by_crs_of_file() -> None:
    """UTM 30N, near Sheffield: the datum is the south-west corner, and PROJ's own transverse Mercator the truth."""
    voxels, context, layers = read(FIELD, {"resolution": "0.01"})
    earth = Transformer.from_crs("EPSG:32630", "EPSG:4326", always_xy=True)
    lon, lat = earth.transform([700000, 700010, 700010], [5900000, 5900000, 5900020])
    assert layers.datum is not None
    assert (layers.datum.latitude, layers.datum.longitude) == (
        np.floor(min(lat) * 1e7) / 1e7,
        np.floor(min(lon) * 1e7) / 1e7,
    )
    pipe = f"+proj=tmerc +lat_0={layers.datum.latitude} +lon_0={layers.datum.longitude} +k=1 +ellps=WGS84"
    x, y = Transformer.from_crs("EPSG:4326", pipe, always_xy=True).transform(lon, lat)
    want = {tuple(int(np.floor(round(v / 0.01, 4))) for v in p) for p in zip(x, y, (50.0, 51.0, 52.5), strict=True)}
    cells = set(zip(*(voxels.axis(k)[0].tolist() for k in range(3)), strict=True))
    assert cells == want
    assert any("no datum" in w.problem for w in context.warnings)


def test_points_are_placed_by_environment_datum() -> None:
    frame = local_frame(Datum(53.21, -0.005, heading=30.0))
    voxels, _, layers = read(FIELD, frame=frame)
    assert layers.datum is None, "the environment keeps its own"
    lon, lat = Transformer.from_crs("EPSG:32630", "EPSG:4326", always_xy=True).transform(700010, 5900020)
    (x, y), *_ = frame.to_local(np.array([[lon, lat]]))
    assert abs(x) < 1500
    assert (np.floor(x / 0.05), np.floor(y / 0.05), 1050) in set(
        zip(*(voxels.axis(k)[0].tolist() for k in range(3)), strict=True)
    )


def test_points_are_local_when_requested_or_crs_is_unknown() -> None:
    voxels, context, layers = read(FIELD, {"crs": "local", "origin": "700000,5900000,50"})
    assert layers.datum is None
    assert voxels.bounds() == (0.0, 0.0, 0.0, 10.05, 20.05, 2.55)
    unknown = FIELD.replace(struct.pack("<H", 32630), struct.pack("<H", 32599))
    _, context, layers = read(unknown)
    assert layers.datum is None
    assert any("unknown CRS" in w.problem for w in context.warnings)
    assert any("used as the local origin" in w.problem for w in context.warnings)


def test_wkt_referring_to_files_is_ignored() -> None:
    header = laspy.LasHeader(version="1.4", point_format=6)
    wkt = 'GEOGCS["x",DATUM["y",SPHEROID["z",6378137,298.25]],EXTENSION["PROJ4","+proj=longlat +nadgrids=/etc/passwd"]]'
    header.vlrs.append(laspy.vlrs.known.WktCoordinateSystemVlr(wkt))
    las = laspy.LasData(header)
    las.x, las.y, las.z = np.array([1.0]), np.array([2.0]), np.array([3.0])
    out = io.BytesIO()
    las.write(out)
    _, context, layers = read(out.getvalue())
    assert layers.datum is None
    assert any("refers to files" in w.problem for w in context.warnings)


def test_wkt_of_las_1_4_with_heights_in_feet_is_applied() -> None:
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.offsets, header.scales = np.array([700000.0, 5900000.0, 0.0]), np.full(3, 0.001)
    las = laspy.LasData(header)
    las.x, las.y, las.z = np.array([700000.5]), np.array([5900000.5]), np.array([100.0])
    las.header.add_crs(CRS("EPSG:32630+6360"))  # NAVD88 height in US survey feet
    out = io.BytesIO()
    las.write(out)
    voxels, _, layers = read(out.getvalue())
    assert layers.datum is not None
    assert voxels.axis(2)[0].tolist() == [int(100 * 1200 / 3937 / 0.05)]


FOOT = 1200 / 3937


def feet(*keys: tuple[int, int]) -> bytes:
    """Return two points of a survey in US feet in New York, with GeoTIFF keys (id, code)."""
    header = laspy.LasHeader(version="1.2", point_format=1)
    header.offsets, header.scales = np.array([982000.0, 200000.0, 0.0]), np.full(3, 0.01)
    packed = b"".join(struct.pack("<4H", key, 0, 1, code) for key, code in keys)
    header.vlrs.append(laspy.VLR("LASF_Projection", 34735, "", struct.pack("<4H", 1, 1, 0, len(keys)) + packed))
    las = laspy.LasData(header)
    las.x, las.y, las.z = np.array([[982000.0, 200000.0, 100.0], [982010.0, 200010.0, 110.0]]).T
    out = io.BytesIO()
    las.write(out)
    return out.getvalue()


def heights(data: bytes) -> tuple[list[float], list[str]]:
    """Return the heights of the voxels' lower sides in metres, and what was reported of the CRS."""
    voxels, context, _ = read(data, {"resolution": "0.01"})
    found = sorted((voxels.axis(2)[0] * voxels.resolution).tolist())
    return found, [w.problem for w in context.warnings if w.where == "crs"]


@pytest.mark.parametrize(
    ("keys", "unit", "warning"),
    [
        (((3072, 2263), (4096, 6360)), FOOT, None),  # NAVD88 in US survey feet
        (((3072, 2263), (4096, 5703)), 1.0, None),  # NAVD88 in metres
        (((3072, 2263), (4099, 9003)), FOOT, None),
        (((3072, 2263), (4099, 9002)), 0.3048, None),
        (((3072, 2263), (4099, 9001)), 1.0, None),
        (((3072, 2263), (4096, 32767), (4099, 9003)), FOOT, None),  # user-defined
        (((3072, 32118), (4099, 9003)), FOOT, None),  # New York in metres
        (
            ((3072, 2263),),
            FOOT,
            "the file names no unit of heights: they are read in that of EPSG:2263, 0.3048006096 m",
        ),
        (((3072, 32118),), 1.0, None),
    ],
)
def test_heights_in_feet_become_metres(keys: tuple[tuple[int, int], ...], unit: float, warning: str | None) -> None:
    found, warnings = heights(feet(*keys))
    assert found == pytest.approx([100 * unit, 110 * unit], abs=0.011)
    assert [w.partition(";")[0] for w in warnings] == ([] if warning is None else [warning])


def test_feet_of_a_user_defined_projection_become_local_metres() -> None:
    data = feet((3072, 32767), (3076, 9003))
    voxels, context, layers = read(data, {"resolution": "0.01"})
    assert layers.datum is None
    low, high = np.array(voxels.bounds()).reshape(2, 3)
    assert (high - low).tolist() == pytest.approx([10 * FOOT] * 3, abs=0.021)
    assert low[2] == pytest.approx(100 * FOOT, abs=0.011)
    assert any("units of 0.3048006096 m (x, y)" in w.problem for w in context.warnings)
    local = points(written({"a.las": data}, frame="local"))
    assert np.ptp(np.asarray(local.x)) == pytest.approx(10 * FOOT, abs=0.002)
    assert np.asarray(local.z).tolist() == pytest.approx([100 * FOOT, 110 * FOOT], abs=0.002)
    assert written({"a.las": data}) == data
    plain, _, _ = read(data, {"resolution": "0.01", "crs": "local"})
    assert plain.bounds()[2] == 100.0, "local metres, ignoring the file"


def test_file_round_trips_and_both_encodings_hold_same_points() -> None:
    assert written({"a.las": FIELD}) == FIELD
    assert written({"a.laz": SPIRAL}) == SPIRAL
    for data, kind in ((FIELD, "laz"), (SPIRAL, "las")):
        other = written({f"a.{'las' if kind == 'laz' else 'laz'}": data}, kind=kind)
        a, b = points(data), points(other)
        assert b.header.are_points_compressed == (kind == "laz")
        assert np.array_equal(a.points.array, b.points.array)
        assert list(a.header.scales) == list(b.header.scales)
        assert list(a.header.offsets) == list(b.header.offsets)
        assert a.header.creation_date == b.header.creation_date
        assert [v.record_data_bytes() for v in a.vlrs] == [v.record_data_bytes() for v in b.vlrs]
        assert written({f"a.{kind}": other}, kind=kind) == other
    assert set(offline({"a.las": FIELD}, "las", options={"kind": "laz"}).files) == {"map.laz"}


def test_dimensions_of_real_las_reach_other_formats() -> None:
    header, rows = clouds.pcd(written({"a.las": FIELD}, "pcd", frame="source"))
    fields = header["FIELDS"].split()
    assert fields[:4] == ["x", "y", "z", "intensity"]
    assert {"return_number", "classification", "gps_time", "user_data", "point_source_id", "scan_angle_rank"} <= {
        *fields
    }
    row = dict(zip(fields, rows[2], strict=True))
    assert (row["x"], row["y"], row["z"]) == (700010.0, 5900020.0, 52.5)
    assert (row["intensity"], row["gps_time"], row["classification"]) == (65535, 3.5, 2)
    assert (row["scan_angle_rank"], row["user_data"], row["point_source_id"]) == (-3, 5, 9)


def test_local_coordinates_in_other_formats_match_voxels() -> None:
    voxels, _, _ = read(FIELD)
    _, rows = clouds.ply(written({"a.las": FIELD}, "ply"))
    cells = {tuple(int(np.floor(v / 0.05)) for v in row[:3]) for row in rows}
    assert cells == set(zip(*(voxels.axis(k)[0].tolist() for k in range(3)), strict=True))


def test_other_cloud_formats_convert_to_las() -> None:
    shelf = (SAMPLES / "pcd" / "shelf.pcd").read_bytes()
    converted = offline({"shelf.pcd": shelf}, "las")
    las = points(converted.files["map.las"])
    assert ("points", 1) in [(d["what"], d["count"]) for d in converted.report.as_dict()["dropped"]], "the NaN"
    assert str(las.header.version) == "1.4"
    assert las.point_format.id == 7
    assert list(las.header.scales) == [0.001] * 3
    truth = [p for p in clouds.pcd(shelf)[1] if p[0] == p[0]]
    assert np.allclose(np.stack([las.x, las.y, las.z], 1), [p[:3] for p in truth], atol=0.0005)
    assert las.red.tolist() == [(p[3] >> 16) * 257 for p in truth]
    assert las["label"].tolist() == [p[4] for p in truth]
    assert las["feature_1"].tolist() == [p[6] for p in truth]
    assert converted.files["map.las"][90:94] == bytes(4), "no date, so the same bytes tomorrow"
    intensity = points(written({"i.pcd": (SAMPLES / "pcd" / "intensity.pcd").read_bytes()}))
    assert intensity.point_format.id == 6
    assert intensity.intensity.tolist() == [0, 10, 20, 30], "whole numbers are LAS's own intensity"


def test_voxels_round_trip_via_las() -> None:
    shed = (SAMPLES / "octomap" / "shed.bt").read_bytes()
    las = points(written({"shed.bt": shed}))
    res = float(shed.partition(b"\nres ")[2].split()[0])
    voxels, _, _ = read(written({"shed.bt": shed}), {"resolution": repr(res)})
    assert voxels.voxel_counts()["occupied"] == len(las.points) > 0
    assert written({"shed.bt": shed}, kind="laz") == written({"shed.bt": shed}, kind="laz")


def corrupt(data: bytes, at: int, form: str, value: int) -> bytes:
    size = struct.calcsize(form)
    return data[:at] + struct.pack(form, value) + data[at + size :]


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (FIELD[:200], "within the header"),
        (corrupt(FIELD, 25, "<B", 9), "1.0 to 1.4"),
        (corrupt(FIELD, 96, "<I", 2**31), "contradict"),
        (corrupt(FIELD, 94, "<H", 10), "contradict"),
        (corrupt(FIELD, 100, "<I", 2**32 - 1), "do not fit before"),
        (corrupt(FIELD, 107, "<I", 2**32 - 1), "limit"),
        (corrupt(FIELD, 107, "<I", 4), "but the file has"),
        (corrupt(FIELD, 104, "<B", 11), "unknown point format"),
        (corrupt(FIELD, 131, "<Q", 0x7FF0000000000000), "finite"),
        (corrupt(SPIRAL, 247, "<Q", 2**63), "limit"),
        (corrupt(SPIRAL, 243, "<I", 2**32 - 1), "do not fit after"),
        (corrupt(SPIRAL, POINTS, "<q", 5), "chunk table"),
        (corrupt(SPIRAL, struct.unpack_from("<q", SPIRAL, POINTS)[0] + 4, "<I", 2**31), "more chunks"),
        (corrupt(SPIRAL, 375 + 54 + 32, "<H", 60000), "ends too early"),
        (corrupt(SPIRAL, 375 + 54 + 36, "<H", 29), "LASzip record declares"),
    ],
)  # fmt: skip
def test_wrong_headers_are_rejected_before_allocation(data: bytes, message: str) -> None:
    tracemalloc.start()
    try:
        with pytest.raises((UnreadableFile, TooLarge), match=message) as caught:
            read(data)
        assert tracemalloc.get_traced_memory()[1] < 2**20
    finally:
        tracemalloc.stop()
    assert caught.value.problems[0].file == "map.las"


def test_limits_are_enforced() -> None:
    with pytest.raises(TooLarge, match="limit is 2"):
        read(FIELD, limits=Limits(voxels=2))
    with pytest.raises(TooLarge, match="more than the limit of"):
        read(SPIRAL, limits=Limits(unpacked_bytes=100))


def test_damaged_compressed_points_are_rejected_or_read(capfd: pytest.CaptureFixture[str]) -> None:
    """Includes panics of lazrs: the message goes to stderr, the exception is UnreadableFile."""
    dice = random.Random(7)
    refused = 0
    for _ in range(400):
        data = bytearray(SPIRAL)
        for _ in range(dice.choice([1, 1, 3, 9])):
            data[dice.randrange(len(data))] ^= 1 << dice.randrange(8)
        cut = bytes(data[: dice.choice([len(data), len(data), dice.randrange(len(data))])])
        try:
            read_bundle({"a.laz": cut}, UploadHints("las"), EnvironmentContext(), Limits())
        except BadUpload as error:
            refused += 1
            assert error.problems[0].file == "a.laz"
    assert refused > 100
    assert "Traceback" not in capfd.readouterr().err
