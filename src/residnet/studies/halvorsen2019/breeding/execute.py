"""Task `breeding`: genetic programming on a mass-spring-damper (Halvorsen 2019, chapter 5)."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, final

import numpy as np

from residnet.core import progress
from residnet.core.errors import require_package
from residnet.core.format import DASH, format_number
from residnet.regression.expressions import Algebra, format_product
from residnet.regression.genetic import evolve_equation, expression_limits, validation_mask
from residnet.report.blocks import Cell, Section, Text, build_table
from residnet.report.figure import COLORS, Case, Figure, GlyphStyle, Panel, tick_labels
from residnet.runs.folder import RunFolder
from residnet.runs.task import SummaryMetric
from residnet.studies.halvorsen2019.breeding.config import (
    CHANNELS,
    TRUE_COEFFICIENTS,
    BreedingTaskConfig,
    SearchConfig,
    SettingValue,
)
from residnet.studies.study import StudyExecutor, StudyResults, find_figures

_MIN_PLOTTED_ERROR = 1e-34
"""Smallest plotted error, in (m/s^2)^2, on the logarithmic axis; rounding errors are smaller."""
_PUBLISHED_RUNS = 10
"""Number of runs of each combination in Tables 5.2 and 5.3."""


def check(config: BreedingTaskConfig) -> None:
    require_package("deap", "genetic programming", "gp")


@final
class BreedingExecutor(StudyExecutor[BreedingTaskConfig]):
    """Search for the equation of the mass-spring-damper with every combination of two settings."""

    def compute_results(self, folder: RunFolder) -> tuple[dict[str, Any], Iterable[Figure]]:
        rows = []
        cells = self.config.combinations()
        for n_done, (i, j) in enumerate(cells):
            progress.report_progress("searching equations", n_done, len(cells))
            settings = self.config.combination_config(i, j)
            start_time = time.process_time()
            trials = [run_search_trial(settings, seed) for seed in range(self.config.repeats)]
            errors, equations = ([*values] for values in zip(*trials, strict=True))
            rows.append(
                {
                    "row": self.config.rows.values[i],
                    "column": self.config.columns.values[j],
                    "found": sum(error < self.config.threshold for error in errors),
                    "published_found": self.config.published and self.config.published[i][j],
                    "right": sum(set(equation) == set(TRUE_COEFFICIENTS) for equation in equations),
                    "error": sum(errors) / len(errors),
                    "published_error": self.config.published_error
                    and self.config.published_error[i][j],
                    "seconds": (time.process_time() - start_time) / self.config.repeats,
                    "equations": equations,
                }
            )
        progress.report_progress("searching equations", len(cells), len(cells))
        content = {
            "schema": "residnet.breeding/1",
            "run": self.config.name,
            "keys": (self.config.rows.key, self.config.columns.key),
            "rows": rows,
            # where the mean error is least, for each value of the first setting
            "least": {
                str(value): min(
                    (row for row in rows if row["row"] == value), key=lambda row: row["error"]
                )["column"]
                for value in self.config.rows.values
            },
        }
        return content, [_result_figure(self.config, rows)]

    def summarize(self, results: StudyResults) -> list[str]:
        rows = results["rows"]
        runs = self.config.repeats * len(rows)
        sentences = [
            f"The equation is found in {sum(row['found'] for row in rows)} of {runs} runs: their"
            f" mean square error on the test record is below {self.config.threshold:g} (m/s^2)^2."
        ]
        published_rows = [row for row in rows if row["published_found"] is not None]
        if published_rows:
            n_found, n_published = (
                sum(row[key] for row in published_rows) for key in ("found", "published_found")
            )
            sentences.append(
                f"Halvorsen 2019 finds it in {n_published:g} of the"
                f" {_PUBLISHED_RUNS * len(published_rows)} runs of the same table; here it is"
                f" {n_found} of {self.config.repeats * len(published_rows)}."
            )
        best_columns = [
            f"{_format_value(column)} ({row})" for row, column in results["least"].items()
        ]
        sentences.append(
            f"The mean error is least at {self.config.columns.key} = {', '.join(best_columns)}."
        )
        n_true_terms = sum(row["right"] for row in rows)
        return [
            *sentences,
            f"In {n_true_terms} of {runs} runs the terms are exactly the true ones.",
        ]

    def main_figures(self, results: StudyResults) -> dict[str, SummaryMetric]:
        rows = results["rows"]
        descriptions = {"found": "that find the equation", "right": "with the true terms"}
        return {
            f"share of runs {description}": SummaryMetric(
                sum(row[key] for row in rows) / (self.config.repeats * len(rows))
            )
            for key, description in descriptions.items()
        }

    def build_sections(self, results: StudyResults, run: Path) -> list[Section]:
        rows = results["rows"]
        explanation = Text(
            is_secondary=True,
            paragraphs=[
                f"Each cell shows in how many of {self.config.repeats} runs the mean square error"
                f" on the test record is below {self.config.threshold:g} (m/s^2)^2. Small print:"
                " the number in the document (of ten runs), the number of runs with exactly the"
                " true terms, and the mean of the mean square errors.",
                f"Rows: {self.config.rows.key}. Columns: {self.config.columns.key}.",
            ],
        )
        cells = {(row["row"], row["column"]): row for row in rows}

        def cell(value: SettingValue, column_value: SettingValue) -> Cell:
            row = cells.get((value, column_value))
            if row is None:
                return Cell(DASH)
            n_published = row["published_found"]
            published_text = "" if n_published is None else f"published {n_published:g}; "
            note = f"{published_text}{row['right']} true; {format_number(row['error'], 2)}"
            return Cell(str(row["found"]), note)

        table = build_table(
            self.config.rows.values,
            [
                (self.config.rows.key, _format_value),
                *(
                    (
                        _format_value(column_value),
                        lambda value, other=column_value: cell(value, other),
                    )
                    for column_value in self.config.columns.values
                ),
            ],
        )
        all_equations = [
            (row, seed, equation) for row in rows for seed, equation in enumerate(row["equations"])
        ]

        def equation_text(row: Any) -> str:
            terms = [f"{format_number(value, 4)} {name}" for name, value in row[2].items()]
            return " + ".join(terms) or DASH

        equations = build_table(
            all_equations,
            [
                (
                    "setting",
                    lambda row: (
                        f"{_format_value(row[0]['row'])}, {_format_value(row[0]['column'])}"
                    ),
                ),
                ("seed", lambda row: Cell(str(row[1]))),
                ("equation of the acceleration", equation_text),
            ],
        )
        return [
            Section(
                "",
                [
                    *(picture.preview() for picture in find_figures(run, "study")),
                    table,
                    explanation,
                ],
            ),
            Section("Found by setting", find_figures(run, "study")),
            Section("All equations", [equations], is_folded=True),
        ]


def run_search_trial(settings: SearchConfig, seed: int) -> tuple[float, dict[str, float]]:
    """Search the equation of u_dot once.

    Args:
        settings: settings of the search.
        seed: seed of the noise and of the search.

    Returns:
        Mean square error on the test record without noise in (m/s^2)^2, and coefficients by term.

    Raises:
        FitError: if the data do not determine an equation.
        UsageError: if DEAP is not installed.
    """
    record = settings.record
    head = settings.head
    clean_record = record.simulate(record.period)
    noisy_record = settings.noise.add_noise(clean_record, np.random.default_rng(seed))
    algebra = Algebra(CHANNELS, expression_limits(head.evolution))
    train = ~validation_mask(np.zeros(len(clean_record["x"]), dtype=int), head.validate_every)
    best_individual = evolve_equation(
        algebra, noisy_record, noisy_record["u_dot"], train, head, seed
    )
    test_record = record.simulate(record.test_period)
    predicted = np.zeros(len(test_record["x"]))
    if best_individual.products:
        predicted = np.array(best_individual.values) @ algebra.evaluate_products(
            best_individual.products, test_record
        )
    term_names = [format_product(algebra, product) for product in best_individual.products]
    error = float(np.square(predicted - test_record["u_dot"]).mean())
    return error, dict(zip(term_names, best_individual.values, strict=True))


def _format_value(value: SettingValue) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


def _result_figure(config: BreedingTaskConfig, rows: Sequence[Mapping[str, Any]]) -> Figure:
    """Return the figure of the numbers of successful runs and of their mean errors."""
    columns = list(config.columns.values)
    styles: dict[str, GlyphStyle] = {}
    counts: dict[str, Any] = {}
    mean_errors: dict[str, Any] = {}
    for row_index, value in enumerate(config.rows.values):
        setting_rows = [row for row in rows if row["row"] == value]
        x = np.array([columns.index(row["column"]) for row in setting_rows], dtype=float)
        name = _format_value(value)
        color = COLORS[row_index % len(COLORS)]
        styles[name] = GlyphStyle(f"{config.rows.key} {name}", color)
        styles[f"{name} points"] = GlyphStyle("", color, kind="points", size=3)
        styles[f"{name} published"] = GlyphStyle("", color, "dotted")
        counts[name] = counts[f"{name} points"] = (
            x,
            np.array([row["found"] for row in setting_rows]),
        )
        error = np.array([max(row["error"], _MIN_PLOTTED_ERROR) for row in setting_rows])
        mean_errors[name] = mean_errors[f"{name} points"] = (x, error)
        if all(row["published_found"] is not None for row in setting_rows):
            published_counts = np.array([row["published_found"] for row in setting_rows])
            counts[f"{name} published"] = (x, published_counts)
    panel_settings: Any = {
        "x_label": config.columns.key,
        "height": 330,
        "x_names": tick_labels(map(_format_value, columns)),
    }
    return Figure(
        "study",
        "Equations found",
        "Left: number of runs below the error threshold, ours (lines) and the document's"
        " (dotted). Right: mean of the mean square errors on the test record.",
        styles,
        [
            Panel(f"found, of {config.repeats}", **panel_settings),
            Panel("mean square error [(m/s^2)^2]", y_log=True, **panel_settings),
        ],
        [Case("", [counts, mean_errors])],
        columns=2,
    )
