"""Document 003 (Woo et al. 2018): what configs/studies/woo2018/woo2018.yaml adds to a fit's report.

The document shows the steady states of constant manoeuvres (Figure 9) and single runs: simplified
steering models in a zigzag (13), surge in an acceleration-deceleration test (14), sway and yaw rate
in a zigzag and a 3-2-1-1 test (15), errors of the speed models (16) and of the steering models (17)
on training and unseen data, and a zigzag with its track (18).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from residnet.core.errors import UsageError
from residnet.core.format import DEG, interval
from residnet.documents import published
from residnet.documents.study import beside_published, compared
from residnet.report.blocks import Block, Section, Table, Text, table_of
from residnet.report.figure import (
    BLUE,
    GREY,
    MEASURED,
    ORANGE,
    PURPLE,
    SKY,
    VERMILLION,
    ZERO,
    Case,
    Curve,
    Figure,
    Look,
    Panel,
    bars,
    names_of,
    whiskers,
)
from residnet.report.figure_files import write_figure
from residnet.report.run_reader import RunFiles, StoredWindow
from residnet.runs.folder import RunFolder

PROTOCOL = "manoeuvre"
LOOKS = {
    "nomoto": Look("Nomoto", PURPLE, "dotted", 1.3),
    "nomoto_side_slip": Look("Nomoto with side slip", SKY, "short", 1.3),
    "baseline": Look("linear", ORANGE, "dashed", 1.3),
    "lstm_printed": Look("LSTM as printed, rate 1e-5", GREY, "dense", 1.3),
    "lstm_rate": Look("LSTM as printed, rate 1e-3", VERMILLION, "long", 1.3),
    "lstm": Look("LSTM, free-run training", BLUE, width=1.3),
}
KINDS = ("zigzag", "acceleration_deceleration", "three_two_one_one")
"""Kinds of manoeuvre that the figures show."""
_SIMPLE, _LEARNED = (
    ("nomoto", "nomoto_side_slip", "baseline"),
    ("lstm_printed", "lstm_rate", "lstm"),
)
_COMPARED = ("baseline", *_LEARNED)
_CHANNELS = {
    "u": (0, "surge velocity u", "m/s", 1.0),
    "v": (1, "sway velocity v", "m/s", 1.0),
    "r": (2, "yaw rate r", "deg/s", DEG),
}
"""Column, name, shown unit and factor to it from SI of each velocity."""
_GROUPS = {"u": "speed", "v": "steering", "r": "steering"}
"""Group of manoeuvres that each velocity is judged on, as in Figures 16 and 17."""
_DRIVEN = {"u": ("tau_x", "N"), "v": ("tau_n", "N m"), "r": ("tau_n", "N m")}
"""What drives each steady state (32)."""
_CAPTION = "Unseen manoeuvres unless it says otherwise; simulated WAM-V with sensor noise."
_RATIOS = (
    "Left: root mean square errors with 95 % intervals over manoeuvres. Right: each unseen run's"
    " error over that of the linear model, with the median; simulated WAM-V with sensor noise."
)


def sections(files: RunFiles) -> list[Section]:
    """Write study.json, draw the figures of document 003 and return the section of the report.

    Raises:
        UsageError: where the run lacks a kind of manoeuvre.
    """
    figures = [
        write_figure(files.path / "figures" / "woo2018", figure) for figure in drawings(files)
    ]
    about = Text(
        "The runs are simulated, with 126 manoeuvres as in the document. Its vessel and its logs"
        " are not public: its figures are comparable in kind and not in size. Beside the document's"
        " manoeuvres stand further acceleration tests that no fit sees, so that surge is judged on"
        " more than two. The plant's own terms are among the candidates of closed-form heads;"
        " configs/studies/woo2018/outside_terms.yaml compares networks and closed forms on a plant"
        " whose terms none of them has."
    )
    changes = {model: changes_of_error(files, model) for model in _LEARNED}
    content = {"schema": "residnet.woo2018/1", "changes": changes}
    RunFolder(files.path).write_json(files.path / "study.json", content)
    shares = published("woo2018")["change_of_error"]
    printed = {channel: 100 * share for channel, share in shares.items()}
    table = table_of(
        [
            {"model": LOOKS[model].label, **of_model, "published": printed}
            for model, of_model in changes.items()
        ],
        [
            ("model", "model"),
            *(column for c in _GROUPS for column in compared(c, f"{c} %", 3, 100)),
        ],
        caption="Change of the root mean square error on unseen manoeuvres from the linear model to"
        " the LSTM. The document prints one figure for each velocity.",
    )
    blocks: list[Block] = [about, steady_table(files), figures[0], table]
    return [Section("Document 003 (Woo et al. 2018)", [*blocks, *figures[1:]])]


def changes_of_error(files: RunFiles, model: str) -> dict[str, float | None]:
    """Return how a model changes the error of the linear one on unseen manoeuvres, by velocity.

    A change is the ratio of root mean square errors less one; None where a row is absent.
    """
    changes: dict[str, float | None] = {}
    for channel, group in _GROUPS.items():
        rows = [files.row(name, "test", PROTOCOL, group) for name in ("baseline", model)]
        before, after = (None if row is None else row["rmse"][channel] for row in rows)
        changes[channel] = None if before is None or after is None else after / before - 1
    return changes


def steady_table(files: RunFiles) -> Table:
    """Return the constraints (32) of the linear model with intervals, beside Table 1."""
    found, printed = files.fit("baseline")["steady_constraints"], published("woo2018")["steady"]
    table = Table(
        ["steady state", "Phi", "95 % interval", "bias", "95 % interval", "unit"],
        caption="Steady states of the constant manoeuvres as x = Phi tau + bias (32), beside those"
        " of Table 1 as corrected (W12, W13). The vessels differ: sizes alone compare.",
    )
    for state, (_, _, unit, factor) in _CHANNELS.items():
        cells: list[Any] = []
        for key, number in zip(("phi", "bias"), printed[state], strict=True):
            value, error = found[state][key], 1.96 * found[state][f"{key}_error"]
            cells.append(beside_published(factor * value, number, 3))
            cells.append(interval([value - error, value + error], factor, 3))
        force, measure = _DRIVEN[state]
        table.add(f"{state} over {force}", [*cells, f"{unit} per {measure}; {unit}"])
    return table


def drawings(files: RunFiles) -> list[Figure]:
    """Return Figures 9 and 13 to 18, named by their numbers.

    Raises:
        UsageError: where the run lacks a kind of manoeuvre.
    """
    unseen = [window for window in files.windows("test") if window.protocol == PROTOCOL]
    zigzag, speed, steps = (typical(files, unseen, kind) for kind in KINDS)
    of_speed = [window for window in unseen if window.manoeuvre == KINDS[1]]
    of_steering = [window for window in unseen if window.manoeuvre in (KINDS[0], KINDS[2])]
    turning = [(zigzag, "v"), (zigzag, "r"), (steps, "v"), (steps, "r")]
    notes = files.fit("baseline")
    states, parts = notes["steady_states"], []
    for state, (_, _, unit, factor) in _CHANNELS.items():
        (force, measure), found = _DRIVEN[state], notes["steady_constraints"][state]
        tau = np.array(states[force])
        ends = np.array([tau.min(), tau.max()])
        line = factor * (found["phi"] * ends + found["bias"])
        curves = {"points": (tau, factor * np.array(states[state])), "line": (ends, line)}
        panel = Panel(f"steady {state} [{unit}]", f"{force} [{measure}]", height=285)
        parts.append((panel, curves))
    looks = {"points": Look("", BLUE, kind="points", size=2.5), "line": Look("", ORANGE)}
    caption = "Points: means of the settled part of each manoeuvre. Lines: Phi tau + bias (32)."
    models = (*_SIMPLE, "lstm")
    start = zigzag.measured[0, 4:6]
    paths = {"measured": zigzag.measured} | {model: zigzag.predicted[model] for model in models}
    track = {name: (path[:, 5] - start[1], path[:, 4] - start[0]) for name, path in paths.items()}
    panel = Panel("north [m]", "east [m]", zigzag.log, kind="map", height=400)
    words = "A zigzag: track, yaw rate and sway velocity"
    return [
        _figure(9, "steady states of the constant manoeuvres", caption, looks, parts, 3),
        _histories(13, "Simplified steering models in a zigzag", turning[:2], _SIMPLE),
        _histories(14, "Surge in an acceleration-deceleration test", [(speed, "u")], _COMPARED),
        _histories(15, "Sway and yaw rate in a zigzag and a 3-2-1-1 test", turning, _COMPARED),
        _errors(files, 16, "speed", of_speed, ("u",), _COMPARED),
        _errors(files, 17, "steering", of_steering, ("v", "r"), (*_SIMPLE, *_LEARNED)),
        _histories(18, words, [(zigzag, "r"), (zigzag, "v")], models, [(panel, track)]),
    ]


def typical(files: RunFiles, unseen: Sequence[StoredWindow], kind: str) -> StoredWindow:
    """Return the unseen run of a kind with the median error of the LSTM trained in free run.

    Raises:
        UsageError: where there is none of the kind.
    """
    runs = [window for window in unseen if window.manoeuvre == kind]
    if not runs:
        raise UsageError(f"{files.path}: study woo2018 needs a test manoeuvre of kind {kind}")
    ranked = sorted(runs, key=lambda window: (float(window.rmse("lstm").sum()), window.log))
    return ranked[(len(ranked) - 1) // 2]


def _figure(
    number: int,
    words: str,
    caption: str,
    looks: Mapping[str, Look],
    parts: Sequence[tuple[Panel, Mapping[str, Curve]]],
    columns: int = 1,
) -> Figure:
    """Return a figure of the document's number, from its panels and what they show."""
    panels, curves = zip(*parts, strict=True)
    title = f"Figure {number} of document 003: {words}"
    return Figure(str(number), title, caption, looks, panels, [Case("", curves)], columns=columns)


def _histories(
    number: int,
    words: str,
    shown: Sequence[tuple[StoredWindow, str]],
    models: Sequence[str],
    first: Sequence[tuple[Panel, Mapping[str, Curve]]] = (),
) -> Figure:
    """Return measured and predicted velocities of some runs, each with its errors below."""
    parts = list(first)
    for window, channel in shown:
        column, name, unit, factor = _CHANNELS[channel]
        time, measured = window.t - window.t[0], factor * window.measured[:, column]
        paths = {model: factor * window.predicted[model][:, column] for model in models}
        group = f"{window.log} {channel}"
        above = Panel(f"{name} [{unit}]", title=window.log, height=210, group=group)
        label = "time since the start of the free run [s]"
        below = Panel(f"error of {channel}\n[{unit}]", label, height=110, group=group)
        curves = {"measured": (time, measured)}
        errors = {"zero": (np.zeros(1), np.zeros(1))}
        for model, path in paths.items():
            curves[model], errors[model] = (time, path), (time, path - measured)
        parts += [(above, curves), (below, errors)]
    looks = {"measured": MEASURED, "zero": ZERO} | {model: LOOKS[model] for model in models}
    return _figure(number, words, _CAPTION, looks, parts)


def _errors(
    files: RunFiles,
    number: int,
    group: str,
    windows: Sequence[StoredWindow],
    channels: Sequence[str],
    models: Sequence[str],
) -> Figure:
    """Return RMSE by model, and beside it the error of each unseen run over the linear model's.

    A line shows the error of the simulator itself, which is the noise of the sensors.
    """
    looks = {
        "train": Look("training data", "#BFBFBF", kind="fill"),
        "test": Look("unseen manoeuvres", BLUE, kind="fill"),
        "ci95": Look("", width=0.8, order=4),
        "noise": Look("simulator itself (sensor noise)", dash="dotted", kind="across"),
        **{model: Look("", LOOKS[model].color, kind="points", size=2.5) for model in models},
        "median": Look("", width=1.2, order=5),
        "one": ZERO,
    }
    names = names_of(LOOKS[model].label for model in models)
    parts: list[tuple[Panel, Mapping[str, Curve]]] = []
    for channel in channels:
        column, name, unit, factor = _CHANNELS[channel]
        bar: dict[str, Curve] = {}
        spans: list[tuple[float, Any, Any]] = []
        for offset, split in ((-0.2, "train"), (0.2, "test")):
            rows = [files.row(model, split, PROTOCOL, group) for model in models]
            at = np.arange(len(models)) + offset
            values = [factor * row["rmse"][channel] if row else np.nan for row in rows]
            bar[split] = bars(at, values, 0.38)
            # too few manoeuvres have no interval
            for place, row in zip(at, rows, strict=True):
                if row and row["rmse_ci95"][channel]:
                    low, high = row["rmse_ci95"][channel]
                    spans.append((place, factor * low, factor * high))
        bar["ci95"] = whiskers(*zip(*spans, strict=True)) if spans else (np.empty(0), np.empty(0))
        noise = files.row("truth", "test", PROTOCOL, group)
        if noise:
            bar["noise"] = (np.zeros(1), np.array([factor * noise["rmse"][channel]]))
        reference = np.array([window.rmse("baseline")[column] for window in windows])
        dots: dict[str, Curve] = {"one": (np.zeros(1), np.ones(1))}
        medians: list[tuple[float, float]] = []
        for place, model in enumerate(models):
            ratio = np.array([window.rmse(model)[column] for window in windows]) / reference
            dots[model] = (place + 0.25 * np.linspace(-1, 1, len(ratio)), ratio)
            middle = float(np.median(ratio))
            medians += [(place - 0.35, middle), (place + 0.35, middle), (np.nan, np.nan)]
        x, y = np.array(medians).T
        dots["median"] = (x, y)
        label = f"error of {channel} over the linear model's"
        parts += [
            (Panel(f"RMSE, {name} [{unit}]", height=320, x_names=names), bar),
            (Panel(label, height=320, x_names=names, y_log=True), dots),
        ]
    return _figure(number, f"Errors of the {group} models", _RATIOS, looks, parts, 2)
