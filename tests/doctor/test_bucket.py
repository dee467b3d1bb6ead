"""``fleetmap doctor`` with stored files in S3: what is wrong with the bucket, and what to do, in one line each."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest
from obstore import put
from obstore.exceptions import BaseError
from obstore.store import S3Store

from app.backends.s3_faults import fault_of
from app.doctor import Finding, Site, examine
from app.errors import Invalid
from app.main import open_store
from tests.api.conftest import empty_database, settings_for
from tests.ports import free_port
from tests.seaweed import ACCESS, Fault, FaultyStore, Seaweed, running_seaweed


def examine_bucket(
    folder: Path, bucket: str = "maps", key: str | None = None, secret: str | None = None
) -> list[Finding]:
    """Examine the stored files of an installation in ``folder``."""
    data = folder / "data"
    (data / "blobs").mkdir(parents=True, exist_ok=True)
    (data / "fleetmap.sqlite3").write_bytes(empty_database())
    url = f"s3://{bucket}/doctor"
    settings = settings_for(data, blob_url=url, blob_access_key=key, blob_secret_key=secret, port=0)
    site = Site(settings)
    with closing(site):
        results = list(examine(site, ["stored-files"]))
    assert all(result.finding.place == url for result in results)
    assert all(secret is None or secret not in str(result) for result in results)
    return [result.finding for result in results]


def one_error(findings: list[Finding]) -> tuple[str, str]:
    """Return detail and advice of the only finding."""
    (finding,) = findings
    assert finding.level == "error"
    return finding.detail, finding.advice


@pytest.fixture
def folder(tmp_path: Path, seaweed: Seaweed, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder, with the real store in the environment."""
    for name, value in seaweed.environment.items():
        monkeypatch.setenv(name, value)
    return tmp_path


def test_usable_bucket_is_left_as_it_was(folder: Path, seaweed: Seaweed) -> None:
    (finding,) = examine_bucket(folder, key="limited", secret="limited-secret")
    assert (finding.level, finding.detail) == ("ok", "can be written, read, listed and emptied")
    with closing(open_store(settings_for(folder / "data", blob_url="s3://maps/doctor"))) as store:
        assert list(store.blobs.files.list()) == []


@pytest.mark.parametrize(
    ("bucket", "user", "secret", "detail", "advice"),
    [
        (
            "maps",
            "limited",
            "not-this-one",
            "the secret key is wrong",
            "correct AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY",
        ),
        ("maps", "nobody", "not-this-one", "it does not know the access key", "FLEETMAP_BLOB_ACCESS_KEY"),
        ("maps", "reader", None, "cannot be written or emptied: access was refused", "bucket's policy"),
        ("maps", "writer", None, "cannot be read or listed: access was refused", "bucket's policy"),
    ],
)
def test_keys_that_do_not_suffice(
    folder: Path, bucket: str, user: str, secret: str | None, detail: str, advice: str
) -> None:
    found = one_error(examine_bucket(folder, bucket, user, secret or f"{user}-secret"))
    assert detail in found[0]
    assert advice in found[1]


def test_wrong_bucket(folder: Path) -> None:
    """SeaweedFS refuses to create it for a put of this key, and says to the other requests that there is none."""
    refused, missing = examine_bucket(folder, "mops", "limited", "limited-secret")
    assert "cannot be written: access was refused" in refused.detail
    assert "check the bucket's name" in refused.advice
    assert "cannot be read or listed or emptied: no such bucket" in missing.detail
    assert "create it, or correct the bucket's name" in missing.advice


def test_full_store(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """SeaweedFS without a volume that it may write answers 500 without a reason."""
    store_folder = tmp_path / "seaweed"
    store_folder.mkdir()
    with running_seaweed(store_folder, volumes=1, megabytes=1) as store:
        for name, value in store.environment.items():
            monkeypatch.setenv(name, value)
        with pytest.raises(BaseError):
            fill(S3Store("maps", client_options={"allow_http": True}, retry_config={"max_retries": 0}))
        detail, advice = one_error(examine_bucket(tmp_path))
    assert "cannot be written: it answered 500" in detail
    assert "SeaweedFS answers so if it has no volume left to write" in advice


def fill(store: S3Store) -> None:
    """Store files until one is refused."""
    for number in range(200):
        put(store, f"ballast/{number}", bytes(500_000 + number))


@pytest.fixture
def faulty(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[FaultyStore]:
    """A store that answers as its ``fault`` says."""
    store = FaultyStore(0)
    for name, value in {**ACCESS, "AWS_ENDPOINT_URL": store.endpoint}.items():
        monkeypatch.setenv(name, value)
    yield store
    store.close()


@pytest.mark.parametrize(
    ("status", "code", "detail", "advice"),
    [
        (507, "InsufficientStorage", "it is full", "raise the quota"),
        (507, "XMinioStorageFull", "it is full", "free space"),
        (403, "QuotaExceeded", "it is full", "raise the quota"),
        (403, "RequestTimeTooSkewed", "the clocks differ", "time service"),
        (403, "AccessDenied", "access was refused", "bucket's policy"),
        (400, "ExpiredToken", "the session has ended", "AWS_SESSION_TOKEN"),
        (400, "AuthorizationHeaderMalformed", "another region", "AWS_REGION"),
        (404, "NoSuchBucket", "no such bucket", "create it"),
    ],
)
def test_answers_of_other_stores(
    faulty: FaultyStore, tmp_path: Path, status: int, code: str, detail: str, advice: str
) -> None:
    faulty.fault = Fault(status, body=f"<?xml version='1.0'?><Error><Code>{code}</Code></Error>".encode())
    found = one_error(examine_bucket(tmp_path))
    assert found[0].startswith("the bucket cannot be written or read or listed or emptied: ")
    assert detail in found[0]
    assert advice in found[1]


@pytest.mark.parametrize("endpoint", ["10.0.0.5:8333", "seaweed", "http://", "ftp://10.0.0.5"])
def test_unusable_address(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, endpoint: str) -> None:
    """obstore would end the thread that uses it, so a server does not start with it."""
    monkeypatch.setenv("AWS_ENDPOINT_URL", endpoint)
    detail, advice = one_error(examine_bucket(tmp_path))
    assert detail == "AWS_ENDPOINT_URL is no address"
    assert "http://host:port" in advice
    with pytest.raises(Invalid, match="AWS_ENDPOINT_URL is no address: use a complete one"):
        open_store(settings_for(tmp_path / "data", blob_url="s3://maps"))


def test_store_that_is_not_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in {**ACCESS, "AWS_ENDPOINT_URL": f"http://127.0.0.1:{free_port()}"}.items():
        monkeypatch.setenv(name, value)
    detail, advice = one_error(examine_bucket(tmp_path))
    assert "it does not answer" in detail
    assert "AWS_ENDPOINT_URL" in advice


def test_errors_without_an_answer() -> None:
    """Errors of obstore as it prints them: without keys it asks the machine's role, here of no cloud."""
    role = "Error performing PUT http://169.254.169.254/latest/api/token in 7ms - status code: 403 Forbidden: denied"
    assert fault_of(BaseError(role)).reason == "no access key is set"
    certificate = "HTTP error: error sending request … kind: Connect … InvalidCertificate( UnknownIssuer )"
    assert fault_of(BaseError(certificate)).reason == "its certificate is not trusted"
    clear = "HTTP error: error sending request … kind: Connect … InvalidMessage( InvalidContentType )"
    assert "http:// or https://" in fault_of(BaseError(clear)).advice
