"""Templates: values that formats need and no layer has, in named sets and per environment.

A set assigns values to the writers' parameters, by format; to add one, add an entry to ``SETS``. Precedence: values of
the request, of the environment (``app.model.templates``), of its set, defaults of the format.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final

from app import formats, parameters
from app.errors import Invalid, NotFound, Problem
from app.formats import Format
from app.model.names import did_you_mean
from app.model.templates import DEFAULT_SET, FormatTemplate, Templates

REQUEST, ENVIRONMENT, DEFAULT = "request", "environment", "default"
"""Origins of a value, besides a set."""

MAX_TEXT_CHARACTERS: Final = 2000
"""Maximum length of a string value, in characters."""


@dataclass(frozen=True, slots=True)
class TemplateSet:
    """Named set of template values. values: by format, then by parameter of its writer."""

    title: str
    values: Mapping[str, Mapping[str, Any]]

    def as_dict(self, name: str) -> dict[str, Any]:
        """Convert the set to JSON for clients."""
        values = {name: dict(sorted(format_values.items())) for name, format_values in sorted(self.values.items())}
        return {"name": name, "title": self.title, "formats": values}


_GOALS = {"action": "NavigateToPose", "action_type": "geometry_msgs/PoseStamped"}

SETS: Final[Mapping[str, TemplateSet]] = {
    DEFAULT_SET: TemplateSet("Each format's own defaults", {}),
    "outdoor": TemplateSet(
        "Fields, orchards and yards: wide goals, grass underfoot, low walls",
        {
            "tmap2": {"verts_radius": 1.5, "xy_goal_tolerance": 0.5, "yaw_goal_tolerance": 0.3},
            "tmap": {"verts_radius": 1.5, "xy_goal_tolerance": 0.5, "yaw_goal_tolerance": 0.3, "top_vel": 1.0},
            "gazebo": {"wall_height": 1.5, "wall_thickness": 0.3, "ground_colour": [0.35, 0.5, 0.25]},
            "lanelet2": {"width": 3.0, "location": "nonurban"},
            "datum": {"half_size": 250.0},
        },
    ),
    "indoor": TemplateSet(
        "Offices and wards: narrow goals, slow robots, rooms of normal height",
        {
            "tmap2": {"verts_radius": 0.5, "xy_goal_tolerance": 0.2},
            "tmap": {"verts_radius": 0.5, "xy_goal_tolerance": 0.2, "top_vel": 0.5},
            "gazebo": {"wall_height": 2.7, "building_height": 3.0},
            "lanelet2": {"width": 1.2, "subtype": "walkway"},
        },
    ),
    "warehouse": TemplateSet(
        "Halls with shelves and docks: exact goals, high walls",
        {
            "tmap2": {"xy_goal_tolerance": 0.1, "yaw_goal_tolerance": 0.05},
            "tmap": {"xy_goal_tolerance": 0.1, "yaw_goal_tolerance": 0.05, "top_vel": 1.5},
            "gazebo": {"wall_height": 6.0, "building_height": 8.0, "ground_colour": [0.6, 0.6, 0.6]},
            "lanelet2": {"width": 2.0},
            "lif": {"vehicle_type": "forklift"},
            "openrmf": {"speed_limit": 1.5},
            "rmf_nav_graph": {"speed_limit": 1.5},
            "rmf_site": {"speed_limit": 1.5},
        },
    ),
    "ros2": TemplateSet(
        "Robots whose topological_navigation and route server run on ROS 2",
        {"tmap2": dict(_GOALS), "tmap": {"action": _GOALS["action"]}},
    ),
}
"""All sets by name. The format's defaults supply all values that a set does not have."""


@dataclass(frozen=True, slots=True)
class ResolvedTemplate:
    """Resolved template values for one format of an environment.

    values: of the set and the environment. origin: of each value, ``environment`` or ``set NAME``. ignored: stored
    values that this release cannot use, with the reason.
    """

    values: Mapping[str, Any] = field(default_factory=dict)
    origin: Mapping[str, str] = field(default_factory=dict)
    ignored: tuple[str, ...] = ()


NO_VALUES: Final = ResolvedTemplate()


def check_set(name: str, location: str = "set") -> str:
    """Check the name of a template set. Raises Invalid with the valid names."""
    if name not in SETS:
        near = did_you_mean(name, SETS)
        reason = f"unknown template set {name[:80]!r}{near}; available: {', '.join(SETS)}"
        raise Invalid(reason, [Problem(reason, where=location)])
    return name


def check_format(name: str) -> Format:
    """Return the format. Raises NotFound if it does not exist or cannot be written."""
    fmt = formats.get_format(name)
    if fmt.write is None:
        raise NotFound(f"{name} is a read-only format: it has no templates")
    return fmt


def check_values(fmt: Format, values: Mapping[str, Any], location: str = "values") -> dict[str, Any]:
    """Convert values of a format's parameters to JSON types. Raises Invalid with each unknown or wrong value."""
    try:
        chosen = parameters.parse(fmt.write_options, values, f"parameter of {fmt.name}")
    except Invalid as error:
        raise Invalid(
            error.detail, [dataclasses.replace(p, where=f"{location}.{p.where}") for p in error.problems]
        ) from None
    out = {name: _plain(getattr(chosen, name)) for name in sorted(values)}
    reason = f"a string must have at most {MAX_TEXT_CHARACTERS} printable characters"
    texts = {name: value for name, value in out.items() if isinstance(value, str)}
    bad = [n for n, text in texts.items() if len(text) > MAX_TEXT_CHARACTERS or not text.isprintable()]
    if bad:
        raise Invalid(reason, [Problem(reason, where=f"{location}.{name}") for name in bad])
    return out


def resolve(templates: Templates, fmt: Format) -> ResolvedTemplate:
    """Resolve the values of an environment's templates for a format.

    Values stored by another release that this one cannot use are skipped and listed in ``ignored``: robots get their
    maps anyway.
    """
    if templates.set == DEFAULT_SET and not templates.formats:
        return NO_VALUES
    format_template, chosen = templates.for_format(fmt.name), templates.set_of(fmt.name)
    ignored = [] if chosen in SETS else [f"template set {chosen!r} is unknown in this release"]
    values: dict[str, Any] = {}
    origin: dict[str, str] = {}
    of_set = SETS[chosen].values.get(fmt.name, {}) if chosen in SETS else {}
    for source, source_values in ((f"set {chosen}", of_set), (ENVIRONMENT, format_template.values)):
        for name, value in source_values.items():
            try:
                check_values(fmt, {name: value})
            except Invalid as error:
                ignored.append(f"{fmt.name}: {error.detail}")
                continue
            values[name], origin[name] = value, source
    return ResolvedTemplate(values, origin, tuple(ignored))


def effective(templates: Templates, fmt: Format) -> dict[str, dict[str, Any]]:
    """Return ``{PARAMETER: {value, from}}`` for all parameters of a format's writer."""
    resolved = resolve(templates, fmt)
    return {
        p["name"]: {
            "value": _plain(resolved.values.get(p["name"], p["default"])),
            "from": resolved.origin.get(p["name"], DEFAULT),
        }
        for p in parameters.describe(fmt.write_options)
    }


def has_parameters(fmt: Format) -> bool:
    """Return whether a format has template parameters."""
    return bool(dataclasses.fields(fmt.write_options))


def with_format_template(templates: Templates, name: str, format_template: FormatTemplate) -> Templates:
    """Replace the template of one format; an empty ``format_template`` removes it."""
    others = {format_name: template for format_name, template in templates.formats.items() if format_name != name}
    return Templates(templates.set, {**others, name: format_template} if format_template.as_dict() else others)


def _plain(value: Any) -> Any:
    return list(map(_plain, value)) if isinstance(value, tuple) else value
