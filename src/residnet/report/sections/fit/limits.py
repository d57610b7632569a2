"""How good the selected model is, where it fails, and what limits it."""

from __future__ import annotations

import math
from collections.abc import Mapping

from residnet.judge.verdict.sentences import diverged_note
from residnet.report.blocks import Block, Cell, Section, Table, Text
from residnet.report.format import DASH, DEG, fixed, number, percent, plural, signed, title_of
from residnet.report.run_reader import Content, RunFiles
from residnet.report.sections.fit.manoeuvres import distinct

_DRAWN = {
    "logs": "whole logs",
    "windows": "runs of consecutive windows, since there are too few logs to draw whole ones",
}
"""What the blocks of the bootstrap are."""


def section(run: RunFiles) -> Section | None:
    """Return for each protocol errors by manoeuvre and band, worst windows and what limits them.

    None where the selected model has no row.
    """
    lead = run.selected or (run.heads[0] if run.heads else run.baseline)
    parts: list[Block] = []
    for protocol in run.protocols:
        row = run.row(lead, run.focus, protocol)
        if lead is not None and row is not None:
            parts.append(_protocol(run, lead, row, protocol, folded=bool(parts)))
    if not parts:
        return None
    notes = (
        "Intervals are percentiles of a block bootstrap. For few blocks they are widened as"
        " Student's t is. Change and difference are those of the mean NRMSE; negative is better. A"
        " bold interval excludes zero. Bands are thirds of the windows; bands of fewer than three"
        " windows are left out."
    )
    title = "How good, where it fails, what limits it"
    return Section(title, [*parts, Text(notes, quiet=True)])


def _protocol(run: RunFiles, lead: str, row: Content, protocol: str, *, folded: bool) -> Section:
    known = _known(run, protocol)
    title = f"Protocol {protocol}" + ("" if folded else f", {run.focus} data")
    return Section(
        title,
        [
            Text(_how_good(lead, row)),
            _where(run, lead, protocol, known),
            _worst(run, lead, known),
            Text(_limits(run, lead, row, protocol, known)),
        ],
        folded=folded,
    )


def _known(run: RunFiles, protocol: str) -> Content:
    """Return what limits.json says of the focus split and a protocol."""
    found: Content = (run.limits.get("splits") or {}).get(run.focus, {}).get(protocol, {})
    return found


def _how_good(lead: str, row: Content) -> str:
    drawn = row.get("ci95_blocks")
    text = f"{lead}: NRMSE {number(row['nrmse']['mean'])}"
    if row["diverged"]:
        text += f" ({diverged_note(row)})"
    interval = row.get("nrmse_mean_ci95")
    if interval:
        text += f", 95 % interval {number(interval[0])} to {number(interval[1])}"
    if drawn:
        text += f" (bootstrap of {drawn['count']} blocks: {_DRAWN[drawn['of']]})"
    elif "ci95_blocks" in row:
        text += "; too few logs for an interval"
    return f"{text}. {against(lead, row.get('difference'))}".strip()


def against(lead: str, difference: Content | None) -> str:
    """Return a paired difference as a sentence, empty where there is none."""
    if not difference:
        return ""
    value, interval = difference["nrmse_mean"], difference["ci95"]
    text = f"Against {difference['to']} over the same windows: {signed(value)}"
    if difference["ratio"] is not None:
        text += f" ({percent(100 * (difference['ratio'] - 1))})"
    if interval is None:
        return text + "; too few logs for an interval of the difference."
    text += f", paired 95 % interval {signed(interval[0])} to {signed(interval[1])}"
    if not difference["excludes_zero"]:
        return text + ". The interval holds zero: these data cannot tell the two apart."
    return text + f". The interval excludes zero: {lead} is {'better' if value < 0 else 'WORSE'}."


def _where(run: RunFiles, lead: str, protocol: str, known: Content) -> Table | None:
    """Return the errors by kind of manoeuvre, speed and wind, None where there is a single row."""
    lines: list[tuple[str, str, int, float, Content | None]] = []
    for kind in ["all", *distinct(run, run.manoeuvres(run.focus, protocol), run.focus, protocol)]:
        row = run.row(lead, run.focus, protocol, kind)
        if row is not None:
            mean = row["nrmse"]["mean"]
            label = kind.replace("_", " ")
            lines.append(("kind", label, row["windows"], mean, row.get("difference")))
    for band in known.get("bands") or []:
        found = band["models"].get(lead)
        if found is not None:
            label = f"{band['by']} {number(band['low'], 2)} to {number(band['high'], 2)} m/s"
            error = (found["nrmse_mean"], found["difference"])
            lines.append((band["by"], label, band["windows"], *error))
    if len(lines) < 2:
        return None
    reference = next((difference["to"] for *_, difference in lines if difference), None)
    paired = [f"NRMSE of {reference}", "change", "difference", "paired 95 % interval"]
    table = Table(["windows of", "windows", f"NRMSE of {lead}", *(paired if reference else [])])
    group = ""
    for by, label, windows, value, difference in lines:
        cells = [
            Cell(str(windows)),
            Cell(number(value)),
            *(_paired(value, difference) if reference else []),
        ]
        table.add(label, cells, rule=by != group)
        group = by
    return table


def _paired(value: float, difference: Content | None) -> list[Cell]:
    if difference is None:
        return [Cell(DASH)] * 4
    interval, ratio = difference["ci95"], difference["ratio"]
    change = (
        Cell(percent(100 * (ratio - 1)), mark="bad" if difference["worse"] else "")
        if ratio is not None
        else Cell(DASH)
    )
    span = (
        Cell(
            f"{signed(interval[0])} to {signed(interval[1])}",
            mark="best" if difference["excludes_zero"] else "",
        )
        if interval
        else Cell(DASH)
    )
    return [
        Cell(number(value - difference["nrmse_mean"])),
        change,
        Cell(signed(difference["nrmse_mean"])),
        span,
    ]


def _worst(run: RunFiles, lead: str, known: Content) -> Table | None:
    """Return the windows with the largest errors of a model, None where none are recorded."""
    entries = (known.get("worst") or {}).get(lead) or []
    if not entries:
        return None
    channels = [name for name in run.channels if name in entries[0]["rmse"]]
    table = Table(
        [
            "worst windows",
            "log time at start [s]",
            "NRMSE",
            *(f"{title_of(name)} [{run.unit(name)[0]}]" for name in channels),
            "position, end [m]",
        ]
    )
    for entry in entries:
        cells = [
            fixed(entry["t"], 1),
            number(entry["nrmse"]),
            *(number(run.unit(name)[1] * entry["rmse"][name]) for name in channels),
            number(entry["position_error_end"], 2),
        ]
        table.add(f"{entry['log']} ({entry['manoeuvre'].replace('_', ' ')})", cells)
    return table


def _limits(run: RunFiles, lead: str, row: Content, protocol: str, known: Content) -> list[str]:
    out = []
    if kinematics := known.get("kinematics"):
        out.append(_consistency(lead, row, kinematics))
    repeats = (run.limits.get("repeatability") or {}).get(protocol)
    if repeats:
        out.append(_repeatability(run, repeats))
    return out


def _consistency(lead: str, row: Content, found: Mapping[str, float]) -> str:
    return (
        "Consistency of the measured channels: the measured velocities, integrated over each window"
        f" from its measured pose, end {number(found['position_mean'], 2)} m and"
        f" {number(DEG * found['heading_mean'], 2)} deg from the measured pose on average (root"
        f" mean square {number(found['position_rms'], 2)} m,"
        f" {number(DEG * found['heading_rms'], 2)} deg). A model that predicted the measured"
        f" velocities exactly would be off by as much; {lead} is off by"
        f" {number(row['position_error_end'], 2)} m and {number(DEG * row['heading_error_end'], 2)}"
        " deg."
    )


def _repeatability(run: RunFiles, found: Content) -> str:
    tolerance = found["tolerance"]
    start = ", ".join(
        f"{name} {number(run.unit(name)[1] * value, 2)} {run.unit(name)[0]}"
        for name, value in tolerance["start"].items()
    )
    rule = (
        f"commands within {100 * tolerance['command_share_of_range']:.0f} % of their range (root"
        f" mean square over the window) and initial velocities within {start}"
    )
    where = "the logs evaluated here" if run.focus == "external" else "the logs of all splits"
    if not found["pairs"]:
        return (
            f"Repeatability: {where} hold no two stretches as long as a window with {rule}. How"
            " well the vessel repeats itself is not known."
        )
    share = 1 / math.sqrt(2)
    apart = ", ".join(
        f"{name} {number(run.unit(name)[1] * found[name])} {run.unit(name)[0]}"
        for name in tolerance["start"]
    )
    kinds = ", ".join(
        f"{name.replace('_', ' ')} {part['pairs']}" for name, part in found["manoeuvres"].items()
    )
    exogenous = (run.resolved.get("signals") or {}).get("exogenous")
    wind = " A model that knows the wind, as these do, can do better." if exogenous else ""
    return (
        f"Repeatability: {plural(found['pairs'], 'pair')} of stretches ({kinds}) in"
        f" {found['logs']} of {where} have {rule}. Their measured motions differ by {apart} (root"
        f" mean square), and by {number(found['position'], 2)} m and"
        f" {number(DEG * found['heading'], 2)} deg at the end. Each motion is off their mean by"
        f" 1/√2 of that: an NRMSE of {number(share * found['nrmse'])} and"
        f" {number(share * found['position'], 2)} m. The remaining differences of commands and"
        " starts are part of it. A model that knows only commands and initial velocities is left"
        f" with an error of this order in such runs, whatever its form.{wind}"
    )
