"""Reported figures include all windows and do not depend on single faulty samples."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from random_vessels import small_boat_logs

import residnet
from residnet.core.log import Log
from residnet.identification.recipe import compute_winsorized_std

INPUTS = ("n_port", "n_stbd")
Splits = dict[str, list[Log]]
Fault = Callable[[Log], Log]


@pytest.fixture(scope="module")
def splits() -> Splits:
    """Eight logs of a boat with two propellers."""
    logs = small_boat_logs("twin", 3, 8, 60.0)
    return {"train": logs[:5], "validation": logs[5:6], "test": logs[6:]}


@pytest.fixture(scope="module")
def figures_of_clean_logs(splits: Splits) -> pd.DataFrame:
    return report_figures(splits)


def report_figures(splits: Splits, **settings: Any) -> pd.DataFrame:
    """Return the errors of all models on validation and test logs."""
    data = residnet.prepare(splits, list(INPUTS), **settings)
    models = residnet.fit(data, "regressors", bands=None)
    rows = models.metrics
    rows = rows[(rows["split"] != "train") & (rows["manoeuvre"] == "all")]
    columns = ["nrmse_mean", "nrmse_u", "nrmse_v", "nrmse_r", "rmse_r", "position_error_end"]
    return rows.set_index(["model", "split", "protocol"])[["windows", *columns]]


def insert_spike(log: Log) -> Log:
    yaw_rate = log["r"].copy()
    yaw_rate[len(log) // 3] = -99.0
    return log.replace(channels={**log.channels, "r": yaw_rate})


def insert_fill_value(log: Log) -> Log:
    channels = {name: values.copy() for name, values in log.channels.items()}
    channels["u"][len(log) // 3] = -9999.0
    return log.replace(channels=channels)


def write_and_read(log: Log, folder: Path) -> Log:
    """Return a log as it is read from a table."""
    pd.DataFrame({"t": log.t, **log.channels}).to_csv(folder / f"{log.name}.csv", index=False)
    (read_log,) = residnet.read_logs(folder / f"{log.name}.csv")
    return read_log


# either fault, and a fault in either split, is among the fast ones
@pytest.mark.parametrize(
    ("insert_fault", "split"),
    [
        (insert_spike, "train"),
        (insert_fill_value, "test"),
        pytest.param(insert_spike, "test", marks=pytest.mark.long),
        pytest.param(insert_fill_value, "train", marks=pytest.mark.long),
    ],
)
def test_one_faulty_sample_changes_no_figure_by_more_than_two_per_cent(
    splits: Splits,
    figures_of_clean_logs: pd.DataFrame,
    insert_fault: Fault,
    split: str,
    tmp_path: Path,
) -> None:
    faulty_log = write_and_read(insert_fault(splits[split][0]), tmp_path)
    figures = report_figures({**splits, split: [faulty_log, *splits[split][1:]]})
    pd.testing.assert_frame_equal(figures, figures_of_clean_logs, rtol=0.02)


@pytest.mark.parametrize("split", ["train", "test"])
def test_values_of_a_masked_stretch_enter_no_figure(splits: Splits, split: str) -> None:
    """A receiver drifts by twenty standard deviations for 3 s, and the stretch is masked."""
    log = splits[split][0]
    n_masked = round(3.0 / float(np.median(np.diff(log.t))))
    rows = slice(len(log) // 3, len(log) // 3 + n_masked)
    is_masked = np.zeros(len(log), dtype=bool)
    is_masked[rows] = True
    masked_log = log.replace(masks={"receiver": is_masked})
    channels = {name: values.copy() for name, values in log.channels.items()}
    # the yaw rate does not depend on the receiver, and is scored at all samples
    for name in ("u", "v"):
        channels[name][rows] += np.linspace(0.0, 20.0, n_masked) * np.std(log[name])
    faulty_log = masked_log.replace(channels=channels)
    figures, reference = (
        report_figures({**splits, split: [first_log, *splits[split][1:]]})
        for first_log in (faulty_log, masked_log)
    )
    pd.testing.assert_frame_equal(figures, reference, rtol=0.02)


def test_winsorized_std_equals_the_standard_deviation_and_ignores_a_spike() -> None:
    values = np.random.default_rng(0).normal(2.0, 0.3, 3000)
    assert compute_winsorized_std(values) == pytest.approx(np.std(values), rel=0.02)
    for outlier in (-99.0, 1e20):
        spiked = np.append(values, outlier)
        assert compute_winsorized_std(spiked) == pytest.approx(np.std(values), rel=0.02)
    few = np.append(values[:40], -99.0)
    assert compute_winsorized_std(few) == pytest.approx(np.std(values[:40]), rel=0.1)
    assert compute_winsorized_std(np.full(3, np.nan)) == 0.0
    assert compute_winsorized_std(np.array([4.0])) == 0.0
