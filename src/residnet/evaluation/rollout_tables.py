"""Tables of the free runs of a split: columns, and files per log."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from residnet.core.files import atomic_write, make_file_stem
from residnet.core.layout import PLANAR_LAYOUT, DegreesOfFreedom
from residnet.evaluation.band import BandsByModel
from residnet.evaluation.bands import band_limits

if TYPE_CHECKING:
    from residnet.evaluation.freerun import FreeRun
    from residnet.preprocessing.prepare import PreparedLog

INPUT_PREFIX = "input_"
"""Prefix of the column names of inputs."""


def state_column_names(dof: DegreesOfFreedom) -> tuple[str, ...]:
    """Return column names of states: u, v, r, heading and position, then roll or dive states."""
    planar = dof.dynamic_states[: PLANAR_LAYOUT.n_dof]
    non_planar_states = dof.dynamic_states[PLANAR_LAYOUT.n_dof :]
    return (*planar, "psi", "x", "y", *non_planar_states)


def iterate_rollout_columns(
    runs: Sequence[FreeRun],
    logs: Sequence[PreparedLog],
    inputs: Sequence[str] = (),
    bands: BandsByModel | None = None,
) -> Iterator[tuple[PreparedLog, dict[str, np.ndarray]]]:
    """Yield each log with windows, with a row for each step of each model's free runs.

    Columns: protocol, model, window, t (s, the log's clock), usable, diverged, then u, v, r, psi,
    x, y (and p and phi with roll) as measured and with `_hat` as predicted (SI, rad), and the
    inputs held over the step after each sample with the prefix `input_`. With prediction intervals,
    `_low` and `_high` are their pointwise limits; for x and y the box about the position circle.
    They are NaN for models without intervals.

    Args:
        inputs: names of the inputs, in column order.
        bands: prediction intervals by model and protocol; None if no model has any.
    """
    bands_by_model = bands or {}
    for log_index, log in enumerate(logs):
        tables: list[dict[str, np.ndarray]] = []
        state_columns = {
            name: log.dof.state_names.index(name) for name in state_column_names(log.dof)
        }
        for run in runs:
            window_indices = [
                window_index
                for window_index, window in enumerate(run.windows)
                if window.log_index == log_index
            ]
            for model, predictions in run.predictions.items():
                band = bands_by_model.get(model, {}).get(run.protocol)
                for window_number, window_index in enumerate(window_indices):
                    window_slice = slice(
                        run.windows[window_index].start, run.windows[window_index].stop
                    )
                    prediction = predictions[window_index]
                    label_columns = {
                        "protocol": run.protocol,
                        "model": model,
                        "window": window_number,
                    }
                    states_by_suffix = {"": log.y[window_slice], "_hat": prediction.states}
                    if any(bands_by_model.values()):
                        lower = upper = np.full_like(prediction.states, np.nan)
                        if band is not None:
                            half_widths = band.half_widths(
                                prediction.states, prediction.spread, prediction.distance
                            )
                            lower, upper = band_limits(prediction.states, half_widths)
                        states_by_suffix |= {"_low": lower, "_high": upper}
                    tables.append(
                        {
                            name: np.full(len(prediction.states), label)
                            for name, label in label_columns.items()
                        }
                        | {"t": log.log.t[window_slice], "usable": log.usable[window_slice]}
                        | {"diverged": np.full(len(prediction.states), prediction.has_diverged)}
                        | {
                            f"{name}{suffix}": values[:, column]
                            for suffix, values in states_by_suffix.items()
                            for name, column in state_columns.items()
                        }
                        | {
                            f"{INPUT_PREFIX}{input_name}": log.w[window_slice, k]
                            for k, input_name in enumerate(inputs)
                        }
                    )
        if tables:
            yield (
                log,
                {name: np.concatenate([table[name] for table in tables]) for name in tables[0]},
            )


def write_rollouts(
    folder: Path,
    runs: Sequence[FreeRun],
    logs: Sequence[PreparedLog],
    inputs: Sequence[str],
    bands: BandsByModel | None = None,
) -> None:
    """Write one file per log of a split, as `iterate_rollout_columns` gives it."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    for log, columns in iterate_rollout_columns(runs, logs, inputs, bands):
        table = pa.table({name: pa.array(values) for name, values in columns.items()})
        with atomic_write(folder / f"{make_file_stem(log.log.name)}.parquet") as file:
            # dictionary encoding pays only for repeated texts, not for floating-point columns
            pq.write_table(table, file, compression="zstd", use_dictionary=["protocol", "model"])
