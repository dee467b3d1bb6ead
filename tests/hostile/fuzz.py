"""Fuzz the upload reader with mutations of every sample: `make fuzz`; a bounded part is a test.

Invariant: an upload is read, or rejected with a file and a reason. Content that was read is written in its own format
and read again. Nothing else is raised, no input takes more than ``CPU_SECONDS`` or the memory of a worker.

    make fuzz ARGS="--minutes 30 --seed 7 --format kml"
"""

from __future__ import annotations

import argparse
import random
import re
import resource
import signal
import sys
import time
import traceback
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path

import orjson

from app import formats, upload_reader
from app.errors import BadUpload, FleetMapError, Invalid
from app.formats import WriteContext
from app.limits import Limits
from app.model.frame import Datum
from app.upload_reader import EnvironmentContext, UploadHints
from tests.hostile.corpus import sample_maps

CPU_SECONDS = 10.0
MEMORY_BYTES = 6 * 2**30
LIMITS = Limits()
HERE = Datum(50.0, 7.0, heading=30.0)

Files = Mapping[str, bytes]

NUMBER = re.compile(rb"(?<![\w.])-?\d+(?:\.\d+)?(?:[eE][+-]?\d+)?(?![\w.])")
WORD = re.compile(rb"[A-Za-z_][\w:-]{1,40}")
NUMBERS = (
    b"0", b"-1", b"1", b"-0.0", b"1e-300", b"1e9", b"1e300", b"1e999", b"nan", b".nan", b"inf", b"-inf", b"2147483648",
    b"9223372036854775808", b"200", b"-90.5", b"3.14159", b"0x10", b"1_0", b"12:30", b"",
)  # fmt: skip
WORDS = (
    b"null", b"true", b"~", b"[]", b"{}", b"''", b"&a", b"*a", b"!!x", b"<<", b"name", b"id", b"nodes", b"\xff", b"\0",
    b"\xc2\x85", b"\xe2\x80\xae", b"<x/>", b"<!-- -->", b"]]>", b"&amp;", b"%", b"-", b"#", b"'", b'"', b"\t",
    b"x" * 300,
)  # fmt: skip


def mutate(data: bytes, dice: random.Random, other: bytes = b"") -> bytes:
    """Apply one to four changes to a file: bytes, lines, numbers, words, cuts, copies, pieces of another file."""
    for _ in range(dice.randint(1, 4)):
        data = dice.choice(MUTATIONS)(data, dice, other)
    return data


def _bytes(data: bytes, dice: random.Random, other: bytes) -> bytes:
    out = bytearray(data)
    for _ in range(dice.randint(1, 8) if out else 0):
        out[dice.randrange(len(out))] = dice.choice((0, 1, 127, 128, 255, dice.randrange(256)))
    return bytes(out)


def _cut(data: bytes, dice: random.Random, other: bytes) -> bytes:
    return data[: dice.randrange(len(data) + 1)]


def _lines(data: bytes, dice: random.Random, other: bytes) -> bytes:
    rows = data.splitlines(keepends=True)
    if not rows:
        return data
    k, j = dice.randrange(len(rows)), dice.randrange(len(rows))
    kind = dice.randrange(4)
    if kind == 0:
        del rows[k]
    elif kind == 1:
        rows.insert(j, rows[k])
    elif kind == 2:
        rows[k], rows[j] = rows[j], rows[k]
    else:
        rows[k] = dice.choice((b" ", b"  ", b"\t")) + rows[k]
    return b"".join(rows)


def _splice(data: bytes, dice: random.Random, other: bytes) -> bytes:
    source = other if other and dice.random() < 0.5 else data
    a, b = sorted(dice.randrange(len(source) + 1) for _ in range(2))
    at = dice.randrange(len(data) + 1)
    return data[:at] + source[a : min(b, a + 4096)] + data[at:]


def _token(pattern: re.Pattern[bytes], choices: tuple[bytes, ...]) -> Callable[[bytes, random.Random, bytes], bytes]:
    def change(data: bytes, dice: random.Random, other: bytes) -> bytes:
        matches = list(pattern.finditer(data))
        if not matches:
            return data
        match = dice.choice(matches)
        new = dice.choice((*choices, dice.choice(matches).group()))
        return data[: match.start()] + new + data[match.end() :]

    return change


MUTATIONS = (_bytes, _cut, _lines, _splice, *(_token(NUMBER, NUMBERS),) * 3, *(_token(WORD, WORDS),) * 2)


class OverrunError(BaseException):
    """Timeout of an input; no reader catches it."""


def _overrun(number: int, frame: object) -> None:
    raise OverrunError(f"more than {CPU_SECONDS:g} s of CPU")


def outcome(name: str | None, files: Files) -> str:
    """Read files as an upload, and again from their own format; raises if the invariant is violated."""
    signal.signal(signal.SIGPROF, _overrun)
    signal.setitimer(signal.ITIMER_PROF, CPU_SECONDS)
    try:
        return _outcome(name, files)
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)


def _outcome(name: str | None, files: Files) -> str:
    try:
        upload_bundle = upload_reader.read(
            upload_reader.unpack(files, LIMITS), UploadHints(name), EnvironmentContext(HERE), LIMITS
        )
    except (BadUpload, Invalid) as error:
        assert error.detail, "refused without a reason"
        if isinstance(error, BadUpload):
            assert error.problems, f"no place: {error.detail}"
            assert all(p.file and p.problem for p in error.problems), f"no file: {error.detail}"
        result = "refused"
    else:
        for part in upload_bundle.parts.values():
            orjson.dumps([list(getattr(part, "ids", ())), list(getattr(part, "properties", ()))])
        orjson.dumps([w.as_dict() for w in upload_bundle.warnings])
        result = _again(upload_bundle)
    return result


def _again(upload_bundle: upload_reader.Bundle) -> str:
    layers = upload_bundle.layers(HERE)
    for name in sorted({use.format for use in upload_bundle.files.values() if use.used and use.format}):
        fmt = formats.all_formats().get(name)
        if fmt is None or fmt.write is None or fmt.traits.is_container:
            continue
        try:
            written = formats.write(fmt, layers, WriteContext())
        except FleetMapError as error:  # the content lacks what the format needs: a network without an edge
            assert error.detail
            continue
        upload_reader.read(written, UploadHints(name), EnvironmentContext(HERE), LIMITS)
    return "read"


def run(seed: int, seconds: float, only: str | None = None, limit: int = 10**9) -> tuple[Counter[str], list[str]]:
    """Mutate until the CPU time is used up. Returns counts of outcomes, and violations, each location once.

    ``limit``: maximum number of mutations.
    """
    maps = [(name, files) for name, files in sample_maps() if only in (None, name)]
    counts: Counter[str] = Counter()
    failures: dict[str, str] = {}
    start, number = time.process_time(), 0
    while time.process_time() - start < seconds and number < limit:
        dice = random.Random(f"{seed}/{number}")
        name, files = maps[number % len(maps)]
        victim = dice.choice(sorted(files))
        other = (
            files[dice.choice(sorted(files))]
            if dice.random() < 0.5
            else dice.choice(list(dice.choice(maps)[1].values()))
        )
        upload = {**files, victim: mutate(files[victim], dice, other)}
        try:
            counts[outcome(name if dice.random() < 0.5 else None, upload)] += 1
        except (Exception, OverrunError) as error:  # noqa: BLE001  every one is a finding
            place = [f for f in traceback.extract_tb(error.__traceback__) if f.name != "_overrun"][-1]
            location = f"{type(error).__name__} {Path(place.filename).name}:{place.lineno} ({name})"
            failures.setdefault(location, f"--seed {seed}, number {number}, {victim}: {error}"[:400])
            counts["broken"] += 1
        number += 1
    return counts, [f"{location}: {text}" for location, text in sorted(failures.items())]


def main() -> int:
    """Fuzz for some minutes of CPU time. Returns 1 if the invariant was violated."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=10.0, help="CPU time; default: 10")
    parser.add_argument("--seed", type=int, default=random.SystemRandom().randrange(2**31), help="default: any")
    parser.add_argument("--format", help="mutate samples of this format only")
    values = parser.parse_args()
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, resource.RLIM_INFINITY))
    counts, failures = run(values.seed, values.minutes * 60.0, values.format)
    sys.stdout.write(
        f"seed {values.seed}: " + ", ".join(f"{n} {outcome}" for outcome, n in sorted(counts.items())) + "\n"
    )
    sys.stdout.writelines(f"{line}\n" for line in failures)
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
