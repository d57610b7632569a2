"""The data doctor: what logs hold, what is wrong with them, and whether a fit would be misled.

A check is a function with `@check` above it, in the module of its subject; it reads a `Record` and
yields findings. `STAGE_DESCRIPTIONS` says when it looks, and at what state of the log.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

from residnet.core.errors import DataError
from residnet.core.log import Log
from residnet.preprocessing.align import GridConfig, align_to_grid
from residnet.preprocessing.masks import MaskRule, apply_masks
from residnet.preprocessing.motion import original_input_names
from residnet.quality import actuators, excitation, frames, inputs, values
from residnet.quality.between import LogSet
from residnet.quality.clock import find_clock_rate_errors
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
    "compute_condition_number",
    "excitation",
    "find_clock_rate_errors",
    "frames",
    "inputs",
    "inspect_log",
    "inspect_log_set",
    "summarize_inspection",
    "values",
]

STAGE_DESCRIPTIONS = {
    "header": "as recorded",
    "order": "as recorded; a finding here ends the examination",
    "clock": "as recorded, with an increasing clock",
    "values": "with its headings continuous",
    "grid": "on a uniform grid, without what a finding about values says is wrong",
    "inputs": "with its headings continuous",
    "actuators": "without what a finding about values says is wrong",
    "excitation": "with its headings continuous",
    "between": "several logs (`Together`)",
}
"""Stage -> the state of the log that its checks see, in the order of the stages."""


def inspect_log(
    log: Log, inputs: Sequence[str] | None = None, masks: Sequence[MaskRule] = ()
) -> InspectionReport:
    """Examine one log as recorded (before the grid, whose effect it cannot see).

    Args:
        log: any log.
        inputs: channels that drive the vessel; None takes all that no sensor of the motion
            measures.
        masks: rules that will leave samples out of a fit; a finding about such samples only is a
            note.

    Raises:
        UsageError: where the log lacks an input that was named.
        DataError: where the log has fewer than two samples, or a channel holds no number.
    """
    if len(log) < 2:
        raise DataError(f"log {log.name}: {len(log)} samples, at least 2 are needed; leave it out")
    for name, channel in log.channels.items():
        if not np.isfinite(channel).any():
            raise DataError(
                f"log {log.name}: channel {name} holds no number; take it out of the channel map"
            )
    driving_inputs = [name for name in log.channels if name not in MOTION_CHANNELS]
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
    findings += _check_on_grid(trusted_statistics)
    findings += [
        *run_checks("inputs", statistics),
        *run_checks("actuators", trusted_statistics),
        *run_checks("excitation", statistics),
    ]
    masked = ~apply_masks(log, masks).usable if masks else np.zeros(len(log), dtype=bool)
    findings = [finding.downgrade_if_masked(masked) for finding in findings]
    if any(finding.level == "will mislead" for finding in findings):
        effects = FindingEffects(statistics.mask_samples(masked))
        findings = [effects.measure(finding) for finding in findings]
    return InspectionReport(log.name, tuple(findings), source)


def _check_on_grid(log: LogStatistics) -> list[Finding]:
    """Return the findings of the checks that need a uniform grid, told at the log's own samples."""
    subsample = log.subsample
    # from one stretch to the next a heading may have turned round many times
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
        # what single samples of a long log do is seen as they were recorded
        return [*run_checks("grid", log.with_subsample(gridded, values.horizontal_motion(log.log)))]
    findings = [*run_checks("grid", gridded)]
    nearest_grid_points = np.searchsorted(gridded.t - gridded.t[0], log.t - log.t[0] - 1e-9)
    nearest_grid_points = np.minimum(nearest_grid_points, len(gridded) - 1)
    return [
        finding
        if finding.sample_mask is None
        else dataclasses.replace(finding, sample_mask=finding.sample_mask[nearest_grid_points])
        for finding in findings
    ]


def inspect_log_set(
    logs: Sequence[Log],
    inputs: Sequence[str] | None = None,
    splits: Mapping[str, str] | None = None,
) -> InspectionReport:
    """Examine logs beside each other: copies, runs cut into files, ranges, excitation.

    The last is whether a fit to all of them has something to learn from.

    Args:
        logs: at least one, each with an increasing clock.
        inputs: channels that drive the vessel; None takes all that no sensor of the motion
            measures.
        splits: log's name -> train, validation or test, where a config says.
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
