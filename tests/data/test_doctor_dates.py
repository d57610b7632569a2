"""A nominal time column beside a column of dates."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from known_logs import wavy

from residnet.core.log import Log
from residnet.data.doctor import date_findings


def written(path: Path, log: Log, rate: float, *, epoch: bool) -> Path:
    seconds = 1.6e9 + rate * log.t
    stamps = (
        seconds if epoch else pd.to_datetime(seconds, unit="s").strftime("%Y-%m-%d %H:%M:%S.%f")
    )
    pd.DataFrame({"t": log.t, "date": stamps, **log.channels}).to_csv(path, index=False)
    return path


@pytest.mark.parametrize("epoch", [True, False])
def test_a_nominal_clock_is_held_against_the_dates(tmp_path: Path, *, epoch: bool) -> None:
    log = wavy()
    (finding,) = date_findings(log, written(tmp_path / "off.csv", log, 1.095, epoch=epoch))
    assert finding.code == "clock_rate"
    assert finding.figures["rate"] == pytest.approx(1.095, abs=1e-4)
    assert date_findings(log, written(tmp_path / "on.csv", log, 1.0, epoch=epoch)) == []


def test_a_file_without_dates_tells_nothing(tmp_path: Path) -> None:
    log = wavy()
    file = tmp_path / "plain.csv"
    pd.DataFrame({"t": log.t, "u": log["u"]}).to_csv(file, index=False)
    assert date_findings(log, file) == []
    file.write_bytes(np.random.default_rng(0).bytes(2000))
    assert date_findings(log, file) == []
