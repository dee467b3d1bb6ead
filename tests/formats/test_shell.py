"""Shell variables: literals with the values of a real shell, nothing that needs execution, and bounded effort."""

from __future__ import annotations

import random
import shutil
import subprocess
import time
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.errors import TooLarge, UnreadableFile
from app.syntax import shell

TEMPLATE = b"""#!/bin/bash
# HEADER: export HIDDEN='no'
__filename=$(realpath "${BASH_SOURCE:-$0}")
__dirname=$(dirname "$__filename")

export COMMON_RELEASE='v1.0.1'
if [ -f "$__dirname/properties.sh" ] ; then
  source "$__dirname/properties.sh"
  export PROPERTIES_FILE='set'
fi
if [[ -f $__dirname/location/datum.yaml ]]; then
    export DATUM_FILE="$__dirname/location/datum.yaml"
else
    export DATUM_FILE="$__dirname/location/datum_autogen.yaml"
fi
for f in a b; do export LOOPED=$f; done
show () {
  export INSIDE='function'
}
case "$1" in
  a) export CASED='a' ;;
esac
export FIELD_NAME="east \\"path\\""  # a comment
export FIELD_ID=p1
"""


def values(text: str | bytes) -> dict[str, str]:
    return shell.assignments(text.encode() if isinstance(text, str) else text)[0]


def test_only_unconditional_literals_are_read() -> None:
    variables, warnings = shell.assignments(TEMPLATE)
    assert variables == {"COMMON_RELEASE": "v1.0.1", "FIELD_NAME": 'east "path"', "FIELD_ID": "p1"}
    text = "\n".join(warnings)
    for name in ("DATUM_FILE", "LOOPED", "INSIDE", "CASED", "PROPERTIES_FILE", "__dirname"):
        assert f"{name} is skipped" in text
    assert "line 9: PROPERTIES_FILE" in text
    assert "HIDDEN" not in text


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("export A='x y'", {"A": "x y"}),
        ('export A="x y"\n', {"A": "x y"}),
        ("A=x", {"A": "x"}),
        ("  export\tA=x  # said\nB=y", {"A": "x", "B": "y"}),
        ("export A=1 B='2 3' C", {"A": "1", "B": "2 3"}),
        ("export A='it'\\''s'", {"A": "it's"}),
        ("A=a\\ b\\$c", {"A": "a b$c"}),
        ("A=a\\", {}),
        ("export A='a'\"b\"c", {"A": "abc"}),
        ("export A=''", {"A": ""}),
        ("export A=", {"A": ""}),
        ("export A=https://example.org/a,b", {"A": "https://example.org/a,b"}),
        ("export A='$HOME `id` $(id)'", {"A": "$HOME `id` $(id)"}),
        ('export A="\\$5 \\\\ \\x"', {"A": "$5 \\ \\x"}),
        ("export A='größer'", {"A": "größer"}),
        ("export A='1'\r\nexport B='2'\r\n", {"A": "1", "B": "2"}),
        ("\ufeffexport A=1", {"A": "1"}),
        ("A=1\nA=2", {"A": "2"}),
        ("A=1\nA=$B", {}),
        ("A=1\nA+=2", {}),
        ("A=1\nunset A", {}),
        ("A=1\nread A", {}),
        ("A=1\nif true; then A=2; fi", {}),
        ("A=$(id)", {}),
        ("A=`id`", {}),
        ('A="$(id)"', {}),
        ("A=1; id", {}),
        ("A=1 id", {}),
        ("A=1 && B=2", {}),
        ("A=~/x", {}),
        ("A=1#x", {}),
        ("A=a*", {}),
        ("A=(1 2)", {}),
        ("A=<(id)", {}),
        ("A='1", {}),
        ("A='1\nB=2\n'\nC=3", {"C": "3"}),
        ("cat <<EOF\nA=1\nEOF\nB=2", {"B": "2"}),
        ("cat <<-'EOF'\nA=1\n\tEOF\nB=2", {"B": "2"}),
        ("read X Y <<< 'hello world'\nB=2", {"B": "2"}),
        ("cat <<<EOF\nB=2\nEOF\nC=3", {"B": "2", "C": "3"}),
        ("(( FLAGS = 1<<4 ))\nB=2", {"B": "2"}),
        ("N=$(( (1 << 3) + 2 ))\nB=2", {"B": "2"}),
        ("N=$((1<<3)); cat <<EOF\nA=1\nEOF\nB=2", {"B": "2"}),
        ("((cat <<EOF) )\nA=1\nEOF\nB=2", {"B": "2"}),
        ("(( ((1<<2)) + 1 ))\nB=2", {"B": "2"}),
        ("(cat <<EOF)\nA=1\nEOF\nB=2", {"B": "2"}),
        ("echo \\\nA=1\nB=2", {"B": "2"}),
        ("f() {\nA=1\n}\nB=2", {"B": "2"}),
        ("f()\n{\nA=1\n}\nB=2", {"B": "2"}),
        ("A=1\nreturn\nB=2", {"A": "1"}),
        ("A=1\n[ -z $X ] && exit\nB=2", {"A": "1"}),
        ("if true; then\n if true; then\n A=1\n fi\n B=2\nfi\nC=3", {"C": "3"}),
        ("while read x; do\nA=1\ndone\nB=2", {"B": "2"}),
        ("echo 'if'\nA=1", {"A": "1"}),
        ("echo if then # if\nA=1", {"A": "1"}),
        ("1A=x\nA-B=x\nA =x\nA= x", {}),
        ("export A='\x07'", {}),
        ("export LD_PRELOAD='/tmp/x.so'\nexport PATH='/tmp'\nexport BASH_ENV=x\nexport A=1", {"A": "1"}),
        ("export GZ_SIM_SYSTEM_PLUGIN_PATH='/x'\nexport PYTHONSTARTUP='/x'\nexport https_proxy=x", {}),
        (
            "export ENVIRONMENT='e'\nexport NODE_NAME='n'\nexport PATHWAY='p'",
            {"ENVIRONMENT": "e", "NODE_NAME": "n", "PATHWAY": "p"},
        ),
        ("", {}),
        ("\n\n# nothing\n", {}),
    ],
)
def test_shell_lines_give_expected_values(text: str, expected: dict[str, str]) -> None:
    variables, warnings = shell.assignments(text.encode())
    assert variables == expected
    assert all("line" in w for w in warnings)


@pytest.mark.parametrize(
    "text", [t for (t,) in [(m,) for m in ("A=$(id)", "A=1; id", "id", "A='\x1b'", "PATH=x", "return\nA=1")]]
)
def test_skipped_assignments_are_reported(text: str) -> None:
    assert shell.assignments(text.encode())[1]


def test_a_here_document_without_an_end_is_reported() -> None:
    variables, warnings = shell.assignments(b"A=1\ncat <<EOF\nB=2\n")
    assert variables == {"A": "1"}
    assert "line 2: the here-document has no end mark EOF; the lines after it are skipped" in warnings


def test_literals_alone_need_no_warning() -> None:
    assert shell.assignments(b"#!/bin/sh\n\nexport A='1'\nexport B=\"2\" # two\n")[1] == []


def test_real_property_files(shared: Path, facts_json: dict[str, Any]) -> None:
    entries = {n: f for n, f in facts_json.items() if f["kind"] == "environment_variables"}
    assert len(entries) == 3
    for name, entry in entries.items():
        read, warnings = shell.assignments((shared / "data" / name).read_bytes())
        assert read == entry["facts"]["literal_assignments"], name
        assert warnings == []


def test_shell_reader_enforces_limits() -> None:
    with pytest.raises(TooLarge):
        shell.assignments(b"#" * (shell.MAX_BYTES + 1))
    with pytest.raises(UnreadableFile, match="not UTF-8"):
        shell.assignments(b"A='\xff'")
    many = "".join(f"A{i}=1\n" for i in range(3000))
    variables, warnings = shell.assignments(many.encode())
    assert len(variables) == shell.MAX_VARIABLES
    assert len(warnings) == shell.MAX_WARNINGS + 1
    assert values(f"A={'x' * (shell.MAX_VALUE + 1)}") == {}


HOSTILE = [
    "<<a ",
    "A=1 ",
    "'",
    '"',
    "\\",
    "{\n",
    "if ",
    "A='x'\"y\"",
    "<<a\na\n",
    "((1<<a",
    "$(",
    "export A=1;",
    "#",
    "A=",
    "\n",
    "  ",
]


@pytest.mark.parametrize("piece", HOSTILE)
def test_hostile_repetition_is_quick(piece: str) -> None:
    started = time.process_time()
    shell.assignments((piece * (2**17 // len(piece))).encode())
    assert time.process_time() - started < 10  # a quadratic scan of 128 KiB takes minutes, ours a second at most


@given(st.binary(max_size=200))
def test_any_bytes_are_parsed_without_error(data: bytes) -> None:
    try:
        variables, _ = shell.assignments(data)
    except UnreadableFile:
        return
    assert all(name.isidentifier() for name in variables)


PIECES = ["A=", "B=", "C", "export ", "'", '"', "\\", "$x", "`", ";", " ", "\n", "#", "x", "1", "é", "\t"]
PIECES += ["if true\n", "then ", "fi\n", "{ ", "}\n"]
BASH = shutil.which("bash") or ""


@pytest.mark.skipif(not BASH, reason="bash is absent")
def test_values_match_real_shell(tmp_path: Path) -> None:
    """Values read from random scripts equal bash's (the script pieces form no harmful command)."""
    dice, checked = random.Random(3), 0
    scripts = ["".join(dice.choice(PIECES) for _ in range(dice.randrange(2, 14))) for _ in range(4000)]
    scripts = [s for s in scripts if values(s)]
    report = 'printf \'%s\\0\' "${A-unset}" "${B-unset}"\n'
    for number, script in enumerate(scripts[:250]):
        file = tmp_path / f"{number}.sh"
        file.write_text(script)
        bash = [BASH, "--norc", "-c", f". {file} >/dev/null 2>&1; {report}"]
        ran = subprocess.run(bash, capture_output=True, check=False, env={"LC_ALL": "C.UTF-8", "PATH": "/nonexistent"})
        a, b, *_ = ran.stdout.decode("utf-8", "replace").split("\0")
        for name, value in values(script).items():
            if name in "AB" and {"A": a, "B": b}[name] != "unset":
                assert {"A": a, "B": b}[name] == value, script
                checked += 1
    assert checked > 100


@given(
    st.dictionaries(
        st.sampled_from(["A", "B_1", "FIELD_NAME"]), st.text(st.characters(categories=["L", "N", "P", "S", "Zs"]))
    )
)
def test_exports_read_back(wanted: dict[str, str]) -> None:
    text = {name: value for name, value in wanted.items() if value.isprintable()}
    assert shell.assignments(shell.exports(text)) == (text, [])


@pytest.mark.skipif(not BASH, reason="bash is absent")
def test_exports_match_real_shell() -> None:
    value = 'it\'s $HOME `id` "x" \\ ; é #'
    script = shell.exports({"A": value}).decode() + 'printf %s "$A"'
    ran = subprocess.run([BASH, "--norc", "-c", script], capture_output=True, check=True)
    assert ran.stdout.decode() == value


@pytest.mark.parametrize(
    ("name", "value"), [("A;id", "1"), ("1A", "x"), ("", "x"), ("A", "x\ny"), ("PATH", "x"), ("A\n", "x")]
)
def test_exports_rejects_invalid_names_and_values(name: str, value: str) -> None:
    with pytest.raises(ValueError, match="cannot be exported"):
        shell.exports({name: value})


CONTROLLING = """
OPENSSL_CONF OPENSSL_MODULES SSL_CERT_FILE CURL_CA_BUNDLE REQUESTS_CA_BUNDLE CURL_HOME HOSTALIASES RES_OPTIONS
ROS_MASTER_URI ROS_DOMAIN_ID ROS_DISCOVERY_SERVER ROS_SECURITY_ENABLE ROS_PACKAGE_PATH ROSCONSOLE_CONFIG_FILE
RMW_IMPLEMENTATION ZENOH_CONFIG_OVERRIDE ZENOH_SESSION_CONFIG_URI CYCLONEDDS_URI FASTDDS_DEFAULT_PROFILES_FILE
FASTRTPS_DEFAULT_PROFILES_FILE GAZEBO_MASTER_URI GAZEBO_MODEL_DATABASE_URI GAZEBO_RESOURCE_PATH GZ_CONFIG_PATH GZ_IP
LESSOPEN LESSCLOSE GTK_MODULES GIO_EXTRA_MODULES GDK_PIXBUF_MODULE_FILE QT_QPA_PLATFORMTHEME QML2_IMPORT_PATH
VK_LAYER_PATH LIBGL_DRIVERS_PATH XDG_CONFIG_HOME DOCKER_HOST NUMBA_CACHE_DIR TMOUT LD_PRELOAD PATH
"""

OF_PLACES = """
FARM_NAME FIELD_NAME FIELD_ID FIELD_TYPE ENVIRONMENT_ORIGINS ENVIRONMENT_COMMON_LATEST_RELEASE LOCALISATION_ZONE WORLD
ROSE_GARDEN QTY LESSON GAZEBO_WORLD_FILE GAZEBO_CUSTOM_MODELS GAZEBO_MODEL_PATH ROBOT_NAME
"""


def test_variables_that_control_programs_and_ros_are_not_exported() -> None:
    names = CONTROLLING.split()
    variables, warnings = shell.assignments("".join(f"{name}='x'\n" for name in names).encode())
    assert (variables, len(warnings)) == ({}, len(names))
    for name in names:
        with pytest.raises(ValueError, match="controls how programs run"):
            shell.exports({name: "x"})


def test_variables_of_places_are_exported() -> None:
    wanted = dict.fromkeys(OF_PLACES.split(), "x")
    assert shell.assignments(shell.exports(wanted)) == (wanted, [])
