"""Figures of free runs: single runs, errors against the horizon and by model, residuals."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import TypeAlias

import numpy as np
import pandas as pd

from residnet.core.format import DEGREES_PER_RADIAN, display_unit, format_count, format_fixed
from residnet.core.layout import DegreesOfFreedom
from residnet.core.model_names import BASELINE, CONSTANT_VELOCITY, PLANT
from residnet.core.names import CHANNEL_UNITS
from residnet.core.stretches import find_runs
from residnet.evaluation.rollout_tables import state_column_names
from residnet.report.figure import (
    COLORS,
    DASHED_STYLE,
    GREEN,
    GREY,
    MASKED_STYLE,
    MAX_PREVIEW_HEIGHT,
    MEASURED_STYLE,
    ORANGE,
    SOLID_STYLE,
    START_STYLE,
    Case,
    Curve,
    Figure,
    GlyphStyle,
    Panel,
    band_outline,
    style_family,
)
from residnet.report.run_reader import RunFiles, StoredWindow

DisplayUnits: TypeAlias = Mapping[str, tuple[str, str, float]]
"""SI unit, display unit and factor from SI to the display unit, by channel."""
_MAX_CASES = 12
"""Largest number of windows in the interactive figure; limits the page to a few megabytes."""
_MAX_STATIC_IMAGES = 6
"""Largest number of windows with an image, for the same reason."""
_MAX_TIME_BINS = 60
"""Largest number of points of an error curve, so that it is smooth."""
_TRACK_PANEL = Panel("north [m]", "east [m]", kind="map", height=380)
_N_OPENING_PANELS = 3
"""Number of motion panels on the first screen: surge, sway and yaw rate of a planar vessel."""
_STEADY_SHARE = 0.3
"""Largest standard deviation of the yaw rate in a steady run, as a share of its mean magnitude."""
_MIN_YAW_RATE = math.radians(0.5)
"""Yaw rate in rad/s below which a run is a straight line."""
_OPENING_PANEL_HEIGHT = 62
"""Height of a motion panel on the first screen, so that the table fits below it on a phone."""
_MOTION_TITLES = {
    "u": "surge velocity\nu",
    "v": "sway velocity\nv",
    "r": "yaw rate\nr",
    "psi": "heading\n",
    "p": "roll rate\np",
    "phi": "roll angle\nphi",
    "w": "heave velocity\nw",
    "q": "pitch rate\nq",
    "z": "depth\nz",
    "theta": "pitch angle\ntheta",
}
_ERROR_NAMES = {
    "u": "u", "v": "v", "r": "r", "x": "position", "psi": "heading", "w": "w", "p": "p", "q": "q",
    "z": "depth", "phi": "phi", "theta": "theta",
}  # fmt: skip
"""Channel whose unit an error has, and the name of the error."""
_SI_UNITS: DisplayUnits = {
    name: (unit, *display_unit(unit)) for name, unit in CHANNEL_UNITS.items()
}
AXES = {
    "u_dot": ("surge", "m/s²", 1.0),
    "v_dot": ("sway", "m/s²", 1.0),
    "r_dot": ("yaw", "deg/s²", DEGREES_PER_RADIAN),
    "p_dot": ("roll", "deg/s²", DEGREES_PER_RADIAN),
    "w_dot": ("heave", "m/s²", 1.0),
    "q_dot": ("pitch", "deg/s²", DEGREES_PER_RADIAN),
}
"""Name of each acceleration's axis, its unit on a page, and the factor to that."""
# colour, line style, drawing order; the plant is drawn above a head that may coincide with it, and
# its gaps show the head
_ROLE_STYLES = {
    CONSTANT_VELOCITY: (GREY, "dotted", 3),
    BASELINE: (ORANGE, "dashed", 3),
    PLANT: (GREEN, "dashdot", 5),
}
_HEAD_COLORS = [color for color in COLORS if color not in (GREY, ORANGE, GREEN)]
_HEAD_DASHES = ("solid", "long", "dense", "short")
_RANK_NAMES = ("median error", "largest error", "least error")


def model_styles(run: RunFiles) -> dict[str, GlyphStyle]:
    """Return the style of each model.

    Constant velocity, baseline and plant have fixed styles; the selected head is always solid blue.
    Initially only the main model, the baseline and the plant are visible.
    """
    visible_models = {run.main_model, run.baseline, run.plant, *run.heads[:1]}
    styles = {}
    for model, kind in run.model_kinds.items():
        if kind in _ROLE_STYLES:
            color, dash, order = _ROLE_STYLES[kind]
        else:
            head_index = run.heads.index(model)
            color = _HEAD_COLORS[head_index % len(_HEAD_COLORS)]
            order = 4
            dash = _HEAD_DASHES[(head_index + head_index // len(_HEAD_COLORS)) % len(_HEAD_DASHES)]
        styles[model] = GlyphStyle(
            short_label(run, model), color, dash, is_visible=model in visible_models, z_order=order
        )
    return styles


def short_label(run: RunFiles, model: str) -> str:
    """Return the name of a model for figures, shortened so that labels do not overlap."""
    label = run.model_label(model)
    return label if len(model) <= 20 else label.replace(model, model[:19] + "…")


def free_run_figure(run: RunFiles, windows: Sequence[StoredWindow]) -> Figure | None:
    """Draw track, motion and inputs of the free runs with median, largest and smallest error.

    Each kind of manoeuvre is included; the runs with median error have a static image.
    """
    ranked_windows = _select_windows(run, windows)
    if not ranked_windows:
        return None
    inputs = list(ranked_windows[0][0].inputs)
    units = display_units(run, inputs)
    panels = [
        *_motion_panels("", units, run.dof),
        *(_build_panel(f"{name}\n", units[name], 125) for name in inputs),
    ]
    panels[-1] = replace(panels[-1], x_label="time since the start of the free run [s]")
    styles = {"measured": MEASURED_STYLE, "masked": MASKED_STYLE} | model_styles(run)
    if any(run.main_model in window.band_lower for window, _ in ranked_windows):
        color = styles[run.main_model].color
        styles["band"] = GlyphStyle(
            f"band of {run.main_model}", color, kind="fill", alpha=0.15, z_order=1
        )
    styles["start"] = START_STYLE
    cases = []
    static_windows = [window for window, rank in ranked_windows if rank == _RANK_NAMES[0]]
    static_windows = [
        window_shown
        for window_shown in static_windows
        if window_shown.protocol == static_windows[0].protocol
    ][:_MAX_STATIC_IMAGES]
    for window, rank in ranked_windows:
        traces = _window_curves(window, run.main_model, units)
        time = window.t - window.t[0]
        for name in inputs:
            traces.append({"measured": (time, units[name][2] * window.inputs[name])})
        manoeuvre_kind = window.manoeuvre.replace("_", " ")
        window_text = f", window {window.number + 1}" if window.number else ""
        note = (
            f"{window.log}: {format_fixed(float(time[-1]), 1)} s under protocol {window.protocol}."
        )
        if diverged := [model for model, state in window.diverged.items() if state]:
            note += (
                f" Diverged: {', '.join(diverged)}; constant-velocity curves are drawn in"
                f" their place."
            )
        kind_prefix = "" if manoeuvre_kind == "unknown" else f"{manoeuvre_kind}, "
        title = f"{kind_prefix}{window.protocol}: {rank} ({window.log}{window_text})"
        cases.append(
            Case(
                title,
                traces,
                note,
                has_static_image=any(window is window_shown for window_shown in static_windows),
            )
        )
    return Figure(
        "free_runs",
        "Free runs",
        "Each free run starts from a measured state and uses only the measured inputs"
        f" ({run.report_data_name})."
        + (
            " North is up, and each track begins at its start. Compare the radius of turns,"
            if run.dof.has_position and run.dof.has_heading
            else " Compare"
        )
        + " the delay at reversals and the steady levels. Grey: masked samples, where u and v are"
        " not evaluated. For every kind of manoeuvre and protocol, the runs with the smallest,"
        f" median and largest error of {run.main_model} can be chosen; print shows the median.",
        styles,
        panels,
        cases,
        "Run",
    )


def track_figure(run: RunFiles, windows: Sequence[StoredWindow]) -> Figure | None:
    """Draw a free run of median error up to the main horizon, for the first screen.

    The panels are the track, if the model has positions, and the first three velocities. A steady
    run (a straight line or a circle) is only drawn if all are steady.
    """
    horizon = math.inf if run.main_horizon is None else run.main_horizon.seconds
    ranked_windows = _rank_by_error(
        run,
        [
            _truncate_window(candidate, horizon)
            for candidate in windows
            if candidate.protocol == run.main_protocol
        ],
    )
    if not ranked_windows:
        return None
    middle = (len(ranked_windows) - 1) // 2
    position = min(
        range(len(ranked_windows)),
        key=lambda index: (_is_steady(ranked_windows[index]), abs(index - middle), index),
    )
    window = ranked_windows[position]
    if position == middle:
        caption = (
            f"Free run with the median error of {len(ranked_windows)} on {run.report_data_name}:"
            f" {window.log}."
        )
    else:
        caption = (
            f"Unsteady free run with the error closest to the median of {len(ranked_windows)} free"
            f" runs on {run.report_data_name}: {window.log} (rank {position + 1})."
        )
    visible_names = {"measured", "start", run.main_model, run.baseline}
    styles = {"measured": MEASURED_STYLE, **model_styles(run), "start": START_STYLE}
    visible_curves = [
        {name: curve for name, curve in window_traces.items() if name in visible_names}
        for window_traces in _window_curves(window, "", display_units(run))
    ]
    has_track = run.dof.has_position and run.dof.has_heading
    panels = _motion_panels("", display_units(run), run.dof)[: _N_OPENING_PANELS + has_track]
    # without a track the velocities take its space
    height = _OPENING_PANEL_HEIGHT if has_track else MAX_PREVIEW_HEIGHT // len(panels)
    panels = [
        replace(panel, height=MAX_PREVIEW_HEIGHT)
        if panel.kind == "map"
        # there is no space for the full name of a velocity, only for its symbol
        else replace(panel, height=height, y_label=panel.y_label.split("\n")[-1])
        for panel in panels
    ]
    panels[-1] = replace(panels[-1], x_label="time since the start of the free run [s]")
    return Figure(
        "track",
        "Track of a typical run" if has_track else "Typical run",
        caption,
        {
            name: replace(style, is_visible=True)
            for name, style in styles.items()
            if name in visible_curves[0]
        },
        panels,
        [Case("", visible_curves[: len(panels)], has_static_image=False)],
        is_drawing=True,
    )


def _truncate_window(window: StoredWindow, horizon: float) -> StoredWindow:
    """Return a free run up to a horizon in s."""
    n_samples = int(np.searchsorted(window.t, window.t[0] + horizon + 1e-6, side="right"))
    if n_samples == window.t.size:
        return window
    return replace(
        window,
        t=window.t[:n_samples],
        usable=window.usable[:n_samples],
        measured=window.measured[:n_samples],
        predicted={name: states[:n_samples] for name, states in window.predicted.items()},
        inputs={name: values[:n_samples] for name, values in window.inputs.items()},
        band_lower={name: limits[:n_samples] for name, limits in window.band_lower.items()},
        band_upper={name: limits[:n_samples] for name, limits in window.band_upper.items()},
    )


def _is_steady(window: StoredWindow) -> bool:
    """Return whether a measured run is a straight line or a circle: its yaw rate hardly varies."""
    yaw_rate = window.measured[:, state_column_names(window.dof).index("r")]
    yaw_rate = yaw_rate[np.isfinite(yaw_rate)]
    if yaw_rate.size < 2 or np.abs(yaw_rate).max() < _MIN_YAW_RATE:
        return True
    return bool(yaw_rate.std() < _STEADY_SHARE * np.abs(yaw_rate).mean())


def plot_window(window: StoredWindow, title: str) -> Figure:
    """Return the figure of a free run that is not stored in a file: track, then velocities.

    A vessel that does not move or turn has no track.
    """
    styles = {"measured": MEASURED_STYLE} | style_family(window.predicted) | {"start": START_STYLE}
    panels = _motion_panels(title, _SI_UNITS, window.dof)
    panels[-1] = replace(panels[-1], x_label="time since the start of the free run [s]")
    visible_curves = [
        {name: curve for name, curve in panel_curves.items() if name in styles}
        for panel_curves in _window_curves(window, "", _SI_UNITS)
    ]
    return Figure("free_run", title, "", styles, panels, [Case(title, visible_curves)])


def display_units(run: RunFiles, names: Iterable[str] = ()) -> DisplayUnits:
    """Return the units of the states, and of further channels of a run."""
    return {
        name: (run.si_unit(name), *run.display_unit(name))
        for name in (*state_column_names(run.dof), *names)
    }


def _build_panel(text: str, unit: tuple[str, str, float], height: int = 165) -> Panel:
    si_unit, display_unit, factor = unit
    label = f"{text} [{display_unit}]".replace("\n ", "\n") if display_unit != "-" else text.strip()
    return Panel(label, height=height, si_unit=() if factor == 1.0 else (si_unit, factor))


def _moving_channels(dof: DegreesOfFreedom) -> set[str]:
    """Return the columns of a free run that the active velocities change; `x` is the position."""
    return {*dof.active_states, *["x"] * dof.has_position, *["psi"] * dof.has_heading}


def _motion_panels(title: str, units: DisplayUnits, dof: DegreesOfFreedom) -> list[Panel]:
    moving_channels = _moving_channels(dof)
    panels = [
        _build_panel(text, units[name])
        for name, text in _MOTION_TITLES.items()
        if name in moving_channels
    ]
    panels[0] = replace(panels[0], title=title)
    return (
        [replace(_TRACK_PANEL, title=title), *panels] if {"x", "psi"} <= moving_channels else panels
    )


def _select_windows(
    run: RunFiles, windows: Sequence[StoredWindow]
) -> list[tuple[StoredWindow, str]]:
    """Return the selectable free runs, each with its rank within its kind of manoeuvre."""
    groups: dict[tuple[int, str], list[StoredWindow]] = {}
    for window in windows:
        if run.main_model in window.predicted:
            group_index = run.protocols.index(window.protocol)
            groups.setdefault((group_index, window.manoeuvre), []).append(window)
    ranked_windows: list[tuple[int, int, StoredWindow]] = []
    # the kind of manoeuvre with the most runs comes first
    ordered_groups = sorted(groups.items(), key=lambda item: (item[0][0], -len(item[1])))
    for group_index, (_, members) in enumerate(ordered_groups):
        members = _rank_by_error(run, members)
        for rank, index in enumerate(((len(members) - 1) // 2, len(members) - 1, 0)):
            if all(members[index] is not entry[2] for entry in ranked_windows):
                ranked_windows.append((rank, group_index, members[index]))
    # if there is no space for all, medians come before the worst and the best runs
    selected = sorted(ranked_windows, key=lambda entry: entry[:2])[:_MAX_CASES]
    selected.sort(key=lambda entry: (entry[1], entry[0]))
    return [(window, _RANK_NAMES[rank]) for rank, _, window in selected]


def _rank_by_error(run: RunFiles, windows: Sequence[StoredWindow]) -> list[StoredWindow]:
    """Return the free runs in ascending order of the error of the main model."""
    scales = {name: run.metrics.scales.get(name, 1.0) for name in run.dof.dynamic_states}
    return sorted(
        (window for window in windows if run.main_model in window.predicted),
        key=lambda one: (one.mean_nrmse(run.main_model, scales), one.log, one.number),
    )


def _window_curves(
    window: StoredWindow, main_model: str, units: DisplayUnits
) -> list[dict[str, Curve]]:
    """Return measured and predicted curves of a run, with the prediction band of one model."""
    time = window.t - window.t[0]
    usable = window.usable
    # headings begin within half a turn of north, tracks at their start
    whole_turns = 2 * math.pi * math.floor((window.measured[0, 3] + math.pi) / (2 * math.pi))
    origin = np.zeros(window.measured.shape[1])
    origin[3:6] = whole_turns, *window.measured[0, 4:6]
    mask_starts, mask_ends = find_runs(~usable)
    masked_intervals = (time[mask_starts], time[np.minimum(mask_ends, time.size - 1)])

    def track_curve(states: np.ndarray, is_shown: np.ndarray) -> Curve:
        north, east = np.where(is_shown[:, None], states - origin, np.nan)[:, 4:6].T
        return east, north

    all_usable = np.ones_like(usable)
    moving_channels = _moving_channels(window.dof)
    panels = [
        {"measured": track_curve(window.measured, usable)}
        | {model: track_curve(states, all_usable) for model, states in window.predicted.items()}
        | {"start": (np.zeros(1), np.zeros(1))}
    ] * ({"x", "psi"} <= moving_channels)
    columns = state_column_names(window.dof)
    for name in _MOTION_TITLES:
        if name not in moving_channels:
            continue
        column = columns.index(name)
        factor = units[name][2]
        is_scored = usable | (column >= 2)
        measured = factor * (window.measured - origin)[:, column]
        panel: dict[str, Curve] = {"measured": (time, np.where(is_scored, measured, np.nan))}
        if len(mask_starts):
            panel["masked"] = masked_intervals
        for model, states in window.predicted.items():
            panel[model] = (time, factor * (states - origin)[:, column])
        if main_model in window.band_lower:
            lower, upper = (
                limit[main_model] - origin for limit in (window.band_lower, window.band_upper)
            )
            panel["band"] = band_outline(time, factor * lower[:, column], factor * upper[:, column])
        panels.append(panel)
    return panels


def error_growth(windows: Sequence[StoredWindow], model: str) -> pd.DataFrame:
    """Return root mean square errors over windows as functions of the time since the start.

    Args:
        windows: free runs of one protocol.

    Returns:
        A row for each time bin that at least half of the windows reach, by its middle in s; columns
        as of `StoredWindow.errors`, in SI.
    """
    model_windows = [window for window in windows if model in window.predicted]
    max_duration = max(float(window.t[-1] - window.t[0]) for window in model_windows)
    n_bins = max(min(_MAX_TIME_BINS, max(window.t.size for window in model_windows) // 2), 1)
    bins = [
        np.minimum((n_bins * (window.t - window.t[0]) / max_duration).astype(int), n_bins - 1)
        for window in model_windows
    ]
    windows_per_bin = np.bincount(np.concatenate([np.unique(window_bins) for window_bins in bins]))
    squares = pd.concat([window.free_run_errors(model).pow(2) for window in model_windows])
    error = squares.groupby(np.concatenate(bins)).mean().pow(0.5)
    error = error[windows_per_bin[error.index] >= 0.5 * len(model_windows)]
    return error.set_index((error.index + 0.5) * max_duration / n_bins)


def horizon_figure(run: RunFiles, windows: Sequence[StoredWindow]) -> Figure | None:
    """Draw the error of every model against the horizon, on a logarithmic scale."""
    cases = []
    (panels, factors) = _build_error_panels(run, "RMS error of\n", 175)
    for protocol in run.protocols:
        protocol_windows = [window for window in windows if window.protocol == protocol]
        panel_curves: list[dict[str, Curve]] = [{} for _ in panels]
        for model in run.model_kinds:
            if any(model in window.predicted for window in protocol_windows):
                error = error_growth(protocol_windows, model)
                error = error[error > 0]
                if len(error) > 1:
                    # errors that start from zero would stretch the scale
                    error.iloc[0] = np.nan
                for panel, (name, factor) in zip(panel_curves, factors.items(), strict=True):
                    panel[model] = (error.index.to_numpy(), factor * error[name].to_numpy())
        if protocol_windows:
            cases.append(
                Case(f"{protocol} ({format_count(len(protocol_windows), 'run')})", panel_curves)
            )
    if not cases:
        return None
    return Figure(
        "horizon",
        "Error against horizon",
        f"Root mean square errors over the free runs of the {run.report_split} data, on a"
        " logarithmic scale. A constant curve means that the error does not grow with time. The"
        " noise of the measurements is a lower limit of all curves.",
        {name: replace(style, is_visible=True) for name, style in model_styles(run).items()},
        [replace(panel, y_log=True) for panel in panels],
        cases,
        "Protocol",
        columns=2,
    )


def _build_error_panels(
    run: RunFiles, prefix: str, height: int
) -> tuple[list[Panel], dict[str, float]]:
    """Return a panel for the errors of each channel, and the factor from SI by channel."""
    units = display_units(run)
    moving_channels = _moving_channels(run.dof)
    error_channels = [name for name in _ERROR_NAMES if name in moving_channels]
    panels = [
        _build_panel(f"{prefix}{_ERROR_NAMES[name]}", units[name], height)
        for name in error_channels
    ]
    panels[-2:] = [replace(panel, x_label="time since the start [s]") for panel in panels[-2:]]
    return panels, {name: units[name][2] for name in error_channels}


def residual_figure(run: RunFiles) -> Figure | None:
    """Draw residual targets against predictions, a case for each head."""
    frame = run.read_parquet("residuals.parquet")
    if frame is None:
        return None
    models = [head for head in run.heads if (frame["model"] == head).any()]
    if not models:
        return None
    axes = [f"{name}_dot" for name in run.dof.velocities]
    curves_by_model: dict[str, dict[str, Curve]] = {model: {} for model in models}
    limits = {}
    for axis in axes:
        limit = 0.0
        for model, rows in frame[frame["axis"] == axis].groupby("model"):
            predicted, target = AXES[axis][2] * rows[["predicted", "target"]].to_numpy(float).T
            # the outermost thousandth would shrink the cloud to a dot
            limit = max(limit, 1.08 * float(np.nanquantile(np.abs((target, predicted)), 0.999)))
            curves_by_model.setdefault(str(model), {})[axis] = (predicted, target)
        limits[axis] = np.array([-1.0, 1.0]) * (limit or 1.0)
    cases = [
        Case(
            run.model_label(model),
            [
                {"equal": (limits[axis],) * 2}
                | ({model: curves_by_axis[axis]} if axis in curves_by_axis else {})
                for axis in axes
            ],
        )
        for model, curves_by_axis in curves_by_model.items()
        if model in models
    ]
    styles = model_styles(run)
    return Figure(
        "residuals",
        "Residual: target against prediction",
        "The acceleration that the baseline leaves (vertical), against what each head predicts"
        " of it (horizontal). The target comes from smoothed derivatives, so it is noisy itself. A"
        " head has learned a cloud along the line; it cannot reach a cloud upright on zero.",
        {
            model: replace(styles[model], kind="points", size=1.6, alpha=0.3, is_visible=True)
            for model in models
        }
        | {"equal": GlyphStyle("target = prediction", width=0.9, z_order=4)},
        [
            Panel(
                f"target [{unit}]",
                f"predicted [{unit}]",
                name,
                height=260,
                group=axis,
                x_limits=limits[axis].tolist(),
                y_limits=limits[axis].tolist(),
            )
            for axis, (name, unit, _) in ((axis, AXES[axis]) for axis in axes)
        ],
        cases,
        "Head",
        columns=3,
    )


def band_figure(run: RunFiles, windows: Sequence[StoredWindow]) -> Figure | None:
    """Draw the half width of the prediction bands of the main model against the errors."""
    model = run.main_model
    bands_by_protocol = run.bands.get(model, {})
    cases = []
    coverage_level = 0.0
    panels, factors = _build_error_panels(run, "", 165)
    for protocol, band in bands_by_protocol.items():
        band_windows = [
            window
            for window in windows
            if window.protocol == protocol and model in window.band_lower
        ]
        if not band_windows:
            continue
        coverage_level = band.level
        # of the position the box about the circle: half its width is the radius
        widths = [
            pd.DataFrame(
                (window.band_upper[model] - window.band_lower[model]) / 2,
                columns=state_column_names(run.dof),
            )
            for window in band_windows
        ]
        errors = [window.free_run_errors(model).abs() for window in band_windows]
        # by the number of the step
        mean_widths = pd.concat(widths).groupby(level=0).mean()
        error_quantiles = pd.concat(errors).groupby(level=0).quantile(coverage_level)
        thinning = slice(1, None, max(len(mean_widths) // 200, 1))
        time = (mean_widths.index.to_numpy() * float(np.median(np.diff(band_windows[0].t))))[
            thinning
        ]
        panel_curves = [
            {
                key: (time, factor * values[name].to_numpy()[thinning])
                for key, values in (("width", mean_widths), ("errors", error_quantiles))
            }
            for name, factor in factors.items()
        ]
        cases.append(Case(protocol, panel_curves))
    if not cases:
        return None
    return Figure(
        "bands",
        "Band against horizon",
        f"Half widths of the bands of {model} in the {run.report_split} data, mean over the runs,"
        f" and the"
        f" errors that {100 * coverage_level:.0f} % of these runs do not exceed. A curve of"
        f" errors well"
        " above the band means that these logs are unlike those that calibrated it; one well"
        " below, that they are easier.",
        {
            "width": replace(SOLID_STYLE, label="half width of the band, mean"),
            "errors": replace(DASHED_STYLE, label=f"{100 * coverage_level:.0f} % of the errors"),
        },
        panels,
        cases,
        "Protocol",
        columns=2,
    )
