"""What was fitted on what: data, splits, inputs, protocols, and what each log holds."""

from __future__ import annotations

import math
from collections.abc import Sequence

from residnet.report.blocks import Block, Cell, Facts, Section, Table
from residnet.report.format import DEG, number
from residnet.report.run_reader import Content, RunFiles


def section(run: RunFiles) -> Section | None:
    """Return the section on the data, None where the folder says nothing about them."""
    facts = fitted_on(run)
    blocks: list[Block] = [Facts(facts)] if facts else []
    if run.quality:
        short, full = quality_tables(run)
        short.caption = (
            "Scored: share of the samples on which u and v are compared. Learned from: share on"
            " which smoothed states and accelerations are defined."
        )
        blocks += [
            Section("Data quality", [short, Section("Log by log", [full], folded=True)]),
        ]
    return Section("What was fitted on what", blocks) if blocks else None


def fitted_on(run: RunFiles) -> list[tuple[str, str]]:
    """Return what was fitted on what, as pairs of a name and a text."""
    baseline = run.resolved.get("baseline") or {}
    samples = run.fit(run.baseline or "baseline").get("samples")
    fit = f", fitted on {samples} samples" if samples else ""
    logs: dict[str, list[Content]] = {}
    for entry in run.quality:
        logs.setdefault(entry["split"], []).append(entry)
    splits = [
        f"{split} {len(members)} logs, {sum(log['seconds'] for log in members) / 60:.1f} min"
        for split, members in logs.items()
    ]
    protocols = run.evaluation.get("protocols") or {}
    scales = [
        f"{name} {number(run.unit(name)[1] * value)} {run.unit(name)[0]}"
        for name, value in (run.metrics.get("scales") or {}).items()
    ]
    facts = [
        ("data", _data(run)),
        ("splits", "; ".join(splits)),
        ("inputs", _inputs(run)),
        *_model(run),
    ]
    facts.append(("baseline", str(baseline.get("kind", "")) + fit if baseline else ""))
    for name, protocol in protocols.items():
        facts.append(
            (
                f"protocol {name}",
                _protocol(protocol)
                + ("; selects the model" if name == run.evaluation.get("selection") else ""),
            )
        )
    facts.append(("NRMSE divides by", ", ".join(scales)))
    return [(name, text) for name, text in facts if text]


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


def _inputs(run: RunFiles) -> str:
    signals = run.resolved.get("signals") or {}
    text = ", ".join(signals.get("inputs") or [])
    if signals.get("exogenous"):
        text += "; exogenous: " + ", ".join(signals["exogenous"])
    if signals.get("forces"):
        text += (
            f"; forces from the thrusters of {signals['forces']}"
            if isinstance(signals["forces"], str)
            else "; forces from given thrusters"
        )
    return text


def _model(run: RunFiles) -> list[tuple[str, str]]:
    card = run.card(run.baseline or "baseline")
    if not card:
        return []
    signals = card.get("signals") or {}
    names = ["u", "v", "r", *(signals.get("inputs") or []), *(signals.get("exogenous") or [])]
    ranges = []
    for name, low, high in zip(names, card["low"], card["high"], strict=False):
        unit, factor = run.unit(name)
        ranges.append(
            f"{name} {number(factor * low)} to {number(factor * high)} {unit}".removesuffix(" -")
        )
    return [
        ("model step", f"{card['dt']:g} s, {card['integrator']}; inputs held over a step"),
        ("training range", "; ".join(ranges)),
    ]


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
    columns = ["logs", "seconds", "samples", "scored [%]", "learned from [%]", "masked"]
    columns += ["largest |u| [m/s]", "largest |v| [m/s]", "largest |r| [deg/s]"]
    short, full = Table(["split, manoeuvre", *columns]), Table(["log", *columns[1:]])
    groups: dict[tuple[str, str], list[Content]] = {}
    for entry in run.quality:
        groups.setdefault((entry["split"], entry.get("manoeuvre") or "–"), []).append(entry)
        full.add(entry["log"], _log_cells([entry]))
    last = None
    for (split, manoeuvre), members in groups.items():
        short.add(
            f"{split}: {manoeuvre.replace('_', ' ')}",
            [str(len(members)), *_log_cells(members)],
            rule=split != last,
        )
        last = split
    return short, full


def _log_cells(entries: Sequence[Content]) -> list[Cell]:
    samples = sum(entry["samples"] for entry in entries)
    masked: dict[str, float] = {}
    for entry in entries:
        for reason, share in (entry.get("masked") or {}).items():
            masked[reason] = masked.get(reason, 0.0) + share * entry["samples"] / samples

    def mean(key: str) -> Cell:
        return Cell(number(100 * sum(entry[key] * entry["samples"] for entry in entries) / samples))

    def largest(channel: str, factor: float) -> Cell:
        return Cell(
            number(
                factor
                * max((entry.get("largest") or {}).get(channel, math.nan) for entry in entries)
            )
        )

    reasons = (
        ", ".join(f"{reason} {100 * share:.2g} %" for reason, share in masked.items()) or "nothing"
    )
    seconds = sum(entry["seconds"] for entry in entries)
    reach = [largest("u", 1), largest("v", 1), largest("r", DEG)]
    return [
        Cell(f"{seconds:.0f}"),
        Cell(str(samples)),
        mean("usable"),
        mean("learned_from"),
        Cell(reasons, mark="text"),
        *reach,
    ]
