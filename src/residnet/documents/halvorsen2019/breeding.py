"""Task `breeding`: genetic programming on a mass-spring-damper (document 000, chapter 5)."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal, final

import numpy as np
from pydantic import Field, ValidationError, model_validator

from residnet.core import progress
from residnet.core.config import Config, Seconds, load_config
from residnet.core.files import read_json
from residnet.documents.cells import pictures
from residnet.heads.genetic import GeneticConfig
from residnet.physics.plant import MassSpringDamperConfig
from residnet.regression.expressions import Algebra
from residnet.regression.genetic import breed, limits_of, validating
from residnet.regression.writing import term
from residnet.report.blocks import Block, Cell, Section, Table, Text, table_of
from residnet.report.figure import COLORS, Case, Figure, Look, Panel, names_of, write_figure
from residnet.report.format import DASH, number
from residnet.runs.folder import RunFolder
from residnet.runs.task import MainFigure, Outcome, Task

Value = int | float | str
Matrix = tuple[tuple[float | None, ...], ...]
Record = dict[str, np.ndarray]
Rows = Sequence[Mapping[str, Any]]
CHANNELS = ("x", "u", "tau_x")
FILE = "study.json"
_LEAST = 1e-34
"""Least error in the picture, in (m/s^2)^2: what rounding leaves is less."""
_PUBLISHED_RUNS = 10
"""Number of runs of each combination in Tables 5.2 and 5.3."""


class RecordConfig(Config):
    """A record of the mass-spring-damper under a square wave of the force, from rest.

    Section 5.3.1 and Figure 5.3 of document 000.

    Attributes:
        system: mass, damping, stiffness and amplitude of the force.
        length: length of the record in s.
        step: time between samples in s; the force is held over a step.
        period: period of the square wave in s; 6 pi s in the document.
        test_period: period in s of the square wave of the record that equations are scored on.
        delay: how much later than recorded the force acts, in s (section 5.3.4).
        corrected: how much later the record is told that the force acted, in s: the correction that
            Listing 5.1 tries.
    """

    system: MassSpringDamperConfig = Field(default_factory=MassSpringDamperConfig)
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

        m, d, k = (getattr(self.system, name).value for name in ("m", "d", "k"))
        t = self.step * np.arange(round(self.length / self.step))
        given = self.system.tau_max * np.where(np.mod(t, period) < period / 2, 1.0, -1.0)
        force, told = (self._late(given, seconds) for seconds in (self.delay, self.corrected))
        block = np.zeros((3, 3))
        block[:2] = [[0.0, 1.0, 0.0], [-k / m, -d / m, 1.0 / m]]
        transition = expm(block * self.step)[:2]
        state = np.zeros((len(t), 2))
        for i in range(1, len(t)):
            state[i] = transition @ [*state[i - 1], force[i - 1]]
        x, u = state.T
        return {"x": x, "u": u, "tau_x": told, "u_dot": (force - d * u - k * x) / m}

    def _late(self, force: np.ndarray, seconds: float) -> np.ndarray:
        """Return a force [N] some time later, its first value before."""
        steps = round(seconds / self.step)
        return np.concatenate((np.full(steps, force[0]), force))[: len(force)]

    def truth(self) -> dict[str, float]:
        """Return the true coefficients of u_dot (4.2) by term."""
        m, d, k = (getattr(self.system, name).value for name in ("m", "d", "k"))
        return {"tau_x": 1.0 / m, "u": -d / m, "x": -k / m}


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
        of_output = ("u_dot",)
        signals = {"output": of_output, "inputs": CHANNELS, "all": (*CHANNELS, *of_output)}
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


@final
class BreedingTaskConfig(Task):
    """A search for the equation with every combination of two settings, several times each.

    Attributes:
        task: `breeding`.
        record: record that the equation is searched in.
        noise: noise on the record.
        head: how the equation is searched; `final: null` keeps the best individual as it is, as the
            document does.
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
    record: RecordConfig = Field(default_factory=RecordConfig)
    noise: NoiseConfig = Field(default_factory=NoiseConfig)
    head: GeneticConfig = Field(default_factory=GeneticConfig)
    rows: Axis
    columns: Axis
    repeats: int = Field(default=10, ge=1, le=10_000)
    threshold: float = Field(default=5e-6, gt=0)
    published: Matrix | None = None
    published_error: Matrix | None = None

    @model_validator(mode="after")
    def _grid(self) -> BreedingTaskConfig:
        shape = [len(self.columns.values)] * len(self.rows.values)
        for name, table in (
            ("published", self.published),
            ("published_error", self.published_error),
        ):
            if table is not None and [len(row) for row in table] != shape:
                raise ValueError(
                    f"{name}: expected {len(self.rows.values)} rows of {len(self.columns.values)}"
                    " numbers, as rows and columns have values"
                )
        for row, column in self.cells():
            try:
                self.cell(row, column)
            except (ValidationError, KeyError) as error:
                what = (
                    error.errors()[0]["msg"]
                    if isinstance(error, ValidationError)
                    else f"no key {error}"
                )
                raise ValueError(
                    f"{self.rows.key}={self.rows.values[row]},"
                    f" {self.columns.key}={self.columns.values[column]}: {what}"
                ) from None
        return self

    def cells(self) -> list[tuple[int, int]]:
        """Return row and column of each combination that is run."""
        return [
            (i, j)
            for i in range(len(self.rows.values))
            for j in range(len(self.columns.values))
            if self.published is None or self.published[i][j] is not None
        ]

    def cell(self, row: int, column: int) -> tuple[RecordConfig, NoiseConfig, GeneticConfig]:
        """Return the settings of one combination.

        Raises:
            KeyError: where a key of the two settings does not exist.
            ValidationError: where a value is not allowed.
        """
        parts: dict[str, Any] = {
            name: getattr(self, name).model_dump() for name in ("record", "noise", "head")
        }
        for axis, place_of in ((self.rows, row), (self.columns, column)):
            *path, last = axis.key.split(".")
            place = parts
            for key in path:
                place = place[key]
            if last not in place:
                raise KeyError(axis.key)
            place[last] = axis.values[place_of]
        return (
            RecordConfig.model_validate(parts["record"]),
            NoiseConfig.model_validate(parts["noise"]),
            GeneticConfig.model_validate(parts["head"]),
        )

    def check(self) -> None:
        from residnet.regression.genetic import require_deap

        require_deap()

    def carry_out(self, folder: RunFolder) -> Outcome:
        rows, cells = [], self.cells()
        for done, (i, j) in enumerate(cells):
            progress.report("searching equations", done, len(cells))
            rows.append(self._row(i, j))
        progress.report("searching equations", len(cells), len(cells))
        content = {
            "schema": "residnet.breeding/1",
            "run": self.name,
            "keys": (self.rows.key, self.columns.key),
            "rows": rows,
            "least": {str(row["row"]): row["column"] for row in least(self, rows)},
        }
        folder.write_json(folder.path / FILE, content)
        write_figure(folder.figures, _drawing(self, rows))
        runs = self.repeats * len(rows)
        figures = {
            f"share of runs {words}": MainFigure(sum(row[key] for row in rows) / runs)
            for key, words in (
                ("found", "that find the equation"),
                ("right", "with the true terms"),
            )
        }
        return Outcome(verdict(self, rows), figures)

    def _row(self, i: int, j: int) -> dict[str, Any]:
        settings = self.cell(i, j)
        started = time.process_time()
        trials = [attempt(*settings, seed) for seed in range(self.repeats)]
        errors = [error for error, _ in trials]
        true = set(settings[0].truth())
        return {
            "row": self.rows.values[i],
            "column": self.columns.values[j],
            "found": sum(error < self.threshold for error in errors),
            "published_found": self.published and self.published[i][j],
            "right": sum(set(equation) == true for _, equation in trials),
            "error": sum(errors) / len(errors),
            "published_error": self.published_error and self.published_error[i][j],
            "seconds": (time.process_time() - started) / self.repeats,
            "equations": [equation for _, equation in trials],
        }

    @classmethod
    def report_sections(cls, run: RunFolder) -> Sequence[Section]:
        config = load_config(run.resolved, [], cls)
        rows = read_json(run.path / FILE)["rows"]
        about = Text(
            [
                f"Each cell shows in how many of {config.repeats} runs the mean square error on the"
                f" test record is below {config.threshold:g} (m/s^2)^2. In small print stand the"
                " document's number of ten runs, in how many runs the terms are the true ones, and"
                " the mean of the mean square errors.",
                f"Rows: {config.rows.key}. Columns: {config.columns.key}.",
            ]
        )
        equations = [
            (f"{_text(row['row'])}, {_text(row['column'])}", seed, equation)
            for row in rows
            for seed, equation in enumerate(row["equations"])
        ]
        columns = [
            ("setting", lambda row: row[0]),
            ("seed", lambda row: Cell(str(row[1]))),
            ("equation of the acceleration", lambda row: _equation(row[2])),
        ]
        found: list[Block] = [about, _table(config, rows), *pictures(run.path, "study")]
        every = [table_of(equations, columns)]
        return [Section("Equations found", found), Section("All equations", every, folded=True)]


def attempt(
    record: RecordConfig, noise: NoiseConfig, head: GeneticConfig, seed: int
) -> tuple[float, dict[str, float]]:
    """Search the equation of u_dot once.

    Args:
        record: record that the equation is searched in.
        noise: noise on the record.
        head: how the equation is searched.
        seed: seed of the noise and of the search.

    Returns:
        Mean square error on the test record without noise in (m/s^2)^2, and coefficients by term.

    Raises:
        FitError: where the data do not determine an equation.
        UsageError: where DEAP is not installed.
    """
    clean = record.record(record.period)
    data = noise.added(clean, np.random.default_rng(seed))
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


def verdict(config: BreedingTaskConfig, rows: Rows) -> list[str]:
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


def least(config: BreedingTaskConfig, rows: Rows) -> list[Mapping[str, Any]]:
    """Return for each value of the first setting the row of the least mean error."""
    return [
        min((row for row in rows if row["row"] == value), key=lambda row: float(row["error"]))
        for value in config.rows.values
    ]


def _table(config: BreedingTaskConfig, rows: Rows) -> Table:
    cells = {(row["row"], row["column"]): row for row in rows}

    def cell(row: Mapping[str, Any] | None) -> Cell:
        if row is None:
            return Cell(DASH)
        found = row["published_found"]
        printed = "" if found is None else f"published {found:g}; "
        return Cell(str(row["found"]), f"{printed}{row['right']} true; {number(row['error'], 2)}")

    table = Table([config.rows.key, *map(_text, config.columns.values)])
    for value in config.rows.values:
        of_row = [cell(cells.get((value, other))) for other in config.columns.values]
        table.add(_text(value), of_row)
    return table


def _equation(equation: Mapping[str, float]) -> str:
    return " + ".join(f"{number(value, 4)} {term}" for term, value in equation.items()) or DASH


def _text(value: Value) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


def _drawing(config: BreedingTaskConfig, rows: Rows) -> Figure:
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
