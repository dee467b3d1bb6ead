"""Members of LIF files, and their names in each version."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from app.formats._fields import ANGLE, COORDINATE, NOT_NEGATIVE, SPEED, Number, OneOf, record
from app.formats._network import CROSS_PART_PROPERTIES
from app.syntax import json

NAME = "lif"
VERSION = "1.0.0"
EPOCH = "1970-01-01T00:00:00.00Z"
"""Default time if the source has none: the same network must give the same bytes."""

ORDER = json.rank_keys(
    "metaInformation projectIdentification lifId creator exportTimestamp lifVersion origins originId layoutId "
    "layoutName layoutVersion layoutLevelId layoutDescription layouts nodes edges stations nodeId nodeName "
    "nodeDescription mapId nodePosition edgeId edgeName edgeDescription startNodeId endNodeId stationId "
    "interactionNodeIds stationName stationDescription stationHeight stationPosition x y theta weight "
    "vehicleTypeNodeProperties vehicleTypeEdgeProperties vehicleTypeId actionType actionDescription "
    "requirementType blockingType actionParameters key value degree knotVector controlPoints"
)
"""Order of the keys, as in the specification."""

LISTS = frozenset({"nodes", "edges", "stations"})
_ACTION = record(
    "actionType actionDescription actionParameters",
    requirementType=OneOf(("REQUIRED", "CONDITIONAL", "OPTIONAL")),
    blockingType=OneOf(("NONE", "SOFT", "HARD")),
)
_TRAJECTORY = record(
    degree=Number(1.0, 1000.0),
    knotVector=[Number(0.0, 1e6)],
    controlPoints=[record(x=COORDINATE, y=COORDINATE, weight=Number(0.0, 1e9, above=True))],
)
_NODE = record(
    "nodeId nodeName nodeDescription mapId",
    nodePosition=record(x=COORDINATE, y=COORDINATE),
    vehicleTypeNodeProperties=[record("vehicleTypeId", theta=Number(-1e4, 1e4), actions=[_ACTION])],
)
_EDGE = record(
    "edgeId edgeName edgeDescription startNodeId endNodeId",
    vehicleTypeEdgeProperties=[
        record(
            "vehicleTypeId rotationAllowed rotationAtStartNodeAllowed rotationAtEndNodeAllowed loadRestriction "
            "reentryAllowed",
            vehicleOrientation=Number(-1e4, 1e4, usual=(-360.0, 360.0), hint="it is beyond a full turn"),
            orientationType=OneOf(("GLOBAL", "TANGENTIAL")),
            maxSpeed=SPEED,
            maxRotationSpeed=Number(0.0, 1000.0, unit="rad/s"),
            minHeight=COORDINATE,
            maxHeight=COORDINATE,
            trajectory=_TRAJECTORY,
            actions=[_ACTION],
        )
    ],
)
_STATION = record(
    "stationId stationName stationDescription interactionNodeIds",
    stationHeight=NOT_NEGATIVE,
    stationPosition=record(x=COORDINATE, y=COORDINATE, theta=ANGLE),
)
SHAPE = record(
    metaInformation=record("projectIdentification creator exportTimestamp lifVersion"),
    layouts=[
        record(
            "layoutId layoutName layoutVersion layoutLevelId layoutDescription",
            nodes=[_NODE],
            edges=[_EDGE],
            stations=[_STATION],
        )
    ],
)
"""Schema of a file of version 1. Source: VDMA LIF 1.0.0, section 8."""

CANONICAL_NODE = frozenset({"kind", "name", "orientation", NAME}) | CROSS_PART_PROPERTIES
CANONICAL_EDGE = frozenset({"kind", "name", "source", "target", "speed_limit", NAME}) | CROSS_PART_PROPERTIES
CANONICAL_STATION = frozenset({"kind", "name", NAME}) | CROSS_PART_PROPERTIES


@dataclass(frozen=True, slots=True)
class Dialect:
    """Member names of a version of the format: entries by vehicle type, and the type in them."""

    node: str
    edge: str
    type: str

    def vehicle_type_member(self, name: str) -> dict[str, Any]:
        """Return the member that names a vehicle type."""
        if self.type == "mobileRobotTypes":
            return {self.type: [{"manufacturer": name, "seriesName": name}]}
        return {self.type: name}


LIF_1 = Dialect("vehicleTypeNodeProperties", "vehicleTypeEdgeProperties", "vehicleTypeId")
LIF_2 = Dialect("mobileRobotTypeNodeProperties", "mobileRobotTypeEdgeProperties", "mobileRobotTypeId")
LIF_3 = Dialect(LIF_2.node, LIF_2.edge, "mobileRobotTypes")
