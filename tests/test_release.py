"""Signature of release artefacts, as SECURITY.md has it checked, and the check of licences."""

from __future__ import annotations

import hashlib
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


def shell(command: str, folder: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(["bash", "-ec", command], cwd=folder, capture_output=True, text=True, check=False)


@pytest.fixture
def signed(tmp_path: Path) -> Path:
    """Folder of signed artefacts, with the list of signers that users have."""
    (tmp_path / "wheel.whl").write_bytes(b"wheel")
    (tmp_path / "SHA256SUMS").write_text(f"{hashlib.sha256(b'wheel').hexdigest()}  wheel.whl\n")
    keygen = ["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-C", "release", "-f", str(tmp_path / "key")]
    subprocess.run(keygen, check=True)
    environment = {**os.environ, "RELEASE_KEY": str(tmp_path / "key")}
    subprocess.run([ROOT / ".ci" / "release", "sign", str(tmp_path)], check=True, env=environment)
    public = " ".join((tmp_path / "key.pub").read_text().split()[:2])
    (tmp_path / "allowed_signers").write_text(f"release@fleet-map-server {public}\n")
    return tmp_path


def documented() -> str:
    """Return the commands of SECURITY.md that check a download."""
    blocks = re.findall(r"```(?:sh|console)\n(.*?)```", (ROOT / "SECURITY.md").read_text(), re.DOTALL)
    (block,) = [b for b in blocks if "SHA256SUMS" in b]
    return block.replace("$ ", "")


def test_documented_commands_accept_only_what_was_signed(signed: Path) -> None:
    assert shell(documented(), signed).returncode == 0
    (signed / "wheel.whl").write_bytes(b"other")
    assert shell(documented(), signed).returncode != 0
    (signed / "SHA256SUMS").write_text(f"{hashlib.sha256(b'other').hexdigest()}  wheel.whl\n")
    answer = shell(documented(), signed)
    assert answer.returncode != 0
    assert "OK" not in answer.stdout


def test_signature_of_another_key_is_refused(signed: Path) -> None:
    keygen = ["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", str(signed / "another")]
    subprocess.run(keygen, check=True)
    environment = {**os.environ, "RELEASE_KEY": str(signed / "another")}
    subprocess.run([ROOT / ".ci" / "release", "sign", str(signed)], check=True, env=environment)
    assert shell(documented(), signed).returncode != 0


def test_licences_of_all_packages_are_accepted() -> None:
    answer = subprocess.run(
        [sys.executable, ROOT / ".ci" / "licences.py"], capture_output=True, text=True, check=False, cwd=ROOT
    )
    assert answer.returncode == 0, answer.stdout


@pytest.mark.parametrize(
    ("text", "accepted"),
    [
        ("MIT", True),
        ("BSD-3-Clause AND MIT", True),
        ("EPL-2.0 OR Apache-2.0", True),
        ("GNU Lesser General Public License v3 (LGPLv3)", True),
        ("LGPL-3.0-only", True),
        ("GPL-3.0-only OR MIT", True),
        ("GNU General Public License v3 (GPLv3)", False),
        ("MIT AND GPL-3.0-or-later", False),
        ("GPL-3.0-only AND (Apache-2.0 OR MIT)", False),
        ("MPL-2.0 AND (Apache-2.0 OR MIT)", True),
        ("AGPL-3.0-only", False),
        ("Proprietary", False),
        ("", False),
    ],
)
def test_licence_is_judged(text: str, accepted: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(ROOT / ".ci"))
    import licences  # type: ignore[import-not-found]

    assert licences.is_accepted(text) is accepted
