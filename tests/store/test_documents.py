"""Documents in the database, and the keys and secrets in them."""

from __future__ import annotations

import itertools
import json
import os
import subprocess
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey

from app.errors import Conflict, Unavailable
from app.signing import Keys, MountedKeys, SharedKeys
from app.store.store import Store


def check_chain(keys: SharedKeys | MountedKeys) -> None:
    """Check that each key is endorsed by the next older one, and that the newest signs."""
    public = keys.public()
    for newer, older in itertools.pairwise(public):
        assert newer.endorsed_by == older.id
        assert newer.endorsement is not None
        Ed25519PublicKey.from_public_bytes(older.public).verify(newer.endorsement, newer.public)
    name, signature = keys.sign(b"manifest")
    assert name == public[0].id
    Ed25519PublicKey.from_public_bytes(public[0].public).verify(signature, b"manifest")


def test_document_keeps_concurrent_changes(store: Store) -> None:
    def append(number: int) -> None:
        store.document("list").update(lambda content: json.dumps([*json.loads(content or b"[]"), number]).encode())

    with ThreadPoolExecutor(4) as threads:
        list(threads.map(append, range(12)))
    assert sorted(json.loads(store.document("list").read() or b"")) == list(range(12))
    assert store.document("another").read() is None


def test_servers_create_one_key_and_see_rotations(store: Store, tmp_path: Path) -> None:
    servers = [SharedKeys(store.document("keys"), tmp_path / str(n)) for n in range(4)]
    with ThreadPoolExecutor(4) as threads:
        first = list(threads.map(lambda keys: keys.public(), servers))
    assert all(keys == first[0] for keys in first)
    new = servers[2].rotate()
    assert [keys.public()[0] for keys in servers] == [new] * 4
    assert servers[0].rotate().endorsed_by == new.id
    for keys in servers:
        assert len(keys.public()) == 3
        check_chain(keys)


def test_keys_of_existing_installation_are_taken_over(
    store: Store, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    old, foreign = Keys(tmp_path / "old"), Keys(tmp_path / "foreign")
    old.rotate()
    unused = foreign.public()[0].id
    keys = SharedKeys(store.document("keys"), tmp_path / "old")
    assert keys.public() == old.public()
    check_chain(keys)
    assert "not used" not in caplog.text
    other = SharedKeys(store.document("keys"), tmp_path / "foreign")
    assert other.public() == old.public()
    assert f"unused={unused}" in caplog.text


def test_mounted_keys_endorse_each_other(tmp_path: Path) -> None:
    file = tmp_path / "signing-key.pem"
    keys = MountedKeys(file)
    with pytest.raises(Unavailable, match=r"could not read signing-key\.pem: No such file"):
        keys.public()
    file.write_text("no key\n")
    with pytest.raises(Unavailable, match="has no key: create one with `openssl genpkey"):
        keys.public()
    create = ("openssl", "genpkey", "-algorithm", "ed25519")
    pems = [subprocess.run(create, check=True, capture_output=True, text=True).stdout for _ in range(2)]
    file.write_text(pems[0])
    (first,) = keys.public()
    file.write_text(pems[1] + pems[0])
    os.utime(file, (1, 1))
    assert [key.id for key in keys.public()][1:] == [first.id]
    check_chain(keys)
    with pytest.raises(Conflict, match="put the new key before the others"):
        keys.rotate()
    file.write_text(pems[0].replace("MC4C", "AAAA"))
    with pytest.raises(Unavailable, match="invalid file"):
        keys.public()
