"""The ferry's raw topics against the table made from them by hand; skipped where RESIDNET_DATA does
not hold them.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from residnet.core.files import config_folder
from residnet.core.log import Log
from residnet.tasks.import_logs import ImportConfig
from residnet.tasks.registry import load_task

FERRY = Path(os.environ.get("RESIDNET_DATA", "")) / "milliampere"
pytestmark = pytest.mark.skipif(not (FERRY / "raw_nlp1").is_dir(), reason=f"no raw_nlp1 in {FERRY}")


@pytest.fixture(scope="module")
def log() -> Log:
    task = load_task(config_folder() / "milliampere_raw.yaml", [])
    assert isinstance(task, ImportConfig)
    return task.reader.build().read(FERRY / "raw_nlp1")


def test_the_raw_topics_become_the_table_made_by_hand(log: Log) -> None:
    table = pd.read_csv(FERRY / "nlp1.csv")
    assert np.ptp(np.diff(log.t)) < 1e-9
    assert log.t[1] == pytest.approx(0.1)
    by_hand = table["gps_utc_s_of_day"].to_numpy()
    ours = np.rint((log.meta["epoch"] % 86400.0 + log.t) * 10.0).astype(int)
    rows = np.searchsorted(ours, np.rint(by_hand * 10.0).astype(int))
    assert (ours[rows] == np.rint(by_hand * 10.0)).all()

    def rms(channel: str, column: str) -> float:
        return float(np.sqrt(np.mean((log[channel][rows] - table[column].to_numpy()) ** 2)))

    assert np.hypot(rms("x", "north"), rms("y", "east")) < 0.05
    assert np.degrees(rms("psi", "psi")) < 0.5
    assert rms("u", "u") < 0.02
    assert rms("v", "v") < 0.02
    assert rms("r", "r") < 0.02


def test_what_was_mended_on_the_way_is_said(log: Log) -> None:
    said = {finding["code"] for finding in log.meta["findings"]}
    assert said >= {
        "unpadded_fraction",
        "time_zone",
        "latency",
        "empty_topic",
        "empty_columns",
        "not_numbers",
        "several_publishers",
        "quaternion_flips",
    }
    zone = next(finding for finding in log.meta["findings"] if finding["code"] == "time_zone")
    assert zone["figures"]["offset"] == 7200.0
    shared = [
        finding["text"]
        for finding in log.meta["findings"]
        if finding["code"] == "several_publishers"
    ]
    assert len(shared) == 1
    assert "control_action" in shared[0]
