"""Read variables of environment.sh and properties.sh without running them.

Robots source these files. Only assignments of a literal (``export NAME='value'``, ``"value"`` or a bare word) that the
shell executes on every run are read. Everything that only a shell can evaluate is skipped with a warning: expansions,
substitutions, conditions, functions, chained commands. Names that change which programs run are skipped, too, since
robots get the variables.
"""

from __future__ import annotations

import re
from collections.abc import Mapping

from app.dangerous_variables import DANGEROUS_VARIABLE
from app.errors import Problem, TooLarge, UnreadableFile
from app.model.frame import is_writable

MAX_BYTES = 2**20
MAX_VARIABLES = 1000
MAX_VALUE = 32 * 2**10
MAX_WARNINGS = 100

OF_FILES = frozenset(
    {
        "BASH_SOURCE",
        "CONFIG_DIR",
        "CONF",
        "PROPERTIES_FILE",
        "DATUM_FILE",
        "TMAP_FILE",
        "POI_FILE",
        "GAZEBO_WORLD_FILE",
        "GAZEBO_CUSTOM_MODELS",
        "GAZEBO_MODEL_PATH",
        "COSTMAP_YAML_FILE",
        "NOGO_COSTMAP_YAML_FILE",
    }
)
"""Variables of the template with paths of its files. Source: environment_template and environment_common."""

_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]{0,127}(?![A-Za-z0-9_])")
_EXPORT = re.compile(r"export(?=[ \t])")
_BLANK = re.compile(r"[ \t]*")
_SINGLE = re.compile(r"'([^'\n]*)'")
_DOUBLE = re.compile(r'"((?>(?:[^"\\$`\n]|\\[^\n])*))"')
_BARE = re.compile(r"[^\s'\"\\$`;&|<>(){}*?\[\]~#!\x00-\x1f]+")
_ESCAPE = re.compile(r"\\([^\n])")
_ESCAPED = re.compile(r'\\(["\\$`])')
_NOTHING = re.compile(r"[ \t]*(?:#[^\n]*)?(?:\n|\Z)")
_END = re.compile(r"(?:[ \t]+#[^\n]*|[ \t]*)(?:\n|\Z)")
_NEXT = re.compile(r"[ \t]+(?=[A-Za-z_])")

_PIECE = re.compile(
    r"""
      '[^']*+(?:'|\Z)                            # quoted text may hold line ends
    | "(?>(?:[^"\\]|\\.)*)(?:"|\Z)
    | \\(?:.|\Z)                                 # an escaped character; an escaped line end continues the line
    | (?<![^\s;&|(){}])\#[^\n]*                  # a comment begins a word
    | <<<                                        # a here-string is on its line
    | <<-?[ \t]*['"]?(?P<here>[A-Za-z0-9_]+)['"]?
    | (?P<word>[^\s'"\\;&|(){}<>]+)
    | (?P<sign>[;&|(){}]|\n)
    | .
    """,
    re.VERBOSE | re.DOTALL,
)
_OPENS = frozenset({"if", "case", "for", "while", "until", "select", "{"})
_CLOSES = frozenset({"fi", "esac", "done", "}"})
_LEADS = frozenset({"then", "do", "else", "elif", "!", "time"})
"""Words before another command."""


def assignments(data: bytes) -> tuple[dict[str, str], list[str]]:
    """Return the variables that always have a literal value when the file is sourced, and warnings about the others.

    Raises TooLarge beyond 1 MiB, UnreadableFile if the file is not UTF-8.
    """
    if len(data) > MAX_BYTES:
        raise TooLarge(f"the file of shell variables has {len(data)} bytes; the limit is {MAX_BYTES}")
    try:
        text = data.decode("utf-8-sig").replace("\r\n", "\n")
    except UnicodeDecodeError as error:
        reason = f"not UTF-8 text (byte 0x{error.object[error.start]:02x}); save the file as UTF-8"
        line = error.object.count(b"\n", 0, error.start) + 1
        raise UnreadableFile(f"line {line}: {reason}", [Problem(reason, line=line)]) from error
    variables: dict[str, str] = {}
    warnings: list[str] = []
    other_lines: list[int] = []
    names_with_warning: set[str] = set()
    at, line, depth = 0, 1, 0
    while at < len(text):
        literals = _literals(text, at) if depth == 0 else None
        if literals is not None:
            values, end = literals
            for name, value in values.items():
                reason = _unfit_reason(name, value, variables)
                if reason:
                    variables.pop(name, None)
                    warnings.append(f"line {line}: {name} is skipped: {reason}")
                else:
                    variables[name] = value
        else:
            end, depth, touched, stop = _command(text, at, depth)
            for name in touched:
                variables.pop(name, None)
                if name not in names_with_warning:
                    warnings.append(f"line {line}: {name} is skipped: only a shell can evaluate it")
                names_with_warning.add(name)
            if not touched:
                other_lines.append(line)
            if stop:
                warnings.append(f"line {line}: {stop}; the lines after it are skipped")
                break
        line += text.count("\n", at, end)
        at = end
    if other_lines:
        many = f"{len(other_lines)} commands are" if len(other_lines) > 1 else "a command is"
        warnings.append(f"line {other_lines[0]}: {many} skipped: only assignments of literals are read")
    if len(warnings) > MAX_WARNINGS:
        warnings = [*warnings[:MAX_WARNINGS], f"and {len(warnings) - MAX_WARNINGS} more like these"]
    return variables, warnings


def exported_variables(variables: object) -> tuple[dict[str, str], list[str], list[str]]:
    """Split stored variables: those that robots may source, names of file paths, reasons why others are skipped."""
    items = variables.items() if isinstance(variables, Mapping) else ()
    out: dict[str, str] = {}
    of_files, reasons = [], []
    for name, value in items:
        if not isinstance(name, str) or not isinstance(value, str):
            continue
        if name in OF_FILES:
            of_files.append(name)
            continue
        try:
            exports({name: value})
        except ValueError as error:
            reasons.append(str(error))
        else:
            out[name] = value
    return out, of_files, reasons


def exports(values: Mapping[str, str]) -> bytes:
    """Format variables as lines for a shell. Raises ValueError for a name or value that must not be exported."""
    lines = []
    for name, value in values.items():
        reason = "invalid variable name" if not _NAME.fullmatch(name) else _unfit_reason(name, value, {})
        if reason:
            raise ValueError(f"{name[:80]!r} cannot be exported: {reason}")
        quoted = value.replace("'", "'\\''")
        lines.append(f"export {name}='{quoted}'\n")
    return "".join(lines).encode()


def _unfit_reason(name: str, value: str, variables: Mapping[str, str]) -> str:
    """Return why a variable must not be exported, or an empty text."""
    if DANGEROUS_VARIABLE.fullmatch(name):
        return "the variable controls how programs run"
    if not is_writable(value):
        return "its value has control characters"
    if len(value) > MAX_VALUE:
        return f"its value has more than {MAX_VALUE} characters"
    if len(variables) >= MAX_VARIABLES and name not in variables:
        return f"the file has more than {MAX_VARIABLES} variables"
    return ""


def _literals(text: str, at: int) -> tuple[dict[str, str], int] | None:
    """Parse the assignments of a line that contains nothing else, and the next line's offset; None for other lines."""
    if nothing := _NOTHING.match(text, at):
        return {}, nothing.end()
    at = _past(_BLANK, text, at)
    exported = _EXPORT.match(text, at)
    if exported:
        at = _past(_BLANK, text, exported.end())
    values: dict[str, str] = {}
    while name := _NAME.match(text, at):
        at = name.end()
        if text[at : at + 1] == "=":
            values[name.group()], at = _value(text, at + 1)
        elif not exported:  # `export NAME` exports a variable assigned elsewhere
            return None
        if end := _END.match(text, at):
            return values, end.end()
        following = _NEXT.match(text, at)
        if following is None:
            return None
        at = following.end()
    return None


def _value(text: str, at: int) -> tuple[str, int]:
    """Parse adjacent quoted and bare pieces. Returns their text and its end."""
    parts = []
    while at < len(text):
        if piece := _SINGLE.match(text, at):
            parts.append(piece.group(1))
        elif piece := _DOUBLE.match(text, at):
            parts.append(_ESCAPED.sub(r"\1", piece.group(1)))
        elif piece := _BARE.match(text, at):
            parts.append(piece.group())
        elif piece := _ESCAPE.match(text, at):
            parts.append(piece.group(1))
        else:
            break
        at = piece.end()
    return "".join(parts), at


def _command(text: str, at: int, depth: int) -> tuple[int, int, list[str], str]:
    """Skip a logical line. Returns its end, the block depth after it, variables it may set, why no line follows."""
    touched: dict[str, None] = {}
    heres: list[str] = []
    begins, leaves, first = True, False, ""
    parentheses = arithmetic = 0  # open ones, and those of them up to the inner one of "((", where "<<" is a shift,
    shifts: list[str] = []  # but a here-document if the two are closed apart: subshells
    while at < len(text):
        piece = _PIECE.match(text, at)
        if piece is None:  # every character matches the last alternative
            break
        at = piece.end()
        token, sign = piece["word"], piece["sign"]
        if sign == "(":
            parentheses += 1
            arithmetic = arithmetic or (parentheses if text.startswith("((", at - 2) else 0)
        elif sign == ")":
            parentheses = max(parentheses - 1, 0)
            if parentheses < arithmetic:
                heres += [] if text.startswith(")", at) else shifts
                arithmetic, shifts = 0, []
        if piece["here"]:
            (shifts if arithmetic else heres).append(piece["here"])
        if sign in ("{", "}") and begins:
            token = sign
        if token:
            assigned = _NAME.match(token)
            if assigned and token[assigned.end() : assigned.end() + 2].startswith(("=", "+=", "[")):
                touched[assigned.group()] = None
            elif (
                assigned and assigned.end() == len(token) and first in ("unset", "read", "readarray", "mapfile", "for")
            ):
                touched[token] = None
            if begins:
                leaves = leaves or (depth == 0 and token in ("return", "exit", "exec"))
                depth += (token in _OPENS) - (token in _CLOSES)
                first = token
            begins = (begins and token in _LEADS | {"{"}) or token in ("then", "do", "else")
        elif sign == "\n":
            break
        elif sign:
            begins = True
        elif piece.group().strip() and not piece.group().startswith("#"):
            begins = False
    for end in heres:
        match = re.compile(rf"^\t*{re.escape(end)}$", re.MULTILINE).search(text, at)
        if match is None:
            stop = f"the here-document has no end mark {end[:80]}" if at < len(text) else ""
            return len(text), max(depth, 0), list(touched), stop
        at = min(len(text), match.end() + 1)
    return at, max(depth, 0), list(touched), "the script exits here" if leaves and at < len(text) else ""


def _past(pattern: re.Pattern[str], text: str, at: int) -> int:
    match = pattern.match(text, at)
    return match.end() if match else at
