"""Readers of simulators' and CAD tools' meshes in memory: STL, OBJ and COLLADA as vertices and triangles.

They replace libraries, since a mesh is hostile input like any other file: pycollada allocates by the counts that a file
states, reads positions as 32-bit numbers and follows images; these readers use positions and faces only, resolve
nothing, and check every count against the size of the file before they allocate memory. (The tests compare with trimesh
and pycollada.)

Units and axes as in Gazebo: COLLADA's ``unit meter`` is applied, its ``up_axis`` is not; STL and OBJ are metres. A
polygon is cut into a fan of triangles.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import Any, NoReturn

import numpy as np
from lxml import etree
from numpy.typing import NDArray

from app.errors import FleetMapError, Invalid, Problem, TooLarge
from app.model.frame import MAX_METRES
from app.model.xml_prolog import check_prolog

Array = NDArray[np.float64]
Faces = NDArray[np.int64]

MAX_FACES = 5_000_000
"""Maximum number of triangles of one mesh. A real collision mesh has some thousands."""

MAX_NODES = 100_000
"""Maximum number of elements of a COLLADA scene, counted per instance: nested instances may double at each level."""

MAX_DEPTH = 64
"""Maximum depth of nested nodes of a COLLADA scene, instances followed."""


@dataclass(frozen=True, slots=True, eq=False)
class Mesh:
    """A mesh in its file's frame: vertices float64 [n, 3] metres, faces int64 [m, 3] of vertex indexes.

    part: int64 [m], index into ``names`` of each face; names: all names of each part (COLLADA: the scene node's, the
    geometry's name and id; OBJ: its object's and group's), the one that Gazebo uses first.
    """

    vertices: Array
    faces: Faces
    part: NDArray[np.int64]
    names: tuple[tuple[str, ...], ...]

    def triangles(self, submesh: str | None = None, *, centre: bool = False) -> Array:
        """Return triangles float64 [m, 3, 3] of the whole mesh or of one part.

        ``centre`` moves the middle of that part's box to the origin, as SDF's ``<center>`` does. Raises Invalid if no
        part has the name.
        """
        faces = self.faces
        if submesh is not None:
            chosen = [k for k, names in enumerate(self.names) if submesh in names[:1]]
            chosen = chosen or [k for k, names in enumerate(self.names) if submesh in names]
            if not chosen:
                submeshes = ", ".join(dict.fromkeys(names[0] for names in self.names if names[0])) or "none"
                raise Invalid(f"unknown submesh {submesh[:80]!r}: the mesh has {submeshes[:400]}")
            faces = faces[np.isin(self.part, chosen)]
        out: Array = self.vertices[faces]
        if centre and len(out):
            flat = out.reshape(-1, 3)
            out = out - (flat.min(axis=0) + flat.max(axis=0)) / 2.0
        return out


def read_mesh(data: bytes, name: str, max_faces: int = MAX_FACES) -> Mesh:
    """Read a mesh file by the ending of its name: .stl, .obj or .dae.

    Raises Invalid (TooLarge beyond ``max_faces`` triangles) with the file's name.
    """
    ending = PurePosixPath(name).suffix.lower()
    reader = _READERS.get(ending)
    if reader is None:
        _raise_unreadable(name, f"is not a supported mesh format: use one of {', '.join(sorted(_READERS))}")
    try:
        vertices, faces, part, names = reader(data, max_faces)
    except TooLarge as error:
        raise TooLarge(f"{name} {error.detail}", [Problem(error.detail, name)]) from error
    except (ValueError, LookupError, ArithmeticError, RecursionError, etree.LxmlError) as error:
        _raise_unreadable(name, f"cannot be read as a mesh: {error}")
    except FleetMapError as error:
        _raise_unreadable(name, f"cannot be read as a mesh: {error.detail}")
    if not len(faces):
        _raise_unreadable(name, "has no triangles")
    if not bool((np.abs(vertices) <= MAX_METRES).all()):
        _raise_unreadable(name, f"has vertices that are not finite metres within ±{MAX_METRES:g}")
    if int(faces.min()) < 0 or int(faces.max()) >= len(vertices):
        _raise_unreadable(name, "has faces with missing vertices")
    return Mesh(vertices, faces, part, names)


_ParsedMesh = tuple[Array, Faces, NDArray[np.int64], tuple[tuple[str, ...], ...]]


def _raise_unreadable(name: str, reason: str) -> NoReturn:
    raise Invalid(f"{name} {reason}", [Problem(reason, name)])


def _check_count(count: int, max_faces: int) -> None:
    if count > max_faces:
        raise TooLarge(f"has {count} triangles; the limit is {max_faces}")


def _numbers(text: str, label: str) -> Array:
    """Parse the decimal numbers of a text. Raises ValueError for anything else."""
    if not text.isascii() or "_" in text:
        raise ValueError(f"{label} must be numbers")
    return np.array(text.split(), np.float64)


def _integers(text: str, label: str) -> NDArray[np.int64]:
    if not text.isascii() or "_" in text:
        raise ValueError(f"{label} must be whole numbers")
    return np.array(text.split(), np.int64)


# --- STL -------------------------------------------------------------------------------------------------------------

_STL_FACE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("more", "<u2")])
_STL_HEAD = 84
_STL_VERTEX = re.compile(rb"vertex\s+(\S+\s+\S+\s+\S+)", re.IGNORECASE)
_STL_FACET = re.compile(rb"^\s*facet\b", re.IGNORECASE | re.MULTILINE)


def _stl(data: bytes, max_faces: int) -> _ParsedMesh:
    """Read STL: binary if the count in its header fits its size (even if it starts with ``solid``), else text."""
    count = int.from_bytes(data[80:_STL_HEAD], "little") if len(data) >= _STL_HEAD else -1
    fits = _STL_HEAD + count * _STL_FACE.itemsize
    if count >= 0 and fits <= len(data) and (fits == len(data) or not _is_text(data)):
        _check_count(count, max_faces)
        corners = np.frombuffer(data, _STL_FACE, count, _STL_HEAD)["corners"].astype(np.float64)
    elif _is_text(data):
        _check_count(len(data) // 40, 16 * max_faces)  # a face has at least 40 characters
        facets = sum(1 for _ in _STL_FACET.finditer(data))
        _check_count(facets, max_faces)
        rows = b" ".join(_STL_VERTEX.findall(data)).decode("ascii")
        flat = _numbers(rows, "vertices")
        if len(flat) != 9 * facets:
            raise ValueError(f"{facets} facets need {3 * facets} vertices, but there are {len(flat) // 3}")
        corners = flat.reshape(-1, 3, 3)
    else:
        face_count = max(0, len(data) - _STL_HEAD) // _STL_FACE.itemsize
        raise ValueError(f"the header states {max(count, 0)} triangles, but there are {face_count}")
    faces = np.arange(3 * len(corners), dtype=np.int64).reshape(-1, 3)
    return corners.reshape(-1, 3), faces, np.zeros(len(faces), np.int64), (("",),)


def _is_text(data: bytes) -> bool:
    return data[:512].lstrip()[:5].lower() == b"solid" and b"\0" not in data[:1024]


# --- OBJ -------------------------------------------------------------------------------------------------------------


def _obj(data: bytes, max_faces: int) -> _ParsedMesh:
    """Read ``v`` and ``f`` lines; ``o`` and ``g`` name the parts. Indexes count from 1, negative ones from the end."""
    text = data.decode("utf-8", "replace").replace("\\\n", " ").replace("\\\r\n", " ")
    rows: list[str] = []
    corners: list[int] = []
    sizes: list[int] = []
    parts: list[int] = []
    names: list[tuple[str, ...]] = [("",)]
    current, thing, count = 0, "", 0
    for line in text.splitlines():
        word, rest = (*line.split(None, 1), "", "")[:2]
        if word == "v":
            tokens = rest.split(None, 3)
            if len(tokens) < 3:
                raise ValueError("a vertex needs three numbers")
            rows += tokens[:3]
        elif word == "f":
            face = [int(corner.partition("/")[0]) for corner in rest.split()]
            if len(face) < 3:
                continue
            n = len(rows) // 3
            if not all(0 < v <= n or -n <= v < 0 for v in face):
                raise ValueError("a face refers to a missing vertex")
            corners += [v - 1 if v > 0 else n + v for v in face]
            sizes.append(len(face))
            parts.append(current)
            count += len(face) - 2
            _check_count(count, max_faces)
        elif word in ("o", "g"):
            thing = rest.strip() if word == "o" else thing
            names.append(tuple(dict.fromkeys(filter(None, (rest.strip(), thing)))) or ("",))
            current = len(names) - 1
    vertices = _numbers(" ".join(rows), "vertices").reshape(-1, 3)
    faces, owner = _fans(np.array(corners, np.int64), np.array(sizes, np.int64))
    return vertices, faces, np.array(parts, np.int64)[owner], tuple(names)


def _fans(corners: NDArray[np.int64], sizes: NDArray[np.int64]) -> tuple[Faces, NDArray[np.int64]]:
    """Split polygons (corners in sequence, and the number of each) into triangles, with the polygon of each."""
    counts = np.maximum(sizes - 2, 0)
    owner = np.repeat(np.arange(len(sizes)), counts)
    first = np.cumsum(sizes) - sizes
    step = np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts)
    at = first[owner]
    return np.column_stack([corners[at], corners[at + step + 1], corners[at + step + 2]]), owner


# --- COLLADA ---------------------------------------------------------------------------------------------------------


def _dae(data: bytes, max_faces: int) -> _ParsedMesh:
    """Read the triangles of the scene, or of all geometries if there is no scene."""
    check_prolog(data)
    # number arrays exceed libxml2's default limit of a text; without a DOCTYPE there are no entities to expand
    parser = etree.XMLParser(
        resolve_entities=False,
        no_network=True,
        load_dtd=False,
        dtd_validation=False,
        huge_tree=True,
        remove_comments=True,
        remove_pis=True,
    )
    root = etree.fromstring(data.lstrip(b"\xef\xbb\xbf \t\r\n"), parser)
    if root.getroottree().docinfo.internalDTD is not None:
        raise ValueError("a DOCTYPE is not accepted: remove it")
    if etree.QName(root).localname != "COLLADA":
        raise ValueError("the root element is not COLLADA")
    scene = _Scene(root, max_faces)
    scene.walk()
    return scene.result()


class _Scene:
    """Reader of a COLLADA document: elements by id, and the triangles that the scene places."""

    def __init__(self, root: etree._Element, max_faces: int) -> None:
        self.root, self.max_faces, self.count = root, max_faces, 0
        self.by_id: dict[str, etree._Element] = {}
        for element in root.iter(etree.Element):
            i = element.get("id")
            if i is not None:
                self.by_id.setdefault(i, element)
        self.geometries: dict[etree._Element, tuple[Array, Faces]] = {}
        self.vertices: list[Array] = []
        self.faces: list[Faces] = []
        self.part: list[NDArray[np.int64]] = []
        self.names: list[tuple[str, ...]] = []
        self.offset = 0
        unit = root.find("{*}asset/{*}unit")
        self.metres = float(_numbers(unit.get("meter", "1"), "unit meter")[0]) if unit is not None else 1.0
        if not (math.isfinite(self.metres) and 0 < self.metres <= 1e6):
            raise ValueError(f"invalid unit of {self.metres:g} metres")

    def walk(self) -> None:
        """Collect the triangles of the scene, depth first, each instance with its own transform."""
        scene = self._target(self.root.find("{*}scene/{*}instance_visual_scene"))
        if scene is None:
            scene = self.root.find("{*}library_visual_scenes/{*}visual_scene")
        if scene is None:
            for geometry in self.root.findall("{*}library_geometries/{*}geometry"):
                self._place(geometry, np.eye(4), "")
            return
        stack: list[tuple[etree._Element, Array, str, int]] = [
            (node, np.eye(4), "", 0) for node in reversed(scene.findall("{*}node"))
        ]
        visited = 0
        while stack:
            node, above, named, depth = stack.pop()
            visited += 1 + len(node)
            if visited > MAX_NODES or depth > MAX_DEPTH:
                raise ValueError(f"its scene has more than {MAX_NODES} elements, or is nested deeper than {MAX_DEPTH}")
            named = node.get("name") or node.get("id") or named
            placement = above @ _transform(node)
            further: list[tuple[etree._Element, Array, str, int]] = []
            for child in node.iterchildren(etree.Element):
                kind = etree.QName(child).localname
                if kind == "node":
                    further.append((child, placement, named, depth + 1))
                elif kind == "instance_node":
                    target = self._target(child)
                    if target is not None:
                        further.append((target, placement, named, depth + 1))
                elif kind == "instance_geometry":
                    geometry = self._target(child)
                    if geometry is not None:
                        self._place(geometry, placement, named)
                elif kind == "instance_controller":
                    skin = self._skin(self._target(child))
                    if skin is not None:
                        self._place(skin[0], placement @ skin[1], named)
            stack += reversed(further)

    def result(self) -> _ParsedMesh:
        """Return all triangles in metres."""
        if not self.faces:
            raise ValueError("its scene has no triangles")
        vertices = np.concatenate(self.vertices) * self.metres
        return vertices, np.concatenate(self.faces), np.concatenate(self.part), tuple(self.names)

    def _target(self, element: etree._Element | None, attribute: str = "url") -> etree._Element | None:
        """Return the element that a reference names in this document; None for external references."""
        url = None if element is None else element.get(attribute)
        return self.by_id.get(url[1:]) if url and url.startswith("#") else None

    def _skin(self, controller: etree._Element | None) -> tuple[etree._Element, Array] | None:
        skin = None if controller is None else controller.find("{*}skin")
        geometry = self._target(skin, "source")
        if skin is None or geometry is None:
            return None
        matrix_text = skin.findtext("{*}bind_shape_matrix")
        return geometry, np.eye(4) if matrix_text is None else _numbers(matrix_text, "bind_shape_matrix").reshape(4, 4)

    def _place(self, geometry: etree._Element, transform: Array, named: str) -> None:
        if geometry not in self.geometries:
            self.geometries[geometry] = self._geometry(geometry)
        vertices, faces = self.geometries[geometry]
        if not len(faces):
            return
        self.count += len(faces)
        _check_count(self.count, self.max_faces)
        with np.errstate(all="ignore"):  # a mesh with infinite or NaN vertices is rejected as a whole
            self.vertices.append(vertices @ transform[:3, :3].T + transform[:3, 3])
        self.faces.append(faces + self.offset)
        self.part.append(np.full(len(faces), len(self.names), np.int64))
        self.names.append(tuple(dict.fromkeys([named, geometry.get("name") or "", geometry.get("id") or ""])))
        self.offset += len(vertices)

    def _geometry(self, geometry: etree._Element) -> tuple[Array, Faces]:
        """Return the vertices of all primitives in sequence, and triangles among them."""
        vertices: list[Array] = []
        faces: list[Faces] = []
        offset = 0
        arrays: dict[etree._Element, tuple[Array, int]] = {}
        for mesh in geometry.findall("{*}mesh"):
            for primitive in mesh.iterchildren(etree.Element):
                cut = _PRIMITIVES.get(etree.QName(primitive).localname)
                if cut is None:
                    continue
                inputs = primitive.findall("{*}input")
                place = {i.get("semantic"): i for i in inputs}
                source = self._positions(self._target(place.get("VERTEX"), "source"))
                width = max((_offset(i) for i in inputs), default=0) + 1
                if width > 64:
                    raise ValueError("a primitive has more than 64 inputs")
                indices = np.concatenate([np.empty((0, 3), np.int64), *cut(primitive, width, _offset(place["VERTEX"]))])
                _check_count(len(indices), self.max_faces)
                if source not in arrays:
                    at = self._source(source)
                    arrays[source] = at, offset
                    vertices.append(at)
                    offset += len(at)
                at, start = arrays[source]
                if len(indices) and (int(indices.min()) < 0 or int(indices.max()) >= len(at)):
                    raise ValueError("a face refers to a missing vertex")
                faces.append(indices + start)
        if not faces:
            return np.empty((0, 3)), np.empty((0, 3), np.int64)
        return np.concatenate(vertices), np.concatenate(faces)

    def _positions(self, element: etree._Element | None) -> etree._Element:
        """Return the source of the positions of a VERTEX input."""
        if element is not None and etree.QName(element).localname == "vertices":
            inputs = [i for i in element.findall("{*}input") if i.get("semantic") == "POSITION"]
            element = self._target(inputs[0], "source") if inputs else None
        if element is None:
            raise ValueError("a primitive has no positions")
        return element

    def _source(self, source: etree._Element) -> Array:
        """Return float64 [n, 3] of a source, as its accessor specifies."""
        accessor = source.find("{*}technique_common/{*}accessor")
        array = self._target(accessor, "source")
        array = source.find("{*}float_array") if array is None else array
        if array is None:
            raise ValueError("a source has no numbers")
        flat = _numbers(array.text or "", "positions")
        stride, first = 3, 0
        if accessor is not None:
            stride, first = (int(_integers(accessor.get(k, d), k)[0]) for k, d in (("stride", "1"), ("offset", "0")))
        if not (3 <= stride <= 64 and first >= 0):
            raise ValueError("positions need three numbers each")
        count = max(0, len(flat) - first) // stride
        return flat[first : first + count * stride].reshape(count, stride)[:, :3].copy()


def _offset(element: etree._Element) -> int:
    value = int(_integers(element.get("offset", "0"), "offset")[0])
    if not 0 <= value < 64:
        raise ValueError("an input's offset must be 0 to 63")
    return value


def _lists(primitive: etree._Element, width: int, column: int) -> Iterator[NDArray[np.int64]]:
    """Return the vertex indexes of each ``<p>``, also of polygons with holes (without their holes)."""
    for p in primitive.iterfind("{*}p"):
        yield _column(p, width, column)
    for p in primitive.iterfind("{*}ph/{*}p"):
        yield _column(p, width, column)


def _column(p: etree._Element, width: int, column: int) -> NDArray[np.int64]:
    flat = _integers(p.text or "", "indexes")
    if len(flat) % width:
        raise ValueError(f"{len(flat)} indexes are not a multiple of {width}")
    return flat.reshape(-1, width)[:, column]


def _read_triangles(primitive: etree._Element, width: int, column: int) -> Iterator[Faces]:
    for corners in _lists(primitive, width, column):
        if len(corners) % 3:
            raise ValueError("triangles need three vertices each")
        yield corners.reshape(-1, 3)


def _read_polylist(primitive: etree._Element, width: int, column: int) -> Iterator[Faces]:
    sizes = _integers(primitive.findtext("{*}vcount") or "", "vcount")
    for corners in _lists(primitive, width, column):
        if len(sizes) and (int(sizes.min()) < 0 or int(sizes.max()) > len(corners)):
            raise ValueError("vcount does not fit the indexes")
        if int(sizes.sum()) != len(corners):
            raise ValueError("vcount does not fit the indexes")
        yield _fans(corners, sizes)[0]


def _read_polygons(primitive: etree._Element, width: int, column: int) -> Iterator[Faces]:
    for corners in _lists(primitive, width, column):
        yield _fans(corners, np.array([len(corners)]))[0]


def _read_strips(primitive: etree._Element, width: int, column: int) -> Iterator[Faces]:
    for c in _lists(primitive, width, column):
        if len(c) < 3:
            continue
        faces = np.column_stack([c[:-2], c[1:-1], c[2:]])
        faces[1::2] = faces[1::2, ::-1]
        yield faces


_Cut = Callable[[etree._Element, int, int], Iterator[Faces]]

_PRIMITIVES: Mapping[str, _Cut] = {
    "triangles": _read_triangles,
    "polylist": _read_polylist,
    "polygons": _read_polygons,
    "trifans": _read_polygons,
    "tristrips": _read_strips,
}


def _transform(node: etree._Element) -> Array:
    """Return a node's own transforms, multiplied in document order: float64 [4, 4]."""
    out = np.eye(4)
    for child in node.iterchildren(etree.Element):
        kind = etree.QName(child).localname
        one = np.eye(4)
        if kind == "matrix":
            one = _numbers(child.text or "", "matrix").reshape(4, 4)
        elif kind == "translate":
            one[:3, 3] = _numbers(child.text or "", "translate").reshape(3)
        elif kind == "scale":
            one[:3, :3] = np.diag(_numbers(child.text or "", "scale").reshape(3))
        elif kind == "rotate":
            one[:3, :3] = _rotation(_numbers(child.text or "", "rotate").reshape(4))
        else:
            continue
        with np.errstate(all="ignore"):
            out = out @ one
    return out


def _rotation(axis_angle: Array) -> Array:
    """Return the rotation about an axis (x, y, z) by an angle in degrees (Rodrigues)."""
    length = float(np.linalg.norm(axis_angle[:3]))
    if not length or not math.isfinite(length):
        return np.eye(3)
    x, y, z = axis_angle[:3] / length
    angle = math.radians(float(axis_angle[3]))
    k: Any = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + math.sin(angle) * k + (1.0 - math.cos(angle)) * (k @ k), np.float64)


_READERS: Mapping[str, Callable[[bytes, int], _ParsedMesh]] = {".stl": _stl, ".obj": _obj, ".dae": _dae}
"""Readers by the ending of the file's name."""
