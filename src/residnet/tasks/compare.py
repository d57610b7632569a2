"""`residnet compare`: finished fits side by side over common windows, and what they differ in."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from residnet.core.errors import UsageError
from residnet.core.format import number, signed
from residnet.core.ownership import recorded_folder
from residnet.judge.metrics import blocks, difference
from residnet.report.blocks import Block, Cell, Section, Table, paired_interval, table_of
from residnet.report.figure import GLANCE, Case, Figure, Panel, family
from residnet.report.figure_files import write_figure
from residnet.report.page import write_page
from residnet.report.run_reader import RunFiles, StoredWindow
from residnet.report.sections.free_runs import errors_table
from residnet.report.sections.runs import growth
from residnet.runs.folder import RunFolder

_MOST = 60
"""Settings in which runs differ that the page shows."""
_ABSENT = object()
Window = tuple[str, str, float]
"""Log, protocol and first time of a window."""


class JudgedRun(RunFiles):
    """A finished fit, as far as runs are compared: by its selected model.

    Attributes:
        name: that tells it from the others.
    """

    def __init__(self, name: str, path: Path) -> None:
        super().__init__(RunFolder.open(path).path)
        if not (path / "metrics.json").is_file():
            raise UsageError(f"{path}: has no metrics.json; runs of fits can be compared")
        self.name, self.model = name, str(self.metrics["selected"])

    @cached_property
    def of(self) -> dict[Window, StoredWindow]:
        """The free runs that it was judged on."""
        found = self.windows(self.focus)
        return {(one.log, one.protocol, round(float(one.t[0]), 3)): one for one in found}


def compare_runs(paths: Sequence[Path], out: Path) -> tuple[str, Path]:
    """Compare finished fits; returns the table for the terminal and the page.

    Args:
        paths: folders of the runs; the first is what the others are compared with.

    Raises:
        UsageError: where a folder holds no finished fit, or the page cannot be written.
    """
    runs = judged_runs(paths)
    pairs = paired(runs)
    of_runs = [errors_table(run, run.focus) for run in runs]
    for run, table in zip(runs, of_runs, strict=True):
        table.caption = f"{run.name}. {table.caption}"
    found = _differing([run.resolved for run in runs], "")
    found = [pair for pair in found if pair[0] not in ("name", "description")]
    more = f" The first {_MOST} of {len(found)} stand here." if len(found) > _MOST else ""
    told = f"What the runs were asked to do differently; what is alike is left out.{more}"
    differing = table_of(
        found[:_MOST],
        [
            ("setting", lambda pair: pair[0]),
            *((run.name, lambda pair, i=i: pair[1][i]) for i, run in enumerate(runs)),
        ],
        caption=told if found else "The runs were asked to do the same.",
    )
    against = [_paired_table(runs, pairs)] if pairs else []
    verdict = _sentence(runs, pairs)
    with recorded_folder(out):
        sections = []
        if pairs:
            # of the first protocol, for the first screen: error, difference, interval
            main = {protocol: pairs[protocol] for protocol in list(pairs)[:1]}
            glance = _paired_table(runs, main).part(3, 6)
            glance.caption = f"Selected models, {next(iter(main))}."
            sections.append(Section("", [_curves(runs, out), glance]))
            sections.append(Section("Selected models over common windows", against))
        sections += [
            Section("Every model of every run", of_runs),
            Section("Where the runs differ", [differing]),
        ]
        names = " against ".join(run.name for run in runs)
        page = write_page(out, "Runs compared", names, [verdict], sections)
    tables = [table.text() for table in (*of_runs, *against, differing)]
    return "\n\n".join([*tables, verdict]), page


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
    runs = [JudgedRun(name, path) for name, path in zip(names, paths, strict=True)]
    for run in runs:
        if not shared_channels([runs[0], run]):
            raise UsageError(
                f"compare: {run.name} predicts {', '.join(run.live.channels)}, and"
                f" {runs[0].name} {', '.join(runs[0].live.channels)}; name runs that share a"
                " velocity (signals.velocities)"
            )
    return runs


def shared_channels(runs: Sequence[JudgedRun]) -> list[str]:
    """Return what moves in all runs, in the order of the first: what they are compared by."""
    return [name for name in runs[0].live.channels if all(name in r.live.channels for r in runs)]


def _common(runs: Sequence[JudgedRun]) -> dict[str, list[Window]]:
    """Return the windows by protocol that all runs were judged on, of one and the same length."""
    shared = set.intersection(*(set(run.of) for run in runs))
    out: dict[str, list[Window]] = {}
    for window in sorted(shared):
        if len({len(run.of[window].t) for run in runs}) == 1:
            out.setdefault(window[1], []).append(window)
    return out


def paired(runs: Sequence[JudgedRun]) -> dict[str, dict[str, Any]]:
    """Return protocol -> run -> difference to the first run over common windows.

    Errors are normalised root mean squares, the mean over what moves in all runs, by the first
    run's scales.
    """
    out: dict[str, dict[str, Any]] = {}
    scales = {str(name): float(scale) for name, scale in _scales(runs).items()}
    for protocol, windows in _common(runs).items():
        errors = [
            np.array([run.of[window].nrmse(run.model, scales) for window in windows])
            for run in runs
        ]
        logs = list(dict.fromkeys(window[0] for window in windows))
        resampled = blocks([logs.index(window[0]) for window in windows])
        out[protocol] = {
            run.name: {
                "windows": len(windows),
                "mean": float(own.mean()),
                **difference(own, errors[0], runs[0].name, resampled),
            }
            for run, own in zip(runs, errors, strict=True)
        }
    return out


def _scales(runs: Sequence[JudgedRun]) -> pd.Series:
    """Return the first run's scales of what moves in all runs."""
    return pd.Series(runs[0].metrics["scales"], dtype=float)[shared_channels(runs)]


def _paired_table(runs: Sequence[JudgedRun], pairs: Mapping[str, Mapping[str, Any]]) -> Table:
    first = runs[0].name
    rows = [
        {**entries[run.name], "run": run.name, "model": run.model, "protocol": protocol}
        for protocol, entries in pairs.items()
        for run in runs
    ]
    least = {
        protocol: min(entry["mean"] for entry in entries.values())
        for protocol, entries in pairs.items()
    }

    def apart(row: Mapping[str, Any]) -> str:
        return "" if row["run"] == first else signed(row["nrmse_mean"])

    def interval(row: Mapping[str, Any]) -> Cell:
        own = row["run"] == first
        return Cell("") if own else paired_interval(row["ci95"], "too few logs")

    return table_of(
        rows,
        [
            ("run", "run"),
            ("model", "model"),
            ("protocol", "protocol"),
            ("windows", "windows", str),
            ("NRMSE [-]", "mean", number),
            ("difference", apart, str),
            ("95 % interval", interval),
        ],
        caption="Selected models over the windows that all runs were judged on, by the scales of"
        f" {first}; differences to {first}, negative where the run is better.",
        selected=lambda row: row["mean"] == least[row["protocol"]],
        rule=lambda row: row["protocol"],
    )


def _differing(values: Sequence[Any], path: str) -> list[tuple[str, list[str]]]:
    """Return the paths below which values differ, with what each says there."""
    if all(value == values[0] for value in values):
        return []
    if not all(isinstance(value, Mapping) for value in values):
        return [(path, [_short(value) for value in values])]
    out = []
    for key in dict.fromkeys(key for value in values for key in value):
        below = [value.get(key, _ABSENT) for value in values]
        out += _differing(below, f"{path}.{key}" if path else str(key))
    return out


def _short(value: Any) -> str:
    """Return a value in a few words; of a part with many settings its kind or its first ones."""
    match value:
        case None | [] | ():
            return "none"
        case bool():
            return "yes" if value else "no"
        case float():
            return f"{value:.4g}"
        case {"kind": kind}:
            return f"there (kind {kind})"
        case Mapping():
            parts = [f"{key} {_short(part)}" for key, part in value.items()]
            more = " ..." if len(parts) > 2 else ""
            return f"there ({', '.join(parts[:2])}{more})" if parts else "there"
        case list() | tuple():
            text = ", ".join(map(_short, value))
        case _:
            text = "not there" if value is _ABSENT else f"{value}"
    return text if len(text) <= 80 else f"{text[:77]}..."


def _sentence(runs: Sequence[JudgedRun], pairs: Mapping[str, Mapping[str, Any]]) -> str:
    if not pairs:
        return "The runs have no window of a log in common: their errors stand beside each other."
    protocol, entries = next(iter(pairs.items()))
    best = min(runs, key=lambda run: float(entries[run.name]["mean"]))
    if best is runs[0]:
        return f"Over the common windows of {protocol}, no run is better than {best.name}."
    entry = entries[best.name]
    sure = ", beyond chance." if entry["excludes_zero"] else ", which may be chance."
    return (
        f"Over {entry['windows']} common windows of {protocol}, {best.name} ({best.model}) has"
        f" the least error: {entry['nrmse_mean']:+.3f} against {runs[0].name}{sure}"
    )


def _curves(runs: Sequence[JudgedRun], out: Path) -> Block:
    """Draw how the errors of the selected models grow over the common windows."""
    protocol, windows = next(iter(_common(runs).items()))
    scales, curves = _scales(runs), {}
    for run in runs:
        error = growth([run.of[window] for window in windows], run.model)[scales.index] / scales
        curves[run.name] = (error.index.to_numpy(), error.mean(axis=1).to_numpy())
    figure = Figure(
        "horizon",
        "Error against horizon",
        f"Selected models over {len(windows)} common windows of {protocol}, mean over"
        f" {', '.join(scales.index)}.",
        family(curves),
        [Panel("error [-]", "time from the start of a free run [s]", height=GLANCE)],
        [Case("", [curves])],
    )
    return write_figure(out / "figures", figure)
