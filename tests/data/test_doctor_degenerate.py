"""The doctor on logs whose channels hold little or nothing."""

from __future__ import annotations

import numpy as np
import pytest
from known_logs import wavy

from residnet.data.doctor import inspect
from residnet.data.doctor.findings import with_channels


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("way", ["zero", "constant", "half unknown"])
def test_channels_without_content_are_told_and_stop_nothing(way: str) -> None:
    log = wavy()
    for name, values in log.channels.items():
        sick = values.copy()
        if way == "zero":
            sick[:] = 0.0
        elif way == "constant":
            sick[:] = sick[20]
        else:
            sick[len(sick) // 2 :] = np.nan
        # reports may say what they like: to end with one is what counts
        assert inspect(with_channels(log, **{name: sick}), inputs=["delta"]).lines(), name


@pytest.mark.filterwarnings("error")
def test_a_moored_vessel_is_inspected() -> None:
    log = wavy()
    still = {name: np.full(len(log), 0.1) for name in ("x", "y", "psi")}
    rest = {name: np.zeros(len(log)) for name in "uvr"}
    report = inspect(with_channels(log, **still, **rest), inputs=["delta"])
    assert report.lines()
