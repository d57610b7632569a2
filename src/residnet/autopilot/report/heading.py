"""The report of an autopilot run: settling, effort and cost of every controller."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from pydantic import Field

from residnet.autopilot.evaluation import describe_limit_cycles, list_unsuitable_conditions
from residnet.autopilot.heading.conditions import ConditionsConfig, settled_time
from residnet.autopilot.heading.evaluation_config import EvaluationConditions, StepTestConfig
from residnet.autopilot.records import (
    AutopilotMetricsFile,
    ControllersFile,
    HeadingRow,
    PolicyNotes,
)
from residnet.core.format import DEGREES_PER_RADIAN, format_signed
from residnet.report.blocks import (
    Block,
    Cell,
    Code,
    Column,
    Section,
    Table,
    Text,
    build_table,
    flag_cell,
)
from residnet.report.figure import (
    BLUE,
    GREY,
    VERMILLION,
    ZERO_LINE_STYLE,
    Case,
    Curve,
    Figure,
    GlyphStyle,
    Panel,
    band_outline,
    step_curve,
    style_family,
)
from residnet.report.figure_files import figures_section, read_figures, write_figures
from residnet.report.run_reader import RunFiles
from residnet.report.run_settings import ShownSettings, read_settings

RESPONSES_FILE = "flights.parquet"
"""File of the responses at the corners of the parameter ranges."""
VESSELS_FILE = "plants.parquet"
"""File of the metrics of each random vessel."""
CONDITIONS_FILE = "conditions.parquet"
"""File of the metrics of each simulation under the stated conditions, by controller."""


class AxisWords(NamedTuple):
    """Words for the controlled axis.

    Attributes:
        value: controlled quantity.
        unit: unit in which it is displayed.
        scale: factor from SI to this unit.
        rate: name of the rate of the vessel.
        rudder: name of the actuator.
        columns: columns of the controlled quantity and of the rate.
    """

    value: str
    unit: str
    scale: float
    rate: str
    rudder: str
    columns: tuple[str, str]


_HEADING_WORDS = AxisWords("heading", "deg", DEGREES_PER_RADIAN, "yaw rate", "rudder", ("psi", "r"))
_DEPTH_WORDS = AxisWords("depth", "m", 1.0, "pitch rate", "stern planes", ("z", "q"))


class PolicySettings(ShownSettings):
    """Whether a policy was trained.

    Attributes:
        training: settings of the training; None for a tuned law.
    """

    training: object = None


class AutopilotSettings(ShownSettings):
    """Settings of an autopilot run that its page shows.

    Attributes:
        rudder: rudder limit of the controllers in rad.
        test: step test of all controllers.
        conditions: operating conditions of tuning, training and evaluation; None for none.
        policies: the policies by name.
    """

    rudder: float
    test: StepTestConfig
    conditions: EvaluationConditions | None = None
    policies: dict[str, PolicySettings] = Field(default_factory=dict)


RowsByProtocol = Mapping[str, HeadingRow]
"""Rows of one controller by the name of the test."""


def _read_simulated_settings(run: RunFiles, metrics: AutopilotMetricsFile) -> AutopilotSettings:
    """Return the settings with all times scaled by the pace, as simulated."""
    settings = read_settings(run.path, AutopilotSettings)
    return settings.model_copy(
        update={"test": metrics.flown.test, "conditions": metrics.flown.conditions}
    )


def axis_words(test: StepTestConfig | ConditionsConfig) -> AxisWords:
    """Return the words for the controlled axis of a test or of conditions."""
    return _HEADING_WORDS if test.depth is None else _DEPTH_WORDS


_LEARNED_KINDS = ("policy", "network")
"""Kinds of controllers with a trained network."""
_KIND_LABELS = {
    "policy": "learned",
    "network": "learned, without a law",
    "constants": "law, constants trained",
    "law": "classical law, exported",
    "untrained": "policy before training",
    "network_off": "policy, network switched off",
    "classical": "classical, tuned",
    "predictive": "document's autopilot",
    "floor": "knows the nominal vessel",
}


def _iterate_autopilot_figures(
    run: RunFiles, metrics: AutopilotMetricsFile, settings: AutopilotSettings
) -> Iterator[Figure]:
    """Yield the figures of an autopilot run for which its folder has the data."""
    conditioned_kinds = {
        row.model: row.kind for row in metrics.rows if row.protocol == "conditions"
    }
    nominal_kinds = {row.model: row.kind for row in metrics.rows if row.protocol == "nominal"}
    yield _response_figure(
        run.read_required_parquet(RESPONSES_FILE), nominal_kinds, settings.test, run.title
    )
    yield _flights_figure(
        run.read_required_parquet(RESPONSES_FILE),
        _order_controllers(metrics.rows, nominal_kinds),
        settings.test,
    )
    axis_labels = axis_words(settings.test)
    yield _distribution_figure(
        run.read_required_parquet(VESSELS_FILE), nominal_kinds, run.title, axis_labels
    )
    conditioned = run.read_parquet(CONDITIONS_FILE)
    if conditioned is not None:
        yield _cost_figure(conditioned, conditioned_kinds, run.title, axis_labels)
    training_notes = {
        name: run.read_required_record(PolicyNotes, f"models/{name}/fit.json")
        for name, policy in settings.policies.items()
        # a tuned law has no training
        if policy.training is not None
    }
    if training_notes:
        yield _learning_figure(training_notes, run.title)


def _controller_styles(kinds: Mapping[str, str]) -> dict[str, GlyphStyle]:
    """Return the style of each controller; policies have the widest lines and are drawn last."""
    return {
        name: replace(style, width=1.8, z_order=4) if kinds[name] == "policy" else style
        for name, style in style_family(kinds, width=1.2).items()
    }


def _response_figure(
    series: pd.DataFrame, kinds: Mapping[str, str], test: StepTestConfig, name: str
) -> Figure:
    """Draw a step of the nominal vessel; for policies also the corners of the ranges, shaded."""
    axis_labels = axis_words(test)
    change, settling_band = test.step_and_tolerance
    value, rate = axis_labels.columns
    series = series.assign(error=change - series[value])
    styles = _controller_styles(kinds)
    scales = {
        value: axis_labels.scale,
        "error": axis_labels.scale,
        rate: DEGREES_PER_RADIAN,
        "rudder": DEGREES_PER_RADIAN,
    }
    traces: dict[str, dict[str, Curve]] = {key: {} for key in scales}
    for controller, model_kind in kinds.items():
        trajectories = series[series["controller"] == controller]
        for quantity, panel in traces.items():
            pivoted: Any = scales[quantity] * trajectories.pivot_table(
                index="t", columns=["effect", "time"], values=quantity
            )
            panel[controller] = (pivoted.index.to_numpy(), pivoted[(1.0, 1.0)].to_numpy())
            if model_kind == "policy" and quantity in (value, "error"):
                shade_name = f"{controller}, corners"
                color = styles[controller].color
                styles[shade_name] = GlyphStyle(
                    shade_name, color, kind="fill", alpha=0.25, z_order=1
                )
                values = pivoted.to_numpy()
                panel[shade_name] = band_outline(
                    pivoted.index, values.min(axis=1), values.max(axis=1)
                )
    for key, centre in ((value, change), ("error", 0.0)):
        band_limits = axis_labels.scale * (centre + settling_band * np.array([-1.0, 1.0]))
        traces[key]["settled"] = (np.zeros(2), band_limits)
    zoom_limit = 2.5 * axis_labels.scale * settling_band
    styles["settled"] = replace(ZERO_LINE_STYLE, label="band of settling", dash="dotted")
    return Figure(
        "responses",
        f"Step responses of {name}",
        f"Step of {axis_labels.scale * change:.3g} {axis_labels.unit}. Lines show the nominal"
        " vessel, shades"
        " the corners of the spread under the learned policies. The dotted band of"
        f" {axis_labels.scale * settling_band:.1f} {axis_labels.unit}, enlarged in the second"
        " panel, is the one in"
        " which a change has settled.",
        styles,
        [
            Panel(f"{axis_labels.value}\n[{axis_labels.unit}]", height=195),
            Panel(
                f"{axis_labels.value} error\n[{axis_labels.unit}]",
                height=150,
                y_limits=(-zoom_limit, zoom_limit),
            ),
            Panel(f"{axis_labels.rate}\n[deg/s]", height=150),
            Panel(f"{axis_labels.rudder}\n[deg]", "time [s]", height=150),
        ],
        [Case("", list(traces.values()))],
    )


_MAX_FLIGHTS = 8
"""Number of controllers whose flights fit on the first screen."""


def _order_controllers(rows: Sequence[HeadingRow], kinds: Mapping[str, str]) -> dict[str, str]:
    """Return the kinds of the controllers, policies first, then by the mean cost or settling."""
    sort_values: dict[str, float] = {}
    for row in rows:
        if row.protocol == "conditions":
            sort_values[row.model] = row.mean_cost
        elif row.protocol == "nominal":
            sort_values.setdefault(row.model, row.max_settling)
    ordered = sorted(
        kinds, key=lambda name: (kinds[name] not in _LEARNED_KINDS, sort_values.get(name, math.inf))
    )
    return {name: kinds[name] for name in ordered[:_MAX_FLIGHTS]}


def _flights_figure(series: pd.DataFrame, kinds: Mapping[str, str], test: StepTestConfig) -> Figure:
    """Draw the step response of each controller in a panel of its own, with the corners shaded.

    Args:
        series: responses of the nominal vessel and of the corners of the spread.
        kinds: kind of each controller that is drawn, in order.
        test: test of the run, with the step.
    """
    axis_labels = axis_words(test)
    change, settling_band = test.step_and_tolerance
    value = axis_labels.columns[0]
    band_limits = axis_labels.scale * (change + settling_band * np.array([-1.0, 1.0]))
    panels = []
    panel_curves: list[dict[str, Curve]] = []
    for name, kind in kinds.items():
        pivoted: Any = axis_labels.scale * series[series["controller"] == name].pivot_table(
            index="t", columns=["effect", "time"], values=value
        )
        values = pivoted.to_numpy()
        style_name = "learned" if kind in _LEARNED_KINDS else "classical"
        panels.append(Panel(title=name, height=90))
        panel_curves.append(
            {
                "corners": band_outline(pivoted.index, values.min(axis=1), values.max(axis=1)),
                "settled": (np.zeros(2), band_limits),
                style_name: (pivoted.index.to_numpy(), pivoted[(1.0, 1.0)].to_numpy()),
            }
        )
    upper_limit = 1.05 * max(
        float(np.nanmax(np.abs(curve["corners"][1]), initial=band_limits[1]))
        for curve in panel_curves
    )
    upper_limit = min(upper_limit, 2.0 * float(band_limits[1]))
    panels = [
        replace(panel, y_limits=(-0.05 * upper_limit, upper_limit), x_label="time [s]")
        if number >= len(panels) - 2
        else replace(panel, y_limits=(-0.05 * upper_limit, upper_limit))
        for number, panel in enumerate(panels)
    ]
    return Figure(
        "flights",
        "Step response by controller",
        f"{axis_labels.value.capitalize()} [{axis_labels.unit}] in a step of"
        f" {axis_labels.scale * change:.3g} {axis_labels.unit}: the nominal vessel, shaded the"
        " corners of the spread; dotted the band of settling.",
        {
            "learned": GlyphStyle("learned policy", VERMILLION, width=1.6, z_order=4),
            "classical": GlyphStyle("classical law", BLUE, width=1.6, z_order=4),
            "corners": GlyphStyle("corners", GREY, kind="fill", alpha=0.3, z_order=1),
            "settled": replace(ZERO_LINE_STYLE, label="band", dash="dotted"),
        },
        panels,
        [Case("", panel_curves, has_static_image=False)],
        columns=2,
        is_drawing=True,
    )


def _cumulative_shares(
    frame: pd.DataFrame,
    styles: Mapping[str, GlyphStyle],
    quantities: Sequence[tuple[str, float, str]],
) -> list[dict[str, Curve]]:
    """Return the cumulative distributions of the rows, one panel per quantity."""
    panels = []
    for quantity, scale, _ in quantities:
        panel = {}
        for controller in styles:
            values = frame.loc[frame["controller"] == controller, quantity].dropna()
            sorted_values = scale * np.sort(values.to_numpy(float))
            cumulative_share = np.arange(len(sorted_values) + 1) / max(len(sorted_values), 1)
            panel[controller] = step_curve(
                np.concatenate((sorted_values[:1], sorted_values)),
                cumulative_share[: len(sorted_values) + 1],
            )
        panels.append(panel)
    return panels


def _share_panels(
    quantities: Sequence[tuple[str, float, str]], limits: Sequence[Sequence[float]], subject: str
) -> list[Panel]:
    return [
        Panel(
            f"share of {subject}" if index % 2 == 0 else "",
            text,
            height=200,
            group=quantity,
            x_limits=axis_limits,
            y_limits=(0.0, 1.02),
        )
        for index, ((quantity, _, text), axis_limits) in enumerate(
            zip(quantities, limits, strict=True)
        )
    ]


def _distribution_figure(
    plants: pd.DataFrame, kinds: Mapping[str, str], name: str, axis_labels: AxisWords
) -> Figure:
    """Draw settling time, overshoot, error, rudder travel and energy over random vessels."""
    quantities = (
        ("settling", 1.0, "settling time [s]"),
        ("overshoot", axis_labels.scale, f"overshoot [{axis_labels.unit}]"),
        ("iae", axis_labels.scale, f"integral of the absolute error [{axis_labels.unit} s]"),
        ("travel", DEGREES_PER_RADIAN, f"{axis_labels.rudder} travel [deg]"),
        ("energy", DEGREES_PER_RADIAN**2, "control energy [deg² s]"),
    )
    # axes hold those controllers that settle more often than not
    median_settling = plants.groupby("controller")["settling"].median()
    settling_vessels = plants[
        plants["controller"].isin(median_settling.index[median_settling < plants["settling"].max()])
    ]
    limits: list[Sequence[float]] = []
    for quantity, scale, _ in quantities:
        values = scale * settling_vessels[quantity].to_numpy(float)
        margin = 0.05 * float(np.ptp(values) or abs(values[0]) or 1.0) if len(values) else 0.0
        limits.append((values.min() - margin, values.max() + margin) if len(values) else ())
    styles = _controller_styles(kinds)
    return Figure(
        "distributions",
        f"Random vessels of {name}",
        f"Share of {len(plants) // len(kinds)} random vessels of the spread that stay below a"
        " value. A change that had not settled at the end of its simulation counts with the"
        " duration of the simulation. Controllers that seldom settle may lie beyond the axes.",
        styles,
        _share_panels(quantities, limits, "vessels"),
        [Case("", _cumulative_shares(plants, styles, quantities))],
        columns=2,
    )


def _cost_figure(
    runs: pd.DataFrame, kinds: Mapping[str, str], name: str, axis_labels: AxisWords
) -> Figure:
    """Draw the cumulative distributions of the metrics under the conditions."""
    conditioned_runs = runs[runs["protocol"] == "conditions"]
    quantities = (
        ("cost", 1.0, "cost [s]"),
        ("time_outside", 1.0, "time outside the band [s]"),
        ("overshoot", axis_labels.scale, f"overshoot [{axis_labels.unit}]"),
        ("travel", DEGREES_PER_RADIAN, f"{axis_labels.rudder} travel [deg]"),
    )
    known_controllers = conditioned_runs[conditioned_runs["controller"].isin(kinds)]
    limits: list[Sequence[float]] = []
    for quantity, scale, _ in quantities:
        values = scale * known_controllers[quantity].dropna().to_numpy(float)
        limits.append((0.0, float(np.quantile(values, 0.98)) * 1.05 or 1.0) if len(values) else ())
    styles = _controller_styles(kinds)
    return Figure(
        "conditions",
        f"Simulations of {name} under the stated conditions",
        f"Share of {conditioned_runs['flight'].nunique()} simulations under the stated conditions"
        " that stay below a value. The two per cent with the largest values may lie beyond an"
        " axis.",
        styles,
        _share_panels(quantities, limits, "simulations"),
        [Case("", _cumulative_shares(conditioned_runs, styles, quantities))],
        columns=2,
    )


def _learning_figure(notes_by_policy: Mapping[str, PolicyNotes], name: str) -> Figure:
    """Draw the cost over the validation simulations, from the start of the training on."""
    panel: dict[str, Curve] = {}
    for policy, notes in notes_by_policy.items():
        costs = {0.0: notes.start_validation} | {
            row.epoch + 1.0: row.validation_error
            for row in notes.training_history
            if row.validation_error is not None
        }
        panel[policy] = (np.array([*costs]), np.array([*costs.values()]))
        panel[f"{policy}, start"] = (np.zeros(1), np.array([notes.start_validation]))
    styles = _controller_styles(dict.fromkeys(notes_by_policy, "policy"))
    start_styles = {
        f"{policy}, start": replace(ZERO_LINE_STYLE, label="start", dash="dotted")
        for policy in notes_by_policy
    }
    return Figure(
        "learning",
        f"Training of {name}",
        "Mean cost over the simulations by which the epoch is selected. Epoch 0 is the tuned law"
        " from which the training starts, shown as a dotted line. The epoch with the smallest cost"
        " is selected.",
        styles | start_styles,
        [Panel("mean cost [s]", "epoch", height=290)],
        [Case("", [panel])],
    )


def sections(run: RunFiles) -> list[Section]:
    """Return costs, comparison, effort, figures and controllers of an autopilot run.

    Raises:
        UsageError: if the folder has no metrics.json.
    """
    metrics = run.read_task_metrics(AutopilotMetricsFile)
    settings = _read_simulated_settings(run, metrics)
    write_figures(run.path / "figures", _iterate_autopilot_figures(run, metrics, settings))
    axis_labels = axis_words(settings.test)
    settling_comparison = settling_table(metrics.rows, metrics.floor, axis_labels)
    conditions = settings.conditions
    costs = None if conditions is None else cost_table(metrics.rows, axis_labels)
    flights = read_figures(run.path / "figures", "flights")
    # settling of the nominal vessel and of the spread, or the cost of a change
    opening_table = (
        settling_comparison.select_columns(0, 3) if costs is None else costs.select_columns(1, 4)
    )
    sections_written = [
        Section("", [*flights, opening_table]),
        Section(
            "Controllers compared",
            [
                settling_comparison,
                Text(_autopilot_definitions(settings), is_secondary=True),
            ],
        ),
        Section(
            "Effort",
            [
                effort_table(metrics.rows, axis_labels),
                Text(_effort_text(settings.test), is_secondary=True),
            ],
        ),
        *figures_section(run.path / "figures", "(?!flights$).*"),
    ]
    if costs is not None and conditions is not None:
        blocks: list[Block] = [costs, Text(_conditions_text(conditions), is_secondary=True)]
        extrapolation = extrapolation_table(metrics.rows)
        if extrapolation is not None:
            blocks += [Text(["Outside the conditions of tuning and training:"]), extrapolation]
        sections_written.insert(1, Section("Under the stated conditions", blocks))
    controllers = run.read_record(ControllersFile, "controllers.json")
    if controllers is not None:
        text = json.dumps(controllers.to_content(), indent=1)
        sections_written.append(Section("Controllers", [Code(text)], is_folded=True))
    return sections_written


def _rows_by_model(rows: Sequence[HeadingRow], protocol: str) -> dict[str, RowsByProtocol]:
    """Return rows by controller and protocol, for the controllers tested under `protocol`."""
    rows_by_model: dict[str, dict[str, HeadingRow]] = {}
    for row in rows:
        rows_by_model.setdefault(row.model, {})[row.protocol] = row
    return {
        model: rows_by_protocol
        for model, rows_by_protocol in rows_by_model.items()
        if protocol in rows_by_protocol
    }


def settling_table(
    rows: Sequence[HeadingRow], reference_controller: str | None, axis_labels: AxisWords
) -> Table:
    """Return the table of settling time, overshoot and steady errors by controller.

    Args:
        reference_controller: the controller whose nominal settling time the others are divided by.
    """
    rows_by_model = _rows_by_model(rows, "nominal")

    def unsettled_cell(row: RowsByProtocol) -> Cell:
        protocols = ("corners", "random", "nominal")
        n_unsettled = sum(row[protocol].unsettled or 0 for protocol in protocols)
        return flag_cell(n_unsettled, n_unsettled)

    def max_overshoot(row: RowsByProtocol) -> float:
        overshoots = (row[protocol].overshoot for protocol in ("corners", "random"))
        return max(overshoot.max for overshoot in overshoots if overshoot is not None)

    columns: list[Column[RowsByProtocol]] = [
        ("controller", "nominal.model"),
        ("nominal [s]", "nominal.settling.max", 2),
    ]
    if reference_controller:
        reference_settling = rows_by_model[reference_controller]["nominal"].max_settling
        columns.append(
            (
                f"over {reference_controller} [-]",
                "nominal.settling.max",
                3,
                1.0 / reference_settling,
            )
        )
    columns += [
        ("worst [s]", "corners.settling.max", 2),
        ("random, mean [s]", "random.settling.mean", 2),
        ("random, 95 % [s]", "random.settling.p95", 2),
        (f"overshoot [{axis_labels.unit}]", max_overshoot, 3, axis_labels.scale),
        (f"bias [{axis_labels.unit}]", "bias.error_end", 4, axis_labels.scale),
    ]
    if any(row.protocol == "wind" for row in rows):
        columns.append((f"wind [{axis_labels.unit}]", "wind.error_end", 4, axis_labels.scale))
    return build_table(
        rows_by_model.values(),
        [*columns, ("not settled", unsettled_cell)],
        is_selected=lambda row: row["nominal"].kind == "policy",
    )


def effort_table(rows: Sequence[HeadingRow], axis_labels: AxisWords) -> Table:
    """Return the table of control effort: of a change over random vessels, and in waves."""
    groups = [
        (f"absolute error [{axis_labels.unit} s]", 2),
        (f"{axis_labels.rudder} travel [deg]", 2),
    ]
    groups.append(("energy [deg² s]", 2))
    columns: list[Column[RowsByProtocol]] = [("controller", "random.model")]
    for quantity, scale in (
        ("iae", axis_labels.scale),
        ("travel", DEGREES_PER_RADIAN),
        ("energy", DEGREES_PER_RADIAN**2),
    ):
        columns += [
            ("mean", f"random.{quantity}.mean", 2, scale),
            ("95 %", f"random.{quantity}.p95", 2, scale),
        ]
    if sea_rows := [row for row in rows if row.protocol == "sea"]:
        sea_angles = [
            "heading",
            "rudder",
            *(["heel"] if any(row.heel_rms is not None for row in sea_rows) else []),
        ]
        columns += [(name, f"sea.{name}_rms.mean", 3, DEGREES_PER_RADIAN) for name in sea_angles]
        groups.append(("sea, root mean square [deg]", len(sea_angles)))
    return build_table(
        _rows_by_model(rows, "random").values(),
        columns,
        groups=groups,
        is_selected=lambda row: row["random"].kind == "policy",
    )


def _autopilot_definitions(settings: AutopilotSettings) -> list[str]:
    test = settings.test
    axis_labels = axis_words(test)
    change, band = (axis_labels.scale * value for value in test.step_and_tolerance)
    return [
        f"One definition holds for all controllers: a step of {change:.3g} {axis_labels.unit}"
        " without"
        f" prefilter, with the {axis_labels.rudder} within {math.degrees(settings.rudder):.3g}"
        " deg. A"
        f" change has settled at its last entry into {band:.3g} {axis_labels.unit}.",
        "Worst: over the corners of the spread. Random: over"
        f" {test.plants} vessels drawn from it. Overshoot: the largest over both. Bias: largest"
        f" error after {test.bias_time:g} s under {math.degrees(test.bias):.3g} deg of"
        f" constant bias of the {axis_labels.rudder}. Not settled: number of changes outside the"
        " band at"
        " their end.",
        "Peers are tuned by the cost under the stated conditions."
        if settings.conditions is not None
        else "The constants of the peers are given.",
    ]


def _effort_text(test: StepTestConfig) -> list[str]:
    texts = [
        f"Mean and 95th percentile over the {test.plants} random vessels: integral of the"
        f" absolute {axis_words(test).value} error, travel of the {axis_words(test).rudder}"
        " command,"
        " and its energy (the integral of its square)."
    ]
    if test.wind:
        texts.append(
            f"Wind: largest error after {test.bias_time:g} s in {test.wind:g} m/s from eight"
            " directions."
        )
    if sea := test.sea:
        texts.append(
            f"Sea: root mean squares over {test.sea_time:g} s after the step, on a course of"
            f" {math.degrees(test.heading):.3g} deg, mean over eight realisations. The waves"
            f" have {sea.significant_height:g} m significant height and"
            f" {sea.peak_period:g} s peak period ({sea.spectrum.kind}) and travel towards"
            f" {math.degrees(sea.direction):.3g} deg."
        )
    return texts


def best_classical_row(rows: Sequence[HeadingRow]) -> HeadingRow:
    """Return the row of the classical controller with the smallest mean cost."""
    condition_rows = [row for row in rows if row.protocol == "conditions"]
    classical_rows = [row for row in condition_rows if row.kind == "classical"]
    return min(classical_rows or condition_rows, key=lambda row: row.mean_cost)


def cost_sentences(rows: Sequence[HeadingRow], vessel_text: str = "") -> list[str]:
    """Return a sentence for each learned policy on its cost and that of the best classical law.

    It is empty without operating conditions.

    Args:
        rows: rows of metrics.json.
        vessel_text: the simulated vessel, for which the claims hold; empty if it is not named.
    """
    conditions_text = f"Under the stated conditions{f' on {vessel_text}' if vessel_text else ''}"
    rows_by_model = {row.model: row for row in rows if row.protocol == "conditions"}
    if not rows_by_model:
        return []
    best_row = best_classical_row(rows)
    sentences = [
        f"{conditions_text} the tuned law '{name}' costs {row.mean_cost:.3f} s a"
        f" change; the best classical law, '{best_row.model}', costs"
        f" {best_row.mean_cost:.3f} s."
        for name, row in rows_by_model.items()
        if row.kind == "law"
    ]
    for row in sorted(rows_by_model.values(), key=lambda row: row.mean_cost):
        if row.kind not in ("policy", "network"):
            continue
        name = row.model
        switched_off = rows_by_model.get(f"{name} network off")
        cost = row.mean_cost
        best_cost = best_row.mean_cost
        network_text = (
            "; it contains no law"
            if switched_off is None
            else f"; {switched_off.mean_cost:.3f} s with its network switched off"
        )
        sentences.append(
            f"{conditions_text} '{name}' has a mean cost of {cost:.3f} s,"
            f" {100 * abs(cost / best_cost - 1):.1f} % {'below' if cost < best_cost else 'above'}"
            f" '{best_row.model}', the best classical law, with {best_cost:.3f} s{network_text}."
        )
        if objections := list_unsuitable_conditions(name, rows):
            sentences.append(f"Do not use '{name}' there: {'; '.join(objections)}.")
        sentences += describe_limit_cycles(name, rows)
    return sentences


def cost_table(rows: Sequence[HeadingRow], axis_labels: AxisWords) -> Table:
    """Return cost, overshoot and travel under the stated conditions by controller."""
    best_row = best_classical_row(rows)
    rows_by_model = _rows_by_model(rows, "conditions")
    return build_table(
        sorted(rows_by_model.values(), key=lambda row: row["conditions"].mean_cost),
        [
            ("controller", "conditions.model"),
            ("kind", lambda row: _KIND_LABELS[row["conditions"].kind]),
            ("mean [s]", "conditions.cost.mean", 3),
            (
                f"over {best_row.model} [%]",
                lambda row: 100 * (row["conditions"].mean_cost / best_row.mean_cost - 1),
                lambda value: format_signed(value, 1),
            ),
            ("95 % [s]", "conditions.cost.p95", 2),
            ("outside, mean [s]", "conditions.time_outside.mean", 2),
            (f"mean [{axis_labels.unit}]", "conditions.overshoot.mean", 2, axis_labels.scale),
            (f"95 % [{axis_labels.unit}]", "conditions.overshoot.p95", 2, axis_labels.scale),
            ("travel, mean [deg]", "conditions.travel.mean", 1, DEGREES_PER_RADIAN),
            (
                f"{axis_labels.value} [{axis_labels.unit}]",
                "quiet.heading_swing.max",
                2,
                axis_labels.scale,
            ),
            (f"{axis_labels.rudder} [deg]", "quiet.rudder_swing.max", 2, DEGREES_PER_RADIAN),
            ("diverged", "conditions.diverged", lambda lost: flag_cell(lost, lost)),
        ],
        groups=[("", 1), ("cost", 3), ("", 1), ("overshoot", 2), ("", 1), ("swing, most", 2)],
        is_selected=lambda row: row["conditions"].kind in ("policy", "network"),
    )


def extrapolation_table(rows: Sequence[HeadingRow]) -> Table | None:
    """Return the table of costs outside the conditions of training; None without simulations."""
    tests = list(dict.fromkeys(row.protocol for row in rows if row.protocol.startswith("beyond_")))
    if not tests:
        return None
    columns: list[Column[RowsByProtocol]] = [("controller", f"{tests[0]}.model")]
    for test in tests:
        columns += [
            ("mean [s]", f"{test}.cost.mean", 3),
            ("most [s]", f"{test}.cost.max", 1),
            ("diverged", f"{test}.diverged", lambda lost: flag_cell(lost, lost)),
        ]
    return build_table(
        _rows_by_model(rows, tests[0]).values(),
        columns,
        groups=[(test.removeprefix("beyond_"), 3) for test in tests],
        is_selected=lambda row: row[tests[0]].kind == "policy",
    )


def _conditions_text(evaluation: EvaluationConditions) -> list[str]:
    """Return sentences that describe the operating conditions of the evaluation."""
    conditions = evaluation.stated
    depth = conditions.depth
    axis_labels = axis_words(conditions)
    step_range = depth.change if depth else conditions.heading
    lower, upper, band = (
        axis_labels.scale * value for value in (*step_range, (depth or conditions).band)
    )
    noise = f"{math.degrees(conditions.noise_psi):.3g} deg on the {'pitch' if depth else 'heading'}"
    if depth:
        noise = f"{depth.noise:.3g} m on the depth, {noise}"
    texts = [
        f"{evaluation.flights} changes of {axis_labels.value} of {lower:.3g} to {upper:.3g}"
        f" {axis_labels.unit},"
        " which were not used for tuning or training, the same for all controllers. K is"
        f" {conditions.effect[0]:g} to {conditions.effect[1]:g} times and T"
        f" {conditions.time[0]:g} to {conditions.time[1]:g} times the nominal value; commands have"
        f" a delay of {conditions.delay[0]:g} to {conditions.delay[1]:g} s; the"
        f" {axis_labels.rudder} has a bias of up to {math.degrees(conditions.bias):.3g} deg and a"
        f" slowly varying disturbance of {math.degrees(conditions.push):.3g} deg; the noise is"
        f" {noise} and"
        f" {math.degrees(conditions.noise_r):.3g} deg/s on the {axis_labels.rate}.",
        f"Cost: the integral of |e| / (|e| + {band:.3g} {axis_labels.unit}) over"
        f" {conditions.duration:g} s from the change on, plus"
        f" {conditions.overshoot_weight:g} s per"
        f" {'decimetre' if depth else 'deg'} of overshoot and {conditions.travel_weight:g} s"
        " per deg"
        f" of {axis_labels.rudder} travel. Swing: largest movement, peak to"
        f" peak, from {settled_time(conditions.duration):.3g} s after a change on in"
        " simulations without noise and disturbance. Classical controllers are"
        " tuned by the same cost, by differential evolution.",
    ]
    if conditions.wind or conditions.current:
        wind = (
            f"wind of {conditions.wind[0]:g} to {conditions.wind[1]:g} m/s"
            if conditions.wind
            else ""
        )
        current = f"current of up to {conditions.current:g} m/s" if conditions.current else ""
        weather_text = " and ".join(text for text in (wind, current) if text)
        texts.append(f"There is {weather_text}, from all directions.")
    if conditions.waves:
        texts.append(
            "Heading and yaw rate are measured with the motion in waves, of up to"
            f" {math.degrees(conditions.waves):.3g} deg (standard deviation) and peak periods of"
            f" {conditions.wave_period[0]:g} to {conditions.wave_period[1]:g} s."
        )
    return texts
