"""Figures of free runs: runs one by one, errors against the horizon and by model, residuals."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import TypeAlias

import numpy as np

from residnet.core.format import DEG, fixed, shown_unit
from residnet.core.layout import Live
from residnet.core.names import CHANNEL_UNITS
from residnet.core.stretches import stretches
from residnet.judge.metrics import columns_of
from residnet.report.figure import (
    BLUE,
    COLORS,
    GLANCE,
    GREEN,
    GREY,
    MASKED,
    MEASURED,
    ORANGE,
    START,
    Case,
    Curve,
    Figure,
    Look,
    Panel,
    band,
    bars,
    family,
    joined,
    names_of,
    whiskers,
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
_AXES = (
    ("u_dot", "surge", "m/s²", 1.0),
    ("v_dot", "sway", "m/s²", 1.0),
    ("r_dot", "yaw", "deg/s²", DEG),
    ("p_dot", "roll", "deg/s²", DEG),
    ("w_dot", "heave", "m/s²", 1.0),
    ("q_dot", "pitch", "deg/s²", DEG),
)
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
    scales = run.metrics.get("scales") or {}
    divisor = np.array([float(scales.get(name, 1.0)) for name in run.live.moving])
    return sorted(
        (one for one in windows if run.lead in one.predicted),
        key=lambda one: (float((one.rmse(run.lead) / divisor).mean()), one.log, one.number),
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


def growth(windows: Sequence[StoredWindow], model: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the root mean square errors over windows against the time since the start.

    Args:
        windows: free runs of one protocol.

    Returns:
        Middles of time bins [K] in s, and errors [K, 2 + n] of u, v, r, position, heading and the
        rest in SI. Bins that fewer than half of the windows reach are left out. u, v and position
        count where usable.
    """
    of_model = [window for window in windows if model in window.predicted]
    longest = max(float(window.t[-1] - window.t[0]) for window in of_model)
    count = max(min(_BINS, max(window.t.size for window in of_model) // 2), 1)
    wide = of_model[0].measured.shape[1] - 1
    squares, samples, reached = np.zeros((count, wide)), np.zeros((count, wide)), np.zeros(count)
    masked = np.isin(np.arange(wide), (0, 1, 3))
    for window in of_model:
        error = np.square(window.predicted[model] - window.measured)
        columns = np.column_stack(
            (error[:, :3], error[:, 4] + error[:, 5], error[:, 3], error[:, 6:])
        )
        weight = np.where(masked, window.usable[:, None], True)
        index = np.minimum((count * (window.t - window.t[0]) / longest).astype(int), count - 1)
        reached[np.unique(index)] += 1
        np.add.at(squares, index, np.where(weight, columns, 0.0))
        np.add.at(samples, index, weight)
    keep = reached >= 0.5 * len(of_model)
    with np.errstate(invalid="ignore", divide="ignore"):
        error = np.sqrt(squares / samples)
    return ((np.arange(count) + 0.5) * longest / count)[keep], error[keep]


def horizon(run: RunFiles, windows: Sequence[StoredWindow]) -> Figure | None:
    """Draw the error of every model against the horizon, on a logarithmic scale."""
    cases, units, shown = [], units_of(run), _errors_of(run)
    named = _told(run.live)
    factors = [units[name][2] for name in named]
    for protocol in run.protocols:
        members = [window for window in windows if window.protocol == protocol]
        curves: list[dict[str, Curve]] = [{} for _ in named]
        for model in run.kinds:
            if any(model in window.predicted for window in members):
                time, errors = growth(members, model)
                errors *= factors
                # errors that start from zero would stretch the scale
                errors[:1] = np.nan if len(errors) > 1 else errors[:1]
                for panel, column in zip(curves, errors.T, strict=True):
                    panel[model] = (time, np.where(column > 0, column, np.nan))
        if members:
            runs = "run" if len(members) == 1 else "runs"
            kept = [curves[place] for place in shown.values()]
            cases.append(Case(f"{protocol} ({len(members)} {runs})", kept))
    if not cases:
        return None
    panels = [
        replace(_panel(f"RMS error of\n{_ERRORS[name]}", units[name], 175), y_log=True)
        for name in shown
    ]
    panels[-2:] = [replace(one, x_label="time since the start [s]") for one in panels[-2:]]
    return Figure(
        "horizon",
        "Error against horizon",
        f"Root mean square over the free runs of the {run.focus} data, on a logarithmic scale. A"
        " model whose curve stays level predicts as well late as early; one whose curve climbs"
        " drifts. The level that no model undercuts is the measurement noise.",
        {name: replace(look, shown=True) for name, look in model_looks(run).items()},
        panels,
        cases,
        "Protocol",
        columns=2,
    )


def _errors_of(run: RunFiles) -> dict[str, int]:
    """Return the channels of `_ERRORS` that the live velocities move, with their places there."""
    moved = _moved(run.live)
    return {name: place for place, name in enumerate(_told(run.live)) if name in moved}


def _told(live: Live) -> list[str]:
    """Return the channels of `_ERRORS` that free runs of a layout have errors of."""
    return [name for name in _ERRORS if name in ("x", "psi", *live.moving)]


def error_bars(run: RunFiles) -> Figure:
    """Draw the error of every model, train beside test, with 95 % intervals.

    Figures 16 and 17 of document 003 look like this. `zero` is left out: it would flatten the rest.
    """
    protocol = run.protocols[0]
    models = [model for model, kind in run.kinds.items() if kind != "zero"]
    thick = 0.8 / len(run.sides)
    curves = []
    panels: list[Panel] = []
    for channel in run.live.channels:
        text = _MOTION[channel].partition("\n")[0]
        unit, factor = run.unit(channel)
        group = bar_group(run, protocol, channel)
        panel: dict[str, Curve] = {}
        spread = []
        for place, split in enumerate(run.sides):
            rows = [run.row(model, split, protocol, group) for model in models]
            found = [(i, row) for i, row in enumerate(rows) if row and channel in row["rmse"]]
            at = [i + (place - 0.5 * (len(run.sides) - 1)) * thick for i, _ in found]
            values = [factor * row["rmse"][channel] for _, row in found]
            panel[split] = bars(at, values, thick)[::-1]
            ends = [(row.get("rmse_ci95") or {}).get(channel) for _, row in found]
            known = [
                (y, factor * span[0], factor * span[1])
                for y, span in zip(at, ends, strict=True)
                if span
            ]
            spread += [whiskers(*zip(*known, strict=True))[::-1]] if known else []
        curves.append(panel | {"interval": joined(spread)})
        panels.append(
            Panel(
                "",
                f"RMSE of {channel} [{unit}]",
                text + (f"\n({group.replace('_', ' ')} runs)" if group != "all" else ""),
                height=70 + 44 * len(models),
                group=channel,
                y_names=names_of(short_label(run, model) for model in models)
                if not panels
                else names_of("" for _ in models),
                y_limits=(len(models) - 0.4, -0.6),
            )
        )
    return Figure(
        "bars",
        "Free-run error by model",
        f"Root mean square error under protocol {protocol} with 95 % intervals over free runs"
        + (
            f". {run.focus.capitalize()} bars well beyond the train bars would mean overfitting."
            if len(run.sides) > 1
            else f" ({run.focus} data)."
        ),
        {
            split: Look(split, BLUE if split == run.focus else ORANGE, kind="fill", alpha=0.85)
            for split in run.sides
        }
        | {"interval": Look("95 % interval", width=0.9, order=4)},
        panels,
        [Case("", curves)],
        columns=3,
    )


def bar_group(run: RunFiles, protocol: str, channel: str) -> str:
    """Return the group of manoeuvres that a channel is judged on.

    Surge is judged on `speed` and the others on `steering`, where a run has both groups.
    """
    groups = set(run.manoeuvres(run.focus, protocol))
    return ("speed" if channel == "u" else "steering") if {"speed", "steering"} <= groups else "all"


def residuals(run: RunFiles) -> Figure | None:
    """Draw residual targets against predictions, a case for each head."""
    frame = run.frame("residuals.parquet")
    models = [] if frame is None else [one for one in run.heads if (frame["model"] == one).any()]
    if not models:
        return None
    axes = [_AXES[place] for place in run.live.learned]
    cases, reach = [], dict.fromkeys((axis for axis, *_ in axes), 0.0)
    for model in models:
        panels, explained = [], []
        for axis, name, _, factor in axes:
            rows = frame[(frame["model"] == model) & (frame["axis"] == axis)]
            target, predicted = factor * rows[["target", "predicted"]].to_numpy(float).T
            panels.append({model: (predicted, target)} if len(rows) else {})
            if len(rows):
                # the outermost thousandth would shrink the cloud to a dot
                outer = float(np.nanquantile(np.abs((target, predicted)), 0.999))
                reach[axis] = max(reach[axis], 1.08 * outer)
                explained.append(f"{name} {r_squared(target, predicted):.2f}")
        cases.append(Case(run.label(model), panels, f"R²: {', '.join(explained)}."))
    limits = {axis: value or 1.0 for axis, value in reach.items()}
    line = {axis: np.array([-value, value]) for axis, value in limits.items()}
    for case in cases:
        for panel, (axis, *_) in zip(case.curves, axes, strict=True):
            panel["equal"] = (line[axis], line[axis])  # type: ignore[index]
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
                x_limits=(-limits[axis], limits[axis]),
                y_limits=(-limits[axis], limits[axis]),
            )
            for axis, name, unit, _ in axes
        ],
        cases,
        "Head",
        columns=3,
    )


def r_squared(target: np.ndarray, predicted: np.ndarray) -> float:
    """Return the share of the variance of the target [N] that the prediction [N] explains."""
    spread = float(np.sum((target - target.mean()) ** 2))
    return 1.0 - float(np.sum((target - predicted) ** 2)) / spread if spread > 0 else math.nan


def bands(run: RunFiles, windows: Sequence[StoredWindow]) -> Figure | None:
    """Draw the half width of the leading model's bands beside the errors that they are to hold."""
    model = run.lead
    known = (run.json("bands.json").get("models") or {}).get(model) or {}
    cases, level, units = [], 0.0, units_of(run)
    shown = _errors_of(run)
    for protocol, found in known.items():
        members = [one for one in windows if one.protocol == protocol and model in one.low]
        if not members:
            continue
        level = float(found["level"])
        longest = max(window.t.size for window in members)
        # u, v, r, heading, position, then what else moves
        wide = members[0].measured.shape[1] - 1
        error, width = np.full((2, len(members), longest, wide), np.nan)
        for i, window in enumerate(members):
            apart = np.abs(window.predicted[model] - window.measured)
            radius = np.hypot(apart[:, 4], apart[:, 5])
            errors = np.column_stack((apart[:, :4], radius, apart[:, 6:]))
            errors[:, [0, 1, 4]] = np.where(window.usable[:, None], errors[:, [0, 1, 4]], np.nan)
            error[i, : len(errors)] = errors
            reach = 0.5 * (window.high[model] - window.low[model])
            width[i, : len(errors)] = np.delete(reach, 5, axis=1)
        time = np.arange(longest) * float(np.median(np.diff(members[0].t)))
        held = np.full((longest, wide), np.nan)
        for column in range(wide):
            seen = np.isfinite(error[:, :, column]).any(axis=0)
            held[seen, column] = np.nanquantile(error[:, seen, column], level, axis=0)
        mean = np.nanmean(width, axis=0)
        few = slice(1, None, max(longest // 200, 1))
        panels: list[dict[str, Curve]] = []
        for name, k in shown.items():
            # heading before position there, behind it here
            k, f = {3: 4, 4: 3}.get(k, k), units[name][2]
            curves = {"width": mean, "errors": held}
            panels.append({key: (time[few], f * of[few, k]) for key, of in curves.items()})
        cases.append(Case(protocol, panels))
    if not cases:
        return None
    panels_of = [_panel(_ERRORS[name], units[name]) for name in shown]
    panels_of[-2:] = [replace(one, x_label="time since the start [s]") for one in panels_of[-2:]]
    return Figure(
        "bands",
        "Band against horizon",
        f"Half widths of the bands of {model} in the {run.focus} data, mean over the runs, and the"
        f" errors that {100 * level:.0f} % of these runs do not exceed. A curve of errors well"
        " above the band means that these logs are unlike those that calibrated it; one well"
        " below, that they are easier.",
        {
            "width": Look("half width of the band, mean", BLUE, width=1.6),
            "errors": Look(f"{100 * level:.0f} % of the errors", ORANGE, "dashed", 1.6, order=4),
        },
        panels_of,
        cases,
        "Protocol",
        columns=2,
    )
