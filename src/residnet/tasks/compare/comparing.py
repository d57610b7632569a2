"""What `residnet compare` makes of runs: one table, one page, and what their configs differ in."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from residnet.core.config import load_mapping
from residnet.core.errors import UsageError
from residnet.report.blocks import Block, Cell, Section, Table
from residnet.report.figure import Case, Figure, Panel, family, write_figure
from residnet.report.page import write_page
from residnet.tasks.compare.errors import JudgedRun, common_windows, judged_runs, paired

_MOST = 60
_ABSENT = object()


def compare_runs(paths: Sequence[Path], out: Path) -> tuple[str, Path]:
    """Compare finished fits; returns the table for the terminal and the page.

    Args:
        paths: folders of the runs; the first is what the others are compared with.
        out: folder of the page.

    Raises:
        UsageError: where a folder holds no finished fit, or the page cannot be written.
    """
    runs = judged_runs(paths)
    pairs, metrics, configs = paired(runs), metrics_table(runs), config_table(runs)
    paired_rows = paired_table(runs, pairs)
    verdict = [_sentence(runs, pairs)]
    try:
        out.mkdir(parents=True, exist_ok=True)
        blocks: list[Block] = [_curves(runs, out)] if pairs else []
        sections = [
            *([Section("On common logs", [paired_rows, *blocks])] if pairs else []),
            Section("Every model of every run", [metrics]),
            Section("Where the runs differ", [configs]),
        ]
        names = " against ".join(run.name for run in runs)
        page = write_page(out, "Runs compared", names, verdict, sections)
    except OSError as error:
        raise UsageError(f"{out}: cannot be written ({error.strerror})") from error
    tables = [metrics, *([paired_rows] if pairs else []), configs]
    text = "\n\n".join([*(table.text() for table in tables), verdict[0]])
    return text, page


def metrics_table(runs: Sequence[JudgedRun]) -> Table:
    """Return the errors of all models of all runs."""
    table = Table(
        ["run", "model", "protocol", "u [m/s]", "v [m/s]", "r [deg/s]", "NRMSE [-]", "diverged"],
        caption="Errors in free run on the test split of each run, by that run's own scales.",
    )
    for run in runs:
        for number, row in enumerate(run.rows()):
            selected = row["model"] == run.selected
            rmse = row["rmse"]
            cells = [
                Cell(f"{row['model']}{' (selected)' if selected else ''}", mark="text"),
                Cell(str(row["protocol"]), mark="text"),
                Cell(f"{rmse['u']:.3g}"),
                Cell(f"{rmse['v']:.3g}"),
                Cell(f"{np.degrees(rmse['r']):.3g}"),
                Cell(f"{row['nrmse']['mean']:.3g}"),
                Cell(f"{row['diverged']}/{row['windows']}"),
            ]
            table.add(run.name, cells, rule=number == 0, selected=selected)
    return table


def paired_table(runs: Sequence[JudgedRun], pairs: Mapping[str, Mapping[str, Any]]) -> Table:
    """Return the paired differences of the selected models to that of the first run."""
    table = Table(
        ["run", "model", "protocol", "windows", "NRMSE [-]", "difference", "95 % interval"],
        caption=(
            "Selected models over the windows that all runs were judged on, by the scales of"
            f" {runs[0].name}; differences to {runs[0].name}, negative where the run is better."
        ),
    )
    for protocol, entries in pairs.items():
        for number, run in enumerate(runs):
            entry = entries[run.name]
            interval = entry["ci95"]
            told = (
                "too few logs" if interval is None else f"{interval[0]:+.3f} to {interval[1]:+.3f}"
            )
            first = number == 0
            cells = [
                Cell(run.selected, mark="text"),
                Cell(protocol, mark="text"),
                Cell(str(entry["windows"])),
                Cell(f"{entry['mean']:.3g}"),
                Cell("" if first else f"{entry['nrmse_mean']:+.3f}"),
                Cell("" if first else told),
            ]
            table.add(run.name, cells, rule=first)
    return table


def config_table(runs: Sequence[JudgedRun]) -> Table:
    """Return the settings in which the runs differ.

    A part that only some runs have, such as a head, stands in one line.
    """
    contents = [dict(load_mapping(run.folder.resolved)) for run in runs]
    found = [pair for pair in _differing(contents, "") if pair[0] not in ("name", "description")]
    more = f" The first {_MOST} of {len(found)} stand here." if len(found) > _MOST else ""
    table = Table(
        ["setting", *(run.name for run in runs)],
        caption=(
            f"What the runs were asked to do differently; what is alike is left out.{more}"
            if found
            else "The runs were asked to do the same."
        ),
    )
    for key, texts in found[:_MOST]:
        table.add(key, [Cell(text, mark="text") for text in texts])
    return table


def _differing(values: Sequence[Any], path: str) -> list[tuple[str, list[str]]]:
    """Return the paths below which values differ, with what each says there."""
    if all(value == values[0] for value in values):
        return []
    if not all(isinstance(value, Mapping) for value in values):
        return [(path, [_short(value) for value in values])]
    keys = dict.fromkeys(key for value in values for key in value)
    return [
        pair
        for key in keys
        for pair in _differing(
            [value.get(key, _ABSENT) for value in values], f"{path}.{key}" if path else str(key)
        )
    ]


def _short(value: Any) -> str:
    """Return a value in a few words; of a part with many settings its kind or its first ones."""
    if value is _ABSENT:
        return "not there"
    if value is None:
        return "none"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, Mapping):
        kind = value.get("kind")
        parts = [f"{key} {_short(part)}" for key, part in value.items() if key != "kind"]
        rest = "" if kind else f" {', '.join(parts[:2])}{' ...' if len(parts) > 2 else ''}"
        return f"there{f' (kind {kind})' if kind else rest and f' ({rest.strip()})'}"
    if isinstance(value, (list, tuple)) and not value:
        return "none"
    text = ", ".join(map(_short, value)) if isinstance(value, (list, tuple)) else f"{value}"
    return text if len(text) <= 80 else f"{text[:77]}..."


def _sentence(runs: Sequence[JudgedRun], pairs: Mapping[str, Mapping[str, Any]]) -> str:
    if not pairs:
        return "The runs have no window of a log in common: their errors stand beside each other."
    protocol, entries = next(iter(pairs.items()))
    best = min(runs, key=lambda run: float(entries[run.name]["mean"]))
    if best is runs[0]:
        return f"Over the common windows of {protocol}, no run is better than {best.name}."
    entry = entries[best.name]
    sure = entry["excludes_zero"]
    return (
        f"Over {entry['windows']} common windows of {protocol}, {best.name} ({best.selected}) has"
        f" the least error: {entry['nrmse_mean']:+.3f} against {runs[0].name}"
        + (", beyond chance." if sure else ", which may be chance.")
    )


def _curves(runs: Sequence[JudgedRun], out: Path) -> Block:
    """Draw how the errors of the selected models grow over the common windows."""
    windows = common_windows(runs)
    protocol = windows[0][1]
    chosen = [window for window in windows if window[1] == protocol]
    shortest = min(len(runs[0].series[window][0]) for window in chosen)
    curves = {}
    for run in runs:
        size = np.stack([(run.series[window][1][:shortest] ** 2) for window in chosen])
        growth = np.sqrt(np.nanmean(size, axis=0)) / runs[0].scales
        curves[run.name] = (run.series[chosen[0]][0][:shortest], growth.mean(axis=1))
    figure = Figure(
        "horizon",
        "Error against horizon",
        f"Selected models over {len(chosen)} common windows of {protocol}, mean over u, v, r.",
        family(curves),
        [Panel("error [-]", "time from the start of a free run [s]", height=300)],
        [Case("", [curves])],
    )
    return write_figure(out / "figures", figure)
