"""The clock of what others may change while the host is suspended."""

from __future__ import annotations

import inspect
import time

import pytest

from app.api.http.auth import Authenticator
from app.backends.lead import SharedLeads
from app.clock import seconds_since_boot


@pytest.mark.skipif(not hasattr(time, "CLOCK_BOOTTIME"), reason="only Linux has a clock that counts suspended time")
def test_clock_counts_suspended_time() -> None:
    before = time.clock_gettime(time.CLOCK_BOOTTIME)
    now = seconds_since_boot()
    assert before <= now <= time.clock_gettime(time.CLOCK_BOOTTIME)


@pytest.mark.parametrize("user", [SharedLeads, Authenticator])
def test_leads_and_cached_tokens_use_it(user: type) -> None:
    assert inspect.signature(user).parameters["clock"].default is seconds_since_boot
