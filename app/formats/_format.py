"""Types that a format declares, and the contexts of its reader and writer.

Public as names of ``app.formats``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from app.errors import Problem
from app.limits import Limits
from app.model.frame import GROUND, Anchor
from app.model.geodesy import LocalFrame
from app.model.layers import MAP, Layer, Layers, PartKey
from app.model.notes import Dropped, Filled, Notes, Warnings

Files = Mapping[str, bytes]
"""A map as named files: relative path with forward slashes -> content."""


@dataclass(slots=True)
class ReadContext(Warnings):
    """Input of a reader, and the place for its warnings.

    Attributes:
        limits: limits for the upload.
        frame: the environment's local frame; None without a datum.
        level: level that the map belongs to.
        grid: name for a grid, else None.
        layer: layer that the lines and polygons of a drawing are meant for, else None.
        options: the format's own read options.
        requested_layers: layers that will be used (None: all); a reader may skip the others.
        decode_cells: whether the cells of grids will be used; if not, a reader checks only an image's header.
        keep_source_properties: whether the map may be exported in this format or its family again; if not, a reader may
            skip format-specific data (``properties.<format>``, the document).
        main: the file that was detected; a reader of several files sets the one that it reads.
        folder: reads files that contain maps of other formats as an upload of a folder is read, for formats that are
            such a folder in one file; None inside such a folder.
    """

    limits: Limits = field(default_factory=Limits)
    frame: LocalFrame | None = None
    level: str = GROUND
    grid: str | None = None
    layer: Layer | None = None
    options: Any = None
    requested_layers: frozenset[Layer] | None = None
    decode_cells: bool = True
    keep_source_properties: bool = True
    folder: Callable[[Files], Layers] | None = None

    def wants(self, layer: Layer) -> bool:
        """Whether this layer will be used."""
        return self.requested_layers is None or layer in self.requested_layers


@dataclass(frozen=True, slots=True)
class NestedMap:
    """A map inside another one: its files, main file first, and its writer's report (see ``WriteContext``)."""

    files: dict[str, bytes]
    dropped: tuple[Dropped, ...] = ()
    template: tuple[Filled, ...] = ()
    warnings: tuple[Problem, ...] = ()


UNTITLED = "map"
"""Title of a map that is written for no environment."""


@dataclass(slots=True)
class WriteContext(Notes):
    """Input of a writer, and the place to declare lost and filled-in data (all loss must be declared).

    Attributes:
        title: the environment's name, for formats that can contain one.
        options: the format's own write options.
        attribution: licences and credits of the sources, for formats that can contain them.
        make: for formats that contain maps of other formats: convert these layers to the named format with these
            options; the last argument says whether to derive missing layers. Raises NotFound for an unknown format,
            and every error of planning and writing.
        stored: licences and credits of each part if the layers are the stored ones; None if a closure has changed them.
    """

    title: str = UNTITLED
    options: Any = None
    attribution: tuple[str, ...] = ()
    make: Callable[[str, Layers, Mapping[str, Any], bool], NestedMap] | None = None
    stored: Mapping[PartKey, Sequence[str]] | None = None


@dataclass(frozen=True, slots=True)
class LayerRequirements:
    """Requirements of a writer: one of several sets of layers, and optionally a datum.

    Attributes:
        one_of: alternatives; the first complete one is enough. Every layer of ``Format.layers`` that exists is written.
        anchor: anchor of the format's coordinates; items with the other anchor need a datum.
        datum: a datum is always needed.
        also: optional layers of which the writer uses a part.
        accepts_family: objects of the format's own family are a complete map: nothing else is needed, not even a datum.
        missing_content: returns what to supply if these layers lack required content (such as an edge), else None.
    """

    one_of: tuple[frozenset[Layer], ...]
    anchor: Anchor | None = None
    datum: bool = False
    also: frozenset[Layer] = frozenset()
    accepts_family: bool = False
    missing_content: Callable[[Layers], str | None] | None = None


ANY_FEATURES: tuple[frozenset[Layer], ...] = tuple(
    frozenset({layer}) for layer in ("objects", "topology", "location", "zones")
)
"""``LayerRequirements.one_of`` of a format that writes all features: any layer with some is enough."""


@dataclass(frozen=True, slots=True)
class NoOptions:
    """Options of formats without options of their own."""


@dataclass(frozen=True, slots=True)
class Parts:
    """Write options that select a part, for formats whose files contain one part of a layer each.

    Attributes:
        layer: layer of the part.
        name: option with the part's name.
        stem: converts a part's name to the stem of its files.
        level: option with the part's level.
        default: name of the part that is written by default.

    The value ``*`` for either option selects every part (``app.convert.site``).
    """

    layer: Layer
    name: str
    stem: Callable[[str], str]
    level: str = "level"
    default: str = MAP


@dataclass(frozen=True, slots=True)
class Selection:
    """Selection of stored parts, for formats that do not write all parts of their layers.

    Attributes:
        choose: returns those of the parts that these write options select.
        from_filename: options that follow from the name of a requested file.
        parts: options that select the part, for formats that contain one part per file.
    """

    choose: Callable[[Sequence[PartKey], Any], Sequence[PartKey]] = lambda keys, options: keys
    from_filename: Callable[[str], Mapping[str, str]] = lambda name: {}
    parts: Parts | None = None


@dataclass(frozen=True, slots=True)
class Claims:
    """Rules by which a format claims files of an upload if name and content alone do not decide.

    Attributes:
        priority: formats with higher priority detect first, and win if two files describe the same network.
        companions: (main file, its content, all names) -> further files that belong to it.
        related_files: (main file, all names) -> files of other maps that it reads.
        sort: (files, its main files) -> the main files that are maps, each with all files that belong to it.
        is_sidecar: whether a main file of this name only describes another one (a world file) and yields to it.
        missing_metadata: what a file lacks to be such a map by itself (an image without a position); else empty.
        completing_options: read options that supply it.
        leads_folder: folder of an environment_template in which its file takes precedence over drawings.
        gives_way: whether it yields there as a drawing does.
    """

    priority: int = 0
    companions: Callable[[str, bytes, Sequence[str]], Iterable[str]] = lambda main, data, names: ()
    related_files: Callable[[str, Sequence[str]], Iterable[str]] = lambda main, names: ()
    sort: Callable[[Files, Sequence[str]], Mapping[str, Iterable[str]]] | None = None
    is_sidecar: Callable[[str], bool] = lambda name: False
    missing_metadata: Callable[[str, bytes], str] = lambda name, data: ""
    completing_options: frozenset[str] = frozenset()
    leads_folder: str = ""
    gives_way: bool = False


def one_map_per_folder(files: Files, mains: Sequence[str]) -> dict[str, list[str]]:
    """Group main files of one folder into one map (graphs ``0.yaml``, ``1.yaml`` …), as ``Claims.sort``."""
    del files
    folders: dict[str, list[str]] = {}
    for main in mains:
        folders.setdefault(main.rpartition("/")[0], []).append(main)
    return {first: further for first, *further in folders.values()}


Bends = Literal["shape", "nodes", "foreign"]
"""Treatment of an edge's bends.

``shape``: the format has shapes. ``nodes``: its edges are straight; bends become nodes (``app.model.bends``) and become
bends again on reading. ``foreign``: its consumers ignore shapes; bends of edges from other formats become nodes
permanently.
"""


@dataclass(frozen=True, slots=True)
class Traits:
    """Traits of a format that differ from the default.

    Attributes:
        family: format with which it shares objects and their properties; default: the format's own name.
        is_drawing: its lines and polygons may be meant for any layer (the upload's ``layer`` decides).
        is_container: it is a folder of maps of other formats.
        own_ids: its ids are global, not local to the file: another id is another thing.
        own_network: its topology contains all its paths, so none is derived from its objects.
        outlines: it writes the positions of grids, not their cells.
        marks_blocked: it can express a blocked edge; other formats omit such an edge.
        keeps_bends: see ``Bends``.
        has_title: it contains the environment's name (``WriteContext.title``), so its bytes depend on that name.
    """

    family: str | None = None
    is_drawing: bool = False
    is_container: bool = False
    own_ids: bool = False
    own_network: bool = False
    outlines: bool = False
    marks_blocked: bool = False
    keeps_bends: Bends = "shape"
    has_title: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Format:
    """A file format. Other packages rely only on these declarations.

    Attributes:
        name: id.
        title: display name.
        files: names of the files of an exported map, main file first, each with its media type.
        layers: layers that it can contain.
        detect: whether a file (name, content) is the main file of such a map; called for every file of every upload.
        read, write: convert files to layers and back; None if not supported.
        check: loader rules of the map's consumers (see ``app.formats.check``).
        needs: requirements of the writer.
        read_options, write_options: dataclasses of ``app.parameters.parameter`` fields.
        extensions: extensions of main files.
        version: increase it when the same layers give other bytes (it is part of every ETag).
        selection, claims, traits: for formats that differ from the default.
    """

    name: str
    title: str
    files: Mapping[str, str]
    layers: frozenset[Layer]
    detect: Callable[[str, bytes], bool]
    read: Callable[[Files, ReadContext], Layers] | None = None
    write: Callable[[Layers, WriteContext], dict[str, bytes]] | None = None
    check: Callable[[Files], Iterable[Problem]] | None = None
    needs: LayerRequirements = field(default_factory=lambda: LayerRequirements(()))
    read_options: type[Any] = NoOptions
    write_options: type[Any] = NoOptions
    extensions: tuple[str, ...] = ()
    version: int = 1
    selection: Selection = Selection()
    claims: Claims = Claims()
    traits: Traits = Traits()

    @property
    def family(self) -> str:
        """Format whose objects and properties it shares: itself by default."""
        return self.traits.family or self.name
