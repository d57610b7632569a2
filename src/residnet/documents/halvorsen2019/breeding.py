"""Task `breeding`: genetic programming on a mass-spring-damper (document 000, chapter 5)."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, final

import numpy as np
from pydantic import Field, model_validator

from residnet.core import progress
from residnet.core.config import Config, Seconds, apply_override, validate
from residnet.core.errors import ConfigError, require_package
from residnet.core.format import DASH, number
from residnet.documents.study import Results, Study, pictures
from residnet.heads.genetic import GeneticConfig
from residnet.regression.expressions import Algebra, term
from residnet.regression.genetic import breed, limits_of, validating
from residnet.report.blocks import Cell, Section, Text, table_of
from residnet.report.figure import COLORS, Case, Figure, Look, Panel, names_of
from residnet.runs.folder import RunFolder
from residnet.runs.task import MainFigure

Value = int | float | str
Matrix = tuple[tuple[float | None, ...], ...]
Record = dict[str, np.ndarray]
CHANNELS = ("x", "u", "tau_x")
MASS, DAMPING, STIFFNESS = 10.0, 13.0, 5.0
"""The system m x_ddot + d x_dot + k x = tau (4.1) in kg, kg/s and N/m (section 5.3, (5.13)); that
of (4.3) is another one: 20 kg, 10 kg/s, 12 N/m (correction H24).
"""
TRUTH = {"tau_x": 1.0 / MASS, "u": -DAMPING / MASS, "x": -STIFFNESS / MASS}
"""True coefficients of u_dot (4.2) by term."""
_LEAST = 1e-34
"""Least error in the picture, in (m/s^2)^2: what rounding leaves is less."""
_PUBLISHED_RUNS = 10
"""Number of runs of each combination in Tables 5.2 and 5.3."""


class RecordConfig(Config):
    """A record of the mass-spring-damper under a square wave of a force of 1 N, from rest.

    Section 5.3.1 and Figure 5.3 of document 000.

    Attributes:
        length: length of the record in s.
        step: time between samples in s; the force is held over a step.
        period: period of the square wave in s; 6 pi s in the document.
        test_period: period in s of the square wave of the record that equations are scored on.
        delay: how much later than recorded the force acts, in s (section 5.3.4).
        corrected: how much later the record is told that the force acted, in s: the correction that
            Listing 5.1 tries.
    """

    length: Seconds = Field(default=50.0, gt=0)
    step: Seconds = Field(default=0.1, gt=0)
    period: Seconds = Field(default=float(6 * np.pi), gt=0)
    test_period: Seconds = Field(default=10.0, gt=0)
    delay: Seconds = Field(default=0.0, ge=0)
    corrected: Seconds = Field(default=0.0, ge=0)

    def record(self, period: float) -> Record:
        """Return a record without noise.

        Args:
            period: period of the square wave in s.

        Returns:
            Displacement x in m, its rate u in m/s, the force tau_x in N and the acceleration u_dot
            in m/s^2, [N] each.
        """
        from scipy.linalg import expm

        t = self.step * np.arange(round(self.length / self.step))
        given = np.where(np.mod(t, period) < period / 2, 1.0, -1.0)
        # later than recorded, with its first value before
        force, told = (
            np.concatenate((np.full(steps, given[0]), given))[: len(given)]
            for steps in (round(seconds / self.step) for seconds in (self.delay, self.corrected))
        )
        block = np.zeros((3, 3))
        block[:2] = [[0.0, 1.0, 0.0], [TRUTH["x"], TRUTH["u"], TRUTH["tau_x"]]]
        transition = expm(block * self.step)[:2]
        state = np.zeros((len(t), 2))
        for i in range(1, len(t)):
            state[i] = transition @ [*state[i - 1], force[i - 1]]
        x, u = state.T
        u_dot = (force - DAMPING * u - STIFFNESS * x) / MASS
        return {"x": x, "u": u, "tau_x": told, "u_dot": u_dot}


class NoiseConfig(Config):
    """Uniform noise on the signals of a record, as a share of each signal's range (5.14).

    Attributes:
        on: noisy signals: the acceleration (`output`), the terms' signals (`inputs`), `all`, or
            `none`.
        factor: amplitude of the noise over the range of the signal (largest minus smallest value).
    """

    on: Literal["output", "inputs", "all", "none"] = "all"
    factor: float = Field(default=0.0, ge=0)

    def added(self, record: Record, random: np.random.Generator) -> Record:
        """Return the record with noise."""
        signals = {"output": ("u_dot",), "inputs": CHANNELS, "all": tuple(record)}
        noisy = signals.get(self.on, ())
        return {
            name: (
                values + self.factor * np.ptp(values) * random.uniform(-1, 1, len(values))
                if name in noisy
                else values
            )
            for name, values in record.items()
        }


class Axis(Config):
    """One setting of the study and the values that it takes.

    Attributes:
        key: dotted key of the study, such as `head.evolution.population`.
        values: values of the setting, in the order of the table.
    """

    key: str = Field(pattern=r"^(head|noise|record)\.[a-z_.]+$")
    values: Annotated[tuple[Value, ...], Field(min_length=1)]


class SearchConfig(Config):
    """How an equation of the acceleration is searched, and in what.

    Attributes:
        record: record that the equation is searched in.
        noise: noise on the record.
        head: how the equation is searched; `final: null` keeps the best individual as it is, as the
            document does.
    """

    record: RecordConfig = Field(default_factory=RecordConfig)
    noise: NoiseConfig = Field(default_factory=NoiseConfig)
    head: GeneticConfig = Field(default_factory=GeneticConfig)


@final
class BreedingTaskConfig(Study, SearchConfig):
    """A search for the equation with every combination of two settings, several times each.

    Attributes:
        task: `breeding`.
        rows: first setting, one row of the table for each value.
        columns: second setting, one column of the table for each value.
        repeats: number of runs of each combination; their seeds are 0, 1, ...
        threshold: mean square error in (m/s^2)^2 on the test record below which an equation counts
            as found (section 5.2.2).
        published: number of runs in which the document finds the equation, one row for each row of
            the table; combinations with null are left out.
        published_error: mean square errors that the document prints, in (m/s^2)^2, likewise.
    """

    task: Literal["breeding"]
    rows: Axis
    columns: Axis
    repeats: int = Field(default=10, ge=1, le=10_000)
    threshold: float = Field(default=5e-6, gt=0)
    published: Matrix | None = None
    published_error: Matrix | None = None

    @model_validator(mode="after")
    def _grid(self) -> BreedingTaskConfig:
        high, wide = len(self.rows.values), len(self.columns.values)
        for name in ("published", "published_error"):
            table = getattr(self, name)
            if table is not None and [len(row) for row in table] != [wide] * high:
                raise ValueError(
                    f"{name}: expected {high} rows of {wide} numbers, as rows and columns have"
                    " values"
                )
        for row, column in self.cells():
            try:
                self.cell(row, column)
            except ConfigError as error:
                raise ValueError(str(error)) from None
        return self

    def cells(self) -> list[tuple[int, int]]:
        """Return row and column of each combination that is run."""
        return [
            (i, j)
            for i in range(len(self.rows.values))
            for j in range(len(self.columns.values))
            if self.published is None or self.published[i][j] is not None
        ]

    def cell(self, row: int, column: int) -> SearchConfig:
        """Return the settings of one combination.

        Raises:
            ConfigError: where a key of the two settings does not exist, or a value is not allowed.
        """
        parts = {name: getattr(self, name).model_dump() for name in SearchConfig.model_fields}
        pairs = ((self.rows, row), (self.columns, column))
        changes = [f"{axis.key}={axis.values[place]}" for axis, place in pairs]
        for change in changes:
            apply_override(parts, change)
        return validate(parts, SearchConfig, ", ".join(changes))

    def check(self) -> None:
        require_package("deap", "genetic programming", "gp")

    def results(self, folder: RunFolder) -> tuple[dict[str, Any], Iterable[Figure]]:
        rows, cells = [], self.cells()
        for done, (i, j) in enumerate(cells):
            progress.report("searching equations", done, len(cells))
            settings, started = self.cell(i, j), time.process_time()
            trials = [attempt(settings, seed) for seed in range(self.repeats)]
            errors, equations = ([*part] for part in zip(*trials, strict=True))
            rows.append(
                {
                    "row": self.rows.values[i],
                    "column": self.columns.values[j],
                    "found": sum(error < self.threshold for error in errors),
                    "published_found": self.published and self.published[i][j],
                    "right": sum(set(equation) == set(TRUTH) for equation in equations),
                    "error": sum(errors) / len(errors),
                    "published_error": self.published_error and self.published_error[i][j],
                    "seconds": (time.process_time() - started) / self.repeats,
                    "equations": equations,
                }
            )
        progress.report("searching equations", len(cells), len(cells))
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
        return content, [_drawing(self, rows)]

    def main_figures(self, results: Results) -> dict[str, MainFigure]:
        rows = results["rows"]
        words = {"found": "that find the equation", "right": "with the true terms"}
        return {
            f"share of runs {what}": MainFigure(
                sum(row[key] for row in rows) / (self.repeats * len(rows))
            )
            for key, what in words.items()
        }

    def verdict(self, results: Results) -> list[str]:
        rows = results["rows"]
        runs = self.repeats * len(rows)
        sentences = [
            f"The equation is found in {sum(row['found'] for row in rows)} of {runs} runs: their"
            f" mean square error on the test record is below {self.threshold:g} (m/s^2)^2."
        ]
        printed = [row for row in rows if row["published_found"] is not None]
        if printed:
            ours, theirs = (
                sum(row[key] for row in printed) for key in ("found", "published_found")
            )
            sentences.append(
                f"Document 000 finds it in {theirs:g} of the {_PUBLISHED_RUNS * len(printed)} runs"
                f" of the same table; here it is {ours} of {self.repeats * len(printed)}."
            )
        best = [f"{_text(column)} ({row})" for row, column in results["least"].items()]
        sentences.append(f"The mean error is least at {self.columns.key} = {', '.join(best)}.")
        right = sum(row["right"] for row in rows)
        return [*sentences, f"In {right} of {runs} runs the terms are exactly the true ones."]

    def sections(self, results: Results, run: Path) -> list[Section]:
        rows = results["rows"]
        about = Text(
            quiet=True,
            paragraphs=[
                f"Each cell shows in how many of {self.repeats} runs the mean square error on the"
                f" test record is below {self.threshold:g} (m/s^2)^2. In small print stand the"
                " document's number of ten runs, in how many runs the terms are the true ones, and"
                " the mean of the mean square errors.",
                f"Rows: {self.rows.key}. Columns: {self.columns.key}.",
            ],
        )
        cells = {(row["row"], row["column"]): row for row in rows}

        def cell(value: Value, other: Value) -> Cell:
            row = cells.get((value, other))
            if row is None:
                return Cell(DASH)
            found = row["published_found"]
            printed = "" if found is None else f"published {found:g}; "
            said = f"{printed}{row['right']} true; {number(row['error'], 2)}"
            return Cell(str(row["found"]), said)

        table = table_of(
            self.rows.values,
            [
                (self.rows.key, _text),
                *(
                    (_text(other), lambda value, other=other: cell(value, other))
                    for other in self.columns.values
                ),
            ],
        )
        every = [
            (row, seed, equation) for row in rows for seed, equation in enumerate(row["equations"])
        ]

        def written(row: Any) -> str:
            terms = [f"{number(value, 4)} {name}" for name, value in row[2].items()]
            return " + ".join(terms) or DASH

        equations = table_of(
            every,
            [
                ("setting", lambda row: f"{_text(row[0]['row'])}, {_text(row[0]['column'])}"),
                ("seed", lambda row: Cell(str(row[1]))),
                ("equation of the acceleration", written),
            ],
        )
        return [
            Section("", [*(one.part() for one in pictures(run, "study")), table, about]),
            Section("Found by setting", pictures(run, "study")),
            Section("All equations", [equations], folded=True),
        ]


def attempt(settings: SearchConfig, seed: int) -> tuple[float, dict[str, float]]:
    """Search the equation of u_dot once.

    Args:
        settings: of the search.
        seed: seed of the noise and of the search.

    Returns:
        Mean square error on the test record without noise in (m/s^2)^2, and coefficients by term.

    Raises:
        FitError: where the data do not determine an equation.
        UsageError: where DEAP is not installed.
    """
    record, head = settings.record, settings.head
    clean = record.record(record.period)
    data = settings.noise.added(clean, np.random.default_rng(seed))
    algebra = Algebra(CHANNELS, limits_of(head.evolution))
    train = ~validating(np.zeros(len(clean["x"]), dtype=int), head.validate_every)
    bred = breed(algebra, data, data["u_dot"], train, head, seed)
    test = record.record(record.test_period)
    predicted = np.zeros(len(test["x"]))
    if bred.products:
        predicted = np.array(bred.values) @ algebra.values(bred.products, test)
    names = [term(algebra, product) for product in bred.products]
    error = float(np.square(predicted - test["u_dot"]).mean())
    return error, dict(zip(names, bred.values, strict=True))


def _text(value: Value) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


def _drawing(config: BreedingTaskConfig, rows: Sequence[Mapping[str, Any]]) -> Figure:
    columns = list(config.columns.values)
    looks: dict[str, Look] = {}
    found: dict[str, Any] = {}
    errors: dict[str, Any] = {}
    for place, value in enumerate(config.rows.values):
        members = [row for row in rows if row["row"] == value]
        x = np.array([columns.index(row["column"]) for row in members], dtype=float)
        name, color = _text(value), COLORS[place % len(COLORS)]
        looks[name] = Look(f"{config.rows.key} {name}", color)
        looks[f"{name} points"] = Look("", color, kind="points", size=3)
        looks[f"{name} published"] = Look("", color, "dotted")
        found[name] = found[f"{name} points"] = (x, np.array([row["found"] for row in members]))
        error = np.array([max(row["error"], _LEAST) for row in members])
        errors[name] = errors[f"{name} points"] = (x, error)
        if all(row["published_found"] is not None for row in members):
            printed = np.array([row["published_found"] for row in members])
            found[f"{name} published"] = (x, printed)
    shared: Any = {
        "x_label": config.columns.key,
        "height": 330,
        "x_names": names_of(map(_text, columns)),
    }
    return Figure(
        "study",
        "Equations found",
        "Left: number of runs below the error threshold, ours (lines) and the document's"
        " (dotted). Right: mean of the mean square errors on the test record.",
        looks,
        [
            Panel(f"found, of {config.repeats}", **shared),
            Panel("mean square error [(m/s^2)^2]", y_log=True, **shared),
        ],
        [Case("", [found, errors])],
        columns=2,
    )
