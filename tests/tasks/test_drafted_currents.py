"""`residnet new` drafts `current` for logs that ran in currents, and only for these."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from random_vessels import small_boat_logs

from residnet.core.log import Log
from residnet.tasks.drafting import draft_fit_config


def write_log(log: Log, path: Path, current: complex) -> None:
    """Write a log over ground of a boat in a current, north + 1j east in m/s."""
    drift = current * log.t
    body = current * np.exp(-1j * log["psi"])
    table = {
        "time [s]": log.t,
        "x [m]": log["x"] + drift.real,
        "y [m]": log["y"] + drift.imag,
        "psi [rad]": log["psi"],
        "u [m/s]": log["u"] + body.real,
        "v [m/s]": log["v"] + body.imag,
        "r [rad/s]": log["r"],
        "n [1/s]": log["n"],
        "delta [rad]": log["delta"],
    }
    pd.DataFrame(table).to_csv(path, index=False)


@pytest.mark.parametrize("share", [0.0, 0.25])
def test_current_is_drafted_where_it_is_significant(tmp_path: Path, share: float) -> None:
    logs = small_boat_logs("boat", 3002, 6, 120.0)
    speed = float(np.median(logs[0]["u"]))
    for number, log in enumerate(logs):
        direction = np.exp(1j * (0.5 + number))
        write_log(log, tmp_path / f"run_{number}.csv", share * speed * direction)
    draft = draft_fit_config([tmp_path], tmp_path, "boat")
    reasons = dict(draft.guesses)
    assert draft.config.get("current") == ({"baseline": "hull"} if share else None)
    assert ("current" in reasons) == bool(share)
    if share:
        assert "significant constant current or wind" in reasons["current"]
