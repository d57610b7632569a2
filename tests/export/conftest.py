"""What makes exports quick enough for tests."""

from __future__ import annotations

import pytest

from residnet.autopilot import export as policy
from residnet.export import vessel

STEPS = 60


@pytest.fixture
def short_parity(monkeypatch: pytest.MonkeyPatch) -> None:
    """Compare over few steps what is written with what it was made of."""
    for module in (policy, vessel):
        monkeypatch.setattr(module, "PARITY_STEPS", STEPS)
