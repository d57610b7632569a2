"""Inspect logs for faults that would mislead a fit (the data doctor).

A check is a function with the decorator `@check` in the module of its subject. It reads
`LogStatistics` and yields findings. `STAGE_DESCRIPTIONS` lists the stages of the inspection.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

from residnet.core.errors import DataError
from residnet.core.log import Log
from residnet.core.names import SET_POINT_CHANNELS
from residnet.preprocessing.align import GridConfig, align_to_grid
from residnet.preprocessing.masks import MaskRule, apply_masks
from residnet.preprocessing.motion import original_input_names
from residnet.quality import actuators, clock, excitation, feedback, frames, inputs, values
from residnet.quality.between import LogSet
from residnet.quality.effects import FindingEffects
from residnet.quality.excitation import compute_condition_number
from residnet.quality.findings import (
    CHECKS,
    Finding,
    InspectionReport,
    build_inspection,
    convert_reader_findings,
    run_checks,
    summarize_inspection,
)
from residnet.quality.statistics import MOTION_CHANNELS, LogStatistics

__all__ = [
    "CHECKS",
    "STAGE_DESCRIPTIONS",
    "Finding",
    "InspectionReport",
    "actuators",
    "build_inspection",
    "clock",
    "compute_condition_number",
    "excitation",
    "feedback",
    "frames",
    "inputs",
    "inspect_log",
    "inspect_log_set",
    "summarize_inspection",
    "values",
]

STAGE_DESCRIPTIONS = {
    "header": "as recorded",
    "order": "as recorded; a finding here ends the inspection",
    "clock": "as recorded, with an increasing clock",
    "values": "with continuous headings",
    "grid": "on a uniform grid, without samples that the stage values found invalid",
    "inputs": "with continuous headings",
    "actuators": "without samples that the stage values found invalid",
    "excitation": "with continuous headings",
    "between": "a set of logs (`LogSet`)",
}
"""Stage -> state of the log that its checks receive, in the order of execution."""

_VELOCITY_DEPENDENT = ("propeller_sign", "rudder_bias")
"""Codes of findings about actuators that need velocities in correct frames."""


def inspect_log(
    log: Log, inputs: Sequence[str] | None = None, masks: Sequence[MaskRule] = ()
) -> InspectionReport:
    """Inspect one log as recorded, before it is resampled to the grid of a fit.

    Args:
        log: log in canonical channels.
        inputs: channels that drive the vessel; None takes all channels except states and
            accelerations.
        masks: rules that exclude samples from a fit; a finding about excluded samples only is a
            note.

    Raises:
        UsageError: if the log lacks an input.
        DataError: if the log has fewer than two samples, or a channel without a number.
    """
    if len(log) < 2:
        raise DataError(f"log {log.name}: {len(log)} samples, at least 2 are needed; exclude it")
    for name, channel in log.channels.items():
        if not np.isfinite(channel).any():
            raise DataError(
                f"log {log.name}: channel {name} holds no number; remove it from the channel map"
            )
    driving_inputs = [
        name for name in log.channels if name not in (*MOTION_CHANNELS, *SET_POINT_CHANNELS)
    ]
    driving_inputs = driving_inputs if inputs is None else original_input_names(log, inputs)
    log.stack(driving_inputs)
    raw_statistics = LogStatistics(log, driving_inputs)
    findings = [
        *convert_reader_findings(log.meta.get("findings", ())),
        *run_checks("header", raw_statistics),
    ]
    source = str(log.meta.get("source", ""))
    order_findings = [*run_checks("order", raw_statistics)]
    if order_findings:
        return InspectionReport(log.name, (*findings, *order_findings), source)
    statistics = LogStatistics(values.unwrap_headings(log), driving_inputs)
    value_findings = [*run_checks("values", statistics)]
    findings += [*run_checks("clock", raw_statistics), *value_findings]
    invalid_masks = [
        finding.sample_mask
        for finding in value_findings
        if finding.invalidates_samples and finding.sample_mask is not None
    ]
    invalid = np.logical_or.reduce([np.zeros(len(log), dtype=bool), *invalid_masks])
    trusted_statistics = statistics if invalid.mean() > 0.5 else statistics.mask_samples(invalid)
    grid_findings = _check_on_grid(trusted_statistics)
    actuator_findings = run_checks("actuators", trusted_statistics)
    if any(finding.code == "frames" and finding.level != "note" for finding in grid_findings):
        # signs and offsets of actuators follow from velocities, which are wrong
        actuator_findings = [f for f in actuator_findings if f.code not in _VELOCITY_DEPENDENT]
    findings += [
        *grid_findings,
        *run_checks("inputs", statistics),
        *actuator_findings,
        *run_checks("excitation", statistics),
    ]
    masked = ~apply_masks(log, masks).usable if masks else np.zeros(len(log), dtype=bool)
    findings = [finding.downgrade_if_masked(masked) for finding in findings]
    if any(finding.level == "will mislead" for finding in findings):
        effects = FindingEffects(statistics.mask_samples(masked))
        findings = [effects.measure(finding) for finding in findings]
    return InspectionReport(log.name, tuple(findings), source)


def _check_on_grid(log: LogStatistics) -> list[Finding]:
    """Run the checks that need a uniform grid; sample masks refer to the samples of the log."""
    subsample = log.subsample
    # between two stretches of a subsample the heading may turn by several circles
    unwrapped_log = subsample.log if subsample is log else values.unwrap_headings(subsample.log)
    try:
        gridded = subsample.on_grid(
            values.horizontal_motion(
                align_to_grid(unwrapped_log, GridConfig(step=log.sampling_interval))
            )
        )
    except DataError as error:
        return [Finding("fatal", "clock_span", f"frames not checked: {error}")]
    if subsample is not log:
        # statistics of a long log use the gridded subsample, single samples the recorded log
        return [*run_checks("grid", log.with_subsample(gridded, values.horizontal_motion(log.log)))]
    findings = [*run_checks("grid", gridded)]
    nearest_grid_points = np.searchsorted(gridded.t - gridded.t[0], log.t - log.t[0] - 1e-9)
    nearest_grid_points = np.minimum(nearest_grid_points, len(gridded) - 1)
    return [
        (
            finding
            if finding.sample_mask is None
            else dataclasses.replace(finding, sample_mask=finding.sample_mask[nearest_grid_points])
        )
        for finding in findings
    ]


def inspect_log_set(
    logs: Sequence[Log],
    inputs: Sequence[str] | None = None,
    splits: Mapping[str, str] | None = None,
) -> InspectionReport:
    """Inspect a set of logs: copies, split runs, ranges, excitation, contradicting logs.

    Args:
        logs: at least one log; those without an increasing clock are ignored.
        inputs: channels that drive the vessel; None takes all channels except states and
            accelerations.
        splits: name of a log -> train, validation or test, as far as a config defines it.
    """
    ordered_logs = [
        log for log in logs if len(log) > 1 and not [*run_checks("order", LogStatistics(log))]
    ]
    if inputs is not None:
        inputs = [
            *dict.fromkeys(
                name for log in ordered_logs for name in original_input_names(log, inputs)
            )
        ]
    findings = (
        run_checks("between", LogSet(ordered_logs, inputs, splits or {})) if ordered_logs else ()
    )
    return InspectionReport("together", tuple(findings))
