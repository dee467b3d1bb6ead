"""Gazebo worlds: SDFormat 1.4 to 1.11, with the models, meshes and materials they need.

A file is a world (``.world``, ``.world.xml``, ``.sdf``), a lone ``model.sdf`` (a world of one model), or one of the
lists that environment_common makes worlds from (``objects.yaml``, ``known_obstacles.yaml``; see ``gazebo.yaml_lists``).

Canonical: each direct model, include and light of a world is an object of the kind ``model``, ``include`` or ``light``,
called by its name, with its ``pose`` and, where the upload tells its solids, ``shapes``, ``size`` and a footprint in
local metres. The rest of its element is kept as text in ``properties.gazebo.sdf``, that of the world (physics, scene,
plugins, wind …) in ``document.gazebo.worlds``. Where a pose says more than six numbers (``relative_to``,
``placement_frame``, an include's own pose) its text stays, with the ``pose`` it means beside it: it holds as long as
nobody moves the object. The worlds of one upload lie in one part side by side; ``world`` says which is written.

``<state>`` is not kept: what it moves is warned of and noted under ``properties.gazebo.state``. Files of models are
kept byte for byte as resources, as ``models/NAME/…``.

Frame: ``spherical_coordinates`` is the datum. Its heading is the angle from east to the world's x axis,
counter-clockwise seen from above (libignition-math: LOCAL2 to SPHERICAL), so the datum's heading, clockwise, is its
negative. Gazebo's frame is the tangent plane and ours a projection: 1 km from the datum they differ by millimetres.
Latitude and longitude 0 are Gazebo's default and no place.
"""

from __future__ import annotations

from collections.abc import Sequence

from app.formats import Claims, Files, Format, LayerRequirements, Selection, Traits, register
from app.formats.gazebo import sdf, yaml_lists
from app.formats.gazebo.library import Library, required_files
from app.formats.gazebo.reading import NAME, model_files, read
from app.formats.gazebo.writing import MAIN, WriteOptions, choose, write


def detect(name: str, data: bytes) -> bool:
    """A root element ``<sdf>`` with a world, model or light, or a list of the generator's."""
    if sdf.is_sdf(data):
        return sdf.contains_element(data, b"world", b"model", b"light")
    return yaml_lists.detect(name, data)


def sort(files: Files, mains: Sequence[str]) -> dict[str, list[str]]:
    """Worlds and lists are maps of their own; a model only where there is no world in the upload and no other model
    includes it. With each come the model folders and files that it needs, also through other models."""
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
    """Of an upload without a world the models that ``model.config`` chooses and no other model includes."""
    mains = []
    for name in models:
        folder = name.rpartition("/")[0]
        config = f"{folder}/model.config" if folder else "model.config"
        if config not in library.files or library.model_file(folder) in (name, None):
            mains.append(name)
    out = {name: [*required_files(library, name), *model_files(library, name)] for name in mains}
    inner = {other for name, companions in out.items() for other in companions if other != name}
    free = {name: companions for name, companions in out.items() if name not in inner}
    # Models that include each other all the way round: one of them tells what is wrong.
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
        version=2,
        selection=Selection(choose),
        claims=Claims(priority=10, sort=sort),
        traits=Traits(has_title=True),
    )
)
