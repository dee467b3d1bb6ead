"""What a format declares, and what its reader and writer are given. Public as names of ``app.formats``."""

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
    """What a reader is told, and where it leaves its warnings.

    frame: the environment's, where it has a datum. level: where the map belongs. grid: the name for a grid, else None.
    layer: what the lines and polygons of a drawing are meant for, else None. options: the format's own read options.
    requested_layers: the layers that will be used (None: all); a reader may leave others out. decode_cells: whether
        anybody will look at
    the cells of grids; if not, a reader checks an image's header only. keep_source_properties: whether anybody will ask
    for this format
    (or its family) back; if not, a reader may leave out what only it knows (``properties.<format>``, the document).
    main: the file that was detected. folder: reads files that hold other formats' maps, as a folder of an upload is
    read, for the formats that are such folders in one file; None inside one.
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
        """Whether anybody will use this layer."""
        return self.requested_layers is None or layer in self.requested_layers


@dataclass(frozen=True, slots=True)
class NestedMap:
    """A map inside another one: its files, main file first, and what its writer declared (see ``WriteContext``)."""

    files: dict[str, bytes]
    dropped: tuple[Dropped, ...] = ()
    template: tuple[Filled, ...] = ()
    warnings: tuple[Problem, ...] = ()


UNTITLED = "map"
"""What a map is called that is made for no environment."""


@dataclass(slots=True)
class WriteContext(Notes):
    """What a writer is told, and where it declares what it lost or made up (loss is data).

    title: the environment's name, for formats with a place for one. options: the format's own write options.
    attribution: licences and credits of the sources, for formats with a place for them. make: for formats that hold
    others: a map of the named format from these layers, with these of its options, its missing layers derived or not;
    it raises NotFound for a format that is not there, and what planning and writing raise. stored: the
    licences and credits of each part, where the layers are what is stored; None where a closure has changed them.
    """

    title: str = UNTITLED
    options: Any = None
    attribution: tuple[str, ...] = ()
    make: Callable[[str, Layers, Mapping[str, Any], bool], NestedMap] | None = None
    stored: Mapping[PartKey, Sequence[str]] | None = None


@dataclass(frozen=True, slots=True)
class LayerRequirements:
    """What a writer needs: one of these sets of layers, and a datum or not.

    one_of: alternatives, the first that is complete is enough; every carried layer that is there is written.
    anchor: the coordinates the format speaks, so that items anchored otherwise need a datum. datum: needed always.
    also: layers of which the writer uses a part where they are there, and does without where they are not.
    accepts_family: objects of the format's own family are a whole map: with them nothing else is needed, no datum
    either.
    missing_content: what such layers must hold besides being there (an edge), and do not: what to supply, or None.
    """

    one_of: tuple[frozenset[Layer], ...]
    anchor: Anchor | None = None
    datum: bool = False
    also: frozenset[Layer] = frozenset()
    accepts_family: bool = False
    missing_content: Callable[[Layers], str | None] | None = None


@dataclass(frozen=True, slots=True)
class NoOptions:
    """For formats without options of their own."""


@dataclass(frozen=True, slots=True)
class Parts:
    """For formats whose files hold one part of a layer each: the write options that select the part.

    name: the option with the part's name. stem: a part's name -> that of its files, without the ending. level: the
    option with its level. default: the name of the part that is written where no name is given. So ``*`` for either
    option gives every part (``app.convert.site``).
    """

    layer: Layer
    name: str
    stem: Callable[[str], str]
    level: str = "level"
    default: str = MAP


@dataclass(frozen=True, slots=True)
class Selection:
    """Which of the stored parts a map holds, for formats that do not take all they carry.

    choose: of the parts, those that these write options ask for. from_filename: the options that a wanted file's name
    says. parts: the options that select the part, where a file holds one.
    """

    choose: Callable[[Sequence[PartKey], Any], Sequence[PartKey]] = lambda keys, options: keys
    from_filename: Callable[[str], Mapping[str, str]] = lambda name: {}
    parts: Parts | None = None


@dataclass(frozen=True, slots=True)
class Claims:
    """How a format claims files of an upload, where its name and content alone do not decide.

    priority: the higher one is asked first, and believed where two files tell the same network.
    companions: (main file, its content, all names) -> further files that belong to it.
    related_files: (main file, all names) -> files of other maps that it looks into.
    sort: (files, its main files) -> the main files that are maps, each with all that belongs to it.
    is_sidecar: a main file of this name only speaks for others (a world file), and yields to one of them.
    missing_metadata: what a file lacks to be such a map by itself (a picture without a place); else empty.
    completing_options: the read options that supply it.
    leads_folder: folder of an environment_template where its file is believed and drawings give way.
    gives_way: whether it gives way there as a drawing does.
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
    """``Claims.sort`` of formats whose main files of one folder are one map (graphs ``0.yaml``, ``1.yaml`` …)."""
    del files
    folders: dict[str, list[str]] = {}
    for main in mains:
        folders.setdefault(main.rpartition("/")[0], []).append(main)
    return {first: further for first, *further in folders.values()}


Bends = Literal["shape", "nodes", "foreign"]
"""What becomes of an edge's bends: the format has shapes; or its edges are straight, so that bends become nodes
(``app.model.bends``), which become bends again when it is read; or it has shapes that its consumers ignore, so that
bends of edges from elsewhere become nodes, and stay ones."""


@dataclass(frozen=True, slots=True)
class Traits:
    """Facts of a format by which it differs from most.

    family: the format with which it shares objects and their properties; its own name where it is not given.
    is_drawing: its lines and polygons may be meant for any layer (the upload's ``layer`` says which).
    is_container: it is a folder of other formats' maps.
    own_ids: its ids are the world's, not the file's: another id is another thing.
    own_network: its topology has all its paths, so none is made of its objects.
    outlines: it writes where grids lie, not their cells.
    marks_blocked: it can express a blocked edge, so that such an edge stays in it; other formats leave it out.
    keeps_bends: see ``Bends``.
    has_title: it names the environment (``WriteContext.title``), so its bytes depend on that name.
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
    """A file format. Only what is declared here is known of it elsewhere.

    name: its id. title: its name for people.
    files: the names it is served as, main file first, each with its media type.
    layers: layers it can hold.
    detect: is this file (name, content) the main file of such a map? Called for every file of every upload.
    read, write: between files and layers; None where it cannot be read or served.
    check: the loader rules of the map's consumers (see ``app.formats.check``).
    needs: what writing takes.
    read_options, write_options: dataclasses of ``app.parameters.parameter`` fields.
    extensions: endings of main files. version: raise it when the same layers give other bytes (it is in every ETag).
    selection, claims, traits: for formats that differ from most.
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
        """The format whose objects and properties are its own, too: itself, unless several formats share them."""
        return self.traits.family or self.name
