"""Hostile files are rejected with file and reason, or read, without crash, hang or high memory use."""

from __future__ import annotations

import resource
import time
from collections.abc import Iterator

import orjson
import pytest

from app import upload_reader
from app.errors import BadUpload, Invalid, TooLarge
from app.limits import Limits
from app.syntax.decimals import numbers
from app.upload_reader import EnvironmentContext, UploadHints
from tests.hostile.corpus import ACCORDING_TO_KIND, Case, cases, damaged, sample_maps, zipped

SECONDS = 10.0
"""CPU time limit of one case, in seconds; the slowest ones take one."""

MEMORY = 6 * 2**30
COPIES, COPIES_OF_A_FILE = 60, 15
"""Damaged copies of a map, and at least so many of each of its files; ``make fuzz`` makes them for minutes."""

LIMITS = Limits()


@pytest.fixture(autouse=True, scope="module")
def little_memory() -> Iterator[None]:
    """Limit the address space like a worker's, to protect the machine."""
    before = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_AS, before)


def outcome(case: Case) -> str:
    """Return ``read`` or ``refused``; fail for anything else."""
    start = time.process_time()
    try:
        upload_bundle = upload_reader.read(
            upload_reader.unpack(case.files, LIMITS), UploadHints(case.format), EnvironmentContext(), LIMITS
        )
    except (BadUpload, Invalid) as error:
        result = "refused"
        assert error.detail
        assert "Traceback" not in error.detail
        if isinstance(error, BadUpload):
            assert error.problems, f"{case.name}: refused without a place: {error.detail}"
            assert all(p.file and p.problem for p in error.problems), f"{case.name}: which file? {error.detail}"
    else:
        result = "read"
        # The content must be valid JSON: no NaN, no integer beyond 64 bits, no lone surrogate.
        for part in upload_bundle.parts.values():
            orjson.dumps([list(getattr(part, "ids", ())), list(getattr(part, "properties", ()))])
        orjson.dumps([w.as_dict() for w in upload_bundle.warnings])
    assert time.process_time() - start < SECONDS, f"{case.name} takes too long"
    return result


@pytest.mark.parametrize("kind", ACCORDING_TO_KIND, ids=lambda kind: kind.__name__)
def test_hostile_files_have_their_verdict(kind: object) -> None:
    wrong = []
    for case in kind():  # type: ignore[operator]
        result = outcome(case)
        if case.verdict not in ("any", result):
            wrong.append(f"{case.name}: {result}, not {case.verdict}")
    assert not wrong, "\n".join(wrong)


def test_hostile_cases_have_unique_names() -> None:
    names = [case.name for case in cases()]
    assert len(names) > 700
    assert len(set(names)) == len(names)


@pytest.mark.parametrize(("name", "files"), [pytest.param(n, f, id=f"{n}/{min(f)}") for n, f in sample_maps()])
def test_damaged_samples_are_read_or_rejected(name: str, files: dict[str, bytes]) -> None:
    results = set()
    copies = max(COPIES_OF_A_FILE, COPIES // len(files))
    for victim in sorted(files):
        for k, data in enumerate(damaged(files[victim], seed=len(files[victim]), count=copies)):
            case = Case(f"{victim}, damage {k}", {**files, victim: data}, "any", name if k % 2 else None)
            results.add(outcome(case))
    assert "refused" in results, "no damage was detected"


def test_archives_of_one_upload_share_the_limit() -> None:
    limits = Limits(unpacked_bytes=3000)
    files = {f"{k}.zip": zipped({f"{k}/z": bytes(1000)}) for k in range(3)}
    assert len(upload_reader.unpack(files, limits)) == 3
    with pytest.raises(TooLarge) as caught:
        upload_reader.unpack({**files, "one more.zip": zipped({"a": b"1"})}, limits)
    assert [p.file for p in caught.value.problems] == ["one more.zip"]


def test_large_numbers_keep_their_digits() -> None:
    values = [1e300, -1e300, 2.0**53, 1.23456789012345, -0.0]
    assert numbers(values) == ["1e+300", "-1e+300", "9007199254740992.0", "1.23456789", "0.0"]
