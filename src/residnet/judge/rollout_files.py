"""The stored rollouts, from which anyone can recompute the metrics."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from residnet.core.files import file_stem, whole
from residnet.core.layout import PLANAR, Live
from residnet.data.prepare import Prepared
from residnet.judge.band import Bands
from residnet.judge.bands import limits
from residnet.judge.freerun import FreeRun, Prediction

INPUT = "input_"
"""Stands before the name of an input among the columns."""


def columns_of(live: Live) -> tuple[str, ...]:
    """Return the names of the columns of states: u, v, r, heading and position, then the rest."""
    planar, beside = live.moving[: PLANAR.dof], live.moving[PLANAR.dof :]
    return (*planar, "psi", "x", "y", *beside)


def write_rollouts(
    folder: Path,
    runs: Sequence[FreeRun],
    logs: Sequence[Prepared],
    inputs: Sequence[str],
    bands: Bands | None = None,
) -> None:
    """Write one file per log of a split.

    Columns: protocol, model, window, t (s, the log's clock), usable, diverged, then u, v, r, psi,
    x, y (and p and phi of a roll) as measured and with `_hat` as predicted (SI, rad), and the
    inputs that are held over the step after each sample with `input_` before their names. Where
    there are bands, `_low` and `_high` are their pointwise limits; those of x and y are the box
    about the circle that holds the position, and a model without a band has NaN.

    Args:
        folder: for the files.
        runs: protocols of a split.
        logs: of the split.
        inputs: names of the inputs, in the order of their columns.
        bands: by model and protocol; None for none.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    folder.mkdir(parents=True, exist_ok=True)
    for number, log in enumerate(logs):
        parts: dict[str, list[np.ndarray]] = {
            name: [] for name in ("protocol", "model", "window", "t", "usable", "diverged")
        }
        measured: list[np.ndarray] = []
        predicted: list[np.ndarray] = []
        given: list[np.ndarray] = []
        low: list[np.ndarray] = []
        high: list[np.ndarray] = []
        for run in runs:
            of_log = [i for i, window in enumerate(run.windows) if window.log == number]
            for model, predictions in run.predictions.items():
                for place, i in enumerate(of_log):
                    rows = slice(run.windows[i].start, run.windows[i].stop)
                    length = rows.stop - rows.start
                    labels: dict[str, object] = {
                        "protocol": run.protocol,
                        "model": model,
                        "window": place,
                        "diverged": predictions[i].diverged,
                    }
                    for key, label in labels.items():
                        parts[key].append(np.full(length, label))
                    parts["t"].append(log.log.t[rows])
                    parts["usable"].append(log.usable[rows])
                    measured.append(log.y[rows])
                    given.append(log.w[rows])
                    predicted.append(predictions[i].states)
                    least, most = _limits(predictions[i], model, run.protocol, bands or {})
                    low.append(least)
                    high.append(most)
        if not measured:
            continue
        columns = {name: np.concatenate(values) for name, values in parts.items()}
        y, y_hat = np.concatenate(measured), np.concatenate(predicted)
        order = {name: log.live.states.index(name) for name in columns_of(log.live)}
        columns |= {name: y[:, place] for name, place in order.items()}
        columns |= {f"{name}_hat": y_hat[:, place] for name, place in order.items()}
        if any((bands or {}).values()):
            for ending, parts_of in (("low", low), ("high", high)):
                reached = np.concatenate(parts_of)
                columns |= {f"{n}_{ending}": reached[:, place] for n, place in order.items()}
        w = np.concatenate(given)
        columns |= {f"{INPUT}{name}": w[:, place] for place, name in enumerate(inputs)}
        table = pa.table({name: pa.array(values) for name, values in columns.items()})
        with whole(folder / f"{file_stem(log.log.name)}.parquet") as file:
            pq.write_table(table, file, compression="zstd")


def _limits(
    prediction: Prediction, model: str, protocol: str, bands: Bands
) -> tuple[np.ndarray, np.ndarray]:
    """Return the lower and upper limits [L, 3 + n] of a prediction; NaN where it has no band."""
    band = bands.get(model, {}).get(protocol)
    if band is None:
        unknown = np.full_like(prediction.states, np.nan)
        return unknown, unknown
    return limits(prediction.states, band.half_widths(prediction.states, prediction.spread))
