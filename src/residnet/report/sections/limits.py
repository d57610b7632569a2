"""The report's section on the model that was chosen: how good it is, where it fails, what limits
it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from residnet.report.run_reader import Row, RunFiles
from residnet.report.tables import DEG, Cell, Table, distinct, number, percent, title_of, unit_of


def section(run: RunFiles) -> list[dict[str, Any]]:
    """For each protocol: name, first, sentences, `table` by manoeuvre and band, `worst` windows,
    what `limits`; empty where nothing is known.
    """
    lead = run.selected or (run.heads[0] if run.heads else run.baseline)
    out: list[dict[str, Any]] = []
    for name in run.protocols:
        row = run.row(lead, run.focus, name)
        if lead is None or row is None:
            continue
        known = _known(run, name)
        entry = {
            "name": name,
            "first": not out,
            "sentences": _good(lead, row),
            "table": _where(run, lead, name, known),
        }
        entry |= {"worst": _worst(run, lead, known), "limits": _limits(run, lead, row, name, known)}
        out.append(entry)
    return out


def _known(run: RunFiles, protocol: str) -> Row:
    """What limits.json says of the focus split and a protocol."""
    found: Row = (run.limits.get("splits") or {}).get(run.focus, {}).get(protocol, {})
    return found


def _good(lead: str, row: Row) -> list[str]:
    drawn = row.get("ci95_blocks")
    text = f"{lead}: NRMSE {number(row['nrmse']['mean'])}"
    interval = row.get("nrmse_mean_ci95")
    if interval:
        text += f", 95 % interval {number(interval[0])} to {number(interval[1])}"
    if drawn:
        what = {
            "logs": "whole logs",
            "windows": "runs of consecutive windows, of too few logs to draw these whole",
        }[drawn["of"]]
        text += f" (bootstrap of {drawn['count']} blocks: {what})"
    elif "ci95_blocks" in row:
        text += "; too few logs for an interval"
    return [text + ".", against(row.get("difference"))]


def against(difference: Row | None) -> str:
    """A paired difference in a sentence; empty where there is none."""
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
        return text + ": these data do not tell the two apart."
    return text + (", without zero: better." if value < 0 else ", without zero: WORSE.")


def signed(value: float) -> str:
    """A difference of NRMSE with its sign."""
    return "0" if abs(value) < 5e-5 else f"{value:+.4f}".replace("-", "−")


def _where(run: RunFiles, lead: str, protocol: str, known: Row) -> Table | None:
    """By kind of manoeuvre, speed and wind; None where there is only one line."""
    lines: list[tuple[str, int, float, Row | None]] = []
    for kind in ["all", *distinct(run, run.manoeuvres(run.focus, protocol), run.focus, protocol)]:
        row = run.row(lead, run.focus, protocol, kind)
        if row is not None:
            lines.append(
                (
                    f"{kind.replace('_', ' ')}",
                    row["windows"],
                    row["nrmse"]["mean"],
                    row.get("difference"),
                )
            )
    for band in known.get("bands") or []:
        own = band["models"].get(lead)
        if own is not None:
            label = f"{band['by']} {number(band['low'], 2)} to {number(band['high'], 2)} m/s"
            lines.append((label, band["windows"], own["nrmse_mean"], own["difference"]))
    if len(lines) < 2:
        return None
    to = next((difference["to"] for *_, difference in lines if difference), None)
    heads = [
        "windows",
        f"NRMSE of {lead}",
        *([f"NRMSE of {to}", "change", "difference", "paired 95 % interval"] if to else []),
    ]
    table = Table(heads=heads, corner="windows of")
    last = ""
    for label, windows, value, difference in lines:
        cells = [
            Cell(str(windows)),
            Cell(number(value)),
            *(_paired(value, difference) if to else []),
        ]
        group = label.split()[0] if label.endswith("m/s") else "kind"
        if group != last:
            cells = [Cell(cell.text, cell.note, (cell.mark + " first").strip()) for cell in cells]
        table.rows.append((label, cells))
        last = group
    return table


def _paired(value: float, difference: Row | None) -> list[Cell]:
    if difference is None:
        return [Cell("–")] * 4
    interval, ratio = difference["ci95"], difference["ratio"]
    change = (
        Cell(percent(100 * (ratio - 1)), mark="bad" if difference["worse"] else "")
        if ratio is not None
        else Cell("–")
    )
    span = (
        Cell(
            f"{signed(interval[0])} to {signed(interval[1])}",
            mark="best" if difference["excludes_zero"] else "",
        )
        if interval
        else Cell("–")
    )
    return [
        Cell(number(value - difference["nrmse_mean"])),
        change,
        Cell(signed(difference["nrmse_mean"])),
        span,
    ]


def _worst(run: RunFiles, lead: str, known: Row) -> Table | None:
    """The worst windows of a model."""
    entries = (known.get("worst") or {}).get(lead) or []
    if not entries:
        return None
    channels = [name for name in run.channels if name in entries[0]["rmse"]]
    heads = [
        "starts at, log's clock [s]",
        "NRMSE",
        *(f"{title_of(name)} [{unit_of(run, name)[0]}]" for name in channels),
        "position, end [m]",
    ]
    table = Table(heads=heads, corner="worst windows")
    for entry in entries:
        errors = [Cell(number(unit_of(run, name)[1] * entry["rmse"][name])) for name in channels]
        cells = [
            Cell(f"{entry['t']:.1f}"),
            Cell(number(entry["nrmse"])),
            *errors,
            Cell(number(entry["position_error_end"], 2)),
        ]
        table.rows.append((f"{entry['log']} ({entry['manoeuvre'].replace('_', ' ')})", cells))
    return table


def _limits(run: RunFiles, lead: str, row: Row, protocol: str, known: Row) -> list[str]:
    out = []
    if kinematics := known.get("kinematics"):
        out.append(_consistency(lead, row, kinematics))
    repeats = (run.limits.get("repeatability") or {}).get(protocol)
    if repeats:
        out.append(_repeats(run, repeats))
    return out


def _consistency(lead: str, row: Row, found: Mapping[str, float]) -> str:
    return (
        "Consistency of the measured channels: measured velocities, integrated over each window"
        f" from its measured pose, end {number(found['position_mean'], 2)} m and"
        f" {number(DEG * found['heading_mean'], 2)} deg from the measured pose on average (root"
        f" mean square {number(found['position_rms'], 2)} m,"
        f" {number(DEG * found['heading_rms'], 2)} deg). A model that predicted the measured"
        f" velocities exactly would be off by as much; {lead} is off by"
        f" {number(row['position_error_end'], 2)} m and {number(DEG * row['heading_error_end'], 2)}"
        " deg."
    )


def _repeats(run: RunFiles, found: Row) -> str:
    tolerance = found["tolerance"]
    start = ", ".join(
        f"{name} {number(unit_of(run, name)[1] * value, 2)} {unit_of(run, name)[0]}"
        for name, value in tolerance["start"].items()
    )
    rule = (
        f"commands within {100 * tolerance['command_share_of_range']:.0f} % of their range (root"
        f" mean square over the window) and initial velocities within {start}"
    )
    where = "the logs evaluated here" if run.focus == "external" else "the logs of all splits"
    if not found["pairs"]:
        return (
            f"Repeatability: {where} hold no two stretches as long as a window with {rule}; how"
            " well the vessel repeats itself is not known."
        )
    share = 1 / math.sqrt(2)
    apart = ", ".join(
        f"{name} {number(unit_of(run, name)[1] * found[name])} {unit_of(run, name)[0]}"
        for name in tolerance["start"]
    )
    kinds = ", ".join(
        f"{name.replace('_', ' ')} {part['pairs']}" for name, part in found["manoeuvres"].items()
    )
    exogenous = (run.resolved.get("signals") or {}).get("exogenous")
    told = " One that is told the wind, as the models here are, can do better." if exogenous else ""
    return (
        f"Repeatability: {found['pairs']} pair{'s' if found['pairs'] > 1 else ''} of stretches"
        f" ({kinds}) in {found['logs']} of {where} have {rule}. Their measured motions differ by"
        f" {apart} (root mean square), {number(found['position'], 2)} m and"
        f" {number(DEG * found['heading'], 2)} deg at the end; each is so off what they share by"
        f" 1/√2 of that, an NRMSE of {number(share * found['nrmse'])} and"
        f" {number(share * found['position'], 2)} m; what is left of unlike commands and starts is"
        " in it. An error of this order is left to a model that knows only commands and initial"
        f" velocities in such runs, whatever its form.{told}"
    )
