"""A place of backups: its description, packs with their indexes, and one manifest for each backup.

``fleetmap-backup.json`` describes the place, ``snapshots/<time>-<random>.json`` is the manifest of a backup, in the
clear, with a code that needs the place's key. The key of a place that is not encrypted is its id; that of an encrypted
one is random, encrypted to the recipients in the description, and known to the server that writes there.
"""

from __future__ import annotations

import base64
import hashlib
import hmac
import json
import re
import secrets
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any, Final

from app.backends.archive_file import ArchiveFiles
from app.backends.blobs import BlobFiles
from app.backup.encryption import Age
from app.backup.packs import (
    ObjectIndex,
    PackEntry,
    PackReference,
    PackWriter,
    index_of,
    read_entries,
    read_index,
)
from app.errors import Conflict, Damaged, Invalid

FORMAT: Final = 1
DESCRIPTION: Final = "fleetmap-backup.json"
NO_BACKUP: Final = (
    "there is no complete backup in this place: the first one was interrupted, or this copy of the place is cut off or "
    "lacks `snapshots`: restore from another copy (`fleetmap backup SOURCE --list` shows what each has)"
)
MAX_MANIFEST: Final = 2**30
_SNAPSHOT: Final = re.compile(r"snapshots/(?P<id>\d{8}T\d{6}Z-[0-9a-f]{8})\.json")
_PLAIN: Final = ("id", "release", "revision", "database", "epoch", "position", "keys", "written")
_HASH: Final = re.compile(r"[0-9a-f]{64}")


@dataclass(frozen=True, slots=True)
class TableContent:
    """Rows of one table in a backup. segments: names of the objects, in order."""

    name: str
    columns: tuple[str, ...]
    rows: int
    segments: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Snapshot:
    """Manifest of one backup. Times in UTC. written: bytes that it added to the place. keys: whether it has keys.

    position: of the newest event. damaged: names of what was damaged in the store already, and is not in the backup.
    """

    id: str
    started: datetime
    finished: datetime
    release: str
    revision: str
    database: str
    epoch: int
    position: int
    key_ids: tuple[str, ...]
    keys: bool
    tables: tuple[TableContent, ...]
    packs: tuple[PackReference, ...]
    written: int
    damaged: tuple[str, ...] = ()

    @property
    def order(self) -> tuple[int, int, datetime]:
        """Key to sort the backups of a server, oldest first: its own counters, then its clock, which may have leapt."""
        return self.epoch, self.position, self.started

    @property
    def size(self) -> int:
        """Bytes of all packs of the backup."""
        return sum(pack.size for pack in self.packs)

    def as_dict(self) -> dict[str, Any]:
        """Convert it to JSON."""
        return {
            "id": self.id,
            "started": self.started.isoformat(),
            "finished": self.finished.isoformat(),
            "release": self.release,
            "revision": self.revision,
            "database": self.database,
            "epoch": self.epoch,
            "position": self.position,
            "key_ids": list(self.key_ids),
            "keys": self.keys,
            "tables": [[t.name, list(t.columns), t.rows, "".join(t.segments)] for t in self.tables],
            "packs": [[pack.name, pack.size] for pack in self.packs],
            "written": self.written,
            "damaged": list(self.damaged),
        }

    @classmethod
    def from_dict(cls, members: dict[str, Any]) -> Snapshot:
        """Read the members of ``as_dict``. Raises KeyError, TypeError, ValueError."""
        table_list = [
            TableContent(name, tuple(columns), rows, tuple(joined[k : k + 32] for k in range(0, len(joined), 32)))
            for name, columns, rows, joined in members["tables"]
        ]
        packs = tuple(PackReference(str(name), int(size)) for name, size in members["packs"])
        if not all(_HASH.fullmatch(pack.name) for pack in packs):
            raise ValueError("invalid name of a pack")
        values: dict[str, Any] = {name: members[name] for name in _PLAIN}
        values |= {name: datetime.fromisoformat(members[name]) for name in ("started", "finished")}
        values |= {name: tuple(members[name]) for name in ("key_ids", "damaged")}
        return cls(**values, tables=tuple(table_list), packs=packs)


@dataclass(frozen=True, slots=True)
class SnapshotList:
    """Backups of a place, oldest first. broken: ids and problems of manifests that are cut off or altered."""

    intact: list[Snapshot]
    broken: dict[str, str] = field(default_factory=dict)


class Repository:
    """A place of backups. Create it with ``create`` or ``open``."""

    def __init__(self, files: BlobFiles, id_: str, key: bytes, age: Age) -> None:
        self.files, self.id, self.key, self.age = files, id_, key, age

    @classmethod
    def create(cls, files: BlobFiles, recipients: Sequence[str]) -> Repository:
        """Describe an empty place. Raises Unavailable."""
        age = Age(recipients)
        id_ = secrets.token_hex(16)
        key = secrets.token_bytes(32) if age.is_on else bytes.fromhex(id_)
        description = {"format": FORMAT, "id": id_, "recipients": list(age.recipients)}
        if age.is_on:
            description["key"] = base64.b64encode(age.encrypt(key)).decode()
        files.prepare()
        files.write({DESCRIPTION: json.dumps(description, indent=1).encode()})
        return cls(files, id_, key, age)

    @classmethod
    def open(cls, files: BlobFiles, *, key: bytes | None = None, identities: Sequence[str] = ()) -> Repository | None:
        """Open a place, None if there is none.

        Args:
            key: of the place, by which it is written to without an identity.
            identities: of age, with which it can be read.

        Raises Invalid for a missing or wrong identity, Damaged for a bad description, Conflict for a newer form.
        """
        description = read_description(files)
        if description is None:
            return None
        age = Age(description.recipients, identities)
        if not age.is_on:
            key = bytes.fromhex(description.id)
        elif identities or key is None:
            key = age.decrypt(description.encrypted_key)
        return cls(files, description.id, key or b"", age)

    # --- packs ---

    def writer(self) -> PackWriter:
        """Return a writer of new packs."""
        return PackWriter(self._write_pack, self.key)

    def _write_pack(self, content: bytes, entries: bytes) -> PackReference:
        data = self.age.encrypt(content)
        pack = PackReference(hashlib.sha256(data).hexdigest(), len(data))
        self.files.write({pack.key: data})
        self.files.write({pack.index_key: index_of(pack, entries, self.key)})
        return pack

    def read_pack(self, pack: PackReference) -> Iterator[PackEntry]:
        """Read the objects of a pack. Raises Damaged if it is lost, cut off or altered."""
        yield from read_entries(self.age.decrypt(self.pack_bytes(pack)))

    def pack_bytes(self, pack: PackReference) -> bytes:
        """Read a pack as it is stored, hashed. Raises Damaged if it is lost, cut off or altered."""
        content = self._bytes(pack.key, pack.size + 1)
        if content is None:
            raise Damaged(f"the backup is not complete: the pack {pack.name[:16]}… is missing")
        if len(content) < pack.size:
            raise Damaged(f"the backup is cut off: the pack {pack.name[:16]}… has {len(content)} of {pack.size} bytes")
        if hashlib.sha256(content).hexdigest() != pack.name:
            raise Damaged(f"the backup is damaged: the pack {pack.name[:16]}… does not match its hash")
        return content

    def load_index(self) -> ObjectIndex:
        """Read which objects the place has, in packs that are complete.

        Of an object in several packs, that of the newest backup counts: it had left the others.
        """
        intact = self.snapshots().intact
        newest = {pack.name for pack in intact[-1].packs} if intact else set()
        sizes = {file.key.rpartition("/")[2]: file.size for file in self.files.list("packs/")}
        packs: list[PackReference] = []
        entries: list[bytes] = []
        indexes = {file.key.rpartition("/")[2]: file for file in self.files.list("index/")}
        for name, file in sorted(indexes.items(), key=lambda item: (item[0] not in newest, item[0])):
            content = self._bytes(file.key, file.size)
            index = None if content is None else read_index(name, content, self.key)
            if index is not None and sizes.get(name) == index[0]:
                packs.append(PackReference(name, index[0]))
                entries.append(index[1])
        return ObjectIndex(packs, entries)

    def remove_unused_packs(self, snapshots: Sequence[Snapshot]) -> int:
        """Remove the packs that none of these backups consists of; returns their bytes."""
        used = {pack.name for snapshot in snapshots for pack in snapshot.packs}
        unused = [file for file in self.files.list("packs/") if file.key.rpartition("/")[2] not in used]
        indexes = [file.key for file in self.files.list("index/") if file.key.rpartition("/")[2] not in used]
        self.files.delete(indexes)
        self.files.delete([file.key for file in unused])
        return sum(file.size for file in unused)

    # --- manifests ---

    def write_snapshot(self, snapshot: Snapshot) -> None:
        """Store a manifest: with it the backup exists."""
        body = json.dumps(snapshot.as_dict(), separators=(",", ":")).encode()
        head = json.dumps({"format": FORMAT, "code": self._code(body)}).encode()
        self.files.write({f"snapshots/{snapshot.id}.json": head + b"\n" + body + b"\n"})

    def snapshots(self) -> SnapshotList:
        """Read the manifests. Raises Conflict if one is of a newer form."""
        out = SnapshotList([])
        for file in sorted(self.files.list("snapshots/"), key=lambda file: file.key):
            match = _SNAPSHOT.fullmatch(file.key)
            if match is None:
                continue
            try:
                out.intact.append(self._read_snapshot(file.key, match["id"]))
            except Damaged as error:
                out.broken[match["id"]] = error.detail
        out.intact.sort(key=lambda snapshot: snapshot.order)
        return out

    def remove_snapshots(self, ids: Sequence[str]) -> None:
        """Remove manifests."""
        self.files.delete([f"snapshots/{id_}.json" for id_ in ids])

    def _read_snapshot(self, key: str, id_: str) -> Snapshot:
        head, _, body = (self._bytes(key, MAX_MANIFEST) or b"").partition(b"\n")
        body = body.removesuffix(b"\n")
        try:
            members = json.loads(head)
            if members["format"] != FORMAT:
                raise Conflict(_newer(members["format"]))
            if not hmac.compare_digest(str(members["code"]), self._code(body)):
                raise Damaged(f"the manifest of backup {id_} is cut off or was altered")
            snapshot = Snapshot.from_dict(json.loads(body))
        except (ValueError, KeyError, TypeError) as error:
            raise Damaged(f"the manifest of backup {id_} is cut off or was altered") from error
        if snapshot.id != id_:
            raise Damaged(f"the manifest of backup {id_} is that of {snapshot.id}")
        return snapshot

    def _code(self, body: bytes) -> str:
        return hashlib.blake2b(body, key=self.key, digest_size=32).hexdigest()

    def _bytes(self, key: str, size: int) -> bytes | None:
        """Read at most so many bytes of a file; None if there is no such file."""
        return _read(self.files, key, size)


@dataclass(frozen=True, slots=True)
class Description:
    """Description of a place. encrypted_key: to the recipients."""

    id: str
    recipients: tuple[str, ...]
    encrypted_key: bytes


def read_description(files: BlobFiles) -> Description | None:
    """Read the description of a place, None if there is none. Raises Damaged, or Conflict for a newer form."""
    content = _read(files, DESCRIPTION, 2**20)
    if content is None:
        return None
    try:
        members = json.loads(content)
        if members["format"] != FORMAT:
            raise Conflict(_newer(members["format"]))
        bytes.fromhex(members["id"])
        key = base64.b64decode(members.get("key", ""))
        return Description(str(members["id"]), tuple(members["recipients"]), key)
    except (ValueError, KeyError, TypeError) as error:
        raise Damaged(f"{DESCRIPTION} is cut off or no description of backups ({type(error).__name__})") from error


def finish(files: BlobFiles) -> None:
    """Complete a backup in a single file."""
    if isinstance(files, ArchiveFiles):
        files.finish()


def choose(snapshots: SnapshotList, id_: str | None) -> Snapshot:
    """Return the backup whose id begins so, the newest without an id. Raises Invalid, Damaged."""
    if id_ is None:
        if not snapshots.intact:
            raise Damaged(next(iter(snapshots.broken.values()), NO_BACKUP))
        newest = snapshots.intact[-1]
        later = [name for name in snapshots.broken if name > newest.id]
        if later:
            raise Damaged(f"{snapshots.broken[later[-1]]}: choose another one with --snapshot ({newest.id} is intact)")
        return newest
    matches = [snapshot for snapshot in snapshots.intact if snapshot.id.startswith(id_)]
    if len(matches) == 1:
        return matches[0]
    broken = [problem for name, problem in snapshots.broken.items() if name.startswith(id_)]
    if broken:
        raise Damaged(broken[0])
    listed = ", ".join(snapshot.id for snapshot in snapshots.intact[-5:]) or "none"
    raise Invalid(f"--snapshot {id_}: {len(matches)} backups begin so; the newest are {listed}")


def _newer(form: object) -> str:
    return (
        f"the backup has form {str(form)[:20]}, this release reads form {FORMAT}: use the release that wrote it, or a "
        "newer one"
    )


def _read(files: BlobFiles, key: str, size: int) -> bytes | None:
    out = bytearray()
    try:
        for piece in files.stream(key):
            out += piece
            if len(out) >= size:
                break
    except FileNotFoundError:
        return None
    return bytes(out)
