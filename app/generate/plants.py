"""Stand of plants grown by L-systems, of a built-in species or by custom rules."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import shapely

from app.derive import DerivationNotes
from app.errors import Invalid, Problem
from app.generate import RandomSource, _lsystem, _plants, generates
from app.generate._shapes import disc
from app.generate._site import Site, SiteOptions, invalid_option_error
from app.generate._site_frame import place_site
from app.model.layers import Layers
from app.parameters import parameter

COLOURS = {"apple": "crown", "vine": "leaf", "bush": "crown_light", "pine": "crown_dark"}
HEADLAND = 3.0
"""Distance in metres between the plants and the fence, where robots turn."""


@dataclass(frozen=True, slots=True)
class Options(SiteOptions):
    """Parameters of a stand of plants."""

    species: Literal["apple", "vine", "bush", "pine"] = parameter("apple", "built-in species")
    rules: str | None = parameter(
        None,
        "L-system instead of a species, statements on separate lines or separated by semicolons, such as: "
        "axiom: !(0.05) F(0.5) A(1); A(l) : l > 0.2 -> F(l) [ +(30) A(l * 0.7) ] /(120) A(l * 0.8)",
    )
    iterations: int | None = parameter(
        None,
        "number of rounds of rewriting; default: the species' own, or 6",
        minimum=0,
        maximum=_lsystem.MAX_ITERATIONS,
    )
    angle: float = parameter(25.0, "angle of a turn without a value", minimum=-360.0, maximum=360.0, unit="°")
    length: float = parameter(0.1, "length of a branch or leaf without a value", minimum=0.001, maximum=100.0, unit="m")
    radius: float = parameter(0.01, "radius of a branch without a value", minimum=0.0005, maximum=10.0, unit="m")
    body: Literal["trunk", "crown"] | None = parameter(
        None, "collision shape: only the trunk or almost the whole plant; default: that of the species"
    )
    rows: int = parameter(4, "number of rows", minimum=1, maximum=200)
    columns: int = parameter(8, "number of plants in a row", minimum=1, maximum=200)
    row_spacing: float | None = parameter(
        None,
        "distance between rows; default: as needed by the plants and a robot",
        minimum=0.1,
        maximum=100.0,
        unit="m",
    )
    spacing: float | None = parameter(
        None, "distance between plants of a row; default: 1.1 times their width", minimum=0.05, maximum=100.0, unit="m"
    )
    jitter: float = parameter(0.1, "maximum random offset of a plant", minimum=0.0, maximum=5.0, unit="m")
    variants: int = parameter(
        4, "number of different plants, which are placed scaled and rotated", minimum=1, maximum=_plants.MAX_VARIANTS
    )
    variation: float = parameter(0.15, "maximum relative deviation of a plant's size", minimum=0.0, maximum=0.5)


@generates(
    {"location", "objects", "resources", "occupancy", "topology", "imagery"},
    also=frozenset({"location"}),
    parameters=Options,
)
def plants(given: Layers, options: Options, source: RandomSource, notes: DerivationNotes) -> Layers:
    """Stand of plants from L-systems: apple trees, vines, bushes, pines, or by custom rules."""
    grown = _grow_plants(options, source)
    largest = 1.0 + options.variation
    body = max(p.body[0] for p in grown) * largest
    width = 2 * max(p.spread for p in grown)
    # one cell on each side of a robot, because grids round obstacles up
    need = 2 * (body + options.jitter + options.robot_radius) + 4 * (options.resolution or 0.1) + 0.1
    row_spacing = max(need, 1.1 * width) if options.row_spacing is None else options.row_spacing
    if row_spacing < need:
        raise invalid_option_error(
            "row_spacing", f"must be at least {need:.2f} m, for a robot to pass between the plants"
        )
    spacing = max(0.2, 1.1 * width) if options.spacing is None else options.spacing
    head = max(HEADLAND, need)
    site = Site(given, options, notes)
    across, along = options.rows * row_spacing, (options.columns - 1) * spacing
    place = place_site(
        site, along + 2 * head, across, 1.0, row_spacing / 2 - body - options.jitter - options.robot_radius
    )
    site.draw(site.fence, "meadow")
    site.files.update(_plants.mesh_files(grown))
    chance = source.stream("places")
    for row in range(options.rows):
        v = (row + 0.5) * row_spacing
        strip = shapely.box(head - spacing / 2, v - body, head + along + spacing / 2, v + body)
        site.draw(place.geometry_to_local(strip), "soil")
        for column in range(options.columns):
            du, dv, turn, size, choice = chance.random(5).tolist()
            plant = grown[int(choice * len(grown))]
            scale = round(1.0 + options.variation * (2.0 * size - 1.0), 3)
            shift = options.jitter * 0.7  # so that no corner of the square is farther away
            x, y = place.to_local(head + column * spacing + shift * (2 * du - 1), v + shift * (2 * dv - 1))
            radius, height = (round(part * scale, 3) for part in plant.body)
            site.add_object(
                f"plant_{row + 1}_{column + 1}",
                plant.kind,
                shapely.Point(x, y),
                shapes=plant.shapes(scale),
                pose=(x, y, 0.0, 6.283185 * turn),
                width=round(2 * radius, 3),
                height=height,
                species=plant.name.rpartition("_")[0],
                colour=COLOURS.get(options.species, "crown"),
                seen=disc(x, y, max(plant.spread * scale, radius)),
            )
    for aisle in range(options.rows + 1):
        v = aisle * row_spacing
        ends = [(head / 2, "west"), (head * 1.5 + along, "east")]
        names = [site.node(f"aisle_{aisle + 1}_{side}", place.to_local(u, v), yaw=place.yaw) for u, side in ends]
        site.add_edges(*names, speed=1.0)
        if aisle:
            for side in ("west", "east"):
                site.add_edges(f"aisle_{aisle}_{side}", f"aisle_{aisle + 1}_{side}", speed=1.0)
    return site.finish(ground="meadow")


def _grow_plants(options: Options, source: RandomSource) -> list[_plants.Plant]:
    """Grow the plants of this stand. Raises Invalid and CannotGenerate for invalid rules."""
    name: str = options.species if options.rules is None else "own"
    if options.rules is None:
        template = _plants.SPECIES[options.species]
    elif options.rules.strip():
        template = _plants.Species("plant", options.rules, 6)
    else:
        raise Invalid("rules: missing", [Problem("missing", where="rules")])
    species = replace(
        template,
        iterations=template.iterations if options.iterations is None else options.iterations,
        body=options.body or template.body,
    )
    system = _lsystem.parse(species.rules)
    budget = _lsystem.Budget()
    measures = {"angle": options.angle, "length": options.length, "radius": options.radius}
    return [
        _plants.grow(system, species, f"{name}_{k + 1}", source.stream(f"plant/{name}/{k}"), budget, **measures)
        for k in range(options.variants)
    ]
