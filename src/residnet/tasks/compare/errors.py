"""Errors of the selected models of several runs over the windows that they have in common."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from residnet.core.errors import UsageError
from residnet.core.names import VELOCITY
from residnet.judge.metrics import blocks, difference
from residnet.runs.folder import RunFolder

if TYPE_CHECKING:
    import pandas as pd

Window = tuple[str, str, float]
"""Log, protocol and first time of a window."""


@dataclass(frozen=True)
class JudgedRun:
    """A finished fit, as far as runs are compared.

    Attributes:
        name: that tells it from the others.
        folder: of the run.
        split: that it is judged on.
        metrics: the content of metrics.json.
        series: of each window the times from its start [T] and the errors of u, v, r [T, 3].
    """

    name: str
    folder: RunFolder
    split: str
    metrics: Mapping[str, Any]
    series: Mapping[Window, tuple[np.ndarray, np.ndarray]]

    @property
    def selected(self) -> str:
        """Name of the selected model."""
        return str(self.metrics["selected"])

    @property
    def scales(self) -> np.ndarray:
        """Scales of u, v, r [3]."""
        return np.array([float(self.metrics["scales"][name]) for name in VELOCITY])

    def rows(self) -> list[Mapping[str, Any]]:
        """Return the rows of the split over all manoeuvres."""
        return [
            row
            for row in self.metrics["rows"]
            if row["split"] == self.split and row["manoeuvre"] == "all"
        ]


def judged_runs(paths: Sequence[Path]) -> list[JudgedRun]:
    """Return the runs in folders.

    Raises:
        UsageError: where there is no finished fit in one of them, or fewer than two are named.
    """
    if len(paths) < 2:
        raise UsageError("compare: name at least two runs")
    short = [path.name or path.resolve().name for path in paths]
    names = short if len(set(short)) == len(short) else [str(path) for path in paths]
    if len(set(names)) < len(names):
        raise UsageError("compare: a run is named twice")
    return [_judged(name, path) for name, path in zip(names, paths, strict=True)]


def _judged(name: str, path: Path) -> JudgedRun:
    folder = RunFolder.open(path)
    if not folder.metrics.is_file():
        raise UsageError(f"{path}: has no metrics.json; runs of fits can be compared")
    metrics = folder.read_metrics()
    splits = list(dict.fromkeys(row["split"] for row in metrics["rows"]))
    split = next((known for known in ("test", "external") if known in splits), splits[-1])
    return JudgedRun(name, folder, split, metrics, _series(folder, split, metrics["selected"]))


def _series(
    folder: RunFolder, split: str, model: str
) -> dict[Window, tuple[np.ndarray, np.ndarray]]:
    import pandas as pd

    out: dict[Window, tuple[np.ndarray, np.ndarray]] = {}
    for file in sorted((folder.rollouts / split).glob("*.parquet")):
        table = pd.read_parquet(file, filters=[("model", "==", model)])
        for (protocol, _), rows in table.groupby(["protocol", "window"], sort=True):
            t = rows["t"].to_numpy()
            out[file.stem, str(protocol), round(float(t[0]), 3)] = (t - t[0], _errors(rows))
    return out


def _errors(rows: pd.DataFrame) -> np.ndarray:
    """Return the errors of u, v, r [T, 3], NaN where a sample is not usable."""
    apart = np.stack([rows[f"{name}_hat"] - rows[name] for name in VELOCITY], axis=1)
    out: np.ndarray = np.where(rows["usable"].to_numpy()[:, None], apart, np.nan)
    return out


def common_windows(runs: Sequence[JudgedRun]) -> list[Window]:
    """Return the windows that all runs were judged on, of one and the same length."""
    shared = set.intersection(*(set(run.series) for run in runs))
    return sorted(
        window for window in shared if len({len(run.series[window][0]) for run in runs}) == 1
    )


def window_errors(run: JudgedRun, windows: Sequence[Window], scales: np.ndarray) -> np.ndarray:
    """Return the normalised root mean square error of each window, the mean over u, v, r, [W]."""
    squares = [np.nanmean(run.series[window][1] ** 2, axis=0) for window in windows]
    return np.asarray((np.sqrt(np.array(squares)) / scales).mean(axis=1))


def paired(runs: Sequence[JudgedRun]) -> dict[str, dict[str, Any]]:
    """Return protocol -> run -> difference to the first run over common windows.

    Errors are in units of the first run's scales.
    """
    scales, shared = runs[0].scales, common_windows(runs)
    out: dict[str, dict[str, Any]] = {}
    for protocol in dict.fromkeys(window[1] for window in shared):
        windows = [window for window in shared if window[1] == protocol]
        logs = {log: number for number, log in enumerate(dict.fromkeys(w[0] for w in windows))}
        resampled = blocks([logs[window[0]] for window in windows])
        errors = [window_errors(run, windows, scales) for run in runs]
        known = np.isfinite(np.stack(errors)).all(axis=0)
        if not known.all():
            resampled = blocks([logs[w[0]] for w, ok in zip(windows, known, strict=True) if ok])
        if not known.any():
            continue
        out[protocol] = {
            run.name: {
                "windows": int(known.sum()),
                "mean": float(own[known].mean()),
                **difference(own[known], errors[0][known], runs[0].name, resampled),
            }
            for run, own in zip(runs, errors, strict=True)
        }
    return out
