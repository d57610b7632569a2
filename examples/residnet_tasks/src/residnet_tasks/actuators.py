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
from residnet.core.files import read_json
from residnet.core.format import DASH, format_interval, format_number
from residnet.core.names import suggest_name, to_si
from residnet.io.readers.text_encoding import open_as_utf8
from residnet.physics.actuators.identify import (
    IntervalEstimate,
    StepResponse,
    ThrottleMap,
    ThrustFit,
    fit_step_response,
    fit_throttle_map,
    fit_thrust_curves,
    simulate_shaft,
)
from residnet.report.blocks import Block, Code, Section, Table, Text, build_table
from residnet.report.figure import (
    GREEN,
    SOLID_STYLE,
    Case,
    Curve,
    Figure,
    GlyphStyle,
    Panel,
    join_with_gaps,
)
from residnet.report.figure_files import read_figures, write_figures
from residnet.runs.folder import RunFolder
from residnet.runs.task import SummaryMetric, Task, TaskOutcome

_PARAMETER_TITLES = {
    ("throttle", "slope"): "revolutions at full throttle, slope",
    ("throttle", "offset"): "revolutions at zero throttle",
    ("throttle", "n_max"): "largest revolutions",
    ("step", "rate"): "rate of the revolutions",
    ("step", "dead_time"): "dead time",
}
_DISPLAY_UNITS = {"1/s": ("rpm", 60.0), "1/s^2": ("rpm/s", 60.0)}
"""Display units with the factor from SI, by SI unit."""


MeasuredStep = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Time in s, commanded and measured shaft speed in 1/s of one step response, each [N]."""


class CsvColumn(Config):
    """A column of a csv file and its unit.

    Attributes:
        column: title in the first line of the file.
        unit: unit of the numbers, for example `rpm`.
    """

    column: str
    unit: str


def _unit_check(expected_unit: str) -> Callable[[CsvColumn], CsvColumn]:
    def check(column: CsvColumn) -> CsvColumn:
        try:
            to_si(column.unit, expected_unit)
        except UsageError as error:
            raise ValueError(str(error)) from None
        return column

    return check


DimensionlessColumn = Annotated[CsvColumn, AfterValidator(_unit_check("-"))]
TimeSeriesColumn = Annotated[CsvColumn, AfterValidator(_unit_check("s"))]
RevolutionsColumn = Annotated[CsvColumn, AfterValidator(_unit_check("1/s"))]
ForceColumn = Annotated[CsvColumn, AfterValidator(_unit_check("N"))]


class ActuatorTest(Config):
    """A test of the actuators.

    Attributes:
        files: csv files of the test.
    """

    files: Annotated[tuple[ExistingPath, ...], Field(min_length=1)]

    def read_columns(self) -> list[tuple[np.ndarray, ...]]:
        """Read the columns [N] of each file in SI units, in the order of the keys.

        Rows with an empty cell are skipped.

        Raises:
            UsageError: if a column is missing.
            DataError: if a cell is not a number, or no row is complete.
        """
        keys = [key for key in type(self).model_fields if key not in ("files", "thrusters")]
        return [_read_columns(path, [getattr(self, key) for key in keys]) for path in self.files]

    def read_concatenated(self) -> tuple[np.ndarray, ...]:
        """Return the columns [N] of all files, concatenated."""
        return tuple(
            np.concatenate(file_columns) for file_columns in zip(*self.read_columns(), strict=True)
        )


class ThrottleTest(ActuatorTest):
    """Steady shaft speed against throttle, one row for each operating point.

    Attributes:
        throttle: column of the throttle, from -1 to 1 (`-`) or in `%`.
        n: column of the shaft speed, for example in `rpm`.
    """

    throttle: DimensionlessColumn
    n: RevolutionsColumn


class StepTest(ActuatorTest):
    """Shaft speed after a step of the command, one file for each step response.

    Attributes:
        t: column of the time, for example in `s`.
        command: column of the commanded revolutions, for example in `rpm`.
        n: column of the measured revolutions, for example in `rpm`.
    """

    t: TimeSeriesColumn
    command: RevolutionsColumn
    n: RevolutionsColumn

    def read_columns(self) -> list[tuple[np.ndarray, ...]]:
        responses = super().read_columns()
        for path, (t, *_) in zip(self.files, responses, strict=True):
            if (backward_steps := np.flatnonzero(np.diff(t) <= 0)).size:
                raise DataError(
                    f"{path}: time repeats or runs backwards in row {int(backward_steps[0]) + 2}"
                    f" of the data"
                )
        return responses


class BollardTest(ActuatorTest):
    """Steady bollard pull of all thrusters against shaft speed.

    Attributes:
        n: column of the revolutions, for example in `rpm`.
        pull: column of the pull, positive ahead, for example in `N`.
        thrusters: number of thrusters.
    """

    n: RevolutionsColumn
    pull: ForceColumn
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
    def _require_test(self) -> ActuatorsTaskConfig:
        if not self._configured_tests():
            raise ValueError("no test is named; give at least one of throttle, step, bollard")
        return self

    def _configured_tests(self) -> list[ActuatorTest]:
        tests: tuple[ActuatorTest | None, ...] = (self.throttle, self.step, self.bollard)
        return [test for test in tests if test is not None]

    def check(self) -> None:
        """Check that the logs can be read.

        Raises:
            ResidnetError: if a column is missing or contains a cell that is not a number.
        """
        for test in self._configured_tests():
            test.read_columns()

    def input_files(self) -> list[Path]:
        """Return the files of all tests."""
        return [path for test in self._configured_tests() for path in test.files]

    def execute(self, folder: RunFolder) -> TaskOutcome:
        """Identify the actuators, and write actuators.json, actuators.yaml and a figure.

        actuators.yaml contains the section `actuators` of a vessel file.

        Raises:
            ResidnetError: if the logs cannot be used or do not determine the actuators.
        """
        throttle_data = step_data = bollard_data = None
        test_names = []
        main_estimates = dict[str, IntervalEstimate]()
        report_json: dict[str, Any] = {"schema": "residnet.actuators/1"}
        vessel_lines: dict[str, Any] = {}
        if self.throttle is not None:
            throttle_values, n = self.throttle.read_concatenated()
            throttle_map = fit_throttle_map(throttle_values, n)
            throttle_data = (throttle_values, n, throttle_map)
            main_estimates["n_max"] = throttle_map.n_max
            report_json["throttle"] = _estimates_to_json(throttle_map._asdict())
            vessel_lines["n_max"] = f"{throttle_map.n_max.value * 60:.5g} rpm"
            test_names.append("throttle map")
        if self.step is not None:
            runs = [(t, command, n) for t, command, n in self.step.read_columns()]
            step_response = fit_step_response(runs)
            step_data = (runs, step_response)
            main_estimates |= {"n_rate": step_response.rate, "dead_time": step_response.dead_time}
            report_json["step"] = _estimates_to_json(step_response._asdict())
            vessel_lines["n_rate"] = f"{step_response.rate.value * 60:.5g} rpm/s"
            test_names.append("step response")
        if self.bollard is not None:
            n, force = self.bollard.read_concatenated()
            thrust_fits = fit_thrust_curves(n, force, self.bollard.thrusters)
            bollard_data = (n, force / self.bollard.thrusters, thrust_fits)
            for name, thrust_fit in zip(("forward", "reverse"), thrust_fits, strict=True):
                coefficients = {
                    f"c{i}": coefficient for i, coefficient in enumerate(thrust_fit.coefficients)
                }
                report_json[name] = _estimates_to_json(
                    {
                        **coefficients,
                        "low": thrust_fit.low,
                        "high": thrust_fit.high,
                        "rms": thrust_fit.rms,
                    }
                )
                vessel_lines[name] = [
                    float(f"{coefficient.value:.6g}") for coefficient in thrust_fit.coefficients
                ]
            range_limits = (thrust_fits[1].low, thrust_fits[0].high)
            vessel_lines["curve_range"] = [
                f"{range_limit * 60:.5g} rpm" for range_limit in range_limits
            ]
            test_names.append("thrust curves")
        vessel_lines["source"] = f"identified by residnet, run {self.name}"
        vessel_yaml = yaml.safe_dump(vessel_lines, sort_keys=False, default_flow_style=None)
        folder.write(folder.path / "actuators.yaml", vessel_yaml)
        folder.write_json(folder.path / "actuators.json", report_json)
        write_figures(
            folder.figures, [plot_actuator_tests(self.name, throttle_data, step_data, bollard_data)]
        )
        sentence = (
            f"The tests gave {' and '.join(test_names)}; actuators.yaml holds the lines for a"
            f" vessel"
            " file."
        )
        summary_metrics = {
            name: SummaryMetric(estimate.value, estimate.unit)
            for name, estimate in main_estimates.items()
        }
        return TaskOutcome(
            [sentence],
            summary_metrics,
            f"{build_parameter_table(report_json).to_text()}\n\n{vessel_yaml}",
        )

    @classmethod
    def report_sections(cls, run: RunFolder) -> Sequence[Section]:
        actuator_json = read_json(run.path / "actuators.json")
        figures = read_figures(run.figures)
        blocks: list[Block] = [
            *(figure.preview() for figure in figures[:1]),
            build_parameter_table(actuator_json),
        ]
        throttle = actuator_json.get("throttle")
        if throttle and not throttle["saturated"]:
            text = (
                "Nothing saturated in the throttle test. The largest revolutions are measured ones."
            )
            blocks.append(Text(text))
        sections = [Section("", blocks), *([Section("Figures", figures)] if figures else [])]
        vessel_lines_path = run.path / "actuators.yaml"
        if vessel_lines_path.is_file():
            explanation = "These lines belong to the section actuators of a vessel file."
            sections.append(
                Section(
                    "Lines for a vessel file",
                    [Text(explanation), Code(vessel_lines_path.read_text())],
                )
            )
        return sections


def _estimates_to_json(estimates: Mapping[str, Any]) -> dict[str, Any]:
    return {k: v._asdict() if isinstance(v, IntervalEstimate) else v for k, v in estimates.items()}


def _read_columns(path: Path, columns: Sequence[CsvColumn]) -> tuple[np.ndarray, ...]:
    import pandas as pd

    try:
        with open_as_utf8(path) as file:
            table = pd.read_csv(file, skipinitialspace=True, encoding="utf-8-sig")
    except (pd.errors.ParserError, pd.errors.EmptyDataError, UnicodeDecodeError) as error:
        raise DataError(
            f"{path}: not a readable csv table ({' '.join(str(error).split())})"
        ) from error
    columns_si = []
    for entry in columns:
        if entry.column not in table.columns:
            suggestion = suggest_name(entry.column, map(str, table.columns))
            raise UsageError(f"{path}: no column '{entry.column}'{suggestion}")
        values = pd.to_numeric(table[entry.column], errors="coerce").to_numpy(dtype=np.float64)
        invalid_rows = np.flatnonzero(~np.isfinite(values) & table[entry.column].notna().to_numpy())
        if invalid_rows.size:
            raise DataError(
                f"{path}: line {int(invalid_rows[0]) + 2}, column '{entry.column}':"
                f" '{table[entry.column].iloc[int(invalid_rows[0])]}' is not a finite number"
            )
        columns_si.append(values * to_si(entry.unit))
    is_complete = np.isfinite(np.stack(columns_si)).all(axis=0)
    if not is_complete.any():
        names = ", ".join(entry.column for entry in columns)
        raise DataError(f"{path}: no row has a number in all of {names}")
    return tuple(values[is_complete] for values in columns_si)


def build_parameter_table(actuator_json: Mapping[str, Any]) -> Table:
    """Return a table of the parameters of actuators.json with 95 % confidence intervals."""
    rows: list[dict[str, str]] = []
    for test, test_results in actuator_json.items():
        estimates = test_results.items() if isinstance(test_results, Mapping) else ()
        for name, estimate in estimates:
            if isinstance(estimate, Mapping):
                unit, factor = _DISPLAY_UNITS.get(estimate["unit"], (estimate["unit"], 1.0))
                rows.append(
                    {
                        "test": test,
                        "title": _PARAMETER_TITLES.get((test, name), f"{test} thrust, {name}"),
                        "value": format_number(factor * estimate["value"], 4),
                        "interval": format_interval([estimate["low"], estimate["high"]], factor, 4),
                        "unit": unit,
                    }
                )
    rows += [
        {
            "test": "residual",
            "title": f"{test} thrust, rms residual",
            "value": format_number(actuator_json[test]["rms"]),
            "interval": DASH,
            "unit": "N",
        }
        for test in ("forward", "reverse")
        if test in actuator_json
    ]
    return build_table(
        rows,
        [
            ("parameter", "title"),
            ("value", lambda row: f"{row['value']} {row['unit']}", str),
            ("95 % interval", "interval", str),
        ],
        group_key=lambda row: row["test"],
    )


def plot_actuator_tests(
    name: str,
    throttle_data: tuple[np.ndarray, np.ndarray, ThrottleMap] | None = None,
    step_data: tuple[Sequence[MeasuredStep], StepResponse] | None = None,
    bollard_data: tuple[np.ndarray, np.ndarray, tuple[ThrustFit, ThrustFit]] | None = None,
) -> Figure:
    """Plot measurements and fitted curves, one panel for each test (document 003, Figs. 4, 6, 7).

    Args:
        throttle_data: throttle [N], revolutions [N] in 1/s, and the fitted map.
        step_data: measured step responses, and the fitted one.
        bollard_data: revolutions [N] in 1/s, thrust [N] of one thruster in N, and the fitted
            curves.
    """
    panels_and_curves: list[tuple[Panel, dict[str, Curve]]] = []
    if throttle_data is not None:
        throttle_values, n, fitted_map = throttle_data
        sample_points = np.linspace(throttle_values.min(), throttle_values.max(), 300)
        panel = Panel("revolutions [rpm]", "throttle [%]", "throttle map", height=250, group="map")
        panel_curves = {
            "measured": (100 * throttle_values, 60 * n),
            "fit": (100 * sample_points, 60 * fitted_map(sample_points)),
        }
        panels_and_curves.append((panel, panel_curves))
    if step_data is not None:
        responses, step_response = step_data
        rate = step_response.rate.value
        dead_time = step_response.dead_time.value
        panel = Panel("revolutions [rpm]", "time [s]", "step response", height=250, group="step")
        step_curves = {
            "command": join_with_gaps((t - t[0], 60 * command) for t, command, _ in responses),
            "measured": join_with_gaps((t - t[0], 60 * n) for t, _, n in responses),
            "fit": join_with_gaps(
                (t - t[0], 60 * simulate_shaft(t, command, rate, dead_time, float(n[:3].mean())))
                for t, command, n in responses
            ),
        }
        panels_and_curves.append((panel, step_curves))
    if bollard_data is not None:
        n, thrust, thrust_fits = bollard_data
        sample_grids = [
            np.linspace(thrust_fit.low, thrust_fit.high, 200) for thrust_fit in thrust_fits
        ]
        panel = Panel(
            "thrust of one [N]", "revolutions [rpm]", "bollard pull", height=250, group="n"
        )
        fit_lines = join_with_gaps(
            (60 * sample_points, thrust_fit(sample_points))
            for sample_points, thrust_fit in zip(sample_grids, thrust_fits, strict=True)
        )
        panels_and_curves.append((panel, {"measured": (60 * n, thrust), "fit": fit_lines}))
    return Figure(
        "actuators",
        f"Actuators of {name}",
        f"Actuator tests of {name}: the measurements, and the fits over them.",
        {
            "command": GlyphStyle("command", GREEN, "dashed"),
            "measured": GlyphStyle("measured", "#666666", kind="points", size=2.5),
            "fit": replace(SOLID_STYLE, label="fit"),
        },
        [panel for panel, _ in panels_and_curves],
        [Case("", [panel_curves for _, panel_curves in panels_and_curves])],
        columns=len(panels_and_curves),
    )
