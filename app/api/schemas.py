"""The edge's shapes: what bodies and parameters may be, what answers look like, and examples that work.

The examples fit each other: a test runs every one of them against a server that holds the demo.
"""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Annotated, Any, Literal

from fastapi import Header, Path, Query
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, field_validator

from app.api.http.problems import MEDIA_TYPE
from app.model.closures import ClosureMode
from app.model.frame import MAX_DATUM_LATITUDE

NAME = r"^[a-z0-9][a-z0-9_-]{0,62}$"
CHANNEL = r"^[a-z][a-z0-9_-]{0,62}$"

VERSION = r"^([0-9]{1,18}|[a-z][a-z0-9_-]{0,62})$"

MAX_TEXT = 20_000
RESERVED = frozenset({"robots", "server"})


class RequestModel(BaseModel):
    """A request body: unknown members and numbers that are not finite are refused."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)


def _representable(moment: datetime) -> datetime:
    """Times near the years 1 and 9999 leave the calendar in another zone, UTC for instance."""
    try:
        moment.astimezone(UTC)
    except OverflowError:
        raise ValueError("this time is outside the calendar: give one between the years 2 and 9998") from None
    return moment


ApiTime = Annotated[datetime, AfterValidator(_representable)]


class DatumBody(RequestModel):
    """Where the local frame's origin is (WGS 84), and where its +y axis points."""

    latitude: float = Field(ge=-MAX_DATUM_LATITUDE, le=MAX_DATUM_LATITUDE, description="Degrees north.")
    longitude: float = Field(ge=-180, le=180, description="Degrees east.")
    altitude: float = Field(0.0, ge=-12_000, le=100_000, description="Metres above the ellipsoid.")
    heading: float = Field(0.0, ge=-360, le=360, description="Degrees clockwise from true north to the local +y axis.")


class CloneBody(RequestModel):
    """Whose content a new environment starts with."""

    environment: str = Field(examples=["orchard"])
    version: int | str = Field("latest", description="Number, channel or `latest`.", examples=["latest"])


class EnvironmentBody(RequestModel):
    """A new environment."""

    model_config = ConfigDict(
        extra="forbid",
        allow_inf_nan=False,
        json_schema_extra={
            "examples": [
                {
                    "name": "orchard-2",
                    "title": "Orchard behind the barn",
                    "datum": {"latitude": 53.2686, "longitude": -0.5245},
                    "tags": ["apple"],
                }
            ]
        },
    )

    name: str = Field(pattern=NAME, description="Lower case letters, digits, `_` and `-`; not `robots` or `server`.")
    title: str = Field("", max_length=200)
    description: str = Field("", max_length=MAX_TEXT)
    datum: DatumBody | None = Field(None, description="Gives version 1; without it the environment starts empty.")
    tags: list[Annotated[str, Field(min_length=1, max_length=100)]] = Field(default_factory=list, max_length=100)
    clone: CloneBody | None = Field(None, description="Start with the content of another one (gives version 1).")


class EnvironmentPatch(RequestModel):
    """What is to change; what is left out stays."""

    model_config = ConfigDict(
        extra="forbid",
        allow_inf_nan=False,
        json_schema_extra={"examples": [{"title": "The farm by the river", "tags": ["wheat"]}]},
    )

    name: str | None = Field(None, pattern=NAME, description="A new name; the old one is free at once.")
    title: str | None = Field(None, max_length=200)
    description: str | None = Field(None, max_length=MAX_TEXT)
    tags: list[Annotated[str, Field(min_length=1, max_length=100)]] | None = Field(None, max_length=100)
    datum: DatumBody | None = Field(
        None,
        description="Makes a version: local items keep their metres, wgs84 items their place on earth, and the answer "
        "warns.",
    )


class RevertBody(RequestModel):
    """A new version with the content of an old one."""

    revert_to: int = Field(ge=0, description="The old version's number.")
    message: str = Field("", max_length=MAX_TEXT)


class PutChange(RequestModel):
    """Add or replace one feature, by id.

    A feature may be put back as `GET …/layers/{layer}` shows it: what was not edited stays exactly as it is stored. A
    feature that is there already keeps its anchor (local metres, or a place on earth), whatever `crs` its new place is
    told in; delete it and put it again to anchor it otherwise. A fence's `properties.datum` sets the environment's
    datum. Edges that end at a node which is moved move along.
    """

    op: Literal["put"]
    layer: Literal["location", "objects", "topology", "zones"]
    feature: dict[str, Any] = Field(
        description="GeoJSON Feature with an `id` (a text); `place` instead of `geometry` is local metres. An edge "
        "without geometry runs straight."
    )
    level: str | None = Field(None, max_length=256)
    name: str | None = Field(None, max_length=256, description="The part's name, where a layer has several.")
    crs: Literal["local", "wgs84"] | None = Field(
        None, description="What `geometry` is in; default: wgs84 where there is a datum."
    )


class DeleteChange(RequestModel):
    """Remove one feature, by id."""

    op: Literal["delete"]
    layer: Literal["location", "objects", "topology", "zones"]
    id: str = Field(min_length=1, max_length=512)
    level: str | None = Field(None, max_length=256)
    name: str | None = Field(None, max_length=256)


class CellsChange(RequestModel):
    """Set the cells of a grid whose centres lie in a polygon."""

    op: Literal["cells"]
    grid: str | None = Field(None, max_length=256, description="Default: `map`, else the only grid.")
    level: str | None = Field(None, max_length=256)
    polygon: dict[str, Any] = Field(description="GeoJSON Polygon or MultiPolygon.")
    crs: Literal["local", "wgs84"] | None = Field(
        None, description="What the polygon is in; default: wgs84 where there is a datum."
    )
    value: int = Field(ge=0, le=255, description="0 free … 100 occupied, 255 unknown.")


Change = Annotated[PutChange | DeleteChange | CellsChange, Field(discriminator="op")]


class EditsBody(RequestModel):
    """Changes that make one version together, or none."""

    model_config = ConfigDict(
        extra="forbid",
        allow_inf_nan=False,
        json_schema_extra={
            "examples": [
                {
                    "message": "a charging dock by the gate",
                    "changes": [
                        {
                            "op": "put",
                            "layer": "topology",
                            "feature": {
                                "type": "Feature",
                                "id": "dock",
                                "geometry": {"type": "Point", "coordinates": [5.6133, 52.4206]},
                                "properties": {"kind": "node", "name": "dock"},
                            },
                        },
                        {
                            "op": "put",
                            "layer": "topology",
                            "feature": {
                                "type": "Feature",
                                "id": "Gate_dock",
                                "geometry": None,
                                "properties": {"kind": "edge", "source": "Gate", "target": "dock"},
                            },
                        },
                    ],
                }
            ]
        },
    )

    message: str = Field("", max_length=MAX_TEXT)
    changes: list[Change] = Field(min_length=1, max_length=100_000)


class DerivationBody(RequestModel):
    """A layer to be computed from others."""

    model_config = ConfigDict(
        extra="forbid",
        allow_inf_nan=False,
        json_schema_extra={
            "examples": [{"method": "objects_to_topology", "parameters": {"join": 0.5}, "replace": True}]
        },
    )

    method: str = Field(max_length=200, description="A derivation's name; see `/api/v1/derivations`.")
    parameters: dict[str, Any] = Field(
        default_factory=dict, description="Of the method, and of the derivations that have to come before it."
    )
    message: str = Field("", max_length=MAX_TEXT)
    replace: bool = Field(False, description="Whether what a source has told, or people have edited, gives way.")


class GenerationBody(RequestModel):
    """A site to be made up."""

    model_config = ConfigDict(
        extra="forbid",
        allow_inf_nan=False,
        json_schema_extra={
            "examples": [{"generator": "orchard", "seed": 7, "parameters": {"rows": 6}, "replace": True}]
        },
    )

    generator: str = Field(max_length=200, description="A generator's name; see `/api/v1/generators`.")
    seed: int = Field(0, ge=0, le=2**63 - 1, description="The same seed and parameters give the same site again.")
    parameters: dict[str, Any] = Field(default_factory=dict, description="Of the generator.")
    message: str = Field("", max_length=MAX_TEXT)
    replace: bool = Field(False, description="Whether what a source has told, or people have edited, gives way.")


class FormatTemplatesBody(RequestModel):
    """What is filled in where the format asks for more than the layers have."""

    model_config = ConfigDict(
        extra="forbid",
        allow_inf_nan=False,
        json_schema_extra={"examples": [{"values": {"action": "NavigateToPose", "xy_goal_tolerance": 0.4}}]},
    )

    set: str | None = Field(None, max_length=100, description="Another set than the environment's; see `/templates`.")
    values: dict[str, Any] = Field(
        default_factory=dict, max_length=100, description="By parameter of the format, as `/formats` lists them."
    )
    message: str = Field("", max_length=MAX_TEXT)
    dry_run: bool = Field(False, description="Only say what would be.")


class OwnTemplatesBody(RequestModel):
    """One format's templates among others."""

    set: str | None = Field(None, max_length=100)
    values: dict[str, Any] = Field(default_factory=dict, max_length=100)


class TemplatesBody(RequestModel):
    """The set of an environment, and values for several formats at once."""

    model_config = ConfigDict(
        extra="forbid",
        allow_inf_nan=False,
        json_schema_extra={
            "examples": [{"set": "outdoor", "formats": {"tmap2": {"values": {"xy_goal_tolerance": 0.4}}}}]
        },
    )

    set: str | None = Field(None, max_length=100, description="A set's name; left out: it stays.")
    formats: dict[str, OwnTemplatesBody] = Field(
        default_factory=dict, max_length=100, description="What is said of these, instead of all that was."
    )
    message: str = Field("", max_length=MAX_TEXT)
    dry_run: bool = Field(False, description="Only say what would be.")


class RolloutBody(RequestModel):
    """A move in two stages. At least one of ``ready`` and ``failed``."""

    ready: float | None = Field(
        None, gt=0, le=1, description="The channel moves when this share of its online robots has the version."
    )
    failed: float | None = Field(
        None, gt=0, le=1, description="It does not move, or moves back, when this share of its robots reports `failed`."
    )
    deadline: ApiTime | None = Field(None, description="RFC 3339 time with zone: without enough robots it stays then.")
    window: float = Field(600.0, ge=1, le=604_800, description="Seconds for which robots are watched after the move.")


class OntoBody(RequestModel):
    """The map that a grid is laid onto."""

    layer: Literal["occupancy", "objects", "voxels"] = Field(
        "occupancy", description="A stored grid, or a layer that a grid is derived from."
    )
    level: str = Field("ground", max_length=256)
    name: str = Field("map", max_length=256, description="Of a stored grid.")
    parameters: dict[str, Any] = Field(
        default_factory=dict, description="Of the derivation, where there is one: `height`, `world` …"
    )


Place = tuple[float, float]


class AlignmentBody(RequestModel):
    """A stored grid that does not lie where it should, and what says where that is: another map, or pairs of points."""

    model_config = ConfigDict(
        extra="forbid",
        allow_inf_nan=False,
        json_schema_extra={
            "examples": [{"pairs": [[[0, 0], [1, 2]], [[10, 0], [11, 2]]], "dry_run": True}],
        },
    )

    grid: str = Field("map", max_length=256, description="The name of the grid that is moved.")
    level: str = Field("ground", max_length=256)
    onto: OntoBody | None = Field(None, description="The map that it shall lie on.")
    pairs: list[tuple[Place, Place]] | None = Field(
        None,
        min_length=2,
        max_length=1000,
        description="Points [[x, y], [x, y]]: where it is, and where it should be, m.",
    )
    angle: float = Field(180.0, ge=0, le=180, description="The largest turn that is tried, degrees.")
    reach: float | None = Field(None, ge=0, le=1e7, description="The farthest that the grid's middle may go, m.")
    near: float | None = Field(
        None, gt=0, le=1000, description="What agrees: cells this near to each other (0.1 m), or points (0.5 m)."
    )
    least: float = Field(0.5, ge=0, le=1, description="The share that has to agree.")
    dry_run: bool = Field(False, description="Only tell what was found.")
    message: str = Field("", max_length=MAX_TEXT)


class ChannelBody(RequestModel):
    """Where a channel is to stand, and since when."""

    model_config = ConfigDict(
        extra="forbid",
        allow_inf_nan=False,
        json_schema_extra={"examples": [{"version": 1}, {"version": 1, "rollout": {"ready": 0.9, "failed": 0.2}}]},
    )

    version: int | str = Field(description="Number, channel or `latest`; kept as the number.")
    activate_at: ApiTime | None = Field(
        None, description="RFC 3339 time with zone at which the channel moves; left out: now."
    )
    rollout: RolloutBody | None = Field(None, description="Let robots fetch it first, and watch them afterwards.")

    @field_validator("version", mode="before")
    @classmethod
    def _no_truth(cls, value: Any) -> Any:
        """To JSON ``true`` is no number."""
        if isinstance(value, bool):
            raise ValueError("a version is a number or a channel's name")
        return value


class StatusHoldsBody(RequestModel):
    """A version that a robot has loaded."""

    version: int = Field(ge=0, lt=2**63)
    root: str = Field(pattern=r"^[0-9a-f]{64}$", description="Root hash of the version; 64 zeros: no map is loaded.")


class StatusBody(RequestModel):
    """What a robot says of itself."""

    model_config = ConfigDict(
        extra="forbid",
        allow_inf_nan=False,
        json_schema_extra={
            "examples": [
                {"environment": "orchard", "channel": "latest", "version": 1, "root": "0" * 64, "state": "active"}
            ]
        },
    )

    environment: str = Field(pattern=NAME)
    channel: str = Field(pattern=CHANNEL, description="The channel that it follows.")
    version: int = Field(ge=0, lt=2**63)
    root: str = Field(pattern=r"^[0-9a-f]{64}$", description="Of the version, as the manifest says it.")
    state: Literal["downloading", "ready", "active", "failed"] = Field(
        description="`ready`: it has the version and does not drive on it yet; `active`: it does."
    )
    detail: str | None = Field(None, max_length=2000)
    time: ApiTime | None = Field(None, description="RFC 3339 time with zone, by the robot's clock.")
    sequence: int | None = Field(None, ge=0, lt=2**63, description="Of the last event that it has processed.")
    overlays: str | None = Field(
        None, pattern=r"^[0-9a-f]{64}$", description="Digest of the closures in the map that it has loaded."
    )
    holds: StatusHoldsBody | None = Field(
        None, description="The loaded map, if the status is about another version. Default: the last `active` one."
    )


class OverlayBody(RequestModel):
    """What is blocked: a polygon or an edge."""

    model_config = ConfigDict(
        extra="forbid",
        allow_inf_nan=False,
        json_schema_extra={
            "examples": [
                {
                    "kind": "blocked",
                    "polygon": {
                        "type": "Polygon",
                        "coordinates": [[[5.6133, 52.4206], [5.6134, 52.4206], [5.6134, 52.4207], [5.6133, 52.4206]]],
                    },
                    "crs": "wgs84",
                    "ttl_seconds": 1800,
                    "detail": "a fallen tree",
                }
            ]
        },
    )

    kind: Literal["blocked"]
    polygon: dict[str, Any] | None = Field(None, description="GeoJSON Polygon or MultiPolygon.")
    edge: str | None = Field(None, min_length=1, max_length=512, description="An edge's id: one direction of a lane.")
    crs: Literal["local", "wgs84"] | None = Field(
        None, description="What the polygon is in; default: wgs84 where there is a datum."
    )
    level: str | None = Field(None, min_length=1, max_length=256, description="Of the polygon; default: `ground`.")
    ttl_seconds: float | None = Field(
        None,
        ge=1,
        le=2_592_000,
        description="How long it is blocked from now on; default: 3600 unless `expires` is given.",
    )
    expires: ApiTime | None = Field(None, description="End, instead of `ttl_seconds`: RFC 3339 time with zone.")
    state: Literal["pending", "accepted"] = Field(
        "pending", description="`accepted` (editors only): in force at once, on every channel."
    )
    detail: str | None = Field(None, max_length=2000)


class LinkBody(RequestModel):
    """The map, or one file of it, that a signed link gives."""

    model_config = ConfigDict(
        extra="forbid",
        allow_inf_nan=False,
        json_schema_extra={"examples": [{"format": "geojson", "file": "map.geojson", "seconds": 3600}]},
    )

    format: str = Field(max_length=64, description="A format's id.")
    file: str | None = Field(
        None, min_length=1, max_length=1000, description="One file of the map; left out: the file itself or a zip."
    )
    parameters: dict[str, str | int | float | bool] = Field(
        default_factory=dict, max_length=50, description="Parameters of the map, as in its address."
    )
    seconds: int | None = Field(
        None, ge=1, description="Life of the link. Default and maximum: the setting `FLEETMAP_LINK_SECONDS`."
    )


class TokenBody(RequestModel):
    """A new token."""

    model_config = ConfigDict(
        extra="forbid",
        allow_inf_nan=False,
        json_schema_extra={
            "examples": [{"name": "mower-3", "role": "robot", "environments": "farm*", "robot": "mower-3"}]
        },
    )

    name: str = Field(min_length=1, max_length=200, description="Who it is for; it stands as author in the history.")
    role: Literal["viewer", "robot", "editor", "admin"]
    environments: str | None = Field(
        None, min_length=1, max_length=200, description="Name pattern (`farm-*`) of the environments it reaches."
    )
    robot: str | None = Field(
        None,
        min_length=1,
        max_length=200,
        description="Role `robot`: the robot whose status it may set. Default: `name`.",
    )
    expires: ApiTime | None = Field(None, description="RFC 3339 time with zone; left out: never.")


# --- answers ---


class DatumOut(BaseModel):
    """The local origin."""

    latitude: float
    longitude: float
    altitude: float
    heading: float


class MatchOut(BaseModel):
    """Why an environment is an answer to a position."""

    by: Literal["fence", "floor", "datum"] = Field(
        description="`fence`: inside the GNSS fence; `floor`: on mapped floor; `datum`: within 200 m of the datum."
    )
    area_m2: float = Field(description="Area of the fence, floor or neighbourhood in square metres.")
    distance_m: float | None = Field(description="Metres from the position to the datum, null if there is none.")


class EnvironmentOut(BaseModel):
    """An environment as it is now. ``bounds``: west, south, east, north."""

    name: str
    title: str
    description: str
    tags: list[str]
    version: int
    root: str
    datum: DatumOut | None
    bounds: list[float] | None
    created: datetime
    updated: datetime
    deleted: datetime | None = None
    match: MatchOut | None = Field(default=None, description="Only in the answer to `contains`.")


class ProblemItem(BaseModel):
    """One thing that is wrong or doubtful, and where."""

    problem: str
    file: str | None = None
    line: int | None = None
    where: str | None = None
    level: Literal["error", "warning"] | None = Field(
        default=None,
        description="Of a finding about a served map: error where its consumer would refuse it, else warning.",
    )


class ProblemOut(BaseModel):
    """RFC 9457."""

    type: str
    title: str
    status: int
    detail: str
    errors: list[ProblemItem] | None = None


class SourceOut(BaseModel):
    """An uploaded file. ``used``: whether the version was made from it."""

    name: str
    size: int
    sha256: str
    format: str | None
    used: bool


class VersionOut(BaseModel):
    """An immutable state. A dry run has ``version: null``."""

    environment: str
    version: int | None
    root: str
    parent: int | None
    author: str
    message: str
    time: datetime | None
    changes: dict[str, Any]
    sources: list[SourceOut]
    warnings: list[ProblemItem]
    information: dict[str, str]
    stale: list[dict[str, Any]] = Field(
        description="Derived parts whose inputs have changed since, with what has: maps are made from them anew."
    )


class AlignmentOut(BaseModel):
    """A motion p -> R(yaw) p + (x, y) in metres and radians, how well it fits, and the version in which it was made."""

    alignment: dict[str, Any] | None = Field(
        description="`x`, `y`, `yaw`, `residual` (m), `agreement` and `overlap` (shares), `origin` and `before`."
    )
    version: VersionOut | None
    warnings: list[ProblemItem]


class LayerOut(BaseModel):
    """One part of a version's content."""

    layer: str
    level: str
    name: str
    count: int
    hash: str
    bounds: dict[str, list[float] | None]
    information: str
    format: str | None = None
    sources: list[str]
    attribution: list[str]


class CoverageOut(BaseModel):
    """Whether a format can be had, by which steps, and else what to supply."""

    format: str
    state: Literal["direct", "derivable", "missing"]
    chain: list[dict[str, Any]]
    missing: list[str]
    choose: str | None = Field(None, description="What the query has to name, where there are several of a kind.")


class ReportOut(BaseModel):
    """What a map is made of and what was lost on the way."""

    format: str
    version: int
    layers: list[dict[str, Any]]
    attribution: list[str] = Field(description="Licences and credits of the sources, to be shown with the map.")
    template: list[dict[str, Any]] = Field(
        description="What was filled in: `what`, `value`, `why`, where a parameter says it `option`, and `from`: "
        "`request`, `environment`, `set NAME` or `default`."
    )
    dropped: list[dict[str, Any]]
    warnings: list[ProblemItem]
    closures: list[dict[str, Any]] = Field(
        description="Each closure in force with its `effect` on this map, and the `edges` that it closes."
    )


class TemplateSetOut(BaseModel):
    """A named set of values, by format and parameter."""

    name: str
    title: str
    formats: dict[str, dict[str, Any]]


class FormatTemplateOut(BaseModel):
    """One format's templates. ``set``: where it is another than the environment's. ``ignored``: what was kept once and
    this release cannot use."""

    format: str
    set: str | None
    values: dict[str, Any]
    effective: dict[str, dict[str, Any]]
    ignored: list[str] | None = None


class FormatTemplatesOut(FormatTemplateOut):
    """A format's templates in a version of an environment."""

    environment: str
    version: int


class TemplatesOut(BaseModel):
    """A version's templates."""

    environment: str
    version: int
    set: str
    sets: list[str]
    formats: list[FormatTemplateOut]


class ChannelRobotsOut(BaseModel):
    """A channel's robots. ``since``: since when all hold its root and closures; null while any does not."""

    total: int
    online: int
    holding: int
    lagging: int
    failed: int
    ready: int = Field(description="Those that have the planned version and count in its roll-out (`vouched`).")
    since: datetime | None


class RolloutOut(BaseModel):
    """The last roll-out of a channel. ``before``: the version that it moves back to; ``detail``: why it stands so."""

    version: int
    root: str
    started: datetime
    ready: float | None
    failed: float | None
    activate_at: datetime | None
    deadline: datetime | None
    window: float
    state: Literal["waiting", "watching", "done", "expired", "failed", "rolled_back", "cancelled"]
    before: int | None
    moved: datetime | None
    detail: str


class OverlaysOut(BaseModel):
    """The closures in force."""

    count: int
    digest: str = Field(description="Robots with equal roots and equal digests hold the same map.")
    sequence: int = Field(description="Of the last event that changed them; 0: none did.")


class ChannelOut(BaseModel):
    """A movable name for a version."""

    channel: str
    version: int | None
    root: str | None
    sequence: int
    overlays: OverlaysOut | None = Field(
        None, description="The closures in force, the same on all channels. Left out with `robots=false`."
    )
    author: str
    time: datetime
    planned: dict[str, Any] | None = None
    rollout: RolloutOut | None = None
    robots: ChannelRobotsOut | None = Field(None, description="Left out with `robots=false`.")


class LagOut(BaseModel):
    """How far a robot is behind its channel: events not acted on, whether its root differs, since when."""

    events: int
    differs: bool
    since: datetime | None


class HoldsOut(BaseModel):
    """What a robot drives on, and since when it said so (the server's clock)."""

    version: int
    root: str
    overlays: str | None = Field(None, description="Digest of the closures in it.")
    since: datetime


class RobotOut(BaseModel):
    """A robot in an environment. ``time``: by its clock, where it told one; ``received`` and ``since`` (when it first
    said the same) by the server's. ``lag`` is null where its channel stands nowhere.
    """

    robot: str
    environment: str
    channel: str
    version: int
    root: str
    state: Literal["downloading", "ready", "active", "failed"]
    detail: str | None = None
    sequence: int | None = None
    overlays: str | None = None
    time: datetime
    received: datetime
    since: datetime
    holds: HoldsOut | None
    online: bool
    vouched: bool = Field(
        description="Whether a report came with authority (by a token that may report for it, or over a router with "
        "users). Other robots do not count in roll-outs."
    )
    lag: LagOut | None


class RobotDetailOut(RobotOut):
    """A robot with its past."""

    environments: list[str]
    history: list[dict[str, Any]]


class TransformOut(BaseModel):
    """One place in both frames."""

    latlon: list[float]
    xy: list[float]
    datum: DatumOut


class FormatOut(BaseModel):
    """A file format; ``options`` are the parameters of its maps (and of reading it, with ``for: read``)."""

    id: str
    title: str
    files: list[str]
    media_types: list[str]
    read: bool
    write: bool
    options: list[dict[str, Any]]
    information: dict[str, str]


class DerivationOut(BaseModel):
    """A way to compute a layer from others."""

    id: str
    title: str
    gives: str
    needs: list[str]
    cost: float
    version: int
    parameters: list[dict[str, Any]]


class GeneratorOut(BaseModel):
    """A way to make up a site."""

    id: str
    title: str
    gives: list[str]
    needs: list[str] = Field(description="Layers that it works on.")
    changes: list[str] = Field(
        description="Layers that it works on where they are there, one at least. With neither it makes a whole site."
    )
    version: int
    parameters: list[dict[str, Any]]


class ProvenanceOut(BaseModel):
    """Which file made which layer, and which map is made of them; ``links`` lead from id to id."""

    environment: str
    version: int
    sources: list[dict[str, Any]]
    parts: list[dict[str, Any]]
    maps: list[dict[str, Any]]
    links: list[dict[str, str]]


class KeyOut(BaseModel):
    """A public key; bytes in base64."""

    id: str
    algorithm: Literal["Ed25519"]
    public_key: str
    created: datetime
    endorsed_by: str | None = None
    endorsement: str | None = None


class ManifestFile(BaseModel):
    """One file of a map."""

    format: str
    name: str = Field(description="With the folder of its level, if that is not the default one: `L2/map.yaml`.")
    size: int
    sha256: str
    level: str | None = Field(None, description="Of a file that belongs to one level.")


class ManifestLevel(BaseModel):
    """A storey."""

    name: str
    elevation: float = Field(description="Metres above the local origin.")


class ManifestMissing(BaseModel):
    """An optional format that cannot be given."""

    format: str
    detail: str = Field(description="Why, and what to supply.")


class ManifestOut(BaseModel):
    """What a robot verifies; its signature is in a header."""

    environment: str
    channel: str | None = None
    epoch: int = Field(
        0,
        description="Order is by epoch, then sequence. The operator raises it after a restore; left out at 0.",
    )
    sequence: int
    version: int
    root: str
    time: datetime = Field(description="When it was signed, in steps of ten minutes.")
    expires: datetime
    levels: list[ManifestLevel] = Field(description="From the lowest up.")
    files: list[ManifestFile]
    missing: list[ManifestMissing] = Field([], description="Optional formats that cannot be given; left out if none.")
    overlays: list[dict[str, Any]] = Field(
        [], description="The closures in force that its files show, by id; left out if there are none."
    )
    closures: Literal["mark", "ignore"] | None = Field(
        None, description="How its files show the closures in force; left out for `apply`."
    )
    parameters: dict[str, dict[str, str]] = Field(
        {}, description="The parameters that each format was requested with; left out if there are none."
    )
    overlays_digest: str = Field(description="SHA-256 of that list; `Fleetmap-Overlays` of each file.")
    layers: dict[str, str] = Field(description="A hash of each layer: equal where the layer is, in any two versions.")
    variables: dict[str, str] | None = Field(
        None, description="What the place is called: literal variables of an environment_template's scripts."
    )


class JobOut(BaseModel):
    """Work that takes long."""

    id: str
    state: Literal["queued", "running", "done", "failed", "cancelled"]
    progress: float
    detail: str
    result: dict[str, Any] | None = None
    problem: ProblemOut | None = None
    created: datetime
    updated: datetime


class TokenOut(BaseModel):
    """A token without its secret."""

    id: str
    name: str
    role: str
    environments: str | None
    robot: str | None
    expires: datetime | None
    created: datetime
    ended: datetime | None = Field(description="When it was seen to have expired; it stays expired.")


class AuditTokenOut(BaseModel):
    """The token that made a change, as it was called then."""

    id: str
    name: str
    role: str


class AuditOut(BaseModel):
    """One change. request: the `X-Request-Id` of its answer, which the server's log has, too. target: what was made,
    where the path does not name it."""

    id: int
    time: datetime
    token: AuditTokenOut
    address: str
    request: str
    method: str
    path: str
    environment: str | None
    target: str | None


class NewTokenOut(TokenOut):
    """A new token with its secret, which is told only now."""

    token: str


class LinkOut(BaseModel):
    """A signed link, and the file that it gives."""

    url: str = Field(description="Needs no token until it expires. Whoever has it can read this map.")
    expires: datetime
    version: int
    root: str
    name: str = Field(description="Of the file.")
    size: int = Field(description="Bytes.")
    sha256: str


class DiffOut(BaseModel):
    """What differs between two versions."""

    model_config = ConfigDict(populate_by_name=True)

    from_: int = Field(alias="from")
    to: int
    layers: dict[str, Any]


class OverlayOut(BaseModel):
    """What was reported as blocked, and what became of it."""

    id: str
    environment: str
    kind: Literal["blocked"]
    state: Literal["pending", "accepted", "rejected", "expired", "ended"]
    level: str
    reporter: str
    created: datetime
    expires: datetime
    polygon: dict[str, Any] | None = None
    edge: str | None = None
    crs: Literal["local", "wgs84"] | None = None
    detail: str | None = None
    decided_by: str | None = None
    decided: datetime | None = None
    version: int | None = Field(None, description="The version that made it permanent.")


class DynamicEdgesOut(BaseModel):
    """A request of `nav2_msgs/srv/DynamicEdges`."""

    closed_edges: list[int]
    opened_edges: list[int]


class LaneRequestOut(BaseModel):
    """A message of `rmf_fleet_msgs/msg/LaneRequest`."""

    fleet_name: str
    open_lanes: list[int]
    close_lanes: list[int]


class GraphLanesOut(BaseModel):
    """What to publish for one navigation graph."""

    graph: str = Field(description="The graph's file, `0.yaml` …")
    message: LaneRequestOut


class LaneRequestsOut(BaseModel):
    """One message for each navigation graph."""

    requests: list[GraphLanesOut]


class ZoneSetsOut(BaseModel):
    """Closures in the words of VDA 5050 3.0."""

    model_config = ConfigDict(populate_by_name=True)

    zone_sets: list[dict[str, Any]] = Field(alias="zoneSets")
    closed_edges: list[dict[str, Any]] = Field(alias="closedEdges")


class FloorActionsOut(BaseModel):
    """Instant actions of VDA 5050 for one floor of a version."""

    model_config = ConfigDict(populate_by_name=True)

    map_id: str = Field(alias="mapId")
    map_version: str = Field(alias="mapVersion")
    level: str | None = Field(description="Null where no level was named.")
    size: int = Field(description="Bytes behind the link.")
    expires: datetime | None = Field(description="End of the link; null where it needs a token.")
    download_map: dict[str, Any] = Field(alias="downloadMap")
    enable_map: dict[str, Any] = Field(alias="enableMap")
    delete_map: dict[str, Any] = Field(alias="deleteMap")


class MissingLevelOut(BaseModel):
    """A level without such a map, and why."""

    level: str
    detail: str


class ActionsOut(FloorActionsOut):
    """Instant actions of VDA 5050 for one version: of its first floor, and in ``maps`` of each."""

    environment: str
    version: int
    root: str
    maps: list[FloorActionsOut]
    missing: list[MissingLevelOut] = Field(description="With `level=*`: levels that have no such map.")


class StateOut(BaseModel):
    """What became of a vehicle's state."""

    robots: list[RobotOut]
    ignored: list[dict[str, str]]


class DeltaOut(BaseModel):
    """What turns one version into another."""

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


# --- parameters ---

EnvironmentPath = Annotated[
    str, Path(pattern=NAME, description="An environment's name.", examples=["orchard"], max_length=63)
]
VersionPath = Annotated[
    str,
    Path(
        pattern=VERSION,
        description="Number, channel, or `latest`.",
        examples=["latest"],
    ),
]
ChannelPath = Annotated[str, Path(pattern=CHANNEL, description="A channel's name.", examples=["production"])]
RobotPath = Annotated[
    str,
    Path(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,127}$", description="A robot's name.", examples=["mower-3"]),
]
FormatPath = Annotated[
    str, Path(max_length=64, description="A format's id; see `GET /api/v1/formats`.", examples=["geojson"])
]
JobPath = Annotated[str, Path(max_length=100, description="A job's id.")]
OverlayPath = Annotated[str, Path(max_length=100, description="An overlay's id.")]
TokenPath = Annotated[str, Path(max_length=100, description="A token's id.")]
ClosuresQuery = Annotated[
    ClosureMode | None,
    Query(
        description="How maps show the closures in force: `apply` (closed edges are left out of formats that "
        "cannot express a blocked edge), `mark` or `ignore`. Default: `apply`, but `ignore` for a version's number."
    ),
]
LayerPath = Annotated[
    Literal["location", "objects", "topology", "occupancy", "voxels", "imagery", "zones"],
    Path(description="A layer.", examples=["topology"]),
]
Limit = Annotated[int, Query(ge=1, le=1000, description="Items on a page.")]
Cursor = Annotated[
    str | None, Query(max_length=500, description="Where the page starts: taken from the last page's `Link` header.")
]
IfMatch = Annotated[
    str | None,
    Header(
        alias="If-Match",
        max_length=2000,
        description='The version that the change builds on, as `"3"`, `"<root>"` or `*`; 412 where the head has moved.',
    ),
]
IdempotencyKey = Annotated[
    str | None,
    Header(
        alias="Idempotency-Key",
        max_length=255,
        description="A text of your choice; the same request sent again with it gets the same answer, and never makes "
        "a second version.",
    ),
]


def problem_responses(
    model: Any, *statuses: int, ok: int = 200, description: str = "OK"
) -> dict[int | str, dict[str, Any]]:
    """OpenAPI's responses: the good one by its shape, and which problems this call can meet besides the usual ones."""
    reasons = {
        400: "The body is malformed.",
        404: "There is no such thing.",
        406: "None of the accepted media types can be served.",
        409: "It does not fit the present state, or several things fit and none was named.",
        412: "The head has moved.",
        413: "Larger than the server takes.",
        415: "A media type or content coding that is not taken.",
        416: "The range lies outside of the file.",
        422: "The request, a file, or what is stored does not allow it; `errors` says where.",
        503: "Too busy, or a part of the server does not answer: try again after `Retry-After` seconds.",
    }
    out: dict[int | str, dict[str, Any]] = {}
    if model is not None:
        out[ok] = {"model": model, "description": description}
    problem = {MEDIA_TYPE: {"schema": {"$ref": "#/components/schemas/Problem"}}}
    for status in statuses:
        out[status] = {"description": reasons[status], "content": problem}
    return out
