"""Figures of free runs: runs one by one, errors against the horizon and by model, residuals."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import TypeAlias

import numpy as np
import pandas as pd

from residnet.core.format import DEG, fixed, plural, shown_unit
from residnet.core.layout import Live
from residnet.core.names import CHANNEL_UNITS
from residnet.core.stretches import stretches
from residnet.judge.metrics import columns_of
from residnet.report.figure import (
    COLORS,
    DASHED,
    GLANCE,
    GREEN,
    GREY,
    MASKED,
    MEASURED,
    ORANGE,
    SOLID,
    START,
    Case,
    Curve,
    Figure,
    Look,
    Panel,
    band,
    family,
)
from residnet.report.run_reader import RunFiles, StoredWindow

Units: TypeAlias = Mapping[str, tuple[str, str, float]]
"""By channel its SI unit, the unit in which it is shown, and the factor to that."""
_MOST_CASES, _MOST_STILLS, _BINS = 12, 6, 60
"""Windows to look into, pictures among them, and points of a curve of growing errors.

Chosen by hand: the page stays a few megabytes, and the curve smooth.
"""
_TRACK = Panel("north [m]", "east [m]", kind="map", height=380)
_MOTION = {
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
_ERRORS = {
    "u": "u", "v": "v", "r": "r", "x": "position", "psi": "heading", "w": "w", "p": "p", "q": "q",
    "z": "depth", "phi": "phi", "theta": "theta",
}  # fmt: skip
"""Channel whose unit an error has, and the name of the error."""
_SI: Units = {name: (unit, *shown_unit(unit)) for name, unit in CHANNEL_UNITS.items()}
AXES = {
    "u_dot": ("surge", "m/s²", 1.0),
    "v_dot": ("sway", "m/s²", 1.0),
    "r_dot": ("yaw", "deg/s²", DEG),
    "p_dot": ("roll", "deg/s²", DEG),
    "w_dot": ("heave", "m/s²", 1.0),
    "q_dot": ("pitch", "deg/s²", DEG),
}
"""Name of each acceleration's axis, its unit on a page, and the factor to that."""
# colour, line, order; the plant lies on the head that comes near it and shows it through its gaps
_ROLES = {
    "zero": (GREY, "dotted", 3),
    "baseline": (ORANGE, "dashed", 3),
    "truth": (GREEN, "dashdot", 5),
}
_HEADS = [color for color in COLORS if color not in (GREY, ORANGE, GREEN)]
_LINES = ("solid", "long", "dense", "short")
_RANKS = ("median error", "largest error", "least error")


def model_looks(run: RunFiles) -> dict[str, Look]:
    """Return how each model looks.

    Zero, baseline and truth have their own looks; the selected head is always the solid blue one.
    Leading head, baseline and plant alone are switched on at first.
    """
    shown = {run.lead, run.baseline, run.truth, *run.heads[:1]}
    out = {}
    for model, kind in run.kinds.items():
        if kind in _ROLES:
            color, dash, order = _ROLES[kind]
        else:
            place = run.heads.index(model)
            color, order = _HEADS[place % len(_HEADS)], 4
            dash = _LINES[(place + place // len(_HEADS)) % len(_LINES)]
        out[model] = Look(short_label(run, model), color, dash, shown=model in shown, order=order)
    return out


def short_label(run: RunFiles, model: str) -> str:
    """Return the name of a model in figures, where a long one would run over its neighbours."""
    full = run.label(model)
    return full if len(model) <= 20 else full.replace(model, model[:19] + "…")


def free_runs(run: RunFiles, windows: Sequence[StoredWindow]) -> Figure | None:
    """Draw track, motion and inputs of the runs with the median, largest and least errors.

    There are runs of each kind of manoeuvre; those of median error have a still picture.
    """
    chosen = _chosen(run, windows)
    if not chosen:
        return None
    inputs = list(chosen[0][0].inputs)
    units = units_of(run, inputs)
    panels = [
        *_panels("", units, run.live),
        *(_panel(f"{name}\n", units[name], 125) for name in inputs),
    ]
    panels[-1] = replace(panels[-1], x_label="time since the start of the free run [s]")
    looks = {"measured": MEASURED, "masked": MASKED} | model_looks(run)
    if any(run.lead in window.low for window, _ in chosen):
        color = looks[run.lead].color
        looks["band"] = Look(f"band of {run.lead}", color, kind="fill", alpha=0.15, order=1)
    looks["start"] = START
    cases = []
    stills = [window for window, rank in chosen if rank == _RANKS[0]]
    stills = [one for one in stills if one.protocol == stills[0].protocol][:_MOST_STILLS]
    for window, rank in chosen:
        curves = _curves(window, run.lead, units)
        time = window.t - window.t[0]
        for name in inputs:
            curves.append({"measured": (time, units[name][2] * window.inputs[name])})
        kind = window.manoeuvre.replace("_", " ")
        number = f", window {window.number + 1}" if window.number else ""
        note = f"{window.log}: {fixed(float(time[-1]), 1)} s under protocol {window.protocol}."
        if diverged := [model for model, state in window.diverged.items() if state]:
            note += f" Diverged: {', '.join(diverged)}; the curves of zero stand in their place."
        named = "" if kind == "unknown" else f"{kind}, "
        title = f"{named}{window.protocol}: {rank} ({window.log}{number})"
        cases.append(Case(title, curves, note, still=any(window is one for one in stills)))
    return Figure(
        "free_runs",
        "Free runs",
        f"Each run starts from a measured state and is given the inputs alone ({run.focus} data)."
        + (
            " North is up, and each track begins at its start."
            " Look for a track that turns tighter, wider or later than the measured one, for lag at"
            if run.live.moves and run.live.turns
            else " Look for lag at"
        )
        + " the reversals, and for levels that stay apart once the motion has settled. Where the"
        " ground is grey, samples are masked and u and v are not scored. Of every kind of"
        " manoeuvre and protocol, the runs with the least, the median and the largest error of"
        f" {run.lead} are here, in print those of the median.",
        looks,
        panels,
        cases,
        "Run",
    )


def track(run: RunFiles, windows: Sequence[StoredWindow]) -> Figure | None:
    """Draw the track of the run of median error under the main protocol, for the first screen.

    Of a vessel without a track its motion stands in its place.
    """
    ranked = _ranked(run, [one for one in windows if one.protocol == run.main])
    if not ranked:
        return None
    window = ranked[(len(ranked) - 1) // 2]
    shown = {"measured", "start", run.lead, run.baseline}
    looks = {"measured": MEASURED, **model_looks(run), "start": START}
    drawn = [
        {name: curve for name, curve in curves.items() if name in shown}
        for curves in _curves(window, "", units_of(run))
    ]
    mapped = run.live.moves and run.live.turns
    panels = [replace(_TRACK, height=GLANCE)]
    if not mapped:
        panels = _panels("", units_of(run), run.live)
        panels[-1] = replace(panels[-1], x_label="time since the start of the free run [s]")
    return Figure(
        "track",
        "Track of the median run" if mapped else "Median run",
        f"Median of {len(ranked)} {run.focus} runs: {window.log}.",
        {name: replace(look, shown=True) for name, look in looks.items() if name in drawn[0]},
        panels,
        [Case("", drawn[: len(panels)])],
    )


def window_figure(window: StoredWindow, title: str) -> Figure:
    """Return the figure of one free run that is held in memory: track, then velocities.

    A vessel that does not move or turn has no track.
    """
    looks = {"measured": MEASURED} | family(window.predicted) | {"start": START}
    panels = _panels(title, _SI, window.live)
    panels[-1] = replace(panels[-1], x_label="time since the start of the free run [s]")
    curves = [
        {name: curve for name, curve in of_panel.items() if name in looks}
        for of_panel in _curves(window, "", _SI)
    ]
    return Figure("free_run", title, "", looks, panels, [Case(title, curves)])


def units_of(run: RunFiles, names: Iterable[str] = ()) -> Units:
    """Return the units of the states, and of further channels of a run."""
    return {name: (run.si(name), *run.unit(name)) for name in (*columns_of(run.live), *names)}


def _panel(text: str, unit: tuple[str, str, float], height: int = 165) -> Panel:
    si, shown, factor = unit
    label = f"{text} [{shown}]".replace("\n ", "\n") if shown != "-" else text.strip()
    return Panel(label, height=height, si=() if factor == 1.0 else (si, factor))


def _moved(live: Live) -> set[str]:
    """Return the columns of a free run that the live velocities move, `x` for the position."""
    return {*live.channels, *["x"] * live.moves, *["psi"] * live.turns}


def _panels(title: str, units: Units, live: Live) -> list[Panel]:
    moved = _moved(live)
    panels = [_panel(text, units[name]) for name, text in _MOTION.items() if name in moved]
    panels[0] = replace(panels[0], title=title)
    return [replace(_TRACK, title=title), *panels] if {"x", "psi"} <= moved else panels


def _chosen(run: RunFiles, windows: Sequence[StoredWindow]) -> list[tuple[StoredWindow, str]]:
    """Return the runs to choose from with the rank of each among its kind."""
    groups: dict[tuple[int, str], list[StoredWindow]] = {}
    for window in windows:
        if run.lead in window.predicted:
            place = run.protocols.index(window.protocol)
            groups.setdefault((place, window.manoeuvre), []).append(window)
    ranked: list[tuple[int, int, StoredWindow]] = []
    # the kind of manoeuvre with the most runs comes first
    by_count = sorted(groups.items(), key=lambda item: (item[0][0], -len(item[1])))
    for place, (_, members) in enumerate(by_count):
        members = _ranked(run, members)
        for rank, index in enumerate(((len(members) - 1) // 2, len(members) - 1, 0)):
            if all(members[index] is not entry[2] for entry in ranked):
                ranked.append((rank, place, members[index]))
    # where there is not room for all, medians come before worst and best runs
    kept = sorted(ranked, key=lambda entry: entry[:2])[:_MOST_CASES]
    kept.sort(key=lambda entry: (entry[1], entry[0]))
    return [(window, _RANKS[rank]) for rank, _, window in kept]


def _ranked(run: RunFiles, windows: Sequence[StoredWindow]) -> list[StoredWindow]:
    """Return the runs of the leading model, the one of least error first."""
    given = run.metrics.get("scales") or {}
    scales = {name: float(given.get(name, 1.0)) for name in run.live.moving}
    return sorted(
        (one for one in windows if run.lead in one.predicted),
        key=lambda one: (one.nrmse(run.lead, scales), one.log, one.number),
    )


def _curves(window: StoredWindow, lead: str, units: Units) -> list[dict[str, Curve]]:
    """Return track and motion of a run, measured and predicted, and the band of one model."""
    time, usable = window.t - window.t[0], window.usable
    # headings begin within half a turn of north, tracks at their start
    turns = 2 * math.pi * math.floor((window.measured[0, 3] + math.pi) / (2 * math.pi))
    origin = np.zeros(window.measured.shape[1])
    origin[3:6] = turns, *window.measured[0, 4:6]
    begin, end = stretches(~usable)
    masked = (time[begin], time[np.minimum(end, time.size - 1)])

    def track(states: np.ndarray, good: np.ndarray) -> Curve:
        north, east = np.where(good[:, None], states - origin, np.nan)[:, 4:6].T
        return east, north

    all_good = np.ones_like(usable)
    moved = _moved(window.live)
    out = [
        {"measured": track(window.measured, usable)}
        | {model: track(states, all_good) for model, states in window.predicted.items()}
        | {"start": (np.zeros(1), np.zeros(1))}
    ] * ({"x", "psi"} <= moved)
    columns = columns_of(window.live)
    for name in _MOTION:
        if name not in moved:
            continue
        column, factor = columns.index(name), units[name][2]
        good = usable | (column >= 2)
        measured = factor * (window.measured - origin)[:, column]
        panel: dict[str, Curve] = {"measured": (time, np.where(good, measured, np.nan))}
        if len(begin):
            panel["masked"] = masked
        for model, states in window.predicted.items():
            panel[model] = (time, factor * (states - origin)[:, column])
        if lead in window.low:
            low, high = (limit[lead] - origin for limit in (window.low, window.high))
            panel["band"] = band(time, factor * low[:, column], factor * high[:, column])
        out.append(panel)
    return out


def growth(windows: Sequence[StoredWindow], model: str) -> pd.DataFrame:
    """Return the root mean square errors over windows against the time since the start.

    Args:
        windows: free runs of one protocol.

    Returns:
        A row for each time bin that at least half of the windows reach, by its middle in s; columns
        as of `StoredWindow.errors`, in SI.
    """
    of_model = [window for window in windows if model in window.predicted]
    longest = max(float(window.t[-1] - window.t[0]) for window in of_model)
    count = max(min(_BINS, max(window.t.size for window in of_model) // 2), 1)
    bins = [
        np.minimum((count * (window.t - window.t[0]) / longest).astype(int), count - 1)
        for window in of_model
    ]
    reached = np.bincount(np.concatenate([np.unique(one) for one in bins]))
    squares = pd.concat([window.errors(model).pow(2) for window in of_model])
    error = squares.groupby(np.concatenate(bins)).mean().pow(0.5)
    error = error[reached[error.index] >= 0.5 * len(of_model)]
    return error.set_index((error.index + 0.5) * longest / count)


def horizon(run: RunFiles, windows: Sequence[StoredWindow]) -> Figure | None:
    """Draw the error of every model against the horizon, on a logarithmic scale."""
    cases, (panels, factors) = [], _error_panels(run, "RMS error of\n", 175)
    for protocol in run.protocols:
        members = [window for window in windows if window.protocol == protocol]
        curves: list[dict[str, Curve]] = [{} for _ in panels]
        for model in run.kinds:
            if any(model in window.predicted for window in members):
                error = growth(members, model)
                error = error[error > 0]
                if len(error) > 1:
                    # errors that start from zero would stretch the scale
                    error.iloc[0] = np.nan
                for panel, (name, factor) in zip(curves, factors.items(), strict=True):
                    panel[model] = (error.index.to_numpy(), factor * error[name].to_numpy())
        if members:
            cases.append(Case(f"{protocol} ({plural(len(members), 'run')})", curves))
    if not cases:
        return None
    return Figure(
        "horizon",
        "Error against horizon",
        f"Root mean square over the free runs of the {run.focus} data, on a logarithmic scale. A"
        " model whose curve stays level predicts as well late as early; one whose curve climbs"
        " drifts. The level that no model undercuts is the measurement noise.",
        {name: replace(look, shown=True) for name, look in model_looks(run).items()},
        [replace(panel, y_log=True) for panel in panels],
        cases,
        "Protocol",
        columns=2,
    )


def _error_panels(run: RunFiles, words: str, height: int) -> tuple[list[Panel], dict[str, float]]:
    """Return a panel for the errors of each channel that moves, and its factor from SI by name."""
    units, moved = units_of(run), _moved(run.live)
    shown = [name for name in _ERRORS if name in moved]
    panels = [_panel(f"{words}{_ERRORS[name]}", units[name], height) for name in shown]
    panels[-2:] = [replace(one, x_label="time since the start [s]") for one in panels[-2:]]
    return panels, {name: units[name][2] for name in shown}


def residuals(run: RunFiles) -> Figure | None:
    """Draw residual targets against predictions, a case for each head."""
    frame = run.frame("residuals.parquet")
    models = [] if frame is None else [one for one in run.heads if (frame["model"] == one).any()]
    if not models:
        return None
    shown = [f"{name}_dot" for name in run.live.velocities]
    curves: dict[str, dict[str, Curve]] = {model: {} for model in models}
    limits = {}
    for axis in shown:
        reach = 0.0
        for model, rows in frame[frame["axis"] == axis].groupby("model"):
            predicted, target = AXES[axis][2] * rows[["predicted", "target"]].to_numpy(float).T
            # the outermost thousandth would shrink the cloud to a dot
            reach = max(reach, 1.08 * float(np.nanquantile(np.abs((target, predicted)), 0.999)))
            curves.setdefault(str(model), {})[axis] = (predicted, target)
        limits[axis] = np.array([-1.0, 1.0]) * (reach or 1.0)
    cases = [
        Case(
            run.label(model),
            [
                {"equal": (limits[axis],) * 2} | ({model: of[axis]} if axis in of else {})
                for axis in shown
            ],
        )
        for model, of in curves.items()
        if model in models
    ]
    looks = model_looks(run)
    return Figure(
        "residuals",
        "Residual: target against prediction",
        "The acceleration that the baseline leaves (vertical), against what each head predicts"
        " of it (horizontal). The target comes from smoothed derivatives, so it is noisy itself. A"
        " head has learned a cloud along the line; it cannot reach a cloud upright on zero.",
        {
            model: replace(looks[model], kind="points", size=1.6, alpha=0.3, shown=True)
            for model in models
        }
        | {"equal": Look("target = prediction", width=0.9, order=4)},
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
            for axis, (name, unit, _) in ((axis, AXES[axis]) for axis in shown)
        ],
        cases,
        "Head",
        columns=3,
    )


def bands(run: RunFiles, windows: Sequence[StoredWindow]) -> Figure | None:
    """Draw the half width of the leading model's bands beside the errors that they are to hold."""
    model = run.lead
    known = (run.json("bands.json").get("models") or {}).get(model) or {}
    cases, level = [], 0.0
    panels, factors = _error_panels(run, "", 165)
    for protocol, found in known.items():
        members = [one for one in windows if one.protocol == protocol and model in one.low]
        if not members:
            continue
        level = float(found["level"])
        # of the position the box about the circle: half its width is the radius
        widths = [
            pd.DataFrame((one.high[model] - one.low[model]) / 2, columns=columns_of(run.live))
            for one in members
        ]
        errors = [one.errors(model).abs() for one in members]
        # by the number of the step
        mean = pd.concat(widths).groupby(level=0).mean()
        held = pd.concat(errors).groupby(level=0).quantile(level)
        few = slice(1, None, max(len(mean) // 200, 1))
        time = (mean.index.to_numpy() * float(np.median(np.diff(members[0].t))))[few]
        curves = [
            {
                key: (time, factor * of[name].to_numpy()[few])
                for key, of in (("width", mean), ("errors", held))
            }
            for name, factor in factors.items()
        ]
        cases.append(Case(protocol, curves))
    if not cases:
        return None
    return Figure(
        "bands",
        "Band against horizon",
        f"Half widths of the bands of {model} in the {run.focus} data, mean over the runs, and the"
        f" errors that {100 * level:.0f} % of these runs do not exceed. A curve of errors well"
        " above the band means that these logs are unlike those that calibrated it; one well"
        " below, that they are easier.",
        {
            "width": replace(SOLID, label="half width of the band, mean"),
            "errors": replace(DASHED, label=f"{100 * level:.0f} % of the errors"),
        },
        panels,
        cases,
        "Protocol",
        columns=2,
    )
