"""Section on the data: split, contents of each log and findings of the data checks."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

from residnet.core.format import DASH, DEGREES_PER_RADIAN, format_minus_signs, format_number
from residnet.evaluation.data_records import LogQuality
from residnet.quality.records import (
    COMPATIBILITY_FILE,
    CompatibilityFile,
    CompatibilityRow,
    FindingRow,
    InstrumentErrorRow,
)
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
from residnet.report.run_reader import RunFiles
from residnet.report.run_settings import ProtocolSettings
from residnet.training.records import CurrentRow, CurrentsFile

_SEVERE_LEVELS = ("fatal", "will mislead")
"""Severity levels above a note, in descending order."""


def fit_data_section(run: RunFiles) -> Section | None:
    """Return the section on the data; None if the folder has no information on them."""
    baseline_notes = run.fit_notes(run.baseline or "baseline")
    samples = None if baseline_notes is None else baseline_notes.samples
    logs: dict[str, list[LogQuality]] = {}
    for entry in run.quality:
        logs.setdefault(entry.split, []).append(entry)
    split_texts = [
        f"{split} {len(members)} logs, {sum(log.seconds for log in members) / 60:.1f} min"
        for split, members in logs.items()
    ]
    scale_texts = [
        f"{name} {format_number(unit.factor * value)} {unit.name}"
        for name, value in run.metrics.scales.items()
        for unit in [run.display_unit(name)]
    ]
    signals = run.fit_settings.signals
    thrusters = (
        f"the thrusters of {signals.forces}"
        if isinstance(signals.forces, str)
        else "given thrusters"
    )
    input_texts = (
        ", ".join(signals.inputs),
        "exogenous: " + ", ".join(signals.exogenous) if signals.exogenous else "",
        f"forces from {thrusters}" if signals.forces else "",
    )
    baseline = run.fit_settings.baseline
    fit_text = f", fitted on {samples} samples" if samples else ""
    facts = {
        "data": _data_text(run),
        "splits": "; ".join(split_texts),
        "inputs": "; ".join(filter(None, input_texts)),
        "velocities": run.dof.description,
        **_model_facts(run),
        "baseline": "" if baseline is None else baseline.kind + fit_text,
        **{
            f"protocol {name}": _protocol_text(protocol)
            + ("; selects the model" if name == run.evaluation.selection else "")
            for name, protocol in run.evaluation.protocols.items()
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
    if compatibility := CompatibilityFile.read_optional(run.path, COMPATIBILITY_FILE):
        blocks.append(Section("Instrument errors", compatibility_tables(compatibility.root)))
    currents = run.read_record(CurrentsFile, "currents.json")
    if currents is not None:
        blocks.append(Section("Currents", [_currents_table(run, currents.root)], is_folded=True))
    return Section("Data and settings", blocks) if blocks else None


def _currents_table(run: RunFiles, currents: Sequence[CurrentRow]) -> Table:
    """Return the table of the estimated current of each log, in the display unit of speeds."""
    unit, factor = run.display_unit("u")

    def component(value: float, standard_error: float) -> Cell:
        error_text = format_number(factor * standard_error, 2)
        return Cell(f"{format_number(factor * value, 2)} ± {error_text}")

    return build_table(
        currents,
        [
            ("log", lambda row: row.log),
            (f"north [{unit}]", lambda row: component(row.current_north, row.standard_error[0])),
            (f"east [{unit}]", lambda row: component(row.current_east, row.standard_error[1])),
            ("p-value", lambda row: format_number(row.p_value, 1)),
            ("coefficients", lambda row: "fitted with it" if row.fitted else "of other logs"),
        ],
        caption="Estimated constant current of each log with one standard error, which includes the"
        " differences between the halves of logs (Birge ratio). The p-value is that of an F test"
        " against no current."
        " Errors of this page are those of the motion through the water.",
    )


def compatibility_tables(rows: Sequence[CompatibilityRow]) -> list[Block]:
    """Return tables of instrument errors over all logs, and of the kind of velocities of each log.

    Args:
        rows: rows of compatibility.json.
    """
    errors: dict[str, list[InstrumentErrorRow]] = {}
    for row in rows:
        for error in row.errors:
            errors.setdefault(error.name, []).append(error)

    def median_text(unit: str, values: Iterable[float]) -> str:
        factor = DEGREES_PER_RADIAN if unit.startswith("rad") else 1.0
        text = format_number(factor * statistics.median(values), 2)
        return text if unit == "-" else f"{text} {unit.replace('rad', 'deg')}"

    def source(members: Sequence[InstrumentErrorRow]) -> str:
        n_determined = sum(error.is_determined for error in members)
        return "sensors" if 2 * n_determined > len(members) else "smoothness only"

    def count_significant(members: Sequence[InstrumentErrorRow]) -> str:
        return f"{sum(e.is_significant for e in members)} of {len(members)}"

    error_table = build_table(
        errors.values(),
        [
            ("instrument error", lambda members: members[0].name),
            (
                "median estimate",
                lambda members: median_text(members[0].unit, (error.value for error in members)),
            ),
            (
                "median standard error",
                lambda members: (
                    median_text(
                        members[0].unit,
                        [error.standard_error for error in members if error.is_determined],
                    )
                    if source(members) == "sensors"
                    else DASH
                ),
            ),
            ("determined by", source),
            ("logs where significant", count_significant),
        ],
        caption="Errors of the instruments, estimated from the kinematics alone. A clock is the"
        " time to add to that of the sensor. An error that only the smoothness of the motion"
        " determines has no interval.",
    )

    def current_text(row: CompatibilityRow) -> str:
        current = row.current
        if current is None:
            return DASH
        size = math.hypot(current.north, current.east)
        verdict = "significant" if current.is_significant else "not significant"
        error = format_number(current.standard_error, 2)
        p_value = format_number(current.p_value, 1)
        return f"{format_number(size, 2)} ± {error} m/s, p = {p_value}, {verdict}"

    log_table = build_table(
        rows,
        [
            ("log", lambda row: row.log),
            ("velocities", lambda row: row.meaning or row.reason or "not measured"),
            ("runner-up", lambda row: row.runner_up or DASH),
            (
                "margin (BIC)",
                lambda row: format_number(row.margin, 3) if row.meaning else DASH,
            ),
            ("current (likelihood-ratio test)", current_text),
        ],
    )
    return [*([error_table] if errors else []), log_table]


def _data_text(run: RunFiles) -> str:
    data = run.fit_settings.data
    if data is None:
        return ""
    if data.kind != "simulated":
        reader_kind = "files" if data.reader is None else data.reader.kind
        n_files = 0 if run.provenance is None else len(run.provenance.inputs)
        return f"measured logs ({reader_kind}), {n_files} files"
    text = f"simulated sea trials of vessel {data.vessel}"
    if data.noise is not None:
        text += (
            f", noise u {format_number(data.noise.u, 2)} m/s, v"
            f" {format_number(data.noise.v, 2)} m/s, r"
            f" {format_number(DEGREES_PER_RADIAN * data.noise.r, 2)} deg/s"
        )
    return text + f"; data seed {data.seed}"


def _model_facts(run: RunFiles) -> dict[str, str]:
    model = run.model_settings(run.baseline or "baseline")
    if model.dt is None:
        return {}
    return {
        "model step": f"{model.dt:g} s, {model.integrator}; inputs held over a step",
        "training range": "; ".join(run.describe_training_ranges(run.baseline or "baseline")),
    }


def _protocol_text(protocol: ProtocolSettings) -> str:
    if protocol.kind == "windows" and protocol.length is not None:
        return (
            f"back-to-back windows of {protocol.length:g} s, the first from"
            f" {protocol.first:g} s on, each from the measured state"
        )
    if protocol.kind == "manoeuvre" and protocol.initial is not None:
        return (
            "complete manoeuvres; they start from the mean velocities of the first"
            f" {protocol.initial:g} s and are scored after them"
        )
    return protocol.kind


def quality_tables(run: RunFiles) -> tuple[Table, Table]:
    """Return tables of the contents of the logs by split and manoeuvre, and for each log."""
    groups: dict[tuple[str, str], list[LogQuality]] = {}
    for entry in run.quality:
        groups.setdefault((entry.split, entry.manoeuvre), []).append(entry)

    def label(members: Sequence[LogQuality]) -> str:
        return f"{members[0].split}: {(members[0].manoeuvre or DASH).replace('_', ' ')}"

    columns: list[Column[Sequence[LogQuality]]] = [
        ("seconds", lambda logs: f"{sum(log.seconds for log in logs):.0f}", str),
        ("samples", lambda logs: sum(log.samples for log in logs), str),
        ("scored [%]", lambda logs: _mean_percentage(logs, lambda log: log.usable), format_number),
        (
            "learned from [%]",
            lambda logs: _mean_percentage(logs, lambda log: log.learned_from),
            format_number,
        ),
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
    summary_columns: list[Column[Sequence[LogQuality]]] = [
        ("split, manoeuvre", label),
        ("logs", len, str),
        *columns,
    ]
    log_columns: list[Column[Sequence[LogQuality]]] = [("log", lambda logs: logs[0].log), *columns]
    return (
        build_table(groups.values(), summary_columns, group_key=lambda logs: logs[0].split),
        build_table([[log] for log in run.quality], log_columns),
    )


def _mean_percentage(logs: Sequence[LogQuality], share: Callable[[LogQuality], float]) -> float:
    """Return the mean percentage over logs, weighted by their numbers of samples."""
    samples = sum(log.samples for log in logs)
    return 100 * sum(share(log) * log.samples for log in logs) / samples


def _largest_value(logs: Sequence[LogQuality], channel: str) -> float:
    return max(log.largest.get(channel, math.nan) for log in logs)


def _masked_text(logs: Sequence[LogQuality]) -> str:
    samples = sum(log.samples for log in logs)
    masked_shares: dict[str, float] = {}
    for log in logs:
        for reason, share in log.masked.items():
            masked_shares[reason] = masked_shares.get(reason, 0.0) + share * log.samples / samples
    text = ", ".join(f"{reason} {100 * share:.2g} %" for reason, share in masked_shares.items())
    return text or "nothing"


class _FindingKind(NamedTuple):
    """All findings of one level and code, with the names of their logs.

    The rank is the position of the level in `_SEVERE_LEVELS`.
    """

    code: str
    rank: int
    findings: Sequence[tuple[str, FindingRow]]

    @property
    def example(self) -> FindingRow:
        """The finding that represents its kind in the table."""
        return self.findings[0][1]


def quality_section(run: RunFiles) -> Section | None:
    """Return the findings by kind and the notes by log; None if the run has no doctor.json."""
    if run.inspection is None or not run.inspection.logs:
        return None
    logs = run.inspection.logs
    findings = run.inspection.named_findings
    severe_findings = [(name, finding) for name, finding in findings if finding.level != "note"]
    mask_note = "Masked samples are not included."
    if severe_findings:
        n_misled = len({name for name, _ in severe_findings} - {"together"})
        logs_verb = "log has" if len(logs) == 1 else "logs have"
        summary = (
            f"{n_misled} of {len(logs)} {logs_verb} a fault that would mislead a fit. {mask_note}"
        )
    else:
        logs_text = "the log" if len(logs) == 1 else f"the {len(logs)} logs"
        summary = f"No fault in {logs_text} would mislead a fit. {mask_note}"
    blocks: list[Block] = [Text(summary)]
    if severe_findings:
        # one row for each kind of finding, the worst first
        findings_by_kind: dict[tuple[int, str], list[tuple[str, FindingRow]]] = {}
        for name, finding in severe_findings:
            key = (_SEVERE_LEVELS.index(finding.level), finding.code)
            findings_by_kind.setdefault(key, []).append((name, finding))
        kinds = [
            _FindingKind(code, rank, named_findings)
            for (rank, code), named_findings in sorted(
                findings_by_kind.items(), key=lambda item: item[0]
            )
        ]
        columns: list[Column[_FindingKind]] = [
            ("finding", lambda kind: kind.code.replace("_", " ")),
            ("level", lambda kind: flag_cell(_SEVERE_LEVELS[kind.rank], kind.rank == 0)),
            ("logs", lambda kind: len({name for name, _ in kind.findings}), str),
            (
                "for example",
                lambda kind: Cell(
                    format_minus_signs(kind.example.text), kind.findings[0][0], "text"
                ),
            ),
            ("what to do", lambda kind: kind.example.action),
        ]
        blocks.append(build_table(kinds, columns))
    notes: dict[str, list[str]] = {}
    for name, finding in findings:
        if finding.level == "note":
            action = f"; {finding.action}" if finding.action else ""
            notes.setdefault(name, []).append(format_minus_signs(f"{finding.text}{action}"))
    if notes:
        by_log = [Section(name, [Bullets(texts)]) for name, texts in notes.items()]
        blocks.append(Section("Notes, log by log", by_log, is_folded=True))
    return Section("Data checks", blocks)
