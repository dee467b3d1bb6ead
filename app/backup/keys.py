"""Keys of a server in backups: those that sign manifests, and the secrets of signed links."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Final

from app.backends.documents import FileDocument
from app.backup.create import KeyBundle
from app.errors import Damaged
from app.signing import Keys, SigningKeys, exported_key_ids
from app.store.store import Store

SIGNING: Final = "keys"
LINKS: Final = "links"


def collect_keys(store: Store, folder: Path, mounted: SigningKeys | None, *, include: bool) -> KeyBundle:
    """Return the ids of a server's keys, and the keys themselves if they are to be included. Creates none.

    Args:
        folder: keys of the data folder.
        mounted: keys of a file of the operator, which no backup includes.
    """
    documents = key_documents(store, folder)
    if mounted is not None:
        documents.pop(SIGNING, None)
        ids = tuple(key.id for key in mounted.public())
    else:
        ids = tuple(exported_key_ids(documents[SIGNING])) if SIGNING in documents else ()
    return KeyBundle(documents if include else {}, ids)


def key_documents(store: Store, folder: Path) -> dict[str, bytes]:
    """Return the keys that a place has, by name, in the form that servers on PostgreSQL share."""
    if store.is_shared and store.backup_source.has_schema():
        contents = {name: store.document(name).read() for name in (SIGNING, LINKS)}
    else:
        contents = {}
    if contents.get(SIGNING) is None:
        contents[SIGNING] = Keys(folder).export()
    if contents.get(LINKS) is None:
        contents[LINKS] = _links(folder).read()
    return {name: content for name, content in contents.items() if content is not None}


def place_keys(store: Store, folder: Path, documents: Mapping[str, bytes]) -> None:
    """Put the keys of a backup into their place: the data folder, or the database that servers share.

    Raises Damaged if they cannot be read.
    """
    if LINKS in documents:  # first: an interrupted restore is recognised by the signing keys
        document = store.document(LINKS) if store.is_shared else _links(folder)
        document.update(lambda _: documents[LINKS])
    if SIGNING in documents:
        try:
            exported_key_ids(documents[SIGNING])
            if store.is_shared:
                store.document(SIGNING).update(lambda _: documents[SIGNING])
            else:
                Keys(folder).bring(documents[SIGNING])
        except (ValueError, KeyError, TypeError) as error:
            raise Damaged(f"the keys in the backup cannot be read ({type(error).__name__})") from error


def _links(folder: Path) -> FileDocument:
    return FileDocument(folder / "links.json")
