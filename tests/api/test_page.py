"""Settings of the web page: the base map, off unless configured, and the one origin that the page may load it from."""

from __future__ import annotations

from pathlib import Path

import pytest

from app.api.page import POLICY, policy_for
from app.setting_values import basemap_origin
from tests.api.conftest import API, running, settings_for

URL = "https://tiles.example.org:8443/base/{z}/{x}/{y}.png?key=k%20"


def test_page_has_no_base_map_by_default(tmp_path: Path) -> None:
    with running(settings_for(tmp_path)) as api:
        assert api.get(f"{API}/page").json() == {"basemap": None}
    assert policy_for(None) == POLICY


def test_base_map_is_given_to_the_page_as_configured(tmp_path: Path) -> None:
    text = "© <b>Example</b>, CC BY 4.0"
    with running(settings_for(tmp_path, basemap_url=URL, basemap_attribution=text)) as api:
        assert api.get(f"{API}/page").json() == {"basemap": {"url": URL, "attribution": text}}


def test_policy_allows_images_of_exactly_that_origin() -> None:
    before, after = (dict(part.split(" ", 1) for part in text.split("; ")) for text in (POLICY, policy_for(URL)))
    assert after.pop("img-src") == before.pop("img-src").replace("'self'", "'self' https://tiles.example.org:8443")
    assert after == before


@pytest.mark.parametrize(
    "url",
    [
        "tiles/{z}/{x}/{y}.png",
        "ftp://a/{z}/{x}/{y}.png",
        "https://a/{z}/{x}.png",
        "https://{s}.a/{z}/{x}/{y}.png",
        "https://user:secret@a/{z}/{x}/{y}.png",
        "https://a;script-src */{z}/{x}/{y}.png",
        "https://a/{z}/{x}/{y}.png; script-src *",
        "https://*/{z}/{x}/{y}.png",
    ],
)
def test_wrong_base_map_addresses_are_refused(tmp_path: Path, url: str) -> None:
    with pytest.raises(ValueError, match="basemap_url"):
        settings_for(tmp_path, basemap_url=url)


def test_origin_has_no_path_query_or_user() -> None:
    assert basemap_origin(URL) == "https://tiles.example.org:8443"
    assert basemap_origin("http://[fd00::1]:80/{z}/{x}/{y}") == "http://[fd00::1]:80"
    assert basemap_origin("https://a@b/{z}/{x}/{y}") is None
