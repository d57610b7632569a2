"""The report page of a search over a table of settings (Tables 5.2, 5.3 and Figure 5.7)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from residnet.documents.cells import pictures
from residnet.documents.halvorsen2019.breeding.config import BreedingSettings, Value
from residnet.report.blocks import Cell, Section, Table, Text
from residnet.report.figures.style import RC, new_figure, save
from residnet.report.format import DASH, number

Rows = Sequence[Mapping[str, Any]]
_LEAST = 1e-34
"""Least error in the picture, in (m/s^2)^2: what rounding leaves is less."""
_PUBLISHED_RUNS = 10
"""Number of runs of each combination in Tables 5.2 and 5.3."""


def verdict(config: BreedingSettings, rows: Rows) -> list[str]:
    """Return the sentences that sum the search up."""
    runs = config.repeats * len(rows)
    found = sum(row["found"] for row in rows)
    sentences = [
        f"The equation is found in {found} of {runs} runs: their mean square error on the test"
        f" record is below {config.threshold:g} (m/s^2)^2."
    ]
    printed = [row for row in rows if row["published_found"] is not None]
    if printed:
        ours, theirs = (sum(row[key] for row in printed) for key in ("found", "published_found"))
        sentences.append(
            f"Document 000 finds it in {theirs:g} of the {_PUBLISHED_RUNS * len(printed)} runs of"
            f" the same table; here it is {ours} of {config.repeats * len(printed)}."
        )
    best = [f"{_text(row['column'])} ({_text(row['row'])})" for row in least(config, rows)]
    sentences.append(f"The mean error is least at {config.columns.key} = {', '.join(best)}.")
    right = sum(row["right"] for row in rows)
    return [*sentences, f"In {right} of {runs} runs the terms are exactly the true ones."]


def least(config: BreedingSettings, rows: Rows) -> list[Mapping[str, Any]]:
    """Return for each value of the first setting the row of the least mean error."""
    return [
        min((row for row in rows if row["row"] == value), key=lambda row: float(row["error"]))
        for value in config.rows.values
    ]


def main_figures(config: BreedingSettings, rows: Rows) -> dict[str, tuple[float, str]]:
    """Return the numbers that sum the search up, with their units."""
    runs = config.repeats * len(rows)
    return {
        "share of runs that find the equation": (sum(row["found"] for row in rows) / runs, "-"),
        "share of runs with the true terms": (sum(row["right"] for row in rows) / runs, "-"),
    }


def sections(config: BreedingSettings, rows: Rows, run: Path) -> list[Section]:
    """Return the sections of the report.

    Args:
        config: the study.
        rows: its results, one for each combination.
        run: run folder, which holds the figure.
    """
    about = Text(
        [
            f"Each cell shows in how many of {config.repeats} runs the mean square error on the"
            f" test record is below {config.threshold:g} (m/s^2)^2. In small print stand the"
            " document's number of ten runs, in how many runs the terms are the true ones, and the"
            " mean of the mean square errors.",
            f"Rows: {config.rows.key}. Columns: {config.columns.key}.",
        ]
    )
    return [
        Section("Equations found", [about, _table(config, rows), *pictures(run, "study")]),
        Section("All equations", [_equations(rows)], folded=True),
    ]


def _table(config: BreedingSettings, rows: Rows) -> Table:
    cells = {(row["row"], row["column"]): row for row in rows}
    table = Table([config.rows.key, *(_text(value) for value in config.columns.values)])
    for value in config.rows.values:
        table.add(
            _text(value), [_cell(cells.get((value, other))) for other in config.columns.values]
        )
    return table


def _cell(row: Mapping[str, Any] | None) -> Cell:
    if row is None:
        return Cell(DASH)
    published = "" if row["published_found"] is None else f"published {row['published_found']:g}; "
    return Cell(str(row["found"]), f"{published}{row['right']} true; {number(row['error'], 2)}")


def _equations(rows: Rows) -> Table:
    table = Table(["setting", "seed", "equation of the acceleration"])
    for row in rows:
        for seed, equation in enumerate(row["equations"]):
            text = " + ".join(f"{number(value, 4)} {term}" for term, value in equation.items())
            table.add(
                f"{_text(row['row'])}, {_text(row['column'])}",
                [str(seed), Cell(text or DASH, mark="text")],
            )
    return table


def _text(value: Value) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


def draw(config: BreedingSettings, rows: Rows, file: Path) -> None:
    """Draw how many runs find the equation over the columns, with one line for each row."""
    from matplotlib import rc_context

    columns = list(config.columns.values)
    with rc_context(RC):
        figure = new_figure(3.2)
        axes, errors = figure.subplots(1, 2)
        for place, value in enumerate(config.rows.values):
            members = [row for row in rows if row["row"] == value]
            x = [columns.index(row["column"]) for row in members]
            axes.plot(
                x,
                [row["found"] for row in members],
                marker="o",
                markersize=3,
                color=f"C{place}",
                label=_text(value),
            )
            errors.semilogy(
                x, [max(row["error"], _LEAST) for row in members], marker="o", markersize=3
            )
            if all(row["published_found"] is not None for row in members):
                axes.plot(
                    x,
                    [row["published_found"] for row in members],
                    linestyle=":",
                    color=f"C{place}",
                )
        for panel in (axes, errors):
            panel.set_xticks(range(len(columns)), [_text(value) for value in columns], rotation=60)
            panel.set_xlabel(config.columns.key)
        errors.set_ylabel("mean square error [(m/s^2)^2]")
        axes.set_ylabel(f"found, of {config.repeats}")
        axes.legend(title=config.rows.key, ncols=4, loc="lower center", bbox_to_anchor=(0.5, 1.0))
        save(
            figure,
            file,
            "Equations found",
            "Left: number of runs below the error threshold, ours (lines) and the document's"
            " (dotted). Right: mean of the mean square errors on the test record.",
        )
