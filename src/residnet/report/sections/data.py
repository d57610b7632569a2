"""Section on the data: split, contents of each log and findings of the data checks."""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence
from typing import Any

from residnet.core.format import DASH, DEGREES_PER_RADIAN, format_minus_signs, format_number
from residnet.report.blocks import (
    Block,
    Bullets,
    Cell,
    Column,
    Facts,
    Section,
    Table,
    Text,
    build_table,
    flag_cell,
)
from residnet.report.run_reader import JsonObject, RunFiles

_SEVERE_LEVELS = ("fatal", "will mislead")
"""Levels above a note, the worst first."""


def fit_data_section(run: RunFiles) -> Section | None:
    """Return the section on the data, None where the folder says nothing about them."""
    baseline = run.resolved_config.get("baseline") or {}
    samples = run.fit_notes(run.baseline or "baseline").get("samples")
    logs: dict[str, list[JsonObject]] = {}
    for entry in run.quality:
        logs.setdefault(entry["split"], []).append(entry)
    split_texts = [
        f"{split} {len(members)} logs, {sum(log['seconds'] for log in members) / 60:.1f} min"
        for split, members in logs.items()
    ]
    scale_texts = [
        f"{name} {format_number(run.display_unit(name)[1] * value)} {run.display_unit(name)[0]}"
        for name, value in (run.metrics.get("scales") or {}).items()
    ]
    signals = run.resolved_config.get("signals") or {}
    forces = signals.get("forces")
    thrusters = f"the thrusters of {forces}" if isinstance(forces, str) else "given thrusters"
    input_texts = (
        ", ".join(signals.get("inputs") or []),
        "exogenous: " + ", ".join(signals["exogenous"]) if signals.get("exogenous") else "",
        f"forces from {thrusters}" if forces else "",
    )
    fit_text = f", fitted on {samples} samples" if samples else ""
    facts = {
        "data": _data_text(run),
        "splits": "; ".join(split_texts),
        "inputs": "; ".join(filter(None, input_texts)),
        "velocities": run.dof.description,
        **_model_facts(run),
        "baseline": str(baseline.get("kind", "")) + fit_text if baseline else "",
        **{
            f"protocol {name}": _protocol_text(protocol)
            + ("; selects the model" if name == run.evaluation.get("selection") else "")
            for name, protocol in (run.evaluation.get("protocols") or {}).items()
        },
        "NRMSE divides by": ", ".join(scale_texts),
    }
    stated_facts = [(name, text) for name, text in facts.items() if text]
    blocks: list[Block] = [Facts(stated_facts)] if stated_facts else []
    if run.quality:
        summary_table, log_table = quality_tables(run)
        summary_table.caption = (
            "Scored: share of the samples on which u and v are compared. Learned from: share on"
            " which smoothed states and accelerations are defined."
        )
        blocks += [
            Section(
                "Data quality", [summary_table, Section("Log by log", [log_table], is_folded=True)]
            )
        ]
    if compatibility := run.read_json("compatibility.json"):
        blocks.append(Section("Instrument errors", compatibility_tables(compatibility)))
    if currents := run.read_json("currents.json"):
        blocks.append(Section("Currents", [_currents_table(run, currents)], is_folded=True))
    return Section("What was fitted on what", blocks) if blocks else None


def _currents_table(run: RunFiles, currents: Any) -> Table:
    """Return the estimated current of each log, in the unit of speeds."""
    unit, factor = run.display_unit("u")

    def component(row: JsonObject, key: str, index: int) -> Cell:
        error = format_number(factor * row["standard_error"][index], 2)
        return Cell(f"{format_number(factor * row[key], 2)} ± {error}")

    return build_table(
        currents,
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


def compatibility_tables(rows: Sequence[JsonObject]) -> list[Block]:
    """Return the instrument errors over all logs, and the meaning of the velocities of each log.

    Args:
        rows: content of compatibility.json.
    """
    errors: dict[str, list[JsonObject]] = {}
    for row in rows:
        for error in row["errors"]:
            errors.setdefault(error["name"], []).append(error)

    def median(members: Sequence[JsonObject], key: str) -> float:
        return statistics.median(float(error[key]) for error in members)

    def scale_text(members: Sequence[JsonObject], key: str) -> str:
        unit = members[0]["unit"]
        factor = DEGREES_PER_RADIAN if unit.startswith("rad") else 1.0
        text = format_number(factor * median(members, key), 2)
        return text if unit == "-" else f"{text} {unit.replace('rad', 'deg')}"

    def source(members: Sequence[JsonObject]) -> str:
        n_determined = sum(bool(error["is_determined"]) for error in members)
        return "sensors" if 2 * n_determined > len(members) else "smoothness only"

    def count_significant(members: Sequence[JsonObject]) -> str:
        return f"{sum(bool(e['is_significant']) for e in members)} of {len(members)}"

    error_table = build_table(
        errors.values(),
        [
            ("instrument error", lambda members: members[0]["name"]),
            ("median estimate", lambda members: scale_text(members, "value")),
            ("median standard error", lambda members: scale_text(members, "standard_error")),
            ("determined by", source),
            ("logs where significant", count_significant),
        ],
        caption="Errors of the instruments, estimated from the kinematics alone. A clock is the"
        " time to add to that of the sensor. An error that only the smoothness of the motion"
        " determines is no finding.",
    )

    def current_text(row: JsonObject) -> str:
        current = row.get("current")
        if not current:
            return DASH
        size = math.hypot(current["north"], current["east"])
        verdict = "significant" if current["is_significant"] else "not significant"
        error = format_number(current["standard_error"], 2)
        p_value = format_number(current["p_value"], 1)
        return f"{format_number(size, 2)} ± {error} m/s, p = {p_value}, {verdict}"

    log_table = build_table(
        rows,
        [
            ("log", lambda row: row["log"]),
            ("velocities", lambda row: row["meaning"] or row["reason"] or "not measured"),
            ("runner-up", lambda row: row["runner_up"] or DASH),
            (
                "margin (BIC)",
                lambda row: format_number(row["margin"], 3) if row["meaning"] else DASH,
            ),
            ("current (likelihood-ratio test)", current_text),
        ],
    )
    return [*([error_table] if errors else []), log_table]


def _data_text(run: RunFiles) -> str:
    data = run.resolved_config.get("data") or {}
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
            f", noise u {format_number(noise.get('u'), 2)} m/s, v"
            f" {format_number(noise.get('v'), 2)} m/s, r"
            f" {format_number(DEGREES_PER_RADIAN * noise.get('r', 0), 2)} deg/s"
        )
    return text + f"; data seed {data.get('seed')}"


def _model_facts(run: RunFiles) -> dict[str, str]:
    card = run.model_card(run.baseline or "baseline")
    if not card:
        return {}
    signals = card.get("signals") or {}
    names = [
        *run.dof.dynamic_states,
        *(signals.get("inputs") or []),
        *(signals.get("exogenous") or []),
    ]
    ranges = []
    for name, lower, upper in zip(names, card["low"], card["high"], strict=False):
        if name in run.dof.fixed_states:
            continue
        unit, factor = run.display_unit(name)
        range_text = f"{name} {format_number(factor * lower)} to {format_number(factor * upper)}"
        # dimensionless channels have the unit "-"
        ranges.append(range_text if unit == "-" else f"{range_text} {unit}")
    return {
        "model step": f"{card['dt']:g} s, {card['integrator']}; inputs held over a step",
        "training range": "; ".join(ranges),
    }


def _protocol_text(protocol: JsonObject) -> str:
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
    """Return the contents of the logs by split and kind of manoeuvre, and for each log."""
    groups: dict[tuple[str, str], list[JsonObject]] = {}
    for entry in run.quality:
        groups.setdefault((entry["split"], entry.get("manoeuvre") or DASH), []).append(entry)

    def label(members: Sequence[JsonObject]) -> str:
        return f"{members[0]['split']}: {(members[0].get('manoeuvre') or DASH).replace('_', ' ')}"

    columns: list[Column] = [
        ("seconds", lambda logs: f"{sum(log['seconds'] for log in logs):.0f}", str),
        ("samples", lambda logs: sum(log["samples"] for log in logs), str),
        ("scored [%]", lambda logs: _mean_percentage(logs, "usable"), format_number),
        ("learned from [%]", lambda logs: _mean_percentage(logs, "learned_from"), format_number),
        ("masked", _masked_text),
        *(
            (
                f"largest |{name}| [{unit}]",
                lambda logs, name=name: _largest_value(logs, name),
                format_number,
                factor,
            )
            for name in run.dof.active_states
            for unit, factor in [run.display_unit(name)]
        ),
    ]
    summary_columns: list[Column] = [("split, manoeuvre", label), ("logs", len, str), *columns]
    return (
        build_table(groups.values(), summary_columns, group_key=lambda logs: logs[0]["split"]),
        build_table(
            [[log] for log in run.quality], [("log", lambda logs: logs[0]["log"]), *columns]
        ),
    )


def _mean_percentage(logs: Sequence[JsonObject], key: str) -> float:
    samples = sum(log["samples"] for log in logs)
    return float(100 * sum(log[key] * log["samples"] for log in logs) / samples)


def _largest_value(logs: Sequence[JsonObject], channel: str) -> float:
    return float(max((log.get("largest") or {}).get(channel, math.nan) for log in logs))


def _masked_text(logs: Sequence[JsonObject]) -> str:
    samples = sum(log["samples"] for log in logs)
    masked_shares: dict[str, float] = {}
    for log in logs:
        for reason, share in (log.get("masked") or {}).items():
            masked_shares[reason] = (
                masked_shares.get(reason, 0.0) + share * log["samples"] / samples
            )
    text = ", ".join(f"{reason} {100 * share:.2g} %" for reason, share in masked_shares.items())
    return text or "nothing"


def quality_section(run: RunFiles) -> Section | None:
    """Return the findings by kind and the notes by log, None where the run has no doctor.json."""
    report = run.read_json("doctor.json")
    logs = report.get("logs") or []
    if not logs:
        return None
    findings = [(str(log["name"]), finding) for log in logs for finding in log["findings"]]
    findings += [("together", finding) for finding in report.get("together") or []]
    severe_findings = [(name, finding) for name, finding in findings if finding["level"] != "note"]
    mask_note = "What the masks of this run leave out does not count."
    if severe_findings:
        n_misled = len({name for name, _ in severe_findings} - {"together"})
        logs_verb = "log holds" if len(logs) == 1 else "logs hold"
        summary = (
            f"{n_misled} of {len(logs)} {logs_verb} something that would mislead a fit. {mask_note}"
        )
    else:
        logs_text = "the log" if len(logs) == 1 else f"the {len(logs)} logs"
        summary = f"Nothing in {logs_text} would mislead a fit. {mask_note}"
    blocks: list[Block] = [Text(summary)]
    if severe_findings:
        # one row for each kind of finding, the worst first
        findings_by_kind: dict[tuple[int, str], list[tuple[str, JsonObject]]] = {}
        for name, finding in severe_findings:
            key = (_SEVERE_LEVELS.index(finding["level"]), str(finding["code"]))
            findings_by_kind.setdefault(key, []).append((name, finding))
        columns: list[Column] = [
            ("finding", lambda row: row[0][1].replace("_", " ")),
            ("level", lambda row: flag_cell(_SEVERE_LEVELS[row[0][0]], row[0][0] == 0)),
            ("logs", lambda row: len({name for name, _ in row[1]}), str),
            (
                "for example",
                lambda row: Cell(format_minus_signs(row[1][0][1]["text"]), row[1][0][0], "text"),
            ),
            ("what to do", lambda row: row[1][0][1]["action"]),
        ]
        blocks.append(
            build_table(sorted(findings_by_kind.items(), key=lambda row: row[0]), columns)
        )
    notes: dict[str, list[str]] = {}
    for name, finding in findings:
        if finding["level"] == "note":
            action = f"; {finding['action']}" if finding["action"] else ""
            notes.setdefault(name, []).append(format_minus_signs(f"{finding['text']}{action}"))
    if notes:
        by_log = [Section(name, [Bullets(texts)]) for name, texts in notes.items()]
        blocks.append(Section("Notes, log by log", by_log, is_folded=True))
    return Section("Data doctor", blocks)
