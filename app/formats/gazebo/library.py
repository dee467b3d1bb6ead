"""File lookup in an upload as in Gazebo: models by name, and the files that they refer to."""

from __future__ import annotations

import re
from collections.abc import Iterable

from app.formats import Files
from app.formats.gazebo.sdf import NEWEST, without_comments

MODELS = "models"
"""Directory beside ``world.sdf`` with the models; add it to Gazebo's model path."""

BODILESS = frozenset({"sun", "ground_plane"})
"""Models that uploads rarely contain and that are no obstacles."""
_REFERENCE = re.compile(
    rb"<(uri|filename|albedo_map|normal_map|roughness_map|metalness_map|environment_map|light_map|emissive_map|"
    rb"ambient_occlusion_map|glossiness_map|specular_map|diffuse|normal|texture|sky|cubemap_uri)\b[^<>]*>([^<>]{1,1024})</"
)
_FETCHED = re.compile(r"(https?|fuel|ign|gz|package|ftp)://", re.IGNORECASE)
_UNSAFE = re.compile(r"[\x00-\x1f\\%~$]")


class Library:
    """Files of an upload, found by SDF references. Files outside the upload are never read."""

    def __init__(self, files: Files) -> None:
        self.files = files
        self._by_base: dict[str, list[str]] = {}
        self._folders: dict[str, set[str]] = {}
        for name in files:
            parts = name.split("/")
            self._by_base.setdefault(parts[-1], []).append(name)
            for k in range(1, len(parts)):
                self._folders.setdefault(parts[k - 1], set()).add("/".join(parts[:k]))
        self._inside: dict[str, list[str]] = {}
        self._cache: dict[tuple[str, str], str | None] = {}

    def find(self, reference: str, near: str) -> str | None:
        """Find the upload's file or directory for a reference in the file ``near``, or return None."""
        folder = near.rpartition("/")[0]
        key = (reference, folder)
        if key not in self._cache:
            self._cache[key] = self._find(reference, folder)
        return self._cache[key]

    def _find(self, reference: str, folder: str) -> str | None:
        path = plain_path(reference)
        if path is None:
            return None
        if not re.match(r"[a-z]+://", reference, re.IGNORECASE):
            beside = _join_path(folder, path)
            if beside is not None and (beside in self.files or self._is_folder(beside)):
                return beside
        if path.startswith(f"{MODELS}/") and reference.lower().startswith("file://"):
            nearest = self._nearest(path, folder)
            return nearest or self._nearest(path[len(MODELS) + 1 :], folder)
        return self._nearest(path, folder)

    def _is_folder(self, path: str) -> bool:
        return path in self._folders.get(path.rpartition("/")[2], ())

    def _nearest(self, path: str, folder: str) -> str | None:
        base = path.rpartition("/")[2]
        candidates = [*self._by_base.get(base, ()), *self._folders.get(base, ())]
        fitting = [name for name in candidates if name == path or name.endswith("/" + path)]
        return min(fitting, key=lambda name: (-_common_folders(name, folder), name.count("/"), name), default=None)

    def model_root(self, reference: str, file: str) -> str:
        """Return the parent directory of a referenced model: ``a/b`` for ``model://NAME/x`` in a/b/NAME/x."""
        path = plain_path(reference) or ""
        if reference.lower().startswith("file://") and path.startswith(f"{MODELS}/"):
            path = path[len(MODELS) + 1 :]
        return file[: -len(path)].rstrip("/") if path and file.endswith(path) else file.rpartition("/")[0]

    def inside(self, folder: str) -> list[str]:
        """Return the files below a directory, sorted."""
        if folder not in self._inside:
            self._inside[folder] = sorted(n for n in self.files if n.startswith(folder + "/"))
        return self._inside[folder]

    def files_beside(self, file: str) -> list[str]:
        """Return a file and its neighbours with the same stem: a mesh's materials and texture."""
        folder, _, base = file.rpartition("/")
        name = base.rpartition(".")[0] or base
        same = [f"{folder}/{b}" if folder else b for b in self._by_base if b.rpartition(".")[0] == name]
        return [file, *sorted(n for n in same if n in self.files and n != file)]

    def model_file(self, folder: str) -> str | None:
        """Return the SDF file of a model directory: the newest version in ``model.config``, else ``model.sdf``."""
        config = self.files.get(f"{folder}/model.config") or self.files.get(f"{folder}/manifest.xml") or b""
        candidates: list[tuple[tuple[int, int], str]] = []
        for version, name in _CONFIG.findall(without_comments(config)):
            path = _join_path(folder, name.decode("utf-8", "replace").strip())
            if path in self.files and path is not None:
                sdf_version = parse_version(version.decode("ascii", "replace"))
                candidates.append((sdf_version or (0, 0), path))
        usable = [f for f in candidates if f[0] <= NEWEST] or candidates
        if usable:
            return max(usable, key=lambda f: f[0])[1]
        default_path = f"{folder}/model.sdf"
        return default_path if default_path in self.files else None


_CONFIG = re.compile(rb"<sdf(?:\s+version\s*=\s*[\"']([^\"'<>]{0,20})[\"'])?[^<>]*>([^<>]{1,512})</sdf>")


def parse_version(text: str | None) -> tuple[int, int] | None:
    """Parse ``1.7`` as (1, 7); return None if it is not a version."""
    match = re.fullmatch(r"\s*(\d{1,3})\.(\d{1,3})(\.\d{1,3})?\s*", text or "", re.ASCII)
    return (int(match[1]), int(match[2])) if match else None


def plain_path(reference: str) -> str | None:
    """Return a reference's path below a model directory, or None for remote addresses and unsafe paths."""
    text = reference.strip()
    if _FETCHED.match(text):
        return None
    match = re.match(r"(model|file)://", text, re.IGNORECASE)
    path = text[match.end() :] if match else text
    path = path.strip("/")
    parts = [p for p in path.split("/") if p not in ("", ".")]
    if not parts or ".." in parts or _UNSAFE.search(path) or len(path) > 1024:
        return None
    return "/".join(parts)


def is_remote(reference: str) -> bool:
    """Check for a reference to another machine or package system (never fetched)."""
    return _FETCHED.match(reference.strip()) is not None


def references(data: bytes) -> list[str]:
    """Find the references of an SDF file without parsing it: each address once, in order.

    Includes comments: a model that is temporarily commented out is stored with its world.
    """
    out: dict[str, None] = {}
    for _, text in _REFERENCE.findall(data):
        reference = text.decode("utf-8", "replace").strip()
        for a, b in (("&amp;", "&"), ("&lt;", "<"), ("&gt;", ">"), ("&quot;", '"'), ("&apos;", "'")):
            reference = reference.replace(a, b)
        if ("/" in reference or "." in reference) and re.search("[A-Za-z]", reference):
            out[reference] = None
    return list(out)


def required_files(library: Library, main: str, more: Iterable[str] = ()) -> dict[str, str]:
    """Return the files that a world needs, directly or indirectly: path in the upload -> path in the exported map.

    A model directory is needed completely and is exported as ``models/NAME/…``, a mesh beside the models as
    ``models/<file>``; files named relative to the world keep their relative path. more: further references.
    """
    roots: dict[str, tuple[str, str]] = {}  # needed directory or file -> (its parent, target directory)
    todo, seen = [main], set()
    extra = list(more)
    while todo:
        name = todo.pop()
        if name in seen:
            continue
        seen.add(name)
        paths = references(library.files[name]) + extra
        extra = []
        for reference in paths:
            file = library.find(reference, name)
            if file is None:
                continue
            is_beside = (
                name == main and "://" not in reference and file == _join_path(main.rpartition("/")[0], reference)
            )
            root = main.rpartition("/")[0] if is_beside else library.model_root(reference, file)
            below = file[len(root) + 1 :] if root else file
            entry = file if is_beside else (root + "/" if root else "") + below.split("/")[0]
            entry = file if entry in library.files or not library.inside(entry) else entry
            if not any(entry.startswith(prefix + "/") for prefix in roots):
                roots.setdefault(entry, (root, "" if is_beside else MODELS + "/"))
            inside = [entry] if entry in library.files else library.inside(entry)
            todo += [n for n in inside if n.lower().endswith(".sdf") and n not in seen]
    out: dict[str, str] = {}
    taken = {"world.sdf"}
    for entry in sorted(roots, key=lambda w: (w.count("/"), w)):
        root, folder = roots[entry]
        for name in library.files_beside(entry) if entry in library.files else library.inside(entry):
            path = folder + (name[len(root) + 1 :] if root else name)
            if name == main or name in out or path in taken:
                continue
            out[name] = path
            taken.add(path)
    return out


def _join_path(folder: str, path: str) -> str | None:
    """Join a relative path to a directory; return None if the result leaves the upload."""
    parts = folder.split("/") if folder else []
    for part in path.split("/"):
        if part in ("", "."):
            continue
        if part == "..":
            if not parts:
                return None
            parts.pop()
        else:
            parts.append(part)
    return "/".join(parts)


def _common_folders(name: str, folder: str) -> int:
    """Count the leading directories that two paths share."""
    count = 0
    for a, b in zip(name.split("/"), folder.split("/") if folder else [], strict=False):
        if a != b:
            break
        count += 1
    return count
