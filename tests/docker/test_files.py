"""Checks of the container files (schema, linter, consistency), the lock file and CI."""

from __future__ import annotations

import re
import stat
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest
import yaml

TOP = Path(__file__).resolve().parents[2]
COMPOSE = TOP / "docker" / "compose.yaml"
DOCKERFILE = TOP / "docker" / "Dockerfile"


def tool(name: str, *arguments: str | Path) -> subprocess.CompletedProcess[str]:
    """Run a tool of this virtual environment."""
    return subprocess.run(
        [Path(sys.executable).parent / name, *arguments], capture_output=True, text=True, timeout=60, check=False
    )


@pytest.fixture(scope="module")
def compose() -> dict[str, Any]:
    loaded: dict[str, Any] = yaml.safe_load(COMPOSE.read_text())
    return loaded


@pytest.mark.parametrize("path", sorted((TOP / "docker").glob("*compose*.yaml")), ids=lambda p: p.name)
def test_compose_file_matches_its_schema(path: Path) -> None:
    process = tool("check-jsonschema", "--builtin-schema", "vendor.compose-spec", path)
    assert process.returncode == 0, process.stdout + process.stderr


def test_schema_check_rejects_wrong_values(tmp_path: Path) -> None:
    wrong = tmp_path / "compose.yaml"
    wrong.write_text(COMPOSE.read_text().replace("cap_drop:", "cap_dropped:"))
    assert tool("check-jsonschema", "--builtin-schema", "vendor.compose-spec", wrong).returncode != 0


@pytest.mark.parametrize("path", [DOCKERFILE, TOP / "docker" / "agent.Dockerfile"], ids=lambda p: p.name)
def test_hadolint_reports_nothing(path: Path) -> None:
    process = tool("hadolint", "--no-color", path)
    assert process.returncode == 0, process.stdout + process.stderr


def test_server_container_is_confined(compose: dict[str, Any]) -> None:
    for name in ("server", "migrate"):
        service = compose["services"][name]
        assert service["read_only"] is True
        assert service["cap_drop"] == ["ALL"]
        assert "no-new-privileges:true" in service["security_opt"]
    user = re.findall(r"^USER (\S+)$", DOCKERFILE.read_text(), re.MULTILINE)
    assert user, "the image runs as root"
    assert all(not u.startswith(("0", "root")) for u in user)


def test_used_secrets_and_volumes_are_declared_and_created(compose: dict[str, Any], tmp_path: Path) -> None:
    used = {secret for service in compose["services"].values() for secret in service.get("secrets", ())}
    assert used == set(compose["secrets"])
    done = subprocess.run(
        [sys.executable, TOP / "docker" / "make_secrets.py", tmp_path / "s"], capture_output=True, text=True, check=True
    )
    secrets = {path.name: path.read_text() for path in (tmp_path / "s").iterdir()}
    assert set(secrets) == {Path(secret["file"]).name for secret in compose["secrets"].values()}
    assert stat.S_IMODE((tmp_path / "s").stat().st_mode) == 0o700
    assert secrets["database_password"].strip() in secrets["fleetmap_database_url"]
    assert all(secret.strip() not in done.stdout for secret in secrets.values())
    again = subprocess.run(
        [sys.executable, TOP / "docker" / "make_secrets.py", tmp_path / "s"], capture_output=True, text=True, check=True
    )
    assert again.stdout == ""
    assert {path.name: path.read_text() for path in (tmp_path / "s").iterdir()} == secrets


def test_database_url_matches_compose(compose: dict[str, Any], tmp_path: Path) -> None:
    subprocess.run([sys.executable, TOP / "docker" / "make_secrets.py", tmp_path], capture_output=True, check=True)
    url = urlsplit((tmp_path / "fleetmap_database_url").read_text().strip())
    database = compose["services"]["database"]["environment"]
    assert url.scheme == "postgresql+psycopg"
    assert url.hostname in compose["services"]
    assert url.username == database["POSTGRES_USER"]
    assert url.path == f"/{database['POSTGRES_DB']}"
    assert database["POSTGRES_PASSWORD_FILE"] == "/run/secrets/database_password"


def test_secrets_are_excluded_from_git_and_image() -> None:
    assert "secrets/" in (TOP / "docker" / ".gitignore").read_text().split()
    allowed = [line for line in (TOP / ".dockerignore").read_text().splitlines() if line.startswith("!")]
    assert not any("docker" in line or "data" in line for line in allowed)


def test_image_needs_only_files_that_dockerignore_allows() -> None:
    allowed = {line[1:] for line in (TOP / ".dockerignore").read_text().splitlines() if line.startswith("!")}
    copied = set()
    for line in re.findall(r"^COPY (?!--from)(.*)$", DOCKERFILE.read_text(), re.MULTILINE):
        copied |= set(line.split()[:-1])
    assert copied == allowed
    assert all((TOP / name).exists() for name in allowed)


def test_lock_file_pins_everything_by_hash_from_the_public_index() -> None:
    lock = tomllib.loads((TOP / "uv.lock").read_text())
    project_packages = [p for p in lock["package"] if "editable" in p["source"]]
    assert [p["name"] for p in project_packages] == ["fleet-map-server"]
    for package in lock["package"]:
        if package in project_packages:
            continue
        assert package["source"] == {"registry": "https://pypi.org/simple"}, package["name"]
        artifacts = package.get("wheels", []) + ([package["sdist"]] if "sdist" in package else [])
        assert artifacts, package["name"]
        for artifact in artifacts:
            assert urlsplit(artifact["url"]).hostname == "files.pythonhosted.org"
            assert artifact["hash"].startswith("sha256:")


def test_lock_file_contains_every_dependency() -> None:
    project = tomllib.loads((TOP / "pyproject.toml").read_text())
    lock = tomllib.loads((TOP / "uv.lock").read_text())
    locked = {package["name"] for package in lock["package"]}
    groups = project["dependency-groups"]
    requirements = project["project"]["dependencies"] + groups["robot"]
    requirements += [one for one in groups["dev"] if isinstance(one, str)]
    requirements += project["project"]["optional-dependencies"]["server"]
    names = {re.split(r"[\[<>=!~; ]", text, maxsplit=1)[0].lower().replace("_", "-") for text in requirements}
    assert not names - locked


def test_uv_version_is_the_same_everywhere() -> None:
    versions = {
        *re.findall(r"UV_VERSION := (\S+)", (TOP / "Makefile").read_text()),
        *re.findall(r"uv==(\d\S*)", DOCKERFILE.read_text()),
    }
    assert len(versions) == 1


def test_ci_is_a_shell_script_that_runs_lint_and_the_tests() -> None:
    script = TOP / ".ci" / "run"
    assert script.stat().st_mode & stat.S_IXUSR
    assert subprocess.run(["bash", "-n", script], check=False).returncode == 0
    text = script.read_text()
    assert "set -euo pipefail" in text
    assert text.index("make lint") < text.index("make test")
