"""The data: what was fitted on what, what each log holds, and what would mislead a fit."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from residnet.core.format import DASH, DEG, minus, number
from residnet.report.blocks import (
    Block,
    Bullets,
    Cell,
    Column,
    Facts,
    Section,
    Table,
    Text,
    bad_where,
    table_of,
)
from residnet.report.run_reader import Content, RunFiles

_LEVELS = ("fatal", "will mislead")
"""Levels above a note, the worst first."""


def fitted_on_what(run: RunFiles) -> Section | None:
    """Return the section on the data, None where the folder says nothing about them."""
    baseline = run.resolved.get("baseline") or {}
    samples = run.fit(run.baseline or "baseline").get("samples")
    logs: dict[str, list[Content]] = {}
    for entry in run.quality:
        logs.setdefault(entry["split"], []).append(entry)
    splits = [
        f"{split} {len(members)} logs, {sum(log['seconds'] for log in members) / 60:.1f} min"
        for split, members in logs.items()
    ]
    scales = [
        f"{name} {number(run.unit(name)[1] * value)} {run.unit(name)[0]}"
        for name, value in (run.metrics.get("scales") or {}).items()
    ]
    signals = run.resolved.get("signals") or {}
    forces = signals.get("forces")
    thrusters = f"the thrusters of {forces}" if isinstance(forces, str) else "given thrusters"
    inputs = (
        ", ".join(signals.get("inputs") or []),
        "exogenous: " + ", ".join(signals["exogenous"]) if signals.get("exogenous") else "",
        f"forces from {thrusters}" if forces else "",
    )
    fit = f", fitted on {samples} samples" if samples else ""
    facts = {
        "data": _data(run),
        "splits": "; ".join(splits),
        "inputs": "; ".join(filter(None, inputs)),
        "velocities": run.live.text,
        **_model(run),
        "baseline": str(baseline.get("kind", "")) + fit if baseline else "",
        **{
            f"protocol {name}": _protocol(protocol)
            + ("; selects the model" if name == run.evaluation.get("selection") else "")
            for name, protocol in (run.evaluation.get("protocols") or {}).items()
        },
        "NRMSE divides by": ", ".join(scales),
    }
    known = [(name, text) for name, text in facts.items() if text]
    blocks: list[Block] = [Facts(known)] if known else []
    if run.quality:
        short, full = quality_tables(run)
        short.caption = (
            "Scored: share of the samples on which u and v are compared. Learned from: share on"
            " which smoothed states and accelerations are defined."
        )
        blocks += [Section("Data quality", [short, Section("Log by log", [full], folded=True)])]
    if found := run.json("currents.json"):
        blocks.append(Section("Currents", [_currents(run, found)], folded=True))
    return Section("What was fitted on what", blocks) if blocks else None


def _currents(run: RunFiles, found: Any) -> Table:
    """Return the estimated current of each log, in the unit of speeds."""
    unit, factor = run.unit("u")

    def component(row: Content, key: str, place: int) -> Cell:
        error = number(factor * row["standard_error"][place], 2)
        return Cell(f"{number(factor * row[key], 2)} ± {error}")

    return table_of(
        found,
        [
            ("log", lambda row: row["log"]),
            (f"north [{unit}]", lambda row: component(row, "current_north", 0)),
            (f"east [{unit}]", lambda row: component(row, "current_east", 1)),
            ("coefficients", lambda row: "fitted with it" if row["fitted"] else "of other logs"),
        ],
        caption="Every log ran in a constant current of its own, which was estimated, with one"
        " standard error: as far as the two halves of a log agree. Errors of this page are those of"
        " the motion through the water.",
    )


def _data(run: RunFiles) -> str:
    data = run.resolved.get("data") or {}
    if not data:
        return ""
    if data.get("kind") != "simulated":
        return (
            f"measured logs ({(data.get('reader') or {}).get('kind', 'files')}),"
            f" {len(run.provenance.get('inputs') or {})} files"
        )
    text = f"simulated sea trials of vessel {data.get('vessel')}"
    noise = data.get("noise") or {}
    if noise:
        text += (
            f", noise u {number(noise.get('u'), 2)} m/s, v {number(noise.get('v'), 2)} m/s, r"
            f" {number(DEG * noise.get('r', 0), 2)} deg/s"
        )
    return text + f"; data seed {data.get('seed')}"


def _model(run: RunFiles) -> dict[str, str]:
    card = run.card(run.baseline or "baseline")
    if not card:
        return {}
    signals = card.get("signals") or {}
    names = [*run.live.moving, *(signals.get("inputs") or []), *(signals.get("exogenous") or [])]
    ranges = []
    for name, low, high in zip(names, card["low"], card["high"], strict=False):
        if name in run.live.dead:
            continue
        unit, factor = run.unit(name)
        ranges.append(
            f"{name} {number(factor * low)} to {number(factor * high)} {unit}".removesuffix(" -")
        )
    return {
        "model step": f"{card['dt']:g} s, {card['integrator']}; inputs held over a step",
        "training range": "; ".join(ranges),
    }


def _protocol(protocol: Content) -> str:
    if protocol.get("kind") == "windows":
        return (
            f"back-to-back windows of {protocol['length']:g} s, the first from"
            f" {protocol.get('first', 0):g} s on, each from the measured state"
        )
    if protocol.get("kind") == "manoeuvre":
        return (
            "whole manoeuvres; they start from the mean velocities of the first"
            f" {protocol['initial']:g} s and are scored after them"
        )
    return str(protocol.get("kind", "not described"))


def quality_tables(run: RunFiles) -> tuple[Table, Table]:
    """Return what the logs hold: by split and kind of manoeuvre, and log by log."""
    groups: dict[tuple[str, str], list[Content]] = {}
    for entry in run.quality:
        groups.setdefault((entry["split"], entry.get("manoeuvre") or DASH), []).append(entry)

    def label(members: Sequence[Content]) -> str:
        return f"{members[0]['split']}: {(members[0].get('manoeuvre') or DASH).replace('_', ' ')}"

    columns: list[Column] = [
        ("seconds", lambda logs: f"{sum(log['seconds'] for log in logs):.0f}", str),
        ("samples", lambda logs: sum(log["samples"] for log in logs), str),
        ("scored [%]", lambda logs: _mean(logs, "usable"), number),
        ("learned from [%]", lambda logs: _mean(logs, "learned_from"), number),
        ("masked", _masked),
        *(
            (
                f"largest |{name}| [{unit}]",
                lambda logs, name=name: _largest(logs, name),
                number,
                factor,
            )
            for name in run.live.channels
            for unit, factor in [run.unit(name)]
        ),
    ]
    short: list[Column] = [("split, manoeuvre", label), ("logs", len, str), *columns]
    return (
        table_of(groups.values(), short, rule=lambda logs: logs[0]["split"]),
        table_of([[log] for log in run.quality], [("log", lambda logs: logs[0]["log"]), *columns]),
    )


def _mean(logs: Sequence[Content], key: str) -> float:
    samples = sum(log["samples"] for log in logs)
    return float(100 * sum(log[key] * log["samples"] for log in logs) / samples)


def _largest(logs: Sequence[Content], channel: str) -> float:
    return float(max((log.get("largest") or {}).get(channel, math.nan) for log in logs))


def _masked(logs: Sequence[Content]) -> str:
    samples = sum(log["samples"] for log in logs)
    masked: dict[str, float] = {}
    for log in logs:
        for reason, share in (log.get("masked") or {}).items():
            masked[reason] = masked.get(reason, 0.0) + share * log["samples"] / samples
    shown = ", ".join(f"{reason} {100 * share:.2g} %" for reason, share in masked.items())
    return shown or "nothing"


def doctor(run: RunFiles) -> Section | None:
    """Return the findings by kind and the notes by log, None where the run has no doctor.json."""
    inspection = run.json("doctor.json")
    logs = inspection.get("logs") or []
    if not logs:
        return None
    findings = [(str(log["name"]), finding) for log in logs for finding in log["findings"]]
    findings += [("together", finding) for finding in inspection.get("together") or []]
    severe = [(name, finding) for name, finding in findings if finding["level"] != "note"]
    beyond = "What the masks of this run leave out does not count."
    if severe:
        misled = len({name for name, _ in severe} - {"together"})
        held = "log holds" if len(logs) == 1 else "logs hold"
        about = f"{misled} of {len(logs)} {held} something that would mislead a fit. {beyond}"
    else:
        count = "the log" if len(logs) == 1 else f"the {len(logs)} logs"
        about = f"Nothing in {count} would mislead a fit. {beyond}"
    blocks: list[Block] = [Text(about)]
    if severe:
        # one row for each kind of finding, the worst first
        kinds: dict[tuple[int, str], list[tuple[str, Content]]] = {}
        for name, finding in severe:
            key = (_LEVELS.index(finding["level"]), str(finding["code"]))
            kinds.setdefault(key, []).append((name, finding))
        columns: list[Column] = [
            ("finding", lambda row: row[0][1].replace("_", " ")),
            ("level", lambda row: bad_where(_LEVELS[row[0][0]], row[0][0] == 0)),
            ("logs", lambda row: len({name for name, _ in row[1]}), str),
            ("for example", lambda row: Cell(minus(row[1][0][1]["text"]), row[1][0][0], "text")),
            ("what to do", lambda row: row[1][0][1]["action"]),
        ]
        blocks.append(table_of(sorted(kinds.items(), key=lambda row: row[0]), columns))
    notes: dict[str, list[str]] = {}
    for name, finding in findings:
        if finding["level"] == "note":
            action = f"; {finding['action']}" if finding["action"] else ""
            notes.setdefault(name, []).append(minus(f"{finding['text']}{action}"))
    if notes:
        by_log = [Section(name, [Bullets(texts)]) for name, texts in notes.items()]
        blocks.append(Section("Notes, log by log", by_log, folded=True))
    return Section("Data doctor", blocks)
