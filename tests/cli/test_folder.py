"""What is taken of a folder, and what an environment made from it is called."""

from __future__ import annotations

from pathlib import Path

import pytest

from app.cli import folder
from app.errors import Invalid


def put(root: Path, *names: str) -> None:
    for name in names:
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(name)


def names(content: folder.UploadFolder) -> list[str]:
    return [f.name for f in content.files]


@pytest.fixture
def template(tmp_path: Path) -> Path:
    root = tmp_path / "Farm North (2)"
    put(root, "config/location/datum.yaml", "config/metric/map/map.yaml", "config/properties.sh", "environment.sh")
    put(root, "README.md", "package.xml", ".git/config", "config/.git/HEAD", "launch/all.launch.py")
    return root


def test_template_folder_yields_only_config_and_scripts(template: Path) -> None:
    content = folder.collect(template)
    assert content.is_template
    assert names(content) == [
        "config/location/datum.yaml",
        "config/metric/map/map.yaml",
        "config/properties.sh",
        "environment.sh",
    ]


def test_config_folder_yields_same_names(template: Path) -> None:
    assert names(folder.collect(template / "config")) == names(folder.collect(template))
    assert folder.collect(template / "config").root == template


def test_other_folder_yields_all_files_without_version_control(tmp_path: Path) -> None:
    put(tmp_path, "building.yaml", "plans/office.png", ".git/HEAD", "config/robot.yaml")
    content = folder.collect(tmp_path)
    assert not content.is_template
    assert names(content) == ["building.yaml", "config/robot.yaml", "plans/office.png"]


def test_links_out_of_folder_are_skipped_and_reported(template: Path, tmp_path: Path) -> None:
    (tmp_path / "secret").write_text("not for the server")
    (template / "config/world").mkdir()
    (template / "config/world/linked.kml").symlink_to(tmp_path / "secret")
    (template / "config/world/inner.yaml").symlink_to(template / "config/location/datum.yaml")
    (template / "config/world/loop").symlink_to(template / "config")
    (template / "config/world/dangling").symlink_to(template / "nothing")
    content = folder.collect(template)
    assert "config/world/inner.yaml" in names(content)
    assert "config/world/linked.kml" not in names(content)
    notes = " ".join(content.notes)
    assert "linked.kml" in notes
    assert "loop" in notes
    assert "dangling" in notes


def test_folder_without_files_is_reported(tmp_path: Path) -> None:
    put(tmp_path, ".git/HEAD")
    with pytest.raises(Invalid, match="no files"):
        folder.collect(tmp_path)


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("Farm North (2)", "farm-north-2"),
        ("riseholme_park", "riseholme_park"),
        ("-x-", "x"),
        ("a" * 80, "a" * 63),
        ("Größe.v2", "gr-e-v2"),
    ],
)
def test_environment_name_is_derived_from_folder_name(text: str, name: str) -> None:
    assert folder.environment_name(text) == name


@pytest.mark.parametrize("text", ["", "...", "robots", "Server", "日本"])
def test_unusable_folder_name_requires_environment_option(text: str) -> None:
    with pytest.raises(Invalid, match="--environment"):
        folder.environment_name(text)


def test_copied_names_and_folders_match_server() -> None:
    from app import upload_reader
    from app.store import base

    assert folder.PARTS == upload_reader.TEMPLATE_FOLDERS
    assert folder.NAME.pattern == base.ENVIRONMENT_NAME.pattern
    assert folder.RESERVED == base.RESERVED
