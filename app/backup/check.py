"""Check a place of backups: every pack of every backup is read and hashed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from app.backup.packs import PackReference
from app.backup.repository import Repository, SnapshotList
from app.errors import Damaged


@dataclass(frozen=True, slots=True)
class PlaceCheck:
    """Result of a check. problems: what is wrong, with the ids of the backups that cannot be restored because of it."""

    snapshots: int
    packs: int
    size: int
    problems: tuple[tuple[str, tuple[str, ...]], ...]


def check_place(
    repository: Repository, listed: SnapshotList, progress: Callable[[int], None] = lambda size: None
) -> PlaceCheck:
    """Read every pack of a place's backups and compare its hash. Needs no identity.

    With an identity the packs of encrypted backups are decrypted as well. Raises Unavailable if the place fails.
    """
    problems: list[tuple[str, tuple[str, ...]]] = [(text, (id_,)) for id_, text in listed.broken.items()]
    users: dict[PackReference, list[str]] = {}
    for snapshot in listed.intact:
        for pack in snapshot.packs:
            users.setdefault(pack, []).append(snapshot.id)
    for pack, ids in users.items():
        problem = _pack_problem(repository, pack)
        if problem is not None:
            problems.append((problem, tuple(ids)))
        progress(pack.size)
    return PlaceCheck(len(listed.intact), len(users), sum(pack.size for pack in users), tuple(problems))


def _pack_problem(repository: Repository, pack: PackReference) -> str | None:
    try:
        if repository.age.can_decrypt:
            for _ in repository.read_pack(pack):
                pass
        else:
            repository.pack_bytes(pack)
    except Damaged as error:
        return error.detail
    except OSError as error:
        return f"the pack {pack.name[:16]}… cannot be read ({type(error).__name__})"
    return None
