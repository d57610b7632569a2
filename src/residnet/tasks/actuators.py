"""Task `actuators`: identify the actuators of a vessel file from tests (document 003, 4.1)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, field_validator, model_validator

from residnet.core.config import Config, ExistingPath
from residnet.core.errors import DataError, UsageError
from residnet.core.names import nearest, to_si
from residnet.data.readers.encoding import as_utf8
from residnet.physics.actuators.identify import (
    fit_step,
    fit_throttle,
    fit_thrust,
)
from residnet.report.blocks import Section
from residnet.report.figure import write_figures
from residnet.report.run_reader import RunFiles
from residnet.report.sections.actuators import sections
from residnet.runs.folder import RunFolder
from residnet.runs.task import MainFigure, Outcome, Task
from residnet.tasks.actuator_lines import numbers, vessel_lines


class Column(Config):
    """A column of a csv file and its unit.

    Attributes:
        column: its title in the first line of the file.
        unit: of its numbers, for example `rpm`.
    """

    column: str
    unit: str

    @field_validator("unit")
    @classmethod
    def _unit(cls, unit: str) -> str:
        try:
            to_si(unit)
        except UsageError as error:
            raise ValueError(str(error)) from None
        return unit

    def measures(self, si: str, key: str) -> None:
        """Check that the unit measures what the SI unit `si` does.

        Raises:
            ValueError: naming the key.
        """
        try:
            to_si(self.unit, si)
        except UsageError as error:
            raise ValueError(f"{key}: {error}") from None


class _Test(Config):
    """A test of the actuators.

    Attributes:
        files: csv files of the test.
    """

    files: Annotated[tuple[ExistingPath, ...], Field(min_length=1)]


class ThrottleTest(_Test):
    """Steady revolutions over throttle, one row for each point.

    Attributes:
        files: csv files of the test.
        throttle: column of the throttle, from -1 to 1 (`-`) or in `%`.
        n: column of the revolutions, for example in `rpm`.
    """

    throttle: Column
    n: Column

    @model_validator(mode="after")
    def _units(self) -> ThrottleTest:
        self.throttle.measures("-", "throttle")
        self.n.measures("1/s", "n")
        return self


class StepTest(_Test):
    """Revolutions over time after steps of the command, one file for each step response.

    Attributes:
        files: csv files of the test.
        t: column of the time, for example in `s`.
        command: column of the commanded revolutions, for example in `rpm`.
        n: column of the measured revolutions, for example in `rpm`.
    """

    t: Column
    command: Column
    n: Column

    @model_validator(mode="after")
    def _units(self) -> StepTest:
        self.t.measures("s", "t")
        self.command.measures("1/s", "command")
        self.n.measures("1/s", "n")
        return self


class BollardTest(_Test):
    """Steady pull on a tether over revolutions, of all thrusters together.

    Attributes:
        files: csv files of the test.
        n: column of the revolutions, for example in `rpm`.
        pull: column of the pull, positive ahead, for example in `N`.
        thrusters: how many pull together.
    """

    n: Column
    pull: Column
    thrusters: int = Field(default=1, ge=1)

    @model_validator(mode="after")
    def _units(self) -> BollardTest:
        self.n.measures("1/s", "n")
        self.pull.measures("N", "pull")
        return self


class ActuatorsTaskConfig(Task):
    """Throttle map, rate limit and thrust curves of a vessel file, from tests of its actuators.

    Attributes:
        throttle: test of the throttle map; null for none. At least one test is needed.
        step: test of the rate limit and the dead time; null for none.
        bollard: test of the thrust curves; null for none.
    """

    task: Literal["actuators"]
    throttle: ThrottleTest | None = None
    step: StepTest | None = None
    bollard: BollardTest | None = None

    @model_validator(mode="after")
    def _any(self) -> ActuatorsTaskConfig:
        if not self.files():
            raise ValueError("no test is named; give at least one of throttle, step, bollard")
        return self

    def files(self) -> list[Path]:
        """Return the files of all tests."""
        tests: tuple[_Test | None, ...] = (self.throttle, self.step, self.bollard)
        return [path for test in tests if test is not None for path in test.files]

    def check(self) -> None:
        """Check that the logs can be read.

        Raises:
            ResidnetError: where a column is missing or holds what is no number.
        """
        _Logs(self)

    def input_files(self) -> list[Path]:
        """Return the files of all logs that the task reads."""
        return self.files()

    def carry_out(self, folder: RunFolder) -> Outcome:
        """Identify the actuators, and write actuators.yaml, actuators.json and a figure.

        Raises:
            ResidnetError: where the logs cannot be used or do not determine the actuators.
        """
        from residnet.report.sections.actuators import actuator_tests

        logs = _Logs(self)
        throttle = fit_throttle(logs.throttle[0], logs.throttle[1]) if logs.throttle else None
        step = fit_step(logs.steps) if logs.steps else None
        thrust = pull_of_one = None
        if self.bollard is not None and logs.bollard:
            n, pull = logs.bollard
            thrust = fit_thrust(n, pull, self.bollard.thrusters)
            pull_of_one = (n, pull / self.bollard.thrusters, thrust)
        text = vessel_lines(self.name, self.files(), throttle, step, thrust)
        folder.write(folder.path / "actuators.yaml", text)
        folder.write_json(folder.path / "actuators.json", numbers(throttle, step, thrust))
        drawing = actuator_tests(
            self.name,
            (logs.throttle[0], logs.throttle[1], throttle) if logs.throttle and throttle else None,
            (logs.steps, step) if step else None,
            pull_of_one,
        )
        write_figures(folder.figures, [drawing])
        figures = {}
        if throttle is not None:
            figures["n_max"] = MainFigure(throttle.n_max.value, "1/s")
        if step is not None:
            figures["n_rate"] = MainFigure(step.rate.value, "1/s^2")
            figures["dead_time"] = MainFigure(step.dead_time.value, "s")
        tests = [
            name
            for name, found in (
                ("throttle map", throttle),
                ("step response", step),
                ("thrust curves", thrust),
            )
            if found is not None
        ]
        verdict = [
            f"The tests gave {' and '.join(tests)}; actuators.yaml holds the lines for a vessel"
            " file."
        ]
        return Outcome(verdict, figures, text)

    @classmethod
    def report_sections(cls, run: RunFolder) -> Sequence[Section]:
        """Return parameters and lines for a vessel file; the figure is that of the run."""
        return sections(RunFiles(run.path))


class _Logs:
    """The contents of the tests in SI: throttle and n; (t, command, n) of each step; n and pull."""

    def __init__(self, config: ActuatorsTaskConfig) -> None:
        self.throttle = (
            _together(config.throttle.files, config.throttle.throttle, config.throttle.n)
            if config.throttle
            else None
        )
        self.bollard = (
            _together(config.bollard.files, config.bollard.n, config.bollard.pull)
            if config.bollard
            else None
        )
        self.steps: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
        for path in config.step.files if config.step else ():
            assert config.step is not None
            t, command, n = _read(path, config.step.t, config.step.command, config.step.n)
            self.steps.append((t, command, n))
            if (np.diff(t) <= 0).any():
                raise DataError(
                    f"{path}: time repeats or runs backwards in row"
                    f" {int(np.flatnonzero(np.diff(t) <= 0)[0]) + 2} of the data"
                )


def _together(paths: Sequence[Path], *columns: Column) -> tuple[np.ndarray, ...]:
    parts = [_read(path, *columns) for path in paths]
    return tuple(np.concatenate(column) for column in zip(*parts, strict=True))


def _read(path: Path, *columns: Column) -> tuple[np.ndarray, ...]:
    """Return columns [N] of a csv file in SI; rows with an empty cell are left out.

    Raises:
        UsageError: where a column is missing.
        DataError: where a cell is no number, or no row is complete.
    """
    import pandas as pd

    try:
        with as_utf8(path) as file:
            table = pd.read_csv(file, skipinitialspace=True, encoding="utf-8-sig")
    except (pd.errors.ParserError, pd.errors.EmptyDataError, UnicodeDecodeError) as error:
        raise DataError(
            f"{path}: not a readable csv table ({' '.join(str(error).split())})"
        ) from error
    out = []
    for entry in columns:
        if entry.column not in table.columns:
            raise UsageError(
                f"{path}: no column"
                f" '{entry.column}'{nearest(entry.column, map(str, table.columns))}"
            )
        values = pd.to_numeric(table[entry.column], errors="coerce").to_numpy(dtype=np.float64)
        bad = np.flatnonzero(~np.isfinite(values) & table[entry.column].notna().to_numpy())
        if bad.size:
            raise DataError(
                f"{path}: line {int(bad[0]) + 2}, column '{entry.column}':"
                f" '{table[entry.column].iloc[int(bad[0])]}' is not a finite number"
            )
        out.append(values * to_si(entry.unit))
    whole = np.isfinite(np.stack(out)).all(axis=0)
    if not whole.any():
        raise DataError(
            f"{path}: no row has a number in all of {', '.join(entry.column for entry in columns)}"
        )
    return tuple(values[whole] for values in out)
