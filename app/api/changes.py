"""Semantic differences between two versions, for robots that patch their live maps."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from typing import Annotated, Any, Literal

import numpy as np
import orjson
from fastapi import Query, Request
from numpy.typing import NDArray
from pydantic import BaseModel
from starlette.responses import Response

from app.api.http.auth import Viewer
from app.api.http.caching import none_match
from app.api.http.dependencies import Services, ServicesDep
from app.api.http.features import Crs
from app.api.http.parameters import parse_version_ref
from app.api.http.responses import api_router, json_bytes, json_response
from app.api.http.schemas import VERSION, EnvironmentPath, VersionPath, problem_responses
from app.api.http.vector_layers import feature_collection
from app.errors import MissingDatum
from app.model.features import Features
from app.model.frame import Anchor
from app.model.geodesy import local_frame
from app.model.grid import OCCUPIED, OccupancyGrid
from app.model.layers import VECTOR_LAYERS, PartKey
from app.store.values import ChangedCells, Delta, FeatureDelta, GridDelta, Version

MAX_CELLS = 4 * 2**20
"""Maximum number of changed cells in a delta; beyond it, fetching the whole grid is cheaper than reading JSON."""


class DeltaOut(BaseModel):
    """Changes that turn one version into another."""

    environment: str
    since: dict[str, Any]
    version: int
    root: str
    crs: Literal["local", "wgs84"]
    datum: dict[str, Any]
    levels: dict[str, Any]
    layers: dict[str, Any]
    grids: list[dict[str, Any]]
    other: list[dict[str, str]]


router = api_router("versions", "/environments/{env}/versions/{v}")


@router.get(
    "/delta",
    responses={
        **problem_responses(DeltaOut, 404, 422),
        304: {"description": "Not modified: the client has this delta"},
    },
    summary="Get the changes since a version",
)
def get_delta(
    env: EnvironmentPath,
    v: VersionPath,
    request: Request,
    services: ServicesDep,
    _: Viewer,
    since: Annotated[
        str, Query(pattern=VERSION, description="The client's version: number, channel, or `latest`.", examples=["0"])
    ],
    crs: Crs = None,
) -> Response:
    """Return the changes that turn the version `since` into `v`. `v` may be the older one.

    - `layers`: for each vector layer, the features to put (GeoJSON, as in `/layers/{layer}`) and those to delete. A
      feature is identified by id, `level` and `part`. If the datum changed, all features are put, because unedited
      ones move too.
    - `grids`: rectangles of changed cells, each as a `map_msgs/OccupancyGridUpdate`: `x`, `y`, `width`, `height` in
      cells of the grid, row 0 at the bottom, `data` row by row, 0…100 and -1 for unknown. If `whole` is true, the
      grid's frame changed (or most of a large grid did): fetch the grid.
    - `other`: parts without a delta: fetch the maps that use them.
    """
    new, old = (
        services.store.versions.get_committed(env, parse_version_ref(v)),
        services.store.versions.get_committed(env, parse_version_ref(since)),
    )
    anchor: Anchor = crs or ("wgs84" if new.datum else "local")
    seed = json_bytes(["delta", old.root, new.root, old.number, new.number, anchor, env])
    headers = {
        "etag": f'"{hashlib.sha256(seed).hexdigest()[:32]}"',
        "fleetmap-version": str(new.number),
        "fleetmap-root": new.root,
    }
    if none_match(request.headers.get("if-none-match"), headers["etag"]):
        return Response(status_code=304, headers=headers)
    delta = services.store.content.delta_parts(old, new)
    body = {
        "environment": env,
        "since": {"version": old.number, "root": old.root},
        "version": new.number,
        "root": new.root,
        "crs": anchor,
        "datum": {"changed": delta.datum, "value": new.datum.as_dict() if new.datum else None},
        "levels": {"changed": delta.levels, "value": [[level.name, level.elevation] for level in new.levels]},
        "layers": _layers(services, new, delta, anchor),
        "grids": [_grid(services, new, change) for change in delta.grids],
        "other": [_part_names(key) for key in delta.other],
    }
    return json_response(body, headers=headers)


def _layers(services: Services, new: Version, delta: Delta, crs: Anchor) -> dict[str, Any]:
    changes = list(delta.features)
    if delta.datum:
        changes = _all_features(services, new, changes)
    frame = local_frame(new.datum) if new.datum else None
    puts: dict[str, list[tuple[PartKey, Features]]] = {}
    deleted: dict[str, list[dict[str, str]]] = {}
    for change in changes:
        layer = change.key.layer
        if frame is None and len(change.put) and bool((change.put.local != (crs == "local")).any()):
            raise MissingDatum(
                f"{new.environment} has no datum in version {new.number}, so local metres cannot be converted "
                "to WGS 84: request the other crs, or set a datum"
            )
        puts.setdefault(layer, []).append((change.key, change.put))
        removed_items = [{"id": item, "level": change.key.level, "part": change.key.name} for item in change.deleted]
        deleted.setdefault(layer, []).extend(removed_items)
    return {
        layer: {
            "put": orjson.Fragment(feature_collection(parts, crs, frame, new, with_datum=False)),
            "deleted": deleted[layer],
        }
        for layer, parts in sorted(puts.items())
    }


def _all_features(services: Services, new: Version, changes: Sequence[FeatureDelta]) -> list[FeatureDelta]:
    """Put all features: with another datum each of them may have moved in the requested frame."""
    out = {change.key: change for change in changes}
    for entry in new.parts:
        if entry.key.layer in VECTOR_LAYERS:
            delta = out.get(entry.key)
            deleted = delta.deleted if delta is not None else ()
            out[entry.key] = FeatureDelta(entry.key, services.store.content.features(new, entry.key), deleted)
    return [out[key] for key in sorted(out)]


def _grid(services: Services, new: Version, change: GridDelta) -> dict[str, Any]:
    out: dict[str, Any] = {"name": change.key.name, "level": change.key.level, "deleted": change.deleted}
    complete = change.whole or sum(r.cells.size for r in change.rectangles) > MAX_CELLS
    out |= {"whole": complete, "frame": None, "updates": []}
    if change.deleted:
        return out
    part = services.store.content.load(new, [change.key]).parts[change.key]
    assert isinstance(part, OccupancyGrid)
    out["frame"] = {
        "width": part.width,
        "height": part.height,
        "resolution": part.resolution,
        "origin": list(part.origin),
    }
    if not complete:
        out["updates"] = [_update(rectangle) for rectangle in change.rectangles]
    return out


def _update(rectangle: ChangedCells) -> dict[str, Any]:
    height, width = rectangle.cells.shape
    cells: NDArray[np.int8] = np.where(rectangle.cells > OCCUPIED, -1, rectangle.cells).astype(np.int8).ravel()
    data = orjson.Fragment(orjson.dumps(np.ascontiguousarray(cells), option=orjson.OPT_SERIALIZE_NUMPY))
    return {"x": rectangle.column, "y": rectangle.row, "width": width, "height": height, "data": data}


def _part_names(key: PartKey) -> dict[str, str]:
    return {"layer": key.layer, "level": key.level, "name": key.name}
