"""The bundle for machines without internet: packed from small wheels, and installed by its own script."""

from __future__ import annotations

import ensurepip
import platform
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import zipfile
from pathlib import Path

import pytest

from tests.docker.containers import TOP

PYTHON = f"{sys.version_info.major}.{sys.version_info.minor}"
PROGRAM = "def main():\n    from offline_part import NAME\n    print(NAME)\n"
ENGINE = '#!/bin/sh\necho "$@" >> "$(dirname "$0")/calls"\n[ "$1" != save ] || echo images > "$3"\n'


def write_wheel(folder: Path, name: str, files: dict[str, str]) -> None:
    """Write a wheel of version 1.0 without dependencies."""
    information = f"{name}-1.0.dist-info"
    metadata = f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n"
    tags = "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n"
    files = {**files, f"{information}/METADATA": metadata, f"{information}/WHEEL": tags}
    files[f"{information}/RECORD"] = "".join(f"{path},,\n" for path in (*files, f"{information}/RECORD"))
    with zipfile.ZipFile(folder / f"{name}-1.0-py3-none-any.whl", "w") as wheel:
        for path, text in files.items():
            wheel.writestr(path, text)


def pip_wheel() -> Path:
    """The wheel of pip that this Python installs into virtual environments."""
    folders = [Path(ensurepip.__file__).parent / "_bundled", Path(sysconfig.get_config_var("WHEEL_PKG_DIR") or "/")]
    return max(wheel for folder in folders for wheel in folder.glob("pip-*.whl"))


def bundle(folder: Path, *options: str, path: str = "/nonexistent") -> subprocess.CompletedProcess[str]:
    """Run make_bundle.py with the wheels of the folder. path: where it looks for a container engine."""
    command = [sys.executable, str(TOP / "docker" / "make_bundle.py")]
    command += ["--wheels", str(folder / "wheels"), "--output", str(folder), *options]
    return subprocess.run(command, capture_output=True, text=True, check=False, env={"PATH": path})


def install(folder: Path, *arguments: str, **variables: str) -> subprocess.CompletedProcess[str]:
    """Run the bundle's installer; pip gets no index from this machine."""
    return subprocess.run(
        ["sh", folder / "install.sh", *arguments],
        cwd=folder.parent,
        env={"PATH": "/usr/bin:/bin", "PYTHON": sys.executable, "PIP_CONFIG_FILE": "/dev/null", **variables},
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.fixture(scope="module")
def unpacked(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of an unpacked bundle."""
    folder = tmp_path_factory.mktemp("bundle")
    (folder / "wheels").mkdir()
    entry = "fleet_map_server-1.0.dist-info/entry_points.txt"
    program = {"fleet_program.py": PROGRAM, entry: "[console_scripts]\nfleetmap = fleet_program:main\n"}
    write_wheel(folder / "wheels", "fleet_map_server", program)
    write_wheel(folder / "wheels", "offline_part", {"offline_part.py": 'NAME = "fleetmap 1.0"\n'})
    assert "no wheel of pip" in bundle(folder).stderr
    shutil.copy(pip_wheel(), folder / "wheels")
    done = bundle(folder)
    assert done.returncode == 0, done.stderr
    assert "no container images in the bundle: no engine answers (docker info, podman info)" in done.stdout
    (archive,) = folder.glob("*.tar")
    assert archive.name == f"fleet-map-server-1.0-server-linux-{platform.machine()}-python{PYTHON}.tar"
    subprocess.run(["sha256sum", "--check", f"{archive}.sha256"], cwd=folder, check=True, capture_output=True)
    before = archive.read_bytes()
    assert bundle(folder).returncode == 0
    assert archive.read_bytes() == before, "it is the same each time"
    subprocess.run(["tar", "-xf", archive], cwd=folder, check=True)
    return folder / archive.name.removesuffix(".tar")


def test_bundle_installs_without_index_and_again(unpacked: Path, tmp_path: Path) -> None:
    done = install(unpacked, "target")
    assert done.returncode == 0, done.stderr
    target = unpacked.parent / "target"
    assert done.stdout.splitlines() == ["fleetmap 1.0", f"installed: {target}/current/bin/fleetmap"]
    assert (target / "current").readlink() == Path("1.0")
    program = subprocess.run([target / "current/bin/fleetmap"], capture_output=True, text=True, check=True)
    assert program.stdout == "fleetmap 1.0\n"


def test_bundle_has_what_containers_need(unpacked: Path, tmp_path: Path) -> None:
    assert not list(unpacked.rglob("__pycache__"))
    assert not (unpacked / "docker" / "secrets").exists()
    done = subprocess.run(
        [sys.executable, "-I", "-S", unpacked / "docker" / "make_secrets.py", tmp_path / "s", "--robot", "tractor-7"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "s" / "router.json5").is_file()


def test_installer_refuses_other_machines_and_damage(unpacked: Path, tmp_path: Path) -> None:
    script = unpacked / "install.sh"
    original = script.read_text()
    sums = (unpacked / "SHA256SUMS").read_text()
    for name, reason in (("PROCESSOR", "this bundle is for Linux/other"), ("PYTHON_VERSION", "is for Python other")):
        changed = "\n".join(f"{name}=other" if line.startswith(f"{name}=") else line for line in original.splitlines())
        script.write_text(changed)
        (unpacked / "SHA256SUMS").write_text(
            "".join(f"{line}\n" for line in sums.splitlines() if "install.sh" not in line)
        )
        refused = install(unpacked, str(tmp_path / "target"))
        assert refused.returncode != 0
        assert reason in refused.stderr
        assert "make bundle" in refused.stderr
    script.write_text(original)
    (unpacked / "SHA256SUMS").write_text(sums)
    wheel = next((unpacked / "wheels").glob("offline*"))
    content = wheel.read_bytes()
    wheel.write_bytes(content[:-1] + b"x")
    refused = install(unpacked, str(tmp_path / "target"))
    wheel.write_bytes(content)
    assert refused.returncode != 0
    assert "the bundle is damaged" in refused.stderr
    assert f"{wheel.name}: FAILED" in refused.stdout
    assert not (tmp_path / "target").exists()


def test_bundle_has_the_images_of_the_compose_file_if_there_is_an_engine(unpacked: Path, tmp_path: Path) -> None:
    engine = tmp_path / "docker"
    engine.write_text(ENGINE)
    engine.chmod(0o755)
    (tmp_path / "wheels").symlink_to(unpacked / "wheels")
    done = bundle(tmp_path, "--processor", "aarch64", path=f"{tmp_path}:/bin:/usr/bin")
    assert done.returncode == 0, done.stderr
    calls = (tmp_path / "calls").read_text().splitlines()
    assert "pull --quiet --platform linux/arm64 eclipse/zenoh:1.10.2" in calls
    assert any(call.startswith("build --quiet --platform linux/arm64 --file docker/Dockerfile") for call in calls)
    saved = calls[-1].split()
    assert saved[:2] == ["save", "--output"]
    compose = (TOP / "docker" / "compose.yaml").read_text()
    assert all(f"image: {image}" in compose for image in saved[3:])
    assert len(saved[3:]) == 7 - 1, "proxy, router, server, database, Prometheus and Grafana"
    (archive,) = tmp_path.glob("*aarch64*.tar")
    with tarfile.open(archive) as tar:
        assert tar.extractfile(f"{archive.name.removesuffix('.tar')}/images.tar").read() == b"images\n"


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        (["--python", "3.10"], "the server requires Python 3.11 or newer"),
        (["--python", "311"], "must be a version such as 3.11"),
        (["--processor", "z80"], "invalid choice"),
    ],
)
def test_bundle_refuses_wrong_options(tmp_path: Path, options: list[str], reason: str) -> None:
    refused = bundle(tmp_path, *options)
    assert refused.returncode != 0
    assert reason in refused.stderr


def test_bundle_needs_this_projects_wheel(tmp_path: Path) -> None:
    refused = bundle(tmp_path, "--no-images")
    assert refused.returncode != 0
    assert "no wheel of fleet-map-server" in refused.stderr
    assert not list(tmp_path.glob("*.tar"))
