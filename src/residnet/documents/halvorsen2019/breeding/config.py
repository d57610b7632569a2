"""Config of the search for the mass-spring-damper's equation (document 000, chapter 5)."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, ValidationError, model_validator

from residnet.core.config import Config, Seconds
from residnet.heads.genetic import GeneticConfig
from residnet.physics.mass_spring_damper import MassSpringDamperConfig
from residnet.runs.task import Task

Value = int | float | str
Matrix = tuple[tuple[float | None, ...], ...]
Record = dict[str, np.ndarray]
CHANNELS = ("x", "u", "tau_x")


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


class BreedingSettings(Task):
    """A search for the equation with every combination of two settings, several times each.

    Attributes:
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
    def _grid(self) -> BreedingSettings:
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
        for axis, number in ((self.rows, row), (self.columns, column)):
            *path, last = axis.key.split(".")
            place = parts
            for key in path:
                place = place[key]
            if last not in place:
                raise KeyError(axis.key)
            place[last] = axis.values[number]
        return (
            RecordConfig.model_validate(parts["record"]),
            NoiseConfig.model_validate(parts["noise"]),
            GeneticConfig.model_validate(parts["head"]),
        )
