"""Woo et al. 2018: section in the report of configs/studies/woo2018/woo2018.yaml.

The document shows the steady states of constant manoeuvres (Figure 9) and single runs: simplified
steering models in a zigzag (13), surge in an acceleration-deceleration test (14), sway and yaw rate
in a zigzag and a 3-2-1-1 test (15), errors of the speed models (16) and of the steering models (17)
on training and unseen data, and a zigzag with its track (18).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np

from residnet.core.errors import UsageError
from residnet.core.format import DEGREES_PER_RADIAN, format_interval
from residnet.report.blocks import Block, Section, Table, Text, build_table
from residnet.report.figure import (
    BLUE,
    GREY,
    MEASURED_STYLE,
    ORANGE,
    PURPLE,
    SKY_BLUE,
    VERMILLION,
    ZERO_LINE_STYLE,
    Case,
    Curve,
    Figure,
    GlyphStyle,
    Panel,
    bar_outlines,
    error_bars,
    tick_labels,
)
from residnet.report.figure_files import write_figure
from residnet.report.fit_studies import FitStudy
from residnet.report.run_reader import RunFiles, StoredWindow
from residnet.runs.folder import RunFolder
from residnet.studies import load_published
from residnet.studies.study import comparison_columns, published_cell

PROTOCOL = "manoeuvre"
MODEL_STYLES = {
    "nomoto": GlyphStyle("Nomoto", PURPLE, "dotted", 1.3),
    "nomoto_side_slip": GlyphStyle("Nomoto with side slip", SKY_BLUE, "short", 1.3),
    "baseline": GlyphStyle("linear", ORANGE, "dashed", 1.3),
    "lstm_printed": GlyphStyle("LSTM as printed, rate 1e-5", GREY, "dense", 1.3),
    "lstm_rate": GlyphStyle("LSTM as printed, rate 1e-3", VERMILLION, "long", 1.3),
    "lstm": GlyphStyle("LSTM, free-run training", BLUE, width=1.3),
}
"""Style of each model of the config in the figures."""
MANOEUVRE_KINDS = ("zigzag", "acceleration_deceleration", "three_two_one_one")
"""Kinds of manoeuvre that the figures show."""
_SIMPLE_MODELS = ("nomoto", "nomoto_side_slip", "baseline")
_LEARNED_MODELS = ("lstm_printed", "lstm_rate", "lstm")
_COMPARED_MODELS = ("baseline", *_LEARNED_MODELS)
_CHANNELS = {
    "u": (0, "surge velocity u", "m/s", 1.0),
    "v": (1, "sway velocity v", "m/s", 1.0),
    "r": (2, "yaw rate r", "deg/s", DEGREES_PER_RADIAN),
}
"""Column, name, displayed unit and factor from SI of each velocity."""
_MANOEUVRE_GROUPS = {"u": "speed", "v": "steering", "r": "steering"}
"""Group of manoeuvres for the errors of each velocity, as in Figures 16 and 17."""
_DRIVING_FORCES = {"u": ("tau_x", "N"), "v": ("tau_n", "N m"), "r": ("tau_n", "N m")}
"""Force of each steady state (32), with its unit."""
_CAPTION = "Unseen manoeuvres unless it says otherwise; simulated WAM-V with sensor noise."
_RATIO_CAPTION = (
    "Left: root mean square errors with 95 % intervals over manoeuvres. Right: each unseen run's"
    " error over that of the linear model, with the median; simulated WAM-V with sensor noise."
)


def sections(files: RunFiles) -> list[Section]:
    """Write study.json, draw the figures of Woo et al. 2018 and return the section of the report.

    Raises:
        UsageError: if the run lacks a kind of manoeuvre.
    """
    figures = [
        write_figure(files.path / "figures" / "woo2018", figure) for figure in build_figures(files)
    ]
    explanation = Text(
        "The runs are simulated, with 126 manoeuvres as in the document. Its vessel and its logs"
        " are not public, so that its figures can be compared qualitatively only. Further"
        " acceleration tests, which no fit uses, are added to the test data, since the document has"
        " only two. The terms of the plant are among the candidates of closed-form heads;"
        " configs/studies/woo2018/outside_terms.yaml compares networks and closed forms on a plant"
        " with other terms."
    )
    changes = {model: error_changes(files, model) for model in _LEARNED_MODELS}
    content = {"schema": "residnet.woo2018/1", "changes": changes}
    RunFolder(files.path).write_json(files.path / "study.json", content)
    shares = load_published("woo2018")["change_of_error"]
    published_changes = {channel: 100 * share for channel, share in shares.items()}
    table = build_table(
        [
            {"model": MODEL_STYLES[model].label, **model_changes, "published": published_changes}
            for model, model_changes in changes.items()
        ],
        [
            ("model", "model"),
            *(
                column
                for c in _MANOEUVRE_GROUPS
                for column in comparison_columns(c, f"{c} %", 3, 100)
            ),
        ],
        caption="Change of the root mean square error on unseen manoeuvres from the linear model to"
        " the LSTM. The document prints one figure for each velocity.",
    )
    blocks: list[Block] = [explanation, steady_state_table(files), figures[0], table]
    return [Section("Woo et al. 2018", [*blocks, *figures[1:]])]


def error_changes(files: RunFiles, model: str) -> dict[str, float | None]:
    """Return the change of the error to the linear model on unseen manoeuvres, by velocity.

    A change is the ratio of root mean square errors minus one; None if a row is missing.
    """
    changes: dict[str, float | None] = {}
    for channel, group in _MANOEUVRE_GROUPS.items():
        rows = [files.find_row(name, "test", PROTOCOL, group) for name in ("baseline", model)]
        baseline_error, model_error = (None if row is None else row.rmse[channel] for row in rows)
        changes[channel] = (
            None
            if baseline_error is None or model_error is None
            else model_error / baseline_error - 1
        )
    return changes


def steady_state_table(files: RunFiles) -> Table:
    """Return the constraints (32) of the linear model with intervals, next to Table 1."""
    notes = files.fit_notes("baseline")
    assert notes is not None, "a finished fit has notes on its baseline"
    published_constraints = load_published("woo2018")["steady"]
    table = Table(
        ["steady state", "Phi", "95 % interval", "bias", "95 % interval", "unit"],
        caption="Steady states of the constant manoeuvres as x = Phi tau + bias (32), next to those"
        " of Table 1 with corrections W12 and W13. The vessels differ, so that only orders of"
        " magnitude can be compared.",
    )
    for state, (_, _, unit, factor) in _CHANNELS.items():
        cells: list[Any] = []
        constraint = notes.steady_constraints[state]
        estimates = (
            (constraint.gain, constraint.gain_error),
            (constraint.bias, constraint.bias_error),
        )
        for (value, standard_error), number in zip(
            estimates, published_constraints[state], strict=True
        ):
            error = 1.96 * standard_error
            cells.append(published_cell(factor * value, number, 3))
            cells.append(format_interval((value - error, value + error), factor, 3))
        force, measure = _DRIVING_FORCES[state]
        table.add_row(f"{state} over {force}", [*cells, f"{unit} per {measure}; {unit}"])
    return table


def build_figures(files: RunFiles) -> list[Figure]:
    """Return Figures 9 and 13 to 18, named by their numbers.

    Raises:
        UsageError: if the run lacks a kind of manoeuvre.
    """
    test_windows = [
        window for window in files.read_split_windows("test") if window.protocol == PROTOCOL
    ]
    zigzag, speed_test, step_test = (
        find_median_run(files, test_windows, kind) for kind in MANOEUVRE_KINDS
    )
    speed_windows = [window for window in test_windows if window.manoeuvre == MANOEUVRE_KINDS[1]]
    steering_windows = [
        window
        for window in test_windows
        if window.manoeuvre in (MANOEUVRE_KINDS[0], MANOEUVRE_KINDS[2])
    ]
    steering_curves = [(zigzag, "v"), (zigzag, "r"), (step_test, "v"), (step_test, "r")]
    notes = files.fit_notes("baseline")
    assert notes is not None, "a finished fit has notes on its baseline"
    states = notes.steady_states
    panels_and_traces = []
    for state, (_, _, unit, factor) in _CHANNELS.items():
        (force, measure) = _DRIVING_FORCES[state]
        constraint = notes.steady_constraints[state]
        tau = np.array(states[force])
        force_limits = np.array([tau.min(), tau.max()])
        fitted_line = factor * (constraint.gain * force_limits + constraint.bias)
        traces = {
            "points": (tau, factor * np.array(states[state])),
            "line": (force_limits, fitted_line),
        }
        panel = Panel(f"steady {state} [{unit}]", f"{force} [{measure}]", height=285)
        panels_and_traces.append((panel, traces))
    styles = {
        "points": GlyphStyle("", BLUE, kind="points", size=2.5),
        "line": GlyphStyle("", ORANGE),
    }
    caption = "Points: means of the settled part of each manoeuvre. Lines: Phi tau + bias (32)."
    models = (*_SIMPLE_MODELS, "lstm")
    start = zigzag.measured[0, 4:6]
    paths = {"measured": zigzag.measured} | {model: zigzag.predicted[model] for model in models}
    track = {name: (path[:, 5] - start[1], path[:, 4] - start[0]) for name, path in paths.items()}
    panel = Panel("north [m]", "east [m]", zigzag.log, kind="map", height=400)
    title = "A zigzag: track, yaw rate and sway velocity"
    return [
        _numbered_figure(
            9, "steady states of the constant manoeuvres", caption, styles, panels_and_traces, 3
        ),
        _time_series_figure(
            13, "Simplified steering models in a zigzag", steering_curves[:2], _SIMPLE_MODELS
        ),
        _time_series_figure(
            14, "Surge in an acceleration-deceleration test", [(speed_test, "u")], _COMPARED_MODELS
        ),
        _time_series_figure(
            15,
            "Sway and yaw rate in a zigzag and a 3-2-1-1 test",
            steering_curves,
            _COMPARED_MODELS,
        ),
        _error_figure(files, 16, "speed", speed_windows, ("u",), _COMPARED_MODELS),
        _error_figure(
            files, 17, "steering", steering_windows, ("v", "r"), (*_SIMPLE_MODELS, *_LEARNED_MODELS)
        ),
        _time_series_figure(18, title, [(zigzag, "r"), (zigzag, "v")], models, [(panel, track)]),
    ]


def find_median_run(
    files: RunFiles, test_windows: Sequence[StoredWindow], manoeuvre_kind: str
) -> StoredWindow:
    """Return the test run of a kind with the median error of the LSTM trained in free run.

    Raises:
        UsageError: if there is no run of this kind.
    """
    runs = [window for window in test_windows if window.manoeuvre == manoeuvre_kind]
    if not runs:
        raise UsageError(
            f"{files.path}: study woo2018 needs a test manoeuvre of kind {manoeuvre_kind}"
        )
    ranked = sorted(
        runs, key=lambda window: (float(window.rmse_by_channel("lstm").sum()), window.log)
    )
    return ranked[(len(ranked) - 1) // 2]


def _numbered_figure(
    number: int,
    title_text: str,
    caption: str,
    styles: Mapping[str, GlyphStyle],
    panels_and_traces: Sequence[tuple[Panel, Mapping[str, Curve]]],
    columns: int = 1,
) -> Figure:
    """Return a figure with the document's figure number, from panels and curves."""
    panels, traces = zip(*panels_and_traces, strict=True)
    title = f"Figure {number} of Woo et al. 2018: {title_text}"
    return Figure(str(number), title, caption, styles, panels, [Case("", traces)], columns=columns)


def _time_series_figure(
    number: int,
    title_text: str,
    windows_and_channels: Sequence[tuple[StoredWindow, str]],
    models: Sequence[str],
    leading_panels: Sequence[tuple[Panel, Mapping[str, Curve]]] = (),
) -> Figure:
    """Return measured and predicted velocities of some runs, each with its errors below."""
    panels_and_traces = list(leading_panels)
    for window, channel in windows_and_channels:
        column, name, unit, factor = _CHANNELS[channel]
        time = window.t - window.t[0]
        measured = factor * window.measured[:, column]
        paths = {model: factor * window.predicted[model][:, column] for model in models}
        group = f"{window.log} {channel}"
        motion_panel = Panel(f"{name} [{unit}]", title=window.log, height=210, group=group)
        label = "time since the start of the free run [s]"
        error_panel = Panel(f"error of {channel}\n[{unit}]", label, height=110, group=group)
        traces = {"measured": (time, measured)}
        errors = {"zero": (np.zeros(1), np.zeros(1))}
        for model, path in paths.items():
            traces[model], errors[model] = (time, path), (time, path - measured)
        panels_and_traces += [(motion_panel, traces), (error_panel, errors)]
    styles = {"measured": MEASURED_STYLE, "zero": ZERO_LINE_STYLE} | {
        model: MODEL_STYLES[model] for model in models
    }
    return _numbered_figure(number, title_text, _CAPTION, styles, panels_and_traces)


def _error_figure(
    files: RunFiles,
    number: int,
    group: str,
    windows: Sequence[StoredWindow],
    channels: Sequence[str],
    models: Sequence[str],
) -> Figure:
    """Return a figure of RMSE by model, and of the errors of test runs relative to the linear
    model.

    A line shows the error of the plant, which is due to sensor noise.
    """
    styles = {
        "train": GlyphStyle("training data", "#BFBFBF", kind="fill"),
        "test": GlyphStyle("unseen manoeuvres", BLUE, kind="fill"),
        "ci95": GlyphStyle("", width=0.8, z_order=4),
        "noise": GlyphStyle("simulator itself (sensor noise)", dash="dotted", kind="hline"),
        **{
            model: GlyphStyle("", MODEL_STYLES[model].color, kind="points", size=2.5)
            for model in models
        },
        "median": GlyphStyle("", width=1.2, z_order=5),
        "one": ZERO_LINE_STYLE,
    }
    names = tick_labels(MODEL_STYLES[model].label for model in models)
    panels_and_traces: list[tuple[Panel, Mapping[str, Curve]]] = []
    for channel in channels:
        column, name, unit, factor = _CHANNELS[channel]
        bar_traces: dict[str, Curve] = {}
        interval_limits: list[tuple[float, Any, Any]] = []
        for offset, split in ((-0.2, "train"), (0.2, "test")):
            rows = [files.find_row(model, split, PROTOCOL, group) for model in models]
            positions = np.arange(len(models)) + offset
            values = [factor * row.rmse[channel] if row else np.nan for row in rows]
            bar_traces[split] = bar_outlines(positions, values, 0.38)
            # there is no interval for too few manoeuvres
            for position, row in zip(positions, rows, strict=True):
                interval = None if row is None else row.rmse_ci95[channel]
                if interval is not None:
                    lower, upper = interval
                    interval_limits.append((position, factor * lower, factor * upper))
        bar_traces["ci95"] = (
            error_bars(*zip(*interval_limits, strict=True))
            if interval_limits
            else (np.empty(0), np.empty(0))
        )
        noise = files.find_row("plant", "test", PROTOCOL, group)
        if noise:
            bar_traces["noise"] = (np.zeros(1), np.array([factor * noise.rmse[channel]]))
        reference = np.array([window.rmse_by_channel("baseline")[column] for window in windows])
        point_traces: dict[str, Curve] = {"one": (np.zeros(1), np.ones(1))}
        medians: list[tuple[float, float]] = []
        for position, model in enumerate(models):
            ratio = (
                np.array([window.rmse_by_channel(model)[column] for window in windows]) / reference
            )
            point_traces[model] = (position + 0.25 * np.linspace(-1, 1, len(ratio)), ratio)
            median_ratio = float(np.median(ratio))
            medians += [
                (position - 0.35, median_ratio),
                (position + 0.35, median_ratio),
                (np.nan, np.nan),
            ]
        x, y = np.array(medians).T
        point_traces["median"] = (x, y)
        label = f"error of {channel} over the linear model's"
        panels_and_traces += [
            (Panel(f"RMSE, {name} [{unit}]", height=320, x_names=names), bar_traces),
            (Panel(label, height=320, x_names=names, y_log=True), point_traces),
        ]
    return _numbered_figure(
        number, f"Errors of the {group} models", _RATIO_CAPTION, styles, panels_and_traces, 2
    )


class Woo2018Study(FitStudy):
    """The figures of Woo et al. 2018 for a fit of its models."""

    name: ClassVar[str] = "woo2018"
    models: ClassVar[tuple[str, ...]] = (
        *("baseline", "nomoto", "nomoto_side_slip"),
        *("lstm_printed", "lstm_rate", "lstm"),
    )

    def sections(self, run: RunFiles) -> list[Section]:
        return sections(run)
