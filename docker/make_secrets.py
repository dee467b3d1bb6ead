"""Make the secrets that compose.yaml mounts: random, once, beside it in ``secrets/``. Existing ones stay."""

from __future__ import annotations

import argparse
import secrets
from pathlib import Path

HERE = Path(__file__).resolve().parent


def make(folder: Path) -> list[str]:
    """Write what is missing: the names that were written.

    The files are readable for all, since a container's user is none of this machine's; their folder is the owner's.
    """
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    password = folder / "database_password"
    written = []
    if not password.exists():
        if (folder / "fleetmap_database_url").exists():
            raise SystemExit("fleetmap_database_url is there and database_password is not: remove it, or write both")
        written.append(_write(password, secrets.token_hex(24)))
    url = f"postgresql+psycopg://fleetmap:{password.read_text().strip()}@database:5432/fleetmap"
    for name, content in (("fleetmap_database_url", url), ("fleetmap_admin_token", secrets.token_urlsafe(32))):
        if not (folder / name).exists():
            written.append(_write(folder / name, content))
    return written


def _write(path: Path, content: str) -> str:
    path.write_text(content + "\n")
    path.chmod(0o444)
    return path.name


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", nargs="?", type=Path, default=HERE / "secrets")
    for name in make(parser.parse_args().folder):
        print("wrote", name)
