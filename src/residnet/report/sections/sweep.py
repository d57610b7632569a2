"""The report of a sweep: the best trials, what their keys matter, and all trials."""

from __future__ import annotations

import json
from collections.abc import Sequence

from residnet.report.blocks import Cell, Figure, Section, Table, Text
from residnet.report.figures.files import figures_section, write_drawings
from residnet.report.figures.sweep import course_of_sweep, parallel_coordinates, shares
from residnet.report.format import fixed, number
from residnet.report.run_reader import Content, RunFiles

_SHOWN = 15


def draw(run: RunFiles) -> list[Figure]:
    """Write the figures of a sweep from its folder alone; returns them."""
    content = run.json("sweep.json")
    if content["best"] is None:
        return write_drawings(run.path / "figures", [])
    drawings = [parallel_coordinates(content), course_of_sweep(content)]
    if content["importance"]:
        drawings.append(shares(content))
    return write_drawings(run.path / "figures", drawings)


def sections(run: RunFiles) -> list[Section]:
    """Return the best trials, the figures that stand in the folder, and all trials."""
    content = run.json("sweep.json")
    about = [
        f"Each trial is a run of its own below trials/; sought is the"
        f" {'least' if content['minimized'] else 'greatest'} {objective(content)}.",
        "best.yaml holds the config of the best trial with all its keys.",
    ]
    out = [Section("The best trials", [trials_table(content), Text(about, quiet=True)])]
    figures = figures_section(run.path / "figures")
    if figures is not None:
        out.append(figures)
    by_number = sorted(content["trials"], key=lambda row: int(row["number"]))
    out.append(Section("All trials", [_table(content, by_number)], folded=True))
    return out


def trials_table(content: Content) -> Table:
    """Return the best trials with their values, the best first.

    Args:
        content: of sweep.json.
    """
    sign = 1.0 if content["minimized"] else -1.0
    finished = [row for row in content["trials"] if row["value"] is not None]
    finished.sort(key=lambda row: (sign * row["value"], row["number"]))
    return _table(content, finished[:_SHOWN])


def _table(content: Content, rows: Sequence[Content]) -> Table:
    keys = content["keys"]
    table = Table(["trial", objective(content), *keys, "run [s]", "state"])
    for row in rows:
        cells = [
            Cell(number(row["value"], 5) if row["value"] is not None else ""),
            *(Cell(_shown(row["values"][key])) for key in keys),
            Cell(fixed(row["seconds"], 1)),
            Cell(row["state"], row["fault"], mark="text"),
        ]
        table.add(str(row["number"]), cells, selected=row["number"] == content["best"])
    return table


def objective(content: Content) -> str:
    """Return what is sought, without the sign of a number that has no unit."""
    return str(content["objective"]).removesuffix(" [-]")


def _shown(value: object) -> str:
    return f"{value:.4g}" if isinstance(value, float) else json.dumps(value)
