"""Gazebo worlds: SDFormat 1.4 to 1.11, with the models, meshes and materials they need.

A file is a world (``.world``, ``.world.xml``, ``.sdf``), a single ``model.sdf`` (a world of one model), or one of the
lists that environment_common generates worlds from (``objects.yaml``, ``known_obstacles.yaml``; see
``gazebo.yaml_lists``).

Canonical: each direct model, include and light of a world is an object of kind ``model``, ``include`` or ``light``. Its
id is its name; it has its ``pose`` and, if the upload contains its solids, ``shapes``, ``size`` and a footprint in
local metres. The rest of its element is stored as text in ``properties.gazebo.sdf``, that of the world (physics, scene,
plugins, wind …) in ``document.gazebo.worlds``. If a pose has more than six numbers (``relative_to``,
``placement_frame``, an include's own pose), its text is stored beside the resulting ``pose`` and is valid until the
object is moved. The worlds of one upload share one part; the option ``world`` selects the one to write.

``<state>`` is dropped: objects that it moves give a warning and are noted in ``properties.gazebo.state``. Model files
are stored byte for byte as resources, as ``models/NAME/…``.

Frame: ``spherical_coordinates`` is the datum. Its heading is the angle from east to the world's x axis,
counter-clockwise seen from above (libignition-math: LOCAL2 to SPHERICAL), so the datum's heading, clockwise, is its
negative. Gazebo's frame is the tangent plane, the local frame a projection: 1 km from the datum they differ by
millimetres. Latitude and longitude 0 are Gazebo's default and give no datum.
"""

from __future__ import annotations

from collections.abc import Sequence

from app.formats import Claims, Files, Format, LayerRequirements, Selection, Traits, register
from app.formats.gazebo import sdf, yaml_lists
from app.formats.gazebo.library import Library, required_files
from app.formats.gazebo.reading import NAME, model_files, read
from app.formats.gazebo.writing import MAIN, WriteOptions, choose, write


def detect(name: str, data: bytes) -> bool:
    """Detect a root element ``<sdf>`` with a world, model or light, or a list of environment_common."""
    if sdf.is_sdf(data):
        return sdf.contains_element(data, b"world", b"model", b"light")
    return yaml_lists.detect(name, data)


def sort(files: Files, mains: Sequence[str]) -> dict[str, list[str]]:
    """Sort an upload into maps, each with the model directories and files that it needs, also indirectly.

    Each world and list is a map; a model is one only if the upload has no world and no other model includes it.
    """
    library = Library(files)
    lists = [n for n in mains if not sdf.is_sdf(files[n])]
    worlds = [n for n in mains if sdf.is_sdf(files[n]) and sdf.contains_element(files[n], b"world")]
    out = {name: list(required_files(library, name)) for name in worlds}
    parts = {name: yaml_lists.find_required_files(library, name) for name in lists}
    inner = {other for name, companions in parts.items() for other in companions if other != name}
    for name in lists:
        if name not in inner or not set(lists) - inner:
            out[name] = parts[name]
    if not out:
        out = _lone_models(library, [n for n in mains if sdf.is_sdf(files[n])])
    return out


def _lone_models(library: Library, models: Sequence[str]) -> dict[str, list[str]]:
    """Return the models that ``model.config`` selects and no other model includes, for an upload without a world."""
    mains = []
    for name in models:
        folder = name.rpartition("/")[0]
        config = f"{folder}/model.config" if folder else "model.config"
        if config not in library.files or library.model_file(folder) in (name, None):
            mains.append(name)
    out = {name: [*required_files(library, name), *model_files(library, name)] for name in mains}
    inner = {other for name, companions in out.items() for other in companions if other != name}
    free = {name: companions for name, companions in out.items() if name not in inner}
    # Models that include each other in a cycle: reading one of them reports the error.
    return free or dict(sorted(out.items())[:1])


register(
    Format(
        name=NAME,
        title="Gazebo world (SDFormat)",
        files={MAIN: "application/xml"},
        extensions=(".world", ".world.xml", ".sdf"),
        layers=frozenset({"objects", "occupancy", "resources"}),
        detect=detect,
        read=read,
        write=write,
        write_options=WriteOptions,
        needs=LayerRequirements(
            one_of=(frozenset({"objects"}), frozenset({"occupancy"})),
            anchor="local",
            also=frozenset({"resources", "occupancy"}),
        ),
        version=3,
        selection=Selection(choose),
        claims=Claims(priority=10, sort=sort),
        traits=Traits(has_title=True),
    )
)
