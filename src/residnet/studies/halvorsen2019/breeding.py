"""Task `breeding`: genetic programming on a mass-spring-damper (document 000, chapter 5)."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, final

import numpy as np
from pydantic import Field, model_validator

from residnet.core import progress
from residnet.core.config import Config, Seconds, apply_override, validate_config
from residnet.core.errors import ConfigError, require_package
from residnet.core.format import DASH, format_number
from residnet.heads.genetic_config import GeneticConfig
from residnet.regression.expressions import Algebra, format_product
from residnet.regression.genetic import evolve_equation, expression_limits, validation_mask
from residnet.report.blocks import Cell, Section, Text, build_table
from residnet.report.figure import COLORS, Case, Figure, GlyphStyle, Panel, tick_labels
from residnet.runs.folder import RunFolder
from residnet.runs.task import SummaryMetric
from residnet.studies.study import StudyResults, StudyTask, find_figures

SettingValue = int | float | str
Matrix = tuple[tuple[float | None, ...], ...]
SignalRecord = dict[str, np.ndarray]
CHANNELS = ("x", "u", "tau_x")
MASS = 10.0
DAMPING = 13.0
STIFFNESS = 5.0
"""The system m x_ddot + d x_dot + k x = tau (4.1) in kg, kg/s and N/m (section 5.3, (5.13)); the
system of (4.3) has other values: 20 kg, 10 kg/s, 12 N/m (correction H24).
"""
TRUE_COEFFICIENTS = {"tau_x": 1.0 / MASS, "u": -DAMPING / MASS, "x": -STIFFNESS / MASS}
"""True coefficients of u_dot (4.2) by term."""
_MIN_PLOTTED_ERROR = 1e-34
"""Smallest plotted error, in (m/s^2)^2, on the logarithmic axis; rounding errors are smaller."""
_PUBLISHED_RUNS = 10
"""Number of runs of each combination in Tables 5.2 and 5.3."""


class RecordConfig(Config):
    """A record of the mass-spring-damper under a square wave of a force of 1 N, from rest.

    Section 5.3.1 and Figure 5.3 of document 000.

    Attributes:
        length: length of the record in s.
        step: time between samples in s; the force is held over a step.
        period: period of the square wave in s; 6 pi s in the document.
        test_period: period in s of the square wave of the test record.
        delay: delay of the acting force relative to the recorded one, in s (section 5.3.4).
        corrected: delay that is applied to the recorded force as a correction, in s (Listing 5.1).
    """

    length: Seconds = Field(default=50.0, gt=0)
    step: Seconds = Field(default=0.1, gt=0)
    period: Seconds = Field(default=float(6 * np.pi), gt=0)
    test_period: Seconds = Field(default=10.0, gt=0)
    delay: Seconds = Field(default=0.0, ge=0)
    corrected: Seconds = Field(default=0.0, ge=0)

    def simulate(self, period: float) -> SignalRecord:
        """Return a record without noise.

        Args:
            period: period of the square wave in s.

        Returns:
            Displacement x in m, its rate u in m/s, the force tau_x in N and the acceleration u_dot
            in m/s^2, [N] each.
        """
        from scipy.linalg import expm

        t = self.step * np.arange(round(self.length / self.step))
        nominal_force = np.where(np.mod(t, period) < period / 2, 1.0, -1.0)
        # delayed by whole steps; the first value fills the beginning
        force, recorded_force = (
            np.concatenate((np.full(steps, nominal_force[0]), nominal_force))[: len(nominal_force)]
            for steps in (round(seconds / self.step) for seconds in (self.delay, self.corrected))
        )
        continuous_matrix = np.zeros((3, 3))
        continuous_matrix[:2] = [
            [0.0, 1.0, 0.0],
            [TRUE_COEFFICIENTS["x"], TRUE_COEFFICIENTS["u"], TRUE_COEFFICIENTS["tau_x"]],
        ]
        # exact discretisation for a force that is constant over a step (zero-order hold)
        transition = expm(continuous_matrix * self.step)[:2]
        state = np.zeros((len(t), 2))
        for i in range(1, len(t)):
            state[i] = transition @ [*state[i - 1], force[i - 1]]
        x, u = state.T
        u_dot = (force - DAMPING * u - STIFFNESS * x) / MASS
        return {"x": x, "u": u, "tau_x": recorded_force, "u_dot": u_dot}


class NoiseConfig(Config):
    """Uniform noise on the signals of a record, as a share of each signal's range (5.14).

    Attributes:
        on: noisy signals: the acceleration (`output`), the terms' signals (`inputs`), `all`, or
            `none`.
        factor: amplitude of the noise over the range of the signal (largest minus smallest value).
    """

    on: Literal["output", "inputs", "all", "none"] = "all"
    factor: float = Field(default=0.0, ge=0)

    def add_noise(self, record: SignalRecord, generator: np.random.Generator) -> SignalRecord:
        """Return the record with noise."""
        signals = {"output": ("u_dot",), "inputs": CHANNELS, "all": tuple(record)}
        noisy = signals.get(self.on, ())
        return {
            name: (
                values + self.factor * np.ptp(values) * generator.uniform(-1, 1, len(values))
                if name in noisy
                else values
            )
            for name, values in record.items()
        }


class StudyAxis(Config):
    """One setting of the study and the values that it takes.

    Attributes:
        key: dotted key of the setting, for example `head.evolution.population`.
        values: values of the setting, in the order of the table.
    """

    key: str = Field(pattern=r"^(head|noise|record)\.[a-z_.]+$")
    values: Annotated[tuple[SettingValue, ...], Field(min_length=1)]


class SearchConfig(Config):
    """Symbolic search of an equation for the acceleration.

    Attributes:
        record: record of the search.
        noise: noise on the record.
        head: settings of the search; `final: null` uses the best individual unchanged, as the
            document does.
    """

    record: RecordConfig = Field(default_factory=RecordConfig)
    noise: NoiseConfig = Field(default_factory=NoiseConfig)
    head: GeneticConfig = Field(default_factory=GeneticConfig)


@final
class BreedingTaskConfig(StudyTask, SearchConfig):
    """A search for the equation with every combination of two settings, several times each.

    Attributes:
        task: `breeding`.
        rows: first setting, one row of the table for each value.
        columns: second setting, one column of the table for each value.
        repeats: number of runs of each combination; their seeds are 0, 1, ...
        threshold: mean square error in (m/s^2)^2 on the test record below which an equation counts
            as found (section 5.2.2).
        published: number of runs in which the document finds the equation, one row for each row of
            the table; combinations with null are skipped.
        published_error: mean square errors that the document prints, in (m/s^2)^2, likewise.
    """

    task: Literal["breeding"]
    rows: StudyAxis
    columns: StudyAxis
    repeats: int = Field(default=10, ge=1, le=10_000)
    threshold: float = Field(default=5e-6, gt=0)
    published: Matrix | None = None
    published_error: Matrix | None = None

    @model_validator(mode="after")
    def _check_grid(self) -> BreedingTaskConfig:
        n_rows = len(self.rows.values)
        n_columns = len(self.columns.values)
        for name in ("published", "published_error"):
            table = getattr(self, name)
            if table is not None and [len(row) for row in table] != [n_columns] * n_rows:
                raise ValueError(
                    f"{name}: expected {n_rows} rows of {n_columns} numbers, one for each value"
                    " of rows and columns"
                )
        for row, column in self.combinations():
            try:
                self.combination_config(row, column)
            except ConfigError as error:
                raise ValueError(str(error)) from None
        return self

    def combinations(self) -> list[tuple[int, int]]:
        """Return row and column of each combination that is run."""
        return [
            (i, j)
            for i in range(len(self.rows.values))
            for j in range(len(self.columns.values))
            if self.published is None or self.published[i][j] is not None
        ]

    def combination_config(self, row: int, column: int) -> SearchConfig:
        """Return the settings of one combination.

        Raises:
            ConfigError: if a key of the two settings does not exist, or a value is not allowed.
        """
        config_parts = {
            name: getattr(self, name).model_dump() for name in SearchConfig.model_fields
        }
        pairs = ((self.rows, row), (self.columns, column))
        changes = [f"{axis.key}={axis.values[value_index]}" for axis, value_index in pairs]
        for change in changes:
            apply_override(config_parts, change)
        return validate_config(config_parts, SearchConfig, ", ".join(changes))

    def check(self) -> None:
        require_package("deap", "genetic programming", "gp")

    def compute_results(self, folder: RunFolder) -> tuple[dict[str, Any], Iterable[Figure]]:
        rows = []
        cells = self.combinations()
        for n_done, (i, j) in enumerate(cells):
            progress.report_progress("searching equations", n_done, len(cells))
            settings = self.combination_config(i, j)
            start_time = time.process_time()
            trials = [run_search_trial(settings, seed) for seed in range(self.repeats)]
            errors, equations = ([*values] for values in zip(*trials, strict=True))
            rows.append(
                {
                    "row": self.rows.values[i],
                    "column": self.columns.values[j],
                    "found": sum(error < self.threshold for error in errors),
                    "published_found": self.published and self.published[i][j],
                    "right": sum(set(equation) == set(TRUE_COEFFICIENTS) for equation in equations),
                    "error": sum(errors) / len(errors),
                    "published_error": self.published_error and self.published_error[i][j],
                    "seconds": (time.process_time() - start_time) / self.repeats,
                    "equations": equations,
                }
            )
        progress.report_progress("searching equations", len(cells), len(cells))
        content = {
            "schema": "residnet.breeding/1",
            "run": self.name,
            "keys": (self.rows.key, self.columns.key),
            "rows": rows,
            # where the mean error is least, for each value of the first setting
            "least": {
                str(value): min(
                    (row for row in rows if row["row"] == value), key=lambda row: row["error"]
                )["column"]
                for value in self.rows.values
            },
        }
        return content, [_result_figure(self, rows)]

    def main_figures(self, results: StudyResults) -> dict[str, SummaryMetric]:
        rows = results["rows"]
        descriptions = {"found": "that find the equation", "right": "with the true terms"}
        return {
            f"share of runs {description}": SummaryMetric(
                sum(row[key] for row in rows) / (self.repeats * len(rows))
            )
            for key, description in descriptions.items()
        }

    def summarize(self, results: StudyResults) -> list[str]:
        rows = results["rows"]
        runs = self.repeats * len(rows)
        sentences = [
            f"The equation is found in {sum(row['found'] for row in rows)} of {runs} runs: their"
            f" mean square error on the test record is below {self.threshold:g} (m/s^2)^2."
        ]
        published_rows = [row for row in rows if row["published_found"] is not None]
        if published_rows:
            n_found, n_published = (
                sum(row[key] for row in published_rows) for key in ("found", "published_found")
            )
            sentences.append(
                f"Document 000 finds it in {n_published:g} of the"
                f" {_PUBLISHED_RUNS * len(published_rows)} runs"
                f" of the same table; here it is {n_found} of {self.repeats * len(published_rows)}."
            )
        best_columns = [
            f"{_format_value(column)} ({row})" for row, column in results["least"].items()
        ]
        sentences.append(
            f"The mean error is least at {self.columns.key} = {', '.join(best_columns)}."
        )
        n_true_terms = sum(row["right"] for row in rows)
        return [
            *sentences,
            f"In {n_true_terms} of {runs} runs the terms are exactly the true ones.",
        ]

    def build_sections(self, results: StudyResults, run: Path) -> list[Section]:
        rows = results["rows"]
        explanation = Text(
            is_secondary=True,
            paragraphs=[
                f"Each cell shows in how many of {self.repeats} runs the mean square error on the"
                f" test record is below {self.threshold:g} (m/s^2)^2. Small print: the"
                " number in the document (of ten runs), the number of runs with exactly the true"
                " terms, and the mean of the mean square errors.",
                f"Rows: {self.rows.key}. Columns: {self.columns.key}.",
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
            self.rows.values,
            [
                (self.rows.key, _format_value),
                *(
                    (
                        _format_value(column_value),
                        lambda value, other=column_value: cell(value, other),
                    )
                    for column_value in self.columns.values
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
