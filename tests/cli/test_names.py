"""Mistyped names: what is proposed, and what is not created or left behind."""

from __future__ import annotations

from pathlib import Path

import pytest

from app.cli.created import slip
from app.model.names import did_you_mean, nearest
from tests.cli.conftest import Fleetmap
from tests.cli.test_commands import NETWORK

EXISTING = ("farm-7", "north-field", "hall-a", "riseholme_vineyard")


@pytest.fixture
def network(tmp_path: Path) -> Path:
    path = tmp_path / "network.tmap2.yaml"
    path.write_text(NETWORK.format(x="1.0"))
    return path


@pytest.mark.parametrize(
    ("name", "meant"),
    [
        ("fram-7", "farm-7"),
        ("farm7", "farm-7"),
        ("farms-7", "farm-7"),
        ("nort-field", "north-field"),
        ("riseholm_vinyard", "riseholme_vineyard"),
        ("farm-8", None),
        ("farm-77", None),
        ("hall-b", None),
        ("hall", None),
        ("south-field", None),
        ("riseholme_orchard", None),
        ("barn", None),
    ],
)
def test_slip_distinguishes_misspelling_from_sibling(name: str, meant: str | None) -> None:
    assert slip(name, EXISTING) == meant


def test_nearest_name_ignores_case() -> None:
    assert nearest("FRAM-7", ["farm-7", "orchard"]) == "farm-7"
    assert did_you_mean("tmpa2", ["tmap2", "kml"]) == " (did you mean tmap2?)"
    assert did_you_mean("zzz", ["tmap2", "kml"]) == ""


def test_unknown_names_get_a_proposal(fleetmap: Fleetmap, network: Path) -> None:
    assert fleetmap("import", network, "-e", "proposals", "--create").status == 0
    assert fleetmap("promote", "proposals", "1").status == 0
    for arguments, proposal in (
        (("versions", "propsals"), "Did you mean proposals?"),
        (("export", "propsals", "tmap2"), "Did you mean proposals?"),
        (("export", "proposals", "tmpa2"), "did you mean tmap2?"),
        (("export", "proposals", "tmap2", "-V", "prodution"), "did you mean production?"),
        (("export", "proposals", "tmap2", "-O", "verts_radus=1"), "did you mean verts_radius?"),
        (("channels", "show", "proposals", "prodution"), "did you mean production?"),
        (("import", network, "-e", "proposals", "--layer", "topolgy"), "did you mean topology?"),
        (("generate", "orchrd", "-e", "proposals"), "did you mean orchard?"),
        (("generate", "orchard", "-e", "proposals", "-O", "rws=3"), "did you mean rows?"),
        (("derive", "proposals", "objects_to_topolgy"), "did you mean objects_to_topology?"),
        (("template", "proposals", "--set", "outdor"), "did you mean outdoor?"),
        (("convert", network, "--to", "kmll", "-o", "-"), "did you mean kml?"),
        (("formats", "tmpa2"), "did you mean tmap2?"),
    ):
        result = fleetmap(*arguments)
        assert result.status == 1, arguments
        assert proposal in result.err, (arguments, result.err)
    for arguments, proposal in (
        (("frmats",), "unknown command frmats (did you mean formats?)"),
        (("convrt",), "unknown command convrt (did you mean convert?)"),
        (("zzz",), "unknown command zzz"),
        (("overlays", "acept", "proposals", "1"), "unknown command acept (did you mean accept?)"),
        (("formats", "--jsn"), "unknown option --jsn (did you mean --json?)"),
        (("check", "--jsn=1", "x"), "unknown option --jsn (did you mean --json?)"),
        (("--versoin",), "unknown option --versoin (did you mean --version?)"),
        (("formats", "-z"), "unknown option -z"),
        (("overlays", "list", "proposals", "--state", "pendng"), "did you mean pending?"),
        (("jobs", "list", "--state", "rnning"), "did you mean running?"),
        (("token", "create", "x", "--role", "edtor"), "did you mean editor?"),
    ):
        result = fleetmap(*arguments)
        assert result.status == 2, arguments
        assert proposal in " ".join(result.err.split()), (arguments, result.err)


def test_misspelled_environment_requires_create(fleetmap: Fleetmap, network: Path) -> None:
    assert fleetmap("import", network, "-e", "meadow-7").status == 0
    for command in (("import", network), ("generate", "cave")):
        refused = fleetmap(*command, "-e", "medaow-7")
        assert (refused.status, refused.out) == (1, "")
        assert "did you mean meadow-7?" in refused.err
        assert "--create" in refused.err
    absent = fleetmap("import", network, "-e", "meadow-8", "--no-create")
    assert absent.status == 1
    assert "unknown environment" in absent.err
    assert fleetmap("import", network, "-e", "meadow-8").status == 0, "a sibling is no slip"
    assert fleetmap("import", network, "-e", "medaow-7", "--create").status == 0


def test_failed_command_removes_new_environment(fleetmap: Fleetmap, tmp_path: Path) -> None:
    bad = tmp_path / "bad.tmap2.yaml"
    bad.write_text("meta: {}\nnodes:\n- node: {name: A\n")
    for command in (("import", bad), ("generate", "no-such-site"), ("generate", "orchard", "-O", "rows=-1")):
        assert fleetmap(*command, "-e", "stillborn", "--datum", "53.2,-0.5").status == 1
        assert "stillborn" not in fleetmap("environment", "list").out
        assert "stillborn" not in fleetmap("environment", "list", "--deleted").out
    assert fleetmap("environment", "create", "stillborn").status == 0, "the name is free"


def test_failed_command_resets_new_datum(fleetmap: Fleetmap, network: Path, tmp_path: Path) -> None:
    bad = tmp_path / "bad.tmap2.yaml"
    bad.write_text("meta: {}\nnodes:\n- node: {name: A\n")
    assert fleetmap("import", network, "-e", "moved").status == 0
    before = fleetmap("environment", "show", "moved", "--json").json
    assert fleetmap("import", bad, "-e", "moved", "--datum", "53.2,-0.5").status == 1
    after = fleetmap("environment", "show", "moved", "--json").json
    assert (after["datum"], after["root"]) == (before["datum"], before["root"])
    assert "reset the datum" in fleetmap("versions", "moved").out
