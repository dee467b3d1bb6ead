"""Create the random secrets that compose.yaml mounts, in ``secrets/`` beside it. Existing ones are kept."""

from __future__ import annotations

import argparse
import secrets
from pathlib import Path

HERE = Path(__file__).resolve().parent


def make(folder: Path) -> list[str]:
    """Write missing secrets and return their names.

    The files are readable by all, since the container's user does not exist on this machine; their folder is private.
    """
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    password = folder / "database_password"
    written = []
    if not password.exists():
        if (folder / "fleetmap_database_url").exists():
            raise SystemExit("fleetmap_database_url exists without database_password: remove it, or write both")
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
