"""Create a bundle that installs the server, or a robot's agent, on a machine without internet (``make bundle``).

It has the wheels of uv.lock for one platform and Python, the files of ``docker/``, the container images if there is an
engine, checksums of all of it, and ``install.sh``, which checks them and installs. This machine needs the network.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import platform
import re
import shutil
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path

TOP = Path(__file__).resolve().parents[1]
BIN = Path(sys.executable).parent
PROJECT = "fleet-map-server"
PROCESSORS = {"x86_64": "linux/amd64", "aarch64": "linux/arm64"}
"""Processors, and their names in container images."""
GLIBC = range(28, 4, -1)
"""Wheels may need glibc up to this minor version: 2.28 is in Debian 10 and Ubuntu 20.04."""
FILES = (
    "docker",
    "app/errors.py",
    "app/__init__.py",
    "app/event_types.py",
    "app/events",
    "app/model",
    "LICENSE",
    "CHANGELOG.md",
)
"""Of this checkout: what the compose files and make_secrets.py need beside the images."""
OWN_IMAGES = {"fleet-map-server": "docker/Dockerfile", "fleet-map-database": "docker/database.Dockerfile"}
ENGINES = ("docker", "podman")
SUMS = "SHA256SUMS"


def main() -> None:
    """Run as a command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=TOP / "build", help="folder of the bundle [default: build]")
    parser.add_argument("--processor", choices=PROCESSORS, default=platform.machine(), help="[default: this machine's]")
    default = f"{sys.version_info.major}.{sys.version_info.minor}"
    parser.add_argument("--python", default=default, metavar="3.N", help=f"Python of the target [default: {default}]")
    parser.add_argument("--robot", action="store_true", help="only what a robot needs: the agent")
    parser.add_argument("--wheels", type=Path, help="folder of wheels to take instead of downloading them")
    parser.add_argument("--no-images", action="store_true", help="without container images")
    options = parser.parse_args()
    if not re.fullmatch(r"3\.\d+", options.python):
        parser.error(f"--python {options.python[:20]!r}: must be a version such as 3.11")
    if not options.robot and int(options.python[2:]) < 11:
        parser.error(f"--python {options.python}: the server requires Python 3.11 or newer; --robot also runs on 3.10")
    options.output.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=options.output) as temporary:
        folder = Path(temporary) / "bundle"
        wheels = folder / "wheels"
        wheels.mkdir(parents=True)
        if options.wheels is None:
            download(wheels, options.processor, options.python, robot=options.robot)
        else:
            for wheel in options.wheels.glob("*.whl"):
                shutil.copy(wheel, wheels)
        version = write_requirements(folder, robot=options.robot)
        copy_files(folder)
        if not options.no_images and not options.robot:
            print(save_images(folder / "images.tar", PROCESSORS[options.processor]))
        fill_in_installer(folder / "install.sh", version, options.processor, options.python)
        write_sums(folder)
        kind = "robot" if options.robot else "server"
        name = f"{PROJECT}-{version}-{kind}-linux-{options.processor}-python{options.python}"
        archive = pack(folder, options.output / f"{name}.tar", name)
    print(f"{archive} ({archive.stat().st_size / 1e6:.0f} MB)")


def download(wheels: Path, processor: str, python: str, *, robot: bool) -> None:
    """Download the wheels of uv.lock by their hashes, and build this project's."""
    uv = shutil.which("uv", path=f"{BIN}:{os.environ['PATH']}")
    if uv is None:
        raise SystemExit("uv is missing: run this by `make bundle`")
    with tempfile.TemporaryDirectory() as temporary:
        locked, chosen = Path(temporary) / "locked.txt", Path(temporary) / "chosen.txt"
        plain = ["--no-header", "--no-annotate", "--quiet"]
        extra = [] if robot else ["--extra", "server"]
        run(uv, "export", "--frozen", "--no-dev", "--no-emit-project", *extra, *plain, "--output-file", str(locked))
        target = ["--python-platform", f"{processor}-manylinux_2_{GLIBC[0]}", "--python-version", python]
        run(
            *(uv, "pip", "compile", str(locked), "--no-deps", "--generate-hashes", *target, *plain),
            *("--output-file", str(chosen)),
        )
        tags = [f"manylinux_2_{minor}_{processor}" for minor in GLIBC] + [f"manylinux2014_{processor}"]
        platforms = [option for tag in tags for option in ("--platform", tag)]
        abis = ["--abi", f"cp{python.replace('.', '')}", "--abi", "abi3", "--abi", "none"]
        fetch = (sys.executable, "-m", "pip", "download", "-qq", "--no-deps", "--only-binary", ":all:")
        fetch += ("--dest", str(wheels), "--python-version", python)
        run(*fetch, "--implementation", "cp", *platforms, *abis, "--require-hashes", "--requirement", str(chosen))
        run(*fetch, "pip")  # the installer's: Debian's Python has none
    run(uv, "build", "--wheel", "--quiet", "--out-dir", str(wheels), str(TOP))
    (wheels / ".gitignore").unlink(missing_ok=True)


def run(*command: str) -> str:
    """Run a command in the checkout and return what it printed; ends this program if it fails."""
    done = subprocess.run(  # noqa: S603  constants and options
        command, cwd=TOP, stdout=subprocess.PIPE, text=True, check=False, env={**os.environ, "UV_SYSTEM_CERTS": "true"}
    )
    if done.returncode:
        raise SystemExit(f"{' '.join(command[:3])} failed (see above): the bundle needs the network")
    return done.stdout


def write_requirements(folder: Path, *, robot: bool) -> str:
    """Write requirements.txt with the wheels and their hashes; return this project's version."""
    lines, version = [], ""
    for wheel in sorted((folder / "wheels").glob("*.whl")):
        name, number = wheel.name.split("-")[:2]
        if name == "pip":
            continue
        if name.replace("_", "-").lower() == PROJECT:
            version = number
        lines.append(f"{name}=={number} --hash=sha256:{sha256(wheel)}\n")
    if not version or not list((folder / "wheels").glob("pip-*.whl")):
        raise SystemExit(f"no wheel of {'pip' if version else PROJECT} among {len(lines)} wheels")
    title = "a robot's agent" if robot else "the server"
    (folder / "requirements.txt").write_text(f"# Packages of {title}, each with its hash.\n{''.join(lines)}")
    return version


def copy_files(folder: Path) -> None:
    """Copy what the containers need, without secrets and settings of this machine, and the installer."""
    ignored = shutil.ignore_patterns("__pycache__", "secrets", ".env", "server.env", "compose.override.yaml")
    for name in FILES:
        source, target = TOP / name, folder / name
        target.parent.mkdir(parents=True, exist_ok=True)
        if source.is_dir():
            shutil.copytree(source, target, ignore=ignored)
        else:
            shutil.copy(source, target)
    shutil.copy(TOP / "docker" / "install.sh", folder / "install.sh")


def images() -> list[str]:
    """Images of compose.yaml."""
    text = (TOP / "docker" / "compose.yaml").read_text()
    return sorted(set(re.findall(r"^\s+image: (\S+)", text, re.MULTILINE)))


def save_images(path: Path, target: str) -> str:
    """Save all images of compose.yaml for a platform into a file, if there is an engine; return what was done."""
    for engine in ENGINES:
        program = shutil.which(engine)
        if program and subprocess.run([program, "info"], capture_output=True, check=False).returncode == 0:  # noqa: S603
            break
    else:
        return f"no container images in the bundle: no engine answers ({' info, '.join(ENGINES)} info)"
    for image in images():
        file = OWN_IMAGES.get(image.partition(":")[0])
        if file is None:
            run(program, "pull", "--quiet", "--platform", target, image)
        else:
            run(program, "build", "--quiet", "--platform", target, "--file", file, "--tag", image, ".")
    run(program, "save", "--output", str(path), *images())
    return f"container images: {', '.join(images())}"


def fill_in_installer(path: Path, version: str, processor: str, python: str) -> None:
    """Write into install.sh what the bundle is for."""
    values = {"VERSION": version, "PROCESSOR": processor, "PYTHON_VERSION": python}
    text = path.read_text()
    for name, value in values.items():
        text = re.sub(rf"^{name}=.*$", f"{name}={value}", text, count=1, flags=re.MULTILINE)
    path.write_text(text)
    path.chmod(0o755)


def write_sums(folder: Path) -> None:
    """Write SHA256SUMS, in the form of sha256sum."""
    paths = sorted(path for path in folder.rglob("*") if path.is_file())
    lines = [f"{sha256(path)}  {path.relative_to(folder)}\n" for path in paths]
    (folder / SUMS).write_text("".join(lines))


def sha256(path: Path) -> str:
    """Return a file's SHA-256 in hexadecimal digits."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def pack(folder: Path, archive: Path, name: str) -> Path:
    """Pack the folder as ``name/``, with the same bytes each time, and its checksum beside it."""

    def plain(member: tarfile.TarInfo) -> tarfile.TarInfo:
        member.mtime, member.uid, member.gid, member.uname, member.gname = 0, 0, 0, "root", "root"
        return member

    temporary = archive.with_suffix(".part")
    with tarfile.open(temporary, "w") as tar:  # wheels are compressed
        tar.add(folder, name, recursive=False, filter=plain)
        for path in sorted(folder.rglob("*")):
            tar.add(path, f"{name}/{path.relative_to(folder)}", recursive=False, filter=plain)
    temporary.replace(archive)
    Path(f"{archive}.sha256").write_text(f"{sha256(archive)}  {archive.name}\n")
    return archive


if __name__ == "__main__":
    main()
