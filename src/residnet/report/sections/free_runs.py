"""Errors of free runs by model, split and kind of manoeuvre; what limits them; their bands."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from residnet.core.format import (
    DASH,
    change,
    fixed,
    listed,
    number,
    percent,
    plural,
    signed,
    title_of,
)
from residnet.judge.verdict import diverged_note, sized
from residnet.report.blocks import (
    Block,
    Bullets,
    Cell,
    Column,
    Section,
    Table,
    Text,
    bad_where,
    paired_interval,
    table_of,
)
from residnet.report.figure import Figure
from residnet.report.run_reader import Content, RunFiles


def distinct(run: RunFiles, split: str, protocol: str) -> list[str]:
    """Return kinds and groups of manoeuvres without those that hold the same runs as one before.

    A group of a single kind holds the same runs as that kind.
    """
    seen: list[Any] = []
    out: list[str] = []
    for kind in run.manoeuvres(split, protocol):
        rows = [run.row(model, split, protocol, kind) for model in run.kinds]
        errors = [(row["windows"], row["rmse"]) for row in rows if row is not None]
        if errors not in seen:
            seen.append(errors)
            out.append(kind)
    return out


def errors(run: RunFiles) -> Section:
    """Return the section on free runs: for each protocol all models, then kind by kind."""
    where = (
        f"The splits {' and '.join(run.sides)} stand side by side."
        if len(run.sides) > 1
        else f"The data are those of the split {run.focus}."
    )
    small = "the 95 % interval of NRMSE"
    if run.baseline is not None:
        small = f"the change against the baseline on the same data, and {small}"
    about = (
        "The tables give the root mean square error of each free run, averaged over the runs."
        f" {where} Small print gives {small}. A run that diverged counts with the error of held"
        " velocities, and its number stands beside the score."
    )
    blocks: list[Block] = [Text(about)]
    for protocol in run.protocols:
        sides = [
            side for side in run.sides if any(run.row(one, side, protocol) for one in run.kinds)
        ]
        if not sides:
            continue
        parts: list[Block] = [_side_by_side(run, protocol, sides)]
        kinds = by_manoeuvre(run, protocol, run.focus)
        if kinds is not None:
            title = f"By kind of manoeuvre, {run.focus} data"
            parts.append(Section(title, [kinds], folded=protocol != run.protocols[0]))
        blocks.append(Section(f"Protocol {protocol}", parts))
    return Section("Free runs", blocks)


def _quantities(run: RunFiles, nrmse: str = "NRMSE [-]") -> dict[str, str]:
    """Return the titles of what tables of errors show."""
    return {
        **{channel: f"{title_of(channel)} [{run.unit(channel)[0]}]" for channel in run.channels},
        "nrmse": nrmse,
        **{end: "{}, end [{}]".format(*run.end(end)) for end in run.ends},
        "diverged": "diverged",
    }


def _side_by_side(run: RunFiles, protocol: str, sides: Sequence[str]) -> Table:
    """Return the errors of all models, the splits side by side for each quantity."""

    def cell(model: str, key: str, split: str) -> Cell:
        return _quantity(run, key, run.row(model, split, protocol))

    quantities = _quantities(run, "NRMSE, mean [-]")
    return table_of(
        run.kinds,
        [
            ("model", run.label),
            *(
                (split, lambda model, key=key, split=split: cell(model, key, split))
                for key in quantities
                for split in sides
            ),
        ],
        groups=[(title, len(sides)) for title in quantities.values()],
        selected=lambda model: model == run.selected,
    )


def errors_table(run: RunFiles, split: str) -> Table:
    """Return the errors of all models on one split under all protocols, for the terminal."""
    rows = [
        row
        for protocol in run.protocols
        for model in run.kinds
        if (row := run.row(model, split, protocol))
    ]

    def cell(row: Content, key: str) -> Cell:
        found = _quantity(run, key, row)
        # a terminal has no room for what stands in small print, but for what diverged
        note = diverged_note(row) if key == "nrmse" else ""
        return Cell(found.text, note, "" if key in run.channels else found.mark)

    return table_of(
        rows,
        [
            ("model", lambda row: run.label(row["model"])),
            ("protocol", "protocol"),
            *(
                (title, lambda row, key=key: cell(row, key))
                for key, title in _quantities(run).items()
            ),
        ],
        caption=f"Free-run errors on {split} data, mean over windows.",
        selected=lambda row: row["model"] == run.selected,
        rule=lambda row: row["protocol"],
    )


def by_manoeuvre(run: RunFiles, protocol: str, split: str) -> Table | None:
    """Return the errors of one split by kind of manoeuvre, None where there is a single kind."""
    kinds = distinct(run, split, protocol)
    if len(kinds) < 2:
        return None
    models = [model for model, role in run.kinds.items() if role != "zero"]
    rows = [row for kind in kinds for one in models if (row := run.row(one, split, protocol, kind))]

    def label(row: Content) -> str:
        # the kind stands once, before its first model
        first = f"{row['manoeuvre'].replace('_', ' ')}: " if row["model"] == models[0] else ""
        return first + run.label(row["model"])

    return table_of(
        rows,
        [
            ("manoeuvre, model", label),
            ("runs", "windows", str),
            *(
                (title, lambda row, key=key: _quantity(run, key, row))
                for key, title in _quantities(run).items()
            ),
        ],
        selected=lambda row: row["model"] == run.selected,
        rule=lambda row: row["manoeuvre"],
    )


def _quantity(run: RunFiles, key: str, row: Content | None) -> Cell:
    """Return what a row says of a quantity, and its change against the baseline's on its data."""
    if row is None:
        return Cell(DASH)
    if key == "diverged":
        return Cell(f"{row['diverged']}/{row['windows']}", mark="bad" if row["diverged"] else "")
    if key in run.ends:
        return Cell(number(run.end(key)[2] * row.get(f"{key}_error_end", math.nan), 2))
    lost = diverged_note(row)
    if key == "nrmse":
        interval = row.get("nrmse_mean_ci95")
        small = f"{number(interval[0])}–{number(interval[1])}" if interval else ""
        value, worse, factor = row["nrmse"]["mean"], False, 1.0
    else:
        value, factor = row["rmse"].get(key), run.unit(key)[1]
        if value is None:
            return Cell(DASH)
        where = (row["split"], row["protocol"], row.get("manoeuvre", "all"))
        own = run.kinds[row["model"]] in ("zero", "baseline")
        base = None if own else run.row(run.baseline, *where)
        worse = base is not None and value > 1.005 * base["rmse"][key]
        small = change(value, base["rmse"][key]) if base is not None else ""
    note = "; ".join(text for text in (small, lost) if text)
    si = f"{number(value)} {run.si(key)}" if factor != 1.0 else ""
    return Cell(number(factor * value), note, "bad" if worse or row["diverged"] else "", si)


def limits(run: RunFiles) -> Section | None:
    """Return for each protocol errors by manoeuvre and band, worst windows and what limits them.

    None where the selected model has no row.
    """
    lead = run.lead
    parts: list[Block] = []
    for protocol in run.protocols:
        row = run.row(lead, run.focus, protocol)
        if row is not None:
            known = (run.limits.get("splits") or {}).get(run.focus, {}).get(protocol, {})
            repeats = (run.limits.get("repeatability") or {}).get(protocol)
            blocks = [
                _where(run, lead, protocol, known),
                None if protocol == run.main else _worst(run, lead, known),
                Text(_repeatability(run, repeats)) if repeats else None,
            ]
            title = f"Protocol {protocol}" + ("" if parts else f", {run.focus} data")
            parts.append(Section(title, blocks, folded=bool(parts)))
    if not parts:
        return None
    notes = (
        "Intervals are percentiles of a block bootstrap. For few blocks they are widened as"
        " Student's t is. Change and difference are those of the mean NRMSE; negative is better. A"
        " bold interval excludes 0. Bands are thirds of the windows; bands of fewer than three"
        " windows are left out."
    )
    title = "How good, where it fails, what limits it"
    return Section(title, [*parts, Text(notes, quiet=True)])


def _where(run: RunFiles, lead: str, protocol: str, known: Content) -> Table:
    """Return the errors by kind of manoeuvre, speed and wind."""
    lines: list[Content] = []
    for kind in ["all", *distinct(run, run.focus, protocol)]:
        if row := run.row(lead, run.focus, protocol, kind):
            about = {"by": "kind", "label": kind.replace("_", " "), "windows": row["windows"]}
            apart = row.get("difference") or {}
            lines.append({**about, "value": row["nrmse"]["mean"], "apart": apart})
    for band in known.get("bands") or []:
        if found := band["models"].get(lead):
            label = f"{band['by']} {number(band['low'], 2)} to {number(band['high'], 2)} m/s"
            about = {"by": band["by"], "label": label, "windows": band["windows"]}
            apart = found["difference"] or {}
            lines.append({**about, "value": found["nrmse_mean"], "apart": apart})
    reference = next((line["apart"]["to"] for line in lines if line["apart"]), None)

    def ratio(line: Content) -> Cell:
        value = line["apart"].get("ratio")
        text = DASH if value is None else percent(100 * (value - 1))
        return bad_where(text, line["apart"].get("worse"))

    def less(line: Content) -> float:
        return float(line["value"] - line["apart"].get("nrmse_mean", math.nan))

    columns: list[Column] = [
        ("windows of", "label"),
        ("windows", "windows", str),
        (f"NRMSE of {lead}", "value", number),
    ]
    if reference:
        columns += [
            (f"NRMSE of {reference}", less, number),
            ("change", ratio),
            ("difference", "apart.nrmse_mean", lambda by: DASH if by is None else signed(by)),
            ("paired 95 % interval", lambda line: paired_interval(line["apart"].get("ci95"))),
        ]
    return table_of(lines, columns, rule=lambda line: line["by"])


def worst(run: RunFiles, figures: Sequence[Figure]) -> Section | None:
    """Return the worst free runs of the main protocol, and a figure to look into them with."""
    known = (run.limits.get("splits") or {}).get(run.focus, {}).get(run.main, {})
    shown = [block for block in (_worst(run, run.lead, known), *figures) if block is not None]
    return Section("Worst runs", shown) if shown else None


def _worst(run: RunFiles, lead: str, known: Content) -> Table | None:
    """Return the windows with the largest errors of a model, None where none are recorded."""
    entries = (known.get("worst") or {}).get(lead) or []
    if not entries:
        return None
    channels = [name for name in run.channels if name in entries[0]["rmse"]]
    first = run.ends[0]
    factor = run.end(first)[2]
    return table_of(
        entries,
        [
            (
                "worst windows",
                lambda entry: f"{entry['log']} ({entry['manoeuvre'].replace('_', ' ')})",
            ),
            ("log time at start [s]", "t", 1),
            ("NRMSE", "nrmse", number),
            *((_quantities(run)[c], f"rmse.{c}", number, run.unit(c)[1]) for c in channels),
            (_quantities(run)[first], lambda e: number(factor * e[f"{first}_error_end"], 2), str),
        ],
    )


def _repeatability(run: RunFiles, found: Content) -> str:
    tolerance = found["tolerance"]

    def told(values: Mapping[str, float], *digits: int) -> str:
        return ", ".join(
            f"{name} {number(run.unit(name)[1] * values[name], *digits)} {run.unit(name)[0]}"
            for name in tolerance["start"]
        )

    rule = (
        f"commands within {100 * tolerance['command_share_of_range']:.0f} % of their range (root"
        " mean square over the window) and initial velocities within"
        f" {told(tolerance['start'], 2)}"
    )
    where = "the logs evaluated here" if run.focus == "external" else "the logs of all splits"
    if not found["pairs"]:
        return (
            f"Repeatability: {where} hold no two stretches as long as a window with {rule}. How"
            " well the vessel repeats itself is not known."
        )
    share = 1 / math.sqrt(2)
    kinds = ", ".join(
        f"{name.replace('_', ' ')} {part['pairs']}" for name, part in found["manoeuvres"].items()
    )
    ends = listed([sized(end, found[end]) for end in run.ends if end in found])
    place = f" and {number(share * found['position'], 2)} m" if "position" in run.ends else ""
    exogenous = (run.resolved.get("signals") or {}).get("exogenous")
    wind = " A model that knows the wind, as these do, can do better." if exogenous else ""
    return (
        f"Repeatability: {plural(found['pairs'], 'pair')} of stretches ({kinds}) in"
        f" {found['logs']} of {where} have {rule}. Their measured motions differ by"
        f" {told(found)} (root"
        f" mean square), and by {ends} at the end. Each motion is off their mean by"
        f" 1/√2 of that: an NRMSE of {number(share * found['nrmse'])}{place}."
        " The remaining differences of commands and"
        " starts are part of it. A model that knows only commands and initial velocities is left"
        f" with an error of this order in such runs, whatever its form.{wind}"
    )


def bands(run: RunFiles) -> Section | None:
    """Return how wide bands are, what they held and what they do not promise; None without any."""
    models: Content = run.json("bands.json").get("models") or {}
    if not models:
        return None
    band = next(iter(next(iter(models.values())).values()))
    level = f"{100 * band['level']:.0f} %"
    about = [
        f"A band is to hold {level} of the errors of a free run on logs that nobody has seen. It"
        " grows with the horizon, and is wider where the predicted run is livelier or the models"
        " disagree. It was calibrated over logs that its model was not fitted on: training logs,"
        " predicted by models that leave them out, and validation logs that no fit has seen.",
        f"The tables say what the bands held of the {run.focus} data. Whole: share of the runs that"
        f" a band holds from beginning to end, each channel for itself, where it is widened to hold"
        f" {level} of them. Score: mean width, and {2 / (1 - band['level']):.0f} times what lies"
        " outside, in units of the error of zero; less is better. Beside it stands a band of one"
        " width at all horizons.",
    ]
    blocks: list[Block] = [Text(about)]
    if told := cautions(run, run.lead):
        blocks.append(Bullets(told, warning=True))
    for protocol in run.protocols:
        models_rows = [run.row(model, run.focus, protocol) for model in run.kinds]
        known = [row for row in models_rows if row and "band_coverage" in row]
        if not known:
            continue
        parts = [_coverage(known, "model", lambda row: run.label(row["model"]), run.selected)]
        of_kinds = [
            run.row(run.lead, run.focus, protocol, kind)
            for kind in distinct(run, run.focus, protocol)
        ]
        kinds = [row for row in of_kinds if row and "band_coverage" in row]
        if len(kinds) > 1:
            title = f"manoeuvre, {run.lead}"
            parts.append(_coverage(kinds, title, lambda row: row["manoeuvre"].replace("_", " ")))
        blocks.append(Section(f"Protocol {protocol}", parts, folded=protocol != run.protocols[0]))
    return Section("Bands", blocks)


def cautions(run: RunFiles, model: str) -> list[str]:
    """Return whole sentences about what the bands of a model do not promise."""
    known: Content = (run.json("bands.json").get("models") or {}).get(model) or {}
    windows = run.windows(run.focus) if known else []
    out: list[str] = []
    for protocol, band in known.items():
        out += [text for text in band["cautions"] if text not in out]
        lengths = [float(w.t[-1] - w.t[0]) for w in windows if w.protocol == protocol]
        longest = max(lengths, default=0.0)
        if longest > band["horizon"] + 1e-6:
            out.append(
                f"Runs of protocol {protocol} last up to {fixed(longest, 0)} s, and the band is"
                f" calibrated up to {fixed(band['horizon'], 0)} s only; beyond, it grows in"
                " proportion to time, without any promise."
            )
    return out


def _coverage(
    rows: Sequence[Content], title: str, label: Any, selected: str | None = None
) -> Table:
    def beside(row: Content, name: str) -> Cell:
        value, own = row.get(name), row["band_score"]
        note = percent(100 * (value / own - 1)) if value is not None and own > 0 else ""
        return Cell(number(value), note)

    shown = [name for name in rows[0]["band_coverage"] if name not in ("mean", "whole")]

    return table_of(
        rows,
        [
            (title, label),
            *((name, f"band_coverage.{name}", 2) for name in (*shown, "mean", "whole")),
            ("bands", "band_score", number),
            ("one width", lambda row: beside(row, "band_score_constant")),
        ],
        groups=[("coverage", len(shown) + 2), ("score", 2)],
        selected=lambda row: row["model"] == selected,
    )
