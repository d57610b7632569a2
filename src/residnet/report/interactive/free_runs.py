"""Interactive figures of a fit: free runs, their errors against the horizon, residuals."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from residnet.report.figures.errors import growth
from residnet.report.figures.style import styles
from residnet.report.figures.tracks import leading
from residnet.report.format import fixed
from residnet.report.interactive.explorer import (
    INK,
    Case,
    Curve,
    Explorer,
    Look,
    Panel,
    thinned,
)
from residnet.report.run_reader import RunFiles, StoredWindow

_DEG = math.degrees(1.0)
_MOST_CASES = 12
_MOST_SAMPLES = 360
_MOST_POINTS = 700
_MEASURED = "measured"
_BAND = "band"
_MOTION = (
    ("surge velocity u [m/s]", 1.0),
    ("sway velocity v [m/s]", 1.0),
    ("yaw rate r [deg/s]", _DEG),
    ("heading [deg]", _DEG),
)
_ERRORS = ("u [m/s]", "v [m/s]", "r [deg/s]", "position [m]", "heading [deg]")
_AXES = (
    ("u_dot", "surge [m/s²]", 1.0),
    ("v_dot", "sway [m/s²]", 1.0),
    ("r_dot", "yaw [deg/s²]", _DEG),
)
_RANKS = {0: "least error", 1: "median error", 2: "largest error"}
_DASHES = {"-": "solid", "--": "dashed", ":": "dotted", "-.": "dashdot"}


def explorers(run: RunFiles) -> list[Explorer]:
    """Return the interactive figures of a fit or an evaluation, those that there are data for."""
    windows = run.windows(run.focus)
    found = [_free_runs(run, windows), _horizon(run, windows), _residuals(run)]
    return [explorer for explorer in found if explorer is not None]


def _looks(run: RunFiles) -> dict[str, Look]:
    """Return how models look, as in the pictures; few of them are switched on at first."""
    lead = leading(run)
    at_first = {lead, run.baseline, run.truth, *run.heads[:1]}
    looks = {}
    for model, style in styles(run).items():
        line = style["linestyle"]
        dash = _DASHES.get(line, "dashed") if isinstance(line, str) else "dashed"
        looks[model] = Look(
            run.label(model),
            str(style["color"]),
            dash,
            2.2 if model == lead else 1.6,
            model in at_first,
        )
    return looks


def _free_runs(run: RunFiles, windows: Sequence[StoredWindow]) -> Explorer | None:
    chosen = _chosen(run, windows)
    if not chosen:
        return None
    inputs = list(chosen[0][0].inputs)
    panels = [
        Panel("track", "east [m]", "map", 380),
        *(Panel(title) for title, _ in _MOTION),
        *(Panel(_input_title(run, name), height=130) for name in inputs),
    ]
    panels[0] = Panel("track, north [m] against east [m]", "", "map", 380)
    last = panels[-1]
    panels[-1] = Panel(last.title, "time since the start [s]", last.kind, last.height + 30)
    return Explorer(
        "free-runs",
        "Free runs",
        f"Each run starts from a measured state and is given the inputs alone ({run.focus} data)."
        " Look for a track that turns tighter, wider or later than the measured one, for lag at"
        " the reversals, and for levels that stay apart once the motion has settled. Gaps in the"
        " measured curves are masked samples. Of every kind of manoeuvre and protocol, the runs"
        f" with the least, the median and the largest error of {leading(run)} are here.",
        "Run",
        {_MEASURED: Look(_MEASURED, INK, width=1.4), **_looks(run), **_band_look(run, chosen)},
        panels,
        [_run_case(run, window, rank, inputs) for window, rank in chosen],
    )


def _band_look(run: RunFiles, chosen: Sequence[tuple[StoredWindow, str]]) -> dict[str, Look]:
    """Return how the limits of the leading model's band look; nothing where it has none."""
    lead = leading(run)
    if not any(lead in window.low for window, _ in chosen):
        return {}
    return {_BAND: Look(f"band of {lead}", _looks(run)[lead].color, "dotted", 1.0)}


def _input_title(run: RunFiles, name: str) -> str:
    unit = run.unit(name)[0]
    return f"input {name} [{unit}]" if unit != "-" else f"input {name}"


def _chosen(run: RunFiles, windows: Sequence[StoredWindow]) -> list[tuple[StoredWindow, str]]:
    """Return the runs to choose from: of each kind those of median, largest and least error."""
    judge = leading(run)
    scales = run.metrics.get("scales") or {}
    divisor = np.array([float(scales.get(name, 1.0)) for name in ("u", "v", "r")])
    groups: dict[tuple[str, str], list[StoredWindow]] = {}
    for protocol in run.protocols:
        for window in windows:
            if window.protocol == protocol and judge in window.predicted:
                groups.setdefault((protocol, window.manoeuvre), []).append(window)
    ranked: list[tuple[int, int, StoredWindow, str]] = []
    # the kind of manoeuvre with the most runs comes first
    by_count = sorted(
        groups.items(), key=lambda item: (run.protocols.index(item[0][0]), -len(item[1]))
    )
    for place, (_, members) in enumerate(by_count):
        members.sort(key=lambda window: float((window.rmse(judge) / divisor).mean()))
        middle = (len(members) - 1) // 2
        for order, (index, rank) in enumerate(((middle, 1), (len(members) - 1, 2), (0, 0))):
            if all(members[index] is not entry[2] for entry in ranked):
                ranked.append((order, place, members[index], _RANKS[rank]))
    # where there is not room for all, medians come before worst and best runs
    kept = sorted(ranked, key=lambda entry: entry[:2])[:_MOST_CASES]
    return [(window, rank) for _, _, window, rank in sorted(kept, key=lambda e: (e[1], e[0]))]


def _run_case(run: RunFiles, window: StoredWindow, rank: str, inputs: Sequence[str]) -> Case:
    rows = thinned(window.t.size, _MOST_SAMPLES)
    time = (window.t - window.t[0])[rows]
    usable = window.usable[rows]
    start = window.measured[0, 4:6]
    turns = 2 * math.pi * math.floor((window.measured[0, 3] + math.pi) / (2 * math.pi))
    measured = window.measured[rows]
    tracks: dict[str, Curve] = {
        _MEASURED: (
            np.where(usable, measured[:, 5] - start[1], np.nan),
            np.where(usable, measured[:, 4] - start[0], np.nan),
        )
    }
    histories: list[dict[str, Curve]] = []
    for column, (_, factor) in enumerate(_MOTION):
        shift = turns if column == 3 else 0.0
        shown = usable | (column >= 2)
        histories.append(
            {_MEASURED: (time, np.where(shown, factor * (measured[:, column] - shift), np.nan))}
        )
        for model, states in window.predicted.items():
            histories[column][model] = (time, factor * (states[rows, column] - shift))
        if leading(run) in window.low:
            lines = (window.low[leading(run)], window.high[leading(run)])
            # both limits are one curve with a gap
            limits = [np.append(factor * (line[rows, column] - shift), np.nan) for line in lines]
            twice = np.append(time, np.nan)
            histories[column][_BAND] = (np.tile(twice, 2), np.concatenate(limits))
    for model, states in window.predicted.items():
        tracks[model] = (states[rows, 5] - start[1], states[rows, 4] - start[0])
    given = [{_MEASURED: (time, run.unit(name)[1] * window.inputs[name][rows])} for name in inputs]
    diverged = [model for model, state in window.diverged.items() if state]
    kind = window.manoeuvre.replace("_", " ")
    number = f", window {window.number + 1}" if window.number else ""
    note = f"{window.log}: {fixed(float(time[-1]), 1)} s under protocol {window.protocol}."
    if diverged:
        note += f" Diverged: {', '.join(diverged)}; the curves of zero stand in their place."
    named = "" if kind == "unknown" else f"{kind}, "
    title = f"{named}{window.protocol}: {rank} ({window.log}{number})"
    return Case(title, [tracks, *histories, *given], note)


def _horizon(run: RunFiles, windows: Sequence[StoredWindow]) -> Explorer | None:
    cases = []
    for protocol in run.protocols:
        members = [window for window in windows if window.protocol == protocol]
        if not members:
            continue
        panels: list[dict[str, Curve]] = [{} for _ in _ERRORS]
        for model in run.kinds:
            if any(model in window.predicted for window in members):
                time, errors = growth(members, model)
                for panel, column in zip(panels, errors.T, strict=True):
                    panel[model] = (time, np.where(column > 0, column, np.nan))
        cases.append(Case(f"{protocol} ({len(members)} runs)", panels))
    if not cases:
        return None
    panels_of = [Panel(f"error of {text}", logarithmic=True) for text in _ERRORS]
    panels_of[-1] = Panel(
        panels_of[-1].title, "time since the start [s]", height=200, logarithmic=True
    )
    looks = {
        name: Look(look.label, look.color, look.dash, look.width)
        for name, look in _looks(run).items()
    }
    return Explorer(
        "horizon",
        "Error against horizon",
        f"Root mean square over the free runs of the {run.focus} data, on a logarithmic scale. A"
        " model whose curve stays level predicts as well late as early; one whose curve climbs"
        " drifts. The level that no model undercuts is the measurement noise.",
        "Protocol",
        looks,
        panels_of,
        cases,
    )


def _residuals(run: RunFiles) -> Explorer | None:
    frame = run.frame("residuals.parquet")
    if frame is None:
        return None
    table = {name: np.asarray(frame[name]) for name in ("model", "axis", "target", "predicted")}
    looks = _looks(run)
    models = [model for model in run.heads if model in set(table["model"].tolist())]
    if not models:
        return None
    cases = [Case(text, [_cloud(table, models, axis, factor)]) for axis, text, factor in _AXES]
    return Explorer(
        "residuals",
        "Residual: target against prediction",
        "The acceleration that the baseline leaves (horizontal), against what each head predicts"
        " of it (vertical). The target comes from smoothed derivatives, so it is noisy itself. A"
        " head has learned a cloud along the line; it cannot reach a cloud upright on zero.",
        "Axis",
        {"equal": Look("target = prediction", INK, width=1.0)}
        # a figure without a cloud says nothing, whichever model was chosen
        | {model: replace(looks[model], shown=True) for model in models},
        [Panel("predicted against target", "target", "cloud", 380)],
        cases,
    )


def _cloud(
    table: Mapping[str, np.ndarray], models: Sequence[str], axis: str, factor: float
) -> dict[str, Curve]:
    out: dict[str, Curve] = {}
    for model in models:
        rows = np.flatnonzero((table["model"] == model) & (table["axis"] == axis))
        rows = rows[thinned(rows.size, _MOST_POINTS)]
        target, predicted = table["target"][rows], table["predicted"][rows]
        out[model] = (factor * target.astype(float), factor * predicted.astype(float))
    ends = np.concatenate([x for x, _ in out.values()])
    finite = ends[np.isfinite(ends)]
    if finite.size:
        line = np.linspace(finite.min(), finite.max(), 60)
        out["equal"] = (line, line)
    return out
