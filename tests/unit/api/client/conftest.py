"""A server that the command talks to."""

from __future__ import annotations

import pytest

from tests.unit.api.conftest import KEY, LiveServer


@pytest.fixture
def command(live: LiveServer, monkeypatch: pytest.MonkeyPatch) -> LiveServer:
    """A live server that the command finds through the environment."""
    monkeypatch.setenv("NERFWORKS_URL", live.url)
    monkeypatch.setenv("NERFWORKS_API_KEY", KEY)
    monkeypatch.setenv("COLUMNS", "200")
    return live
