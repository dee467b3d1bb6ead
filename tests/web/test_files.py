"""Files of the page: headers that confine it, compression, and that a wheel brings it."""

from __future__ import annotations

import re
import subprocess
import sys
import zipfile
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest

from tests.web.conftest import WebServer

TOP = Path(__file__).resolve().parents[2]
MAX_FIRST_VIEW_BYTES = 250_000
MAX_ALL_BYTES = 450_000


@pytest.fixture
def anyone(server: WebServer) -> Iterator[httpx.Client]:
    with httpx.Client(base_url=server.address) as http:
        yield http


def test_policy_allows_this_server_only(anyone: httpx.Client) -> None:
    answer = anyone.get("/")
    assert answer.status_code == 200
    policy = dict(part.split(" ", 1) for part in answer.headers["content-security-policy"].split("; "))
    assert policy["default-src"] == policy["frame-ancestors"] == policy["base-uri"] == "'none'"
    assert policy["script-src"] == policy["style-src"] == policy["connect-src"] == "'self'"
    assert "unsafe" not in answer.headers["content-security-policy"]
    assert not re.search(r"<script(?![^>]*src=)|<style|\son\w+=|style=", answer.text)


def test_files_are_compressed_and_small(anyone: httpx.Client) -> None:
    front = anyone.get("/").text
    names = set(re.findall(r"/assets/[\w.-]+", front))
    first = sum(int(anyone.get(name).headers["content-length"]) for name in names)
    folder = TOP / "app" / "web" / "dist" / "assets"
    everything = sum(int(anyone.get(f"/assets/{path.name}").headers["content-length"]) for path in folder.iterdir())
    assert names
    assert first <= MAX_FIRST_VIEW_BYTES
    assert everything <= MAX_ALL_BYTES


def test_files_with_a_hash_are_cached_forever(anyone: httpx.Client) -> None:
    name = re.findall(r"/assets/[\w.-]+\.js", anyone.get("/").text)[0]
    answer = anyone.get(name)
    assert "immutable" in answer.headers["cache-control"]
    assert answer.headers["content-type"].startswith("text/javascript")
    assert anyone.get(name, headers={"if-none-match": answer.headers["etag"]}).status_code == 304
    assert "immutable" not in anyone.get("/").headers["cache-control"]


@pytest.mark.parametrize("path", ["/assets/..%2f..%2f..%2fauth.py", "/assets/none.js", "/assets/.sources"])
def test_other_files_are_not_served(anyone: httpx.Client, path: str) -> None:
    assert anyone.get(path).status_code == 404


def test_wheel_and_sdist_contain_the_built_page_only(tmp_path: Path) -> None:
    subprocess.run(
        [sys.executable, "-m", "pip", "wheel", "--no-deps", "-q", "-w", str(tmp_path), "."],
        cwd=TOP,
        check=True,
        capture_output=True,
    )
    with zipfile.ZipFile(next(tmp_path.glob("*.whl"))) as wheel:
        names = [name for name in wheel.namelist() if name.startswith("app/web/")]
    assert "app/web/dist/index.html" in names
    assert all(name.startswith("app/web/dist/") for name in names)
