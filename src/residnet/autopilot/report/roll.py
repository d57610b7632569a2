"""The report of a roll reduction run: roll and heading error by sea state and direction."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence

import numpy as np

from residnet.autopilot.records import (
    RelativeChange,
    RollController,
    RollMetricsFile,
    RollRow,
    RollTotal,
)
from residnet.autopilot.roll_config import (
    GAIN_NAMES,
    HEADING_ONLY,
    LEARNED,
    TRAINED_LAW,
)
from residnet.core.format import DEGREES_PER_RADIAN, format_fixed, format_signed, join_list
from residnet.report.blocks import Cell, Section, Table, Text, build_table
from residnet.report.figure import (
    BLUE,
    GREEN,
    ORANGE,
    VERMILLION,
    ZERO_LINE_STYLE,
    Case,
    Curve,
    Figure,
    GlyphStyle,
    Panel,
    bar_outlines,
    tick_labels,
)
from residnet.report.figure_files import figures_section, read_figures, write_figures
from residnet.report.run_reader import RunFiles

SIMULATIONS_FILE = "simulations.parquet"
"""File with a row for each simulation of the comparison."""
LABELS = {
    HEADING_ONLY: "heading control alone",
    "rudder": "rudder alone",
    "fins": "fins PD",
    "both": "rudder and fins",
    TRAINED_LAW: "rudder and fins, trained constants",
    LEARNED: "learned policy",
}
"""Description of each controller."""
_BAR_WIDTH = 0.36
"""Width of a bar in units of the spacing of directions: two bars and a gap fit into it."""
_SAME_RMS_CHANGE = 1e-5
"""Relative difference of RMS values by which two controllers are the same but for rounding."""


def verdict_texts(metrics: RollMetricsFile) -> list[str]:
    """Return the verdict: policy against classical law, reductions by sea state, and limits."""
    comparison = metrics.comparison
    totals = {(total.model, total.sea_state): total for total in metrics.totals}
    policy = totals[comparison.policy, None]
    classical = totals[comparison.classical, None]
    negation = "" if comparison.is_as_good else "NOT "
    sentences = [
        f"The learned policy is {negation}at least as good as the best classical combination"
        f" ({LABELS[comparison.classical]}) in roll with the same heading error.",
        f"Over all seas the RMS roll is {_degrees(policy.roll_rms, 2)} against"
        f" {_degrees(classical.roll_rms, 2)} ({_describe_change(comparison.roll)}), the RMS heading"
        f" error {_degrees(policy.heading_rms, 3)} against {_degrees(classical.heading_rms, 3)}"
        f" ({_describe_change(comparison.heading)}); up to +{100 * comparison.tolerance:g} % counts"
        " as the same.",
    ]
    bounds = (*comparison.roll.interval, *comparison.heading.interval)
    if max(map(abs, bounds)) < _SAME_RMS_CHANGE:
        # the best epoch is the start of the training, at which the network adds nothing
        sentences[0] = (
            "The training did not improve on the law it started from"
            f" ({LABELS[comparison.classical]}): the learned policy is this law."
        )
    states = [
        total.sea_state
        for total in metrics.totals
        if total.model == comparison.policy and total.sea_state is not None
    ]
    reductions = [
        f"{100 * totals[comparison.policy, state].roll_reduction:.0f} % in sea state {state}"
        f" (classical {100 * totals[comparison.classical, state].roll_reduction:.0f} %)"
        for state in states
    ]
    sentences.append(f"Against heading control alone it reduces roll by {join_list(reductions)}.")
    sentences.append(
        f"Of {comparison.n_seas} sea states and directions of the waves, it rolls less than the"
        f" classical combination in {comparison.n_less_roll}, and has a larger heading error in"
        f" {comparison.n_larger_heading}."
    )
    return sentences


def _degrees(angle: float, decimals: int) -> str:
    return f"{format_fixed(DEGREES_PER_RADIAN * angle, decimals)} deg"


def _describe_change(change: RelativeChange) -> str:
    lower, upper = (format_signed(100 * bound, 1) for bound in change.interval)
    return (
        f"{format_signed(100 * change.value, 1)} %, 95 % confidence interval {lower} to {upper} %"
    )


def _iterate_roll_figures(metrics: RollMetricsFile) -> Iterator[Figure]:
    """Yield the figures of roll reduction and of heading error by direction of the waves."""
    states = list(dict.fromkeys(row.sea_state for row in metrics.rows))
    yield _sea_figure(
        metrics,
        states,
        "reduction",
        "Roll reduction by direction of the waves",
        "Reduction of the RMS roll angle relative to heading control alone. Seas in which the"
        " vessel rolls less than the noise of the sensors are omitted.",
        "roll reduction\n[%]",
    )
    yield _sea_figure(
        metrics,
        states,
        "heading",
        "Heading error by direction of the waves",
        "RMS heading error.",
        "heading error\n[deg]",
    )


def _sea_figure(
    metrics: RollMetricsFile,
    states: Sequence[int],
    name: str,
    title: str,
    caption: str,
    y_label: str,
) -> Figure:
    """Return a figure with a panel per sea state: bars of classical law and policy, points of both
    actuators alone.
    """
    comparison = metrics.comparison
    is_reduction = name == "reduction"
    bars = {comparison.classical: -0.5, comparison.policy: 0.5}
    points = [model for model in ("rudder", "fins") if model != comparison.classical]
    if not is_reduction:
        points = [HEADING_ONLY, *points]
    panels = []
    curves_by_panel: list[dict[str, Curve]] = []
    for state in states:
        rows = [row for row in metrics.rows if row.sea_state == state]
        directions = [row.direction for row in rows if row.model == comparison.policy]
        panel_curves: dict[str, Curve] = {"zero": (np.array([0.0]), np.array([0.0]))}
        for model in (*bars, *points):
            values = np.array(
                [
                    100.0 * row.roll_reduction
                    if is_reduction
                    else DEGREES_PER_RADIAN * row.heading_rms
                    for row in rows
                    if row.model == model
                ]
            )
            positions = np.arange(len(values), dtype=float)
            if is_reduction:
                is_judged = np.array([row.is_judged for row in rows if row.model == model])
                values = np.where(is_judged, values, np.nan)
            if model in bars:
                has_value = np.isfinite(values)
                panel_curves[model] = bar_outlines(
                    positions[has_value] + bars[model] * _BAR_WIDTH, values[has_value], _BAR_WIDTH
                )
            else:
                panel_curves[model] = (positions, values)
        panels.append(
            Panel(
                y_label,
                title=f"sea state {state}: {rows[0].height:g} m, {rows[0].period:g} s",
                height=150,
                x_names=tick_labels(f"{math.degrees(angle):.0f}" for angle in directions),
                x_limits=(-0.6, len(directions) - 0.4),
                y_limits=_reduction_limits(metrics) if is_reduction else (),
            )
        )
        curves_by_panel.append(panel_curves)
    panels[-1] = Panel(
        **(vars(panels[-1]) | {"x_label": "waves travel to [deg]: 0 following, 180 head"})
    )
    markers = {HEADING_ONLY: ("x", "#666666"), "rudder": ("^", GREEN), "fins": ("s", ORANGE)}
    styles = {
        comparison.classical: GlyphStyle(LABELS[comparison.classical], BLUE, kind="fill"),
        comparison.policy: GlyphStyle(LABELS[comparison.policy], VERMILLION, kind="fill"),
        **{
            model: GlyphStyle(
                LABELS[model], markers[model][1], kind="points", marker=markers[model][0], size=5
            )
            for model in points
        },
        "zero": ZERO_LINE_STYLE,
    }
    return Figure(name, title, caption, styles, panels, [Case("all", curves_by_panel)])


def _reduction_limits(metrics: RollMetricsFile) -> tuple[float, float]:
    """Return limits in % of the axis of roll reduction, the same for all sea states."""
    lowest = min(row.roll_reduction for row in metrics.rows if row.is_judged)
    return 10.0 * math.floor(min(10.0 * lowest - 0.3, 0.0)), 100.0


def sections(run: RunFiles) -> list[Section]:
    """Return the sections: reductions by sea state, by direction, controllers, and explanations.

    Raises:
        UsageError: if the folder has no metrics.json.
    """
    metrics = run.read_task_metrics(RollMetricsFile)
    write_figures(run.path / "figures", _iterate_roll_figures(metrics))
    previews = [
        figure.preview(len(figure.panels))
        for figure in read_figures(run.path / "figures", "reduction")
    ]
    return [
        Section("", [*previews, total_table(metrics)]),
        Section("By sea state and direction of the waves", [sea_table(metrics)]),
        Section("All controllers", [*controller_tables(metrics)], is_folded=True),
        Section("Definitions", [Text(_definitions(metrics))]),
        *figures_section(run.path / "figures"),
    ]


def total_table(metrics: RollMetricsFile) -> Table:
    """Return the table of roll reductions by sea state, and of the heading error in all seas."""
    states = list(dict.fromkeys(row.sea_state for row in metrics.rows))
    totals = {(total.model, total.sea_state): total for total in metrics.totals}
    comparison = metrics.comparison
    table = Table(
        ["controller", *(f"sea state {state}" for state in states), "heading error [deg]"],
        groups=[("roll reduction [%]", len(states)), ("RMS", 1)],
    )
    for controller in metrics.controllers:
        model = controller.model
        table.add_row(
            LABELS[model],
            [
                *(
                    "0" if model == HEADING_ONLY else _percent(totals[model, state])
                    for state in states
                ),
                format_fixed(DEGREES_PER_RADIAN * totals[model, None].heading_rms, 3),
            ],
            is_selected=model in (comparison.policy, comparison.classical),
        )
    return table


def _percent(row: RollTotal | RollRow) -> str:
    return format_fixed(100.0 * row.roll_reduction, 1)


def sea_table(metrics: RollMetricsFile) -> Table:
    """Return the table of roll reduction and heading error of the best law and the policy."""
    comparison = metrics.comparison
    return _rows_table(metrics, [comparison.classical, comparison.policy])


def _rows_table(metrics: RollMetricsFile, models: Sequence[str]) -> Table:
    """Return a table of the seas with roll reduction and heading error of controllers."""
    rows = {(row.model, row.sea_state, row.direction): row for row in metrics.rows}
    table = Table(
        [
            "sea state, direction",
            "RMS roll [deg]",
            *(LABELS[model] for model in (*models, HEADING_ONLY, *models)),
        ],
        "RMS roll of heading control alone, its reduction, and the RMS heading error. Grey: the"
        " vessel rolls less than the noise of the sensors, so that there is no roll to reduce.",
        [
            (LABELS[HEADING_ONLY], 1),
            ("roll reduction [%]", len(models)),
            ("heading error [deg]", len(models) + 1),
        ],
    )
    previous_state = None
    for row in (row for row in metrics.rows if row.model == HEADING_ONLY):
        sea_rows = {model: rows[model, row.sea_state, row.direction] for model in models}
        highest = max(sea_row.roll_reduction for sea_row in sea_rows.values())
        table.add_row(
            f"{row.sea_state}, {math.degrees(row.direction):.0f} deg",
            [
                format_fixed(DEGREES_PER_RADIAN * row.roll_rms, 2),
                *(_reduction_cell(sea_row, highest) for sea_row in sea_rows.values()),
                *(
                    format_fixed(DEGREES_PER_RADIAN * sea_row.heading_rms, 3)
                    for sea_row in (row, *sea_rows.values())
                ),
            ],
            has_rule=row.sea_state != previous_state,
        )
        previous_state = row.sea_state
    return table


def _reduction_cell(row: RollRow, highest: float) -> Cell:
    """Return a cell with a roll reduction: the highest of its sea marked, grey if not judged."""
    if not row.is_judged:
        return Cell(_percent(row), mark="weak")
    if row.roll_reduction < 0:
        return Cell(_percent(row), mark="bad")
    return Cell(_percent(row), mark="best" if row.roll_reduction >= highest else "")


def controller_tables(metrics: RollMetricsFile) -> list[Table]:
    """Return the tables of all controllers: by sea, and with their constants and costs."""
    models = [row.model for row in metrics.controllers if row.model != HEADING_ONLY]
    costs: Table = build_table(
        metrics.controllers,
        [
            ("controller", lambda controller: LABELS[controller.model]),
            ("name", "model"),
            ("cost, tuning or validation [deg²/m²]", "tuning_cost", 3),
            ("cost at the start [deg²/m²]", "start_cost", 3),
            ("cost, judging [deg²/m²]", "judged_cost", 3),
            ("time [s]", "seconds", 0),
        ],
    )
    gains: Table = build_table(
        metrics.controllers,
        [
            ("controller", lambda controller: LABELS[controller.model]),
            *((name.replace("_", " "), _gain_column(name), 3) for name in GAIN_NAMES),
        ],
    )
    return [_rows_table(metrics, models), costs, gains]


def _gain_column(name: str) -> Callable[[RollController], float]:
    return lambda controller: controller.gains[name]


def _definitions(metrics: RollMetricsFile) -> list[str]:
    row = metrics.rows[0]
    return [
        f"The vessel holds a straight course at {metrics.speed:.3g} m/s in long-crested JONSWAP"
        f" waves. Each value is over {row.n} realisations of the waves, the same for all"
        " controllers and not used in tuning and training. Directions are those to which the waves"
        " travel, relative to the course: 0 deg following seas, 180 deg head seas.",
        "Wave loads are first-order Froude-Krylov loads of a box with the volume and the"
        " metacentric radius of the hull; diffraction is neglected. Reductions hold for these loads"
        " and for the fins of the vessel file.",
        "The network starts from the law with trained constants; its training has a penalty for a"
        " heading error above that of this law (`training.heading_excess`).",
        "Cost: mean square roll, heading error and angles of rudder and fins with the weights of"
        " the config, divided by the squared significant wave height. Tuning and training minimise"
        " it. The best classical combination is that with the lowest cost in the judging seas.",
        "Law: rudder = -(heading gain) psi_f - (yaw rate gain) r_f - (rudder roll rate gain) p -"
        " (rudder roll gain) phi, fins = -(fin roll rate gain) p - (fin roll gain) phi; psi_f and"
        " r_f are low-pass filtered with the filter share per step.",
    ]
