"""Task `breeding`: genetic programming on a mass-spring-damper (Halvorsen 2019, chapter 5)."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal, final

import numpy as np
from pydantic import Field, model_validator

from residnet.core.config import Config, Seconds, apply_override, validate_config
from residnet.core.errors import ConfigError
from residnet.heads.genetic_config import GeneticConfig
from residnet.studies.study import StudyTask

SettingValue = int | float | str
Matrix = tuple[tuple[float | None, ...], ...]
SignalRecord = dict[str, np.ndarray]
CHANNELS = ("x", "u", "tau_x")
# The system m x_ddot + d x_dot + k x = tau (4.1) with the values of section 5.3, (5.13); the system
# of (4.3) has other values: 20 kg, 10 kg/s, 12 N/m (see H24 in docs/documents/corrections.md).
MASS = 10.0
"""Mass m in kg."""
DAMPING = 13.0
"""Damping d in kg/s."""
STIFFNESS = 5.0
"""Stiffness k in N/m."""
TRUE_COEFFICIENTS = {"tau_x": 1.0 / MASS, "u": -DAMPING / MASS, "x": -STIFFNESS / MASS}
"""True coefficients of u_dot (4.2) by term."""


class RecordConfig(Config):
    """A record of the mass-spring-damper under a square wave of a force of 1 N, from rest.

    Source: Halvorsen 2019, section 5.3.1 and Figure 5.3.

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
        """Return the record with uniform noise, relative to the range of each signal."""
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

    executor_class: ClassVar[str] = "BreedingExecutor"

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
