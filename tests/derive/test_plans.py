"""Floor plans drawn with known walls: tinted rooms, icons, text, legends, furniture; and pictures that are no plan."""

from __future__ import annotations

import itertools
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from app import upload_reader
from app.derive import DerivationNotes
from app.derive.imagery_to_objects import Parameters as ObjectParameters
from app.derive.imagery_to_objects import imagery_to_objects
from app.derive.imagery_to_occupancy import Parameters, imagery_to_occupancy
from app.errors import BadUpload, CannotConvert, FleetMapError
from app.limits import Limits
from app.model.features import Features
from app.model.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from app.model.imagery import GeoImage
from app.model.layers import Layers, PartKey
from app.upload_reader import EnvironmentContext, UploadHints

SIZE = 0.05
SHAPE = (360, 480)
TINTS = ((225, 205, 245), (205, 225, 250), (255, 228, 208), (240, 236, 252), (215, 216, 223))


def layers(pixels: NDArray[np.uint8], size: float = SIZE) -> Layers:
    picture = GeoImage(pixels, (size, 0.0, 0.0, 0.0, -size, len(pixels) * size))
    return Layers({PartKey("imagery", "ground", "plan"): picture})


def values(pixels: NDArray[np.uint8], notes: DerivationNotes | None = None, **options: Any) -> NDArray[np.uint8]:
    """Return the grid as an image, row 0 on top; a cell is a pixel."""
    derived = imagery_to_occupancy(layers(pixels), Parameters(**options), notes or DerivationNotes())
    (grid,) = derived.parts.values()
    assert isinstance(grid, OccupancyGrid)
    return np.asarray(grid.cells[::-1])


class Plan:
    """A drawn plan: its pixels, its walls (bool [h, w]), and the middles of its rooms."""

    def __init__(
        self, seed: int, background: tuple[int, int, int], wall: int, ink: tuple[int, int, int] | None
    ) -> None:
        """wall: thickness in pixels. ink: colour of the walls; None: a darker shade of each room's tint."""
        self.rng = np.random.default_rng(seed)
        self.pixels = np.full((*SHAPE, 3), background, np.uint8)
        self.walls = np.zeros(SHAPE, np.uint8)
        self.clutter = np.zeros(SHAPE, np.uint8)
        self.rooms: list[tuple[int, int, int, int]] = []
        xs = [60, 60 + int(self.rng.integers(90, 130)), 60 + int(self.rng.integers(190, 240)), 420]
        middle = int(self.rng.integers(150, 190))
        for x0, x1 in itertools.pairwise(xs):
            for y0, y1 in ((50, middle), (middle, 300)):
                self.rooms.append((x0, y0, x1, y1))
        for k, (x0, y0, x1, y1) in enumerate(self.rooms):
            tint = TINTS[(k + seed) % len(TINTS)]
            cv2.rectangle(self.pixels, (x0, y0), (x1, y1), tint, -1)
        for k, (x0, y0, x1, y1) in enumerate(self.rooms):
            colour = ink or tuple(int(0.75 * c) for c in TINTS[(k + seed) % len(TINTS)])
            cv2.rectangle(self.pixels, (x0, y0), (x1, y1), colour, wall)
            cv2.rectangle(self.walls, (x0, y0), (x1, y1), 1, wall)

    def furnish(self) -> None:
        """Draw an icon, a label and a table in every room, and a legend and a title outside."""
        for x0, y0, x1, y1 in self.rooms:
            x, y = x0 + int(self.rng.integers(32, x1 - x0 - 32)), y0 + int(self.rng.integers(28, y1 - y0 - 50))
            cv2.circle(self.pixels, (x, y), 12, (110, 90, 70), 2, cv2.LINE_AA)
            cv2.circle(self.pixels, (x, y), 5, (110, 90, 70), -1, cv2.LINE_AA)
            cv2.circle(self.clutter, (x, y), 15, 1, -1)
            cv2.putText(self.pixels, "n12", (x - 12, y + 30), cv2.FONT_HERSHEY_PLAIN, 0.9, (60, 60, 60), 1, cv2.LINE_AA)
            cv2.rectangle(self.clutter, (x - 16, y + 16), (x + 24, y + 34), 1, -1)
        for k, tint in enumerate(TINTS):
            cv2.rectangle(self.pixels, (20 + 60 * k, 325), (32 + 60 * k, 337), tint, -1)
            cv2.putText(self.pixels, "shop", (36 + 60 * k, 336), cv2.FONT_HERSHEY_PLAIN, 0.7, (0, 0, 0), 1)
        cv2.putText(self.pixels, "TERMINAL", (30, 30), cv2.FONT_HERSHEY_SIMPLEX, 0.8, (90, 60, 120), 2)


PLANS = {
    "thin outlines of tints on white": (1, (255, 255, 255), 1, None),
    "thin outlines of tints on cream": (2, (252, 246, 230), 2, None),
    "black walls, tinted rooms": (3, (255, 255, 255), 4, (20, 20, 20)),
    "grey walls, tinted rooms, blue paper": (4, (214, 230, 246), 4, (90, 95, 100)),
}


@pytest.mark.parametrize("name", PLANS)
def test_coloured_plan_gives_walls_and_tinted_floor(name: str) -> None:
    plan = Plan(*PLANS[name])
    plan.furnish()
    value = values(plan.pixels)
    near = cv2.dilate(plan.walls, np.ones((5, 5), np.uint8)) == 1
    occupied = value == OCCUPIED
    assert (cv2.dilate(occupied.astype(np.uint8), np.ones((5, 5), np.uint8)) == 1)[plan.walls == 1].mean() >= 0.95
    assert near[occupied].mean() >= 0.95, "icons, text and legend are no walls"
    inside = np.zeros(SHAPE, bool)
    for x0, y0, x1, y1 in plan.rooms:
        inside[y0 + 5 : y1 - 4, x0 + 5 : x1 - 4] = True
    assert (value[inside & (plan.clutter == 0)] == FREE).mean() >= 0.98, "tinted rooms are floor"
    beyond = np.ones(SHAPE, bool)
    beyond[45:306, 55:426] = False
    assert (value == FREE)[beyond].mean() <= 0.01, "the ground outside, the legend and the title are unknown"


def test_symbols_are_unknown_and_reported() -> None:
    plan = Plan(*PLANS["black walls, tinted rooms"])
    x0, y0, x1, y1 = plan.rooms[0]
    x, y = (x0 + x1) // 2, (y0 + y1) // 2
    cv2.circle(plan.pixels, (x, y), 14, (40, 40, 40), 1)
    notes = DerivationNotes()
    value = values(plan.pixels, notes)
    assert set(value[y - 5 : y + 5, x - 5 : x + 5].ravel().tolist()) == {UNKNOWN}, "a table, or an icon: who knows"
    assert value[y, x0 + 10] == FREE
    assert [(d.subject, d.count) for d in notes.dropped] == [("symbols", 1)]


def test_thin_lines_beside_thick_walls_are_no_walls_but_windows_are() -> None:
    pixels = np.full((240, 300, 3), 255, np.uint8)
    cv2.rectangle(pixels, (40, 40), (260, 200), (0, 0, 0), 8)
    cv2.rectangle(pixels, (120, 34), (170, 46), (255, 255, 255), -1)
    cv2.line(pixels, (118, 40), (172, 40), (0, 0, 0), 1)  # a window of 2.5 m, wider than gap
    cv2.ellipse(pixels, (45, 150), (24, 24), 0, -90, 0, (0, 0, 0), 1)  # the swing of a door
    cv2.line(pixels, (45, 126), (45, 150), (0, 0, 0), 1)
    value = values(pixels)
    assert value[40, 145] == OCCUPIED, "the window"
    assert (value[130:136, 58:66] == UNKNOWN).any(), "the swing"
    assert not (value[130:136, 58:66] == OCCUPIED).any()
    assert value[100, 200] == FREE
    assert value[15, 15] == UNKNOWN


def drawn_in_two_lines() -> NDArray[np.uint8]:
    """Return a plan of two rooms of 7 and 6 m: walls are two lines 0.2 m apart."""
    pixels = np.full((240, 340, 3), 255, np.uint8)
    for wall in range(2):
        side = 4 * wall
        cv2.rectangle(pixels, (30 + side, 30 + side), (304 - side, 204 - side), (0, 0, 0), 1)
        cv2.line(pixels, (170 + side, 34), (170 + side, 200), (0, 0, 0), 1)
    return pixels


def test_furniture_that_touches_walls_of_two_lines_is_unknown() -> None:
    pixels = drawn_in_two_lines()
    cv2.rectangle(pixels, (60, 34), (92, 50), (0, 0, 0), 1)  # a desk at the wall
    cv2.circle(pixels, (76, 56), 6, (0, 0, 0), 1)  # its chair
    cv2.putText(pixels, "desk", (60, 72), cv2.FONT_HERSHEY_PLAIN, 0.9, (0, 0, 0), 1)
    cv2.line(pixels, (76, 62), (76, 66), (0, 0, 0), 1)  # so that the label touches it
    cv2.line(pixels, (34, 120), (114, 120), (0, 0, 0), 1)  # a partition of 4 m
    cv2.rectangle(pixels, (230, 120), (237, 127), (0, 0, 0), -1)  # a pillar
    cv2.ellipse(pixels, (174, 150), (24, 24), 0, 0, 90, (0, 0, 0), 1)  # the swing of a door
    value = values(pixels)
    occupied = value == OCCUPIED
    assert not occupied[38:80, 40:160].any()
    assert (value[44, 60], value[56, 82]) == (UNKNOWN, UNKNOWN), "the desk and the chair"
    assert not occupied[140:180, 184:200].any(), "the swing"
    assert value[120, 80] == OCCUPIED, "the partition"
    assert value[123, 233] == OCCUPIED, "the pillar"
    for row, column in ((30, 100), (34, 200), (100, 30), (100, 304), (100, 170), (204, 250)):
        assert value[row, column] == OCCUPIED, "the walls"
    assert value[100, 100] == value[180, 250] == FREE


def test_short_walls_of_a_single_line_stay_walls_if_all_walls_are_so() -> None:
    pixels = np.full((240, 300, 3), 255, np.uint8)
    cv2.rectangle(pixels, (20, 20), (280, 220), (0, 0, 0), 1)
    cv2.line(pixels, (60, 20), (60, 56), (0, 0, 0), 1)
    cv2.line(pixels, (20, 56), (60, 56), (0, 0, 0), 1)
    value = values(pixels)
    assert value[40, 60] == value[56, 40] == OCCUPIED
    assert value[40, 40] == FREE


@pytest.mark.parametrize("turn", [0, 7, 20, 45, 78])
def test_walls_of_two_lines_are_found_in_any_direction(turn: int) -> None:
    matrix = cv2.getRotationMatrix2D((170, 120), turn, 1)
    matrix[:, 2] += (60, 110)
    pixels = cv2.warpAffine(drawn_in_two_lines(), matrix, (460, 460), borderValue=(255, 255, 255))
    truth = cv2.warpAffine(drawn_in_two_lines(), matrix, (460, 460), borderValue=(255, 255, 255))[..., 0] < 128
    assert (values(np.asarray(pixels, np.uint8)) == OCCUPIED)[truth].mean() >= 0.9


def test_pillars_stay_walls() -> None:
    pixels = np.full((240, 300, 3), 255, np.uint8)
    cv2.rectangle(pixels, (20, 20), (280, 220), (0, 0, 0), 5)
    cv2.rectangle(pixels, (100, 100), (109, 109), (0, 0, 0), -1)
    assert values(pixels)[104, 104] == OCCUPIED


def test_marked_routes_are_no_walls() -> None:
    pixels = np.full((240, 300, 3), 255, np.uint8)
    cv2.rectangle(pixels, (20, 20), (280, 220), (0, 0, 0), 1)
    cv2.line(pixels, (40, 120), (260, 120), (0, 0, 255), 1)
    value = values(pixels)
    assert not (value[110:130, 30:270] == OCCUPIED).any()
    assert value[60, 100] == value[180, 100] == FREE


def test_grey_rooms_are_floor_and_grey_of_robot_maps_is_unknown() -> None:
    pixels = np.full((200, 260, 3), 255, np.uint8)
    cv2.rectangle(pixels, (40, 40), (220, 160), (216, 216, 216), -1)
    cv2.rectangle(pixels, (40, 40), (220, 160), (0, 0, 0), 2)
    assert values(pixels)[100, 100] == FREE
    robot = np.full((200, 260, 3), 205, np.uint8)
    robot[40:160, 40:220] = 254
    cv2.rectangle(robot, (40, 40), (220, 160), (0, 0, 0), 2)
    notes = DerivationNotes()
    value = values(robot, notes)
    assert (value[100, 100], value[10, 10]) == (FREE, UNKNOWN)
    assert any("205" in warning.problem for warning in notes.warnings)


def test_floor_that_the_edge_cuts_off_is_floor() -> None:
    """A corridor between shops, which leaves the picture; the street around them is none."""
    pixels = np.full((300, 500, 3), 255, np.uint8)
    for y0, y1 in ((60, 120), (180, 240)):
        for x in range(30, 450, 60):
            cv2.rectangle(pixels, (x, y0), (x + 60, y1), TINTS[0], -1)
            cv2.rectangle(pixels, (x, y0), (x + 60, y1), (60, 40, 90), 1)
    cv2.rectangle(pixels, (450, 60), (499, 240), (255, 255, 255), -1)
    for y in (60, 240):
        cv2.line(pixels, (450, y), (499, y), (60, 40, 90), 1)
    cv2.line(pixels, (30, 60), (30, 240), (60, 40, 90), 1)
    notes = DerivationNotes()
    value = values(pixels, notes)
    assert value[150, 200] == FREE
    assert value[90, 60] == FREE
    assert value[20, 200] == value[280, 200] == UNKNOWN
    assert any("cuts off" in warning.problem for warning in notes.warnings)


def test_walls_have_a_confidence() -> None:
    sure = []
    for name in ("black walls, tinted rooms", "thin outlines of tints on white"):
        plan = Plan(*PLANS[name])
        plan.furnish()
        derived = imagery_to_objects(layers(plan.pixels), ObjectParameters(), DerivationNotes())
        (part,) = derived.parts.values()
        assert isinstance(part, Features)
        walls = [f.properties["confidence"] for f in part if f.properties["kind"] == "wall"]
        assert walls
        sure.append(max(walls))
    assert 1 > sure[0] > sure[1] > 0.5, "a thick black wall is surer than a thin outline"


def test_walls_below_the_confidence_are_unknown() -> None:
    plan, notes = Plan(*PLANS["black walls, tinted rooms"]), DerivationNotes()
    plan.furnish()

    def grids(confidence: float | None, notes: DerivationNotes) -> dict[str, NDArray[np.uint8]]:
        how = Parameters(segmentation="plan", probabilities=True, confidence=confidence)
        parts = imagery_to_occupancy(layers(plan.pixels), how, notes).parts
        return {key.name: cells(part) for key, part in parts.items()}

    drawn, doubted = grids(None, DerivationNotes()), grids(0.95, notes)
    every, some, chance = drawn["map"], doubted["map"], drawn["probability"]
    assert (chance == doubted["probability"]).all()
    assert (chance[every == OCCUPIED] > 50).all()
    assert (chance[every == FREE] == 0).all()
    assert (some[every == OCCUPIED] == UNKNOWN).all()
    assert (some == every)[every != OCCUPIED].all()
    assert any("of the walls of" in w.problem and "confidence=0.95: unknown" in w.problem for w in notes.warnings)


def cells(part: object) -> NDArray[np.uint8]:
    assert isinstance(part, OccupancyGrid)
    return part.cells


def test_plan_derivation_is_repeatable() -> None:
    plan = Plan(*PLANS["thin outlines of tints on cream"])
    plan.furnish()
    assert (values(plan.pixels) == values(plan.pixels.copy())).all()


def test_pictures_that_are_no_plan_raise_cannot_convert() -> None:
    with pytest.raises(CannotConvert, match="a single shade"):
        values(np.full((40, 40, 3), (200, 120, 90), np.uint8), segmentation="plan")
    picture = layers(Plan(*PLANS["black walls, tinted rooms"]).pixels, 1.0)
    with pytest.raises(CannotConvert, match=r"pixels of 1 m.*metres_per_pixel"):
        imagery_to_occupancy(picture, Parameters(segmentation="plan"), DerivationNotes())


def test_plan_without_a_scale_is_refused() -> None:
    ok, data = cv2.imencode(".png", Plan(*PLANS["black walls, tinted rooms"]).pixels)
    assert ok
    with pytest.raises(FleetMapError, match="metres_per_pixel") as raised:
        upload_reader.read(
            {"plan.png": data.tobytes()}, UploadHints(format="satellite"), EnvironmentContext(), Limits()
        ).layers(None)
    assert isinstance(raised.value, BadUpload)
