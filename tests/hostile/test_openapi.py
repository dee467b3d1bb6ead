"""Fuzz every operation of the OpenAPI document with values that its schemas allow.

``SCHEMATHESIS_EXAMPLES=500 pytest tests/hostile/test_openapi.py`` runs longer than CI does.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from typing import Any

import httpx
import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from app.cli import demo
from app.cli.client import Client
from tests.api.conftest import ADMIN, Api, running, settings_for

EXAMPLES = int(os.environ.get("SCHEMATHESIS_EXAMPLES", "2"))
CPU_SECONDS = 2.0
FOLLOWED = "/api/v1/events"
"""Endpoint of server-sent events, which never ends when followed."""


@pytest.fixture(scope="module")
def api(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Api]:
    """Server with the demo and another environment, which may be deleted."""
    with running(settings_for(tmp_path_factory.mktemp("openapi"), job_seconds=60)) as api:
        with Client(api.url, ADMIN) as client:
            demo.install(client)
        yield api


@pytest.mark.filterwarnings("ignore:Do not use the `random` module inside strategies")  # the server's threads do
def test_every_response_is_declared_and_no_call_fails_the_server(api: Api) -> None:
    import schemathesis  # here, since it takes seconds and each worker imports this module

    schema = schemathesis.openapi.from_dict(api.get("/openapi.json").json())
    failures: list[str] = []
    count = 0

    for result in schema.get_all_operations():
        operation = result.ok()

        @settings(
            max_examples=EXAMPLES,
            deadline=None,
            derandomize="SCHEMATHESIS_EXAMPLES" not in os.environ,
            database=None,
            phases=[Phase.generate],
            suppress_health_check=list(HealthCheck),
        )
        @given(case=operation.as_strategy(), existing=st.booleans())
        def call(case: Any, existing: bool) -> None:
            nonlocal count
            names = {"env": demo.NAME, "v": "latest"} if existing and case.method != "DELETE" else {}
            case.path_parameters = {**(case.path_parameters or {}), **names}
            arguments = case.as_transport_kwargs(base_url=api.url)
            if case.operation.path == FOLLOWED:
                arguments["params"] = {**(arguments.get("params") or {}), "follow": "false"}
            headers = {n: v for n, v in (case.headers or {}).items() if n.lower() != "authorization"}
            if isinstance(arguments.get("data"), (bytes, str)):
                arguments["content"] = arguments.pop("data")
            before = time.process_time()
            try:
                answer = api.http.request(**{k: v for k, v in arguments.items() if k in KEPT}, headers=headers)
            except httpx.LocalProtocolError:
                return  # not a valid header
            spent = time.process_time() - before
            count += 1
            operation = f"{case.method} {case.operation.path} {arguments}"[:2000]
            if answer.status_code >= 500 and not (answer.status_code in (503, 507) and "retry-after" in answer.headers):
                failures.append(f"{answer.status_code} {answer.text[:300]}: {operation}")
            declared = case.operation.definition.raw["responses"]
            if str(answer.status_code) not in declared:
                failures.append(f"{answer.status_code} is not declared: {answer.text[:300]}: {operation}")
            if spent > CPU_SECONDS:
                failures.append(f"{spent:.1f} s of CPU: {operation}")

        call()
    assert count > 200
    assert not failures, f"{len(failures)} of {count}:\n" + "\n".join(failures[:20])


KEPT = {"method", "url", "params", "json", "data", "files", "content"}
