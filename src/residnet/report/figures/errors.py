"""Figures of errors: against the horizon, by model and split, of residuals."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from residnet.report.figures.style import (
    collect,
    legend_above,
    new_figure,
    short_label,
    styled,
    styles,
)
from residnet.report.run_reader import RunFiles, StoredWindow

_DEG = 180.0 / math.pi
_BINS = 60
_AXES = (
    ("u_dot", "surge", "m/s²", 1.0),
    ("v_dot", "sway", "m/s²", 1.0),
    ("r_dot", "yaw", "deg/s²", _DEG),
)
_VELOCITIES = (
    ("u", "surge velocity u [m/s]", 1.0),
    ("v", "sway velocity v [m/s]", 1.0),
    ("r", "yaw rate r [deg/s]", _DEG),
)
_HORIZON = ("u [m/s]", "v [m/s]", "r [deg/s]", "position [m]", "heading [deg]")


def growth(windows: Sequence[StoredWindow], model: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the root mean square errors over windows against the time since the start.

    Args:
        windows: free runs of one protocol.
        model: whose errors are taken.

    Returns:
        Middles of time bins [K] in s, and errors [K, 5] of u, v (m/s), r (deg/s), position (m),
        heading (deg). Bins that fewer than half of the windows reach are left out. u, v and
        position count where usable.
    """
    of_model = [window for window in windows if model in window.predicted]
    longest = max(float(window.t[-1] - window.t[0]) for window in of_model)
    count = max(min(_BINS, max(window.t.size for window in of_model) // 2), 1)
    squares, samples, reached = np.zeros((count, 5)), np.zeros((count, 5)), np.zeros(count)
    for window in of_model:
        error = window.predicted[model] - window.measured
        columns = (
            error[:, 0],
            error[:, 1],
            _DEG * error[:, 2],
            np.hypot(error[:, 4], error[:, 5]),
            _DEG * error[:, 3],
        )
        index = np.minimum((count * (window.t - window.t[0]) / longest).astype(int), count - 1)
        reached[np.unique(index)] += 1
        for k, column in enumerate(columns):
            weight = window.usable if k in (0, 1, 3) else np.ones_like(window.usable)
            squares[:, k] += np.bincount(index, np.where(weight, column, 0.0) ** 2, count)
            samples[:, k] += np.bincount(index, weight, count)
    keep = reached >= 0.5 * len(of_model)
    with np.errstate(invalid="ignore", divide="ignore"):
        error = np.sqrt(squares / samples)
    return ((np.arange(count) + 0.5) * longest / count)[keep], error[keep]


@styled
def horizon(run: RunFiles, windows: Sequence[StoredWindow]) -> Any:
    """Draw the error of every model against the horizon, on a logarithmic scale.

    Args:
        run: folder of the fit.
        windows: free runs of one protocol.
    """
    figure = new_figure(5.4)
    grid = figure.subplots(3, 2, sharex=True)
    panels = [grid[0, 0], grid[1, 0], grid[2, 0], grid[1, 1], grid[2, 1]]
    handles: dict[str, Any] = {}
    curves = {
        model: growth(windows, model)
        for model in run.kinds
        if any(model in window.predicted for window in windows)
    }
    look = styles(run)
    for k, (axes, text) in enumerate(zip(panels, _HORIZON, strict=True)):
        for model, (time, error) in curves.items():
            axes.plot(time, error[:, k], **look[model])
        # the first bin, where every position and heading error starts from zero, would stretch the
        # scale
        later = np.concatenate(
            [error[1:, k] if len(error) > 1 else error[:, k] for _, error in curves.values()]
        )
        later = later[np.isfinite(later) & (later > 0)]
        if later.size:
            axes.set_yscale("log")
            axes.set_ylim(later.min() / 1.25, later.max() * 1.25)
            _plain_log(axes)
        axes.set_ylabel(f"RMS error of\n{text}")
        collect(handles, axes)
    grid[0, 1].set_axis_off()
    grid[0, 1].legend(handles.values(), handles.keys(), loc="center", ncols=1 + len(handles) // 8)
    for axes in grid[2]:
        axes.set_xlabel("time since the start [s]")
    figure.align_ylabels()
    return figure


def _plain_log(axes: Any) -> None:
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    low, high = axes.get_ylim()
    decades = math.log10(high / low)
    axes.yaxis.set_major_locator(
        LogLocator(
            subs=(1.0,) if decades > 2.5 else (1.0, 3.0) if decades > 1.5 else (1.0, 2.0, 5.0)
        )
    )
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())


@styled
def bars(run: RunFiles, protocol: str) -> Any:
    """Draw the error of every model, train beside test, with 95 % intervals.

    Figures 16 and 17 of document 003 look like this. `zero` is left out: it would flatten the rest.
    """
    from matplotlib.patches import Patch

    models = [model for model, kind in run.kinds.items() if kind != "zero"]
    figure = new_figure(1.2 + 0.42 * len(models))
    panels = figure.subplots(1, 3, sharey=True)
    thick = 0.8 / len(run.sides)
    look = styles(run)
    for axes, (channel, text, factor) in zip(panels, _VELOCITIES, strict=True):
        group = bar_group(run, protocol, channel)
        for place, split in enumerate(run.sides):
            for number, model in enumerate(models):
                row = run.row(model, split, protocol, group)
                if row is None or channel not in row["rmse"]:
                    continue
                value = factor * row["rmse"][channel]
                interval = (row.get("rmse_ci95") or {}).get(channel) or [row["rmse"][channel]] * 2
                low, high = (factor * edge for edge in interval)
                y = number + (place - 0.5 * (len(run.sides) - 1)) * thick
                axes.barh(
                    y,
                    value,
                    thick,
                    color=look[model]["color"],
                    alpha=_alpha(run, split),
                    edgecolor="black",
                    linewidth=0.5,
                )
                spread = [[max(value - low, 0.0)], [max(high - value, 0.0)]]
                axes.errorbar(value, y, xerr=spread, color="black", linewidth=0.9, capsize=2)
        axes.set_xlabel(f"RMSE of {text.split()[-2]} {text.split()[-1]}")
        axes.set_title(
            text.rsplit(" ", 2)[0]
            + (f"\n({group.replace('_', ' ')} runs)" if group != "all" else "")
        )
        axes.grid(False, axis="y")
        axes.set_xlim(left=0)
    panels[0].set_yticks(range(len(models)), [short_label(run, model) for model in models])
    panels[0].invert_yaxis()
    handles = {
        split: Patch(facecolor="0.4", alpha=_alpha(run, split), edgecolor="black", linewidth=0.5)
        for split in run.sides
    }
    legend_above(figure, handles)
    return figure


def bar_group(run: RunFiles, protocol: str, channel: str) -> str:
    """Return the group of manoeuvres that a channel is judged on.

    Surge is judged on `speed` and the others on `steering`, where a run has both groups.
    """
    groups = set(run.manoeuvres(run.focus, protocol))
    return ("speed" if channel == "u" else "steering") if {"speed", "steering"} <= groups else "all"


def _alpha(run: RunFiles, split: str) -> float:
    return 0.85 if split == run.focus else 0.3


@styled
def residuals(run: RunFiles, table: Mapping[str, np.ndarray], models: Sequence[str]) -> Any:
    """Draw residual targets against predictions, a row of panels for each head.

    Args:
        run: folder of the fit.
        table: columns model, axis, target and predicted, each [N], in SI.
        models: whose rows are drawn.
    """
    from matplotlib.ticker import MaxNLocator

    figure = new_figure(0.2 + 2.5 * len(models))
    panels = figure.subplots(len(models), 3, squeeze=False)
    for line, model in zip(panels, models, strict=True):
        for axes, (axis, name, unit, factor) in zip(line, _AXES, strict=True):
            chosen = (table["model"] == model) & (table["axis"] == axis)
            target, predicted = (
                factor * table["target"][chosen].astype(float),
                factor * table["predicted"][chosen].astype(float),
            )
            if not target.size:
                axes.set_axis_off()
                continue
            # the outermost thousandth would shrink the cloud to a dot
            reach = (
                1.08 * float(np.quantile(np.abs(np.concatenate((target, predicted))), 0.999)) or 1.0
            )
            axes.hexbin(
                predicted,
                target,
                gridsize=45,
                extent=(-reach, reach, -reach, reach),
                bins="log",
                mincnt=1,
                cmap="Blues",
                vmin=0.3,
                linewidths=0.1,
            )
            axes.plot([-reach, reach], [-reach, reach], color="black", linewidth=0.9)
            axes.set_xlim(-reach, reach)
            axes.set_ylim(-reach, reach)
            axes.set_aspect("equal")
            axes.set_title(
                f"{short_label(run, model)}\n{name}, R² = {r_squared(target, predicted):.2f}"
            )
            axes.xaxis.set_major_locator(MaxNLocator(4, symmetric=True))
            axes.yaxis.set_major_locator(MaxNLocator(4, symmetric=True))
            axes.set_xlabel(f"predicted [{unit}]")
            axes.set_ylabel(f"target [{unit}]")
    return figure


def r_squared(target: np.ndarray, predicted: np.ndarray) -> float:
    """Return the share of the variance of the target [N] that the prediction [N] explains."""
    spread = float(np.sum((target - target.mean()) ** 2))
    return 1.0 - float(np.sum((target - predicted) ** 2)) / spread if spread > 0 else math.nan
