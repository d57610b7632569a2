"""Task `actuators`: identify the actuators of a vessel file from tests (document 003, 4.1)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import yaml
from pydantic import AfterValidator, Field, model_validator

from residnet.core.config import Config, ExistingPath
from residnet.core.errors import DataError, UsageError
from residnet.core.format import DASH, interval, number
from residnet.core.names import nearest, to_si
from residnet.data.readers.texts import as_utf8
from residnet.physics.actuators.identify import (
    Estimate,
    StepAnswer,
    ThrottleMap,
    ThrustFit,
    fit_step,
    fit_throttle,
    fit_thrust,
    follow_command,
)
from residnet.report.blocks import Block, Code, Section, Table, Text, table_of
from residnet.report.figure import GREEN, SOLID, Case, Curve, Figure, Look, Panel, joined
from residnet.report.figure_files import read_figures, write_figures
from residnet.report.run_reader import Content, RunFiles
from residnet.runs.folder import RunFolder
from residnet.runs.task import MainFigure, Outcome, Task

_TITLES = {
    ("throttle", "slope"): "revolutions at full throttle, slope",
    ("throttle", "offset"): "revolutions at zero throttle",
    ("throttle", "n_max"): "largest revolutions",
    ("step", "rate"): "rate of the revolutions",
    ("step", "dead_time"): "dead time",
}
_PER_MINUTE = {"1/s": ("rpm", 60.0), "1/s^2": ("rpm/s", 60.0)}
"""Units of revolutions as test engineers read them, with the factor from SI."""


Step = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Time in s, command and measured revolutions in 1/s of one step response, each [N]."""


class Column(Config):
    """A column of a csv file and its unit.

    Attributes:
        column: its title in the first line of the file.
        unit: of its numbers, for example `rpm`.
    """

    column: str
    unit: str


def _measures(si: str) -> Callable[[Column], Column]:
    def check(column: Column) -> Column:
        try:
            to_si(column.unit, si)
        except UsageError as error:
            raise ValueError(str(error)) from None
        return column

    return check


Share = Annotated[Column, AfterValidator(_measures("-"))]
Time = Annotated[Column, AfterValidator(_measures("s"))]
Revolutions = Annotated[Column, AfterValidator(_measures("1/s"))]
Force = Annotated[Column, AfterValidator(_measures("N"))]


class ActuatorTest(Config):
    """A test of the actuators.

    Attributes:
        files: csv files of the test.
    """

    files: Annotated[tuple[ExistingPath, ...], Field(min_length=1)]

    def read(self) -> list[tuple[np.ndarray, ...]]:
        """Return the columns [N] of each file in SI, in the order of the keys; rows with an empty
        cell are left out.

        Raises:
            UsageError: where a column is missing.
            DataError: where a cell is no number, or no row is complete.
        """
        keys = [key for key in type(self).model_fields if key not in ("files", "thrusters")]
        return [_read(path, [getattr(self, key) for key in keys]) for path in self.files]

    def together(self) -> tuple[np.ndarray, ...]:
        """Return the columns of all files as one."""
        return tuple(np.concatenate(parts) for parts in zip(*self.read(), strict=True))


class ThrottleTest(ActuatorTest):
    """Steady revolutions over throttle, one row for each point.

    Attributes:
        throttle: column of the throttle, from -1 to 1 (`-`) or in `%`.
        n: column of the revolutions, for example in `rpm`.
    """

    throttle: Share
    n: Revolutions


class StepTest(ActuatorTest):
    """Revolutions over time after steps of the command, one file for each step response.

    Attributes:
        t: column of the time, for example in `s`.
        command: column of the commanded revolutions, for example in `rpm`.
        n: column of the measured revolutions, for example in `rpm`.
    """

    t: Time
    command: Revolutions
    n: Revolutions

    def read(self) -> list[tuple[np.ndarray, ...]]:
        found = super().read()
        for path, (t, *_) in zip(self.files, found, strict=True):
            if (bad := np.flatnonzero(np.diff(t) <= 0)).size:
                raise DataError(
                    f"{path}: time repeats or runs backwards in row {int(bad[0]) + 2} of the data"
                )
        return found


class BollardTest(ActuatorTest):
    """Steady pull on a tether over revolutions, of all thrusters together.

    Attributes:
        n: column of the revolutions, for example in `rpm`.
        pull: column of the pull, positive ahead, for example in `N`.
        thrusters: how many pull together.
    """

    n: Revolutions
    pull: Force
    thrusters: int = Field(default=1, ge=1)


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
        if not self._tests():
            raise ValueError("no test is named; give at least one of throttle, step, bollard")
        return self

    def _tests(self) -> list[ActuatorTest]:
        tests: tuple[ActuatorTest | None, ...] = (self.throttle, self.step, self.bollard)
        return [test for test in tests if test is not None]

    def check(self) -> None:
        """Check that the logs can be read.

        Raises:
            ResidnetError: where a column is missing or holds what is no number.
        """
        for test in self._tests():
            test.read()

    def input_files(self) -> list[Path]:
        """Return the files of all logs that the task reads."""
        return [path for test in self._tests() for path in test.files]

    def carry_out(self, folder: RunFolder) -> Outcome:
        """Identify the actuators, and write actuators.json, actuators.yaml and a figure.

        actuators.yaml holds the lines for the section `actuators` of a vessel file.

        Raises:
            ResidnetError: where the logs cannot be used or do not determine the actuators.
        """
        throttle = step = pull = None
        tests, main = [], dict[str, Estimate]()
        numbers: dict[str, Any] = {"schema": "residnet.actuators/1"}
        lines: dict[str, Any] = {}
        if self.throttle is not None:
            share, n = self.throttle.together()
            curve = fit_throttle(share, n)
            throttle, main["n_max"] = (share, n, curve), curve.n_max
            numbers["throttle"] = _plain(curve._asdict())
            lines["n_max"] = f"{curve.n_max.value * 60:.5g} rpm"
            tests.append("throttle map")
        if self.step is not None:
            runs = [(t, command, n) for t, command, n in self.step.read()]
            answer = fit_step(runs)
            step = (runs, answer)
            main |= {"n_rate": answer.rate, "dead_time": answer.dead_time}
            numbers["step"] = _plain(answer._asdict())
            lines["n_rate"] = f"{answer.rate.value * 60:.5g} rpm/s"
            tests.append("step response")
        if self.bollard is not None:
            n, force = self.bollard.together()
            thrust = fit_thrust(n, force, self.bollard.thrusters)
            pull = (n, force / self.bollard.thrusters, thrust)
            for name, fit in zip(("forward", "reverse"), thrust, strict=True):
                found = {f"c{i}": c for i, c in enumerate(fit.coefficients)}
                numbers[name] = _plain({**found, "low": fit.low, "high": fit.high, "rms": fit.rms})
                lines[name] = [float(f"{c.value:.6g}") for c in fit.coefficients]
            ends = (thrust[1].low, thrust[0].high)
            lines["curve_range"] = [f"{end * 60:.5g} rpm" for end in ends]
            tests.append("thrust curves")
        lines["source"] = f"identified by residnet, run {self.name}"
        text = yaml.safe_dump(lines, sort_keys=False, default_flow_style=None)
        folder.write(folder.path / "actuators.yaml", text)
        folder.write_json(folder.path / "actuators.json", numbers)
        write_figures(folder.figures, [actuator_tests(self.name, throttle, step, pull)])
        sentence = (
            f"The tests gave {' and '.join(tests)}; actuators.yaml holds the lines for a vessel"
            " file."
        )
        figures = {name: MainFigure(one.value, one.unit) for name, one in main.items()}
        return Outcome([sentence], figures, f"{parameter_table(numbers).text()}\n\n{text}")

    @classmethod
    def report_sections(cls, run: RunFolder) -> Sequence[Section]:
        found = RunFiles(run.path).json("actuators.json")
        drawn = read_figures(run.figures)
        blocks: list[Block] = [*(one.part() for one in drawn[:1]), parameter_table(found)]
        throttle = found.get("throttle")
        if throttle and not throttle["saturated"]:
            text = (
                "Nothing saturated in the throttle test. The largest revolutions are measured ones."
            )
            blocks.append(Text(text))
        out = [Section("", blocks), *([Section("Figures", drawn)] if drawn else [])]
        lines = run.path / "actuators.yaml"
        if lines.is_file():
            about = "These lines belong to the section actuators of a vessel file."
            out.append(Section("Lines for a vessel file", [Text(about), Code(lines.read_text())]))
        return out


def _plain(parts: Mapping[str, Any]) -> dict[str, Any]:
    return {k: v._asdict() if isinstance(v, Estimate) else v for k, v in parts.items()}


def _read(path: Path, columns: Sequence[Column]) -> tuple[np.ndarray, ...]:
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
            near = nearest(entry.column, map(str, table.columns))
            raise UsageError(f"{path}: no column '{entry.column}'{near}")
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
        names = ", ".join(entry.column for entry in columns)
        raise DataError(f"{path}: no row has a number in all of {names}")
    return tuple(values[whole] for values in out)


def parameter_table(found: Mapping[str, Any]) -> Table:
    """Return a row for each parameter of actuators.json with its 95 % interval."""
    rows: list[Content] = []
    for test, parts in found.items():
        estimates = parts.items() if isinstance(parts, Mapping) else ()
        for name, estimate in estimates:
            if isinstance(estimate, Mapping):
                unit, factor = _PER_MINUTE.get(estimate["unit"], (estimate["unit"], 1.0))
                rows.append(
                    {
                        "test": test,
                        "title": _TITLES.get((test, name), f"{test} thrust, {name}"),
                        "value": number(factor * estimate["value"], 4),
                        "interval": interval([estimate["low"], estimate["high"]], factor, 4),
                        "unit": unit,
                    }
                )
    rows += [
        {
            "test": "residual",
            "title": f"{test} thrust, rms residual",
            "value": number(found[test]["rms"]),
            "interval": DASH,
            "unit": "N",
        }
        for test in ("forward", "reverse")
        if test in found
    ]
    return table_of(
        rows,
        [
            ("parameter", "title"),
            ("value", lambda row: f"{row['value']} {row['unit']}", str),
            ("95 % interval", "interval", str),
        ],
        rule=lambda row: row["test"],
    )


def actuator_tests(
    name: str,
    throttle: tuple[np.ndarray, np.ndarray, ThrottleMap] | None = None,
    steps: tuple[Sequence[Step], StepAnswer] | None = None,
    bollard: tuple[np.ndarray, np.ndarray, tuple[ThrustFit, ThrustFit]] | None = None,
) -> Figure:
    """Draw measurements as dots and the fits over them, a panel for each test (Figs. 4, 6, 7).

    Args:
        throttle: throttle [N], revolutions [N] in 1/s, and the fitted map.
        steps: measured step responses, and the fitted one.
        bollard: revolutions [N] in 1/s, thrust [N] of one thruster in N, and the fitted curves.
    """
    drawn: list[tuple[Panel, dict[str, Curve]]] = []
    if throttle is not None:
        share, n, fitted = throttle
        grid = np.linspace(share.min(), share.max(), 300)
        panel = Panel("revolutions [rpm]", "throttle [%]", "throttle map", height=250, group="map")
        curves = {"measured": (100 * share, 60 * n), "fit": (100 * grid, 60 * fitted(grid))}
        drawn.append((panel, curves))
    if steps is not None:
        runs, answer = steps
        rate, dead = answer.rate.value, answer.dead_time.value
        panel = Panel("revolutions [rpm]", "time [s]", "step response", height=250, group="step")
        of_runs = {
            "command": joined((t - t[0], 60 * command) for t, command, _ in runs),
            "measured": joined((t - t[0], 60 * n) for t, _, n in runs),
            "fit": joined(
                (t - t[0], 60 * follow_command(t, command, rate, dead, float(n[:3].mean())))
                for t, command, n in runs
            ),
        }
        drawn.append((panel, of_runs))
    if bollard is not None:
        n, thrust, fits = bollard
        grids = [np.linspace(fit.low, fit.high, 200) for fit in fits]
        panel = Panel(
            "thrust of one [N]", "revolutions [rpm]", "bollard pull", height=250, group="n"
        )
        lines = joined((60 * grid, fit(grid)) for grid, fit in zip(grids, fits, strict=True))
        drawn.append((panel, {"measured": (60 * n, thrust), "fit": lines}))
    return Figure(
        "actuators",
        f"Actuators of {name}",
        f"Actuator tests of {name}: the measurements, and the fits over them.",
        {
            "command": Look("command", GREEN, "dashed"),
            "measured": Look("measured", "#666666", kind="points", size=2.5),
            "fit": replace(SOLID, label="fit"),
        },
        [panel for panel, _ in drawn],
        [Case("", [curves for _, curves in drawn])],
        columns=len(drawn),
    )
