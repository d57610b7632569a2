"""The data doctor: what logs hold, what is wrong with them, and whether a fit would be misled."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

from residnet.core.errors import DataError
from residnet.core.log import Log
from residnet.data.align import GridConfig, align
from residnet.data.doctor.actuators.between import between_findings
from residnet.data.doctor.actuators.propeller import propeller_findings
from residnet.data.doctor.actuators.rudder import rudder_findings
from residnet.data.doctor.actuators.timing import timing_findings
from residnet.data.doctor.clock import clock_findings, order_findings
from residnet.data.doctor.compare import comparison_findings
from residnet.data.doctor.effects import Effects
from residnet.data.doctor.excitation import excitation_findings, set_findings
from residnet.data.doctor.findings import Finding, Level, Report, imported, inspection
from residnet.data.doctor.frames import frame_findings
from residnet.data.doctor.inputs import input_findings
from residnet.data.doctor.sensors.fixes import fix_findings
from residnet.data.doctor.signals import MEASURED, without
from residnet.data.doctor.summary import Summary, summary
from residnet.data.doctor.values import channel_findings, value_findings
from residnet.data.doctor.wraps import unwrapped, wrap_findings
from residnet.data.masks import Mask, apply_masks

__all__ = [
    "Finding",
    "Level",
    "Report",
    "Summary",
    "inspect",
    "inspect_together",
    "inspection",
    "summary",
]


# findings about single samples of pose and velocities
_DOUBTED = ("frozen", "outliers", "spikes", "clipping", "interpolated")


def inspect(log: Log, inputs: Sequence[str] | None = None, masks: Sequence[Mask] = ()) -> Report:
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
    for name, values in log.channels.items():
        if not np.isfinite(values).any():
            raise DataError(
                f"log {log.name}: channel {name} holds no number; take it out of the channel map"
            )
    driving = (
        tuple(name for name in log.channels if name not in MEASURED)
        if inputs is None
        else tuple(inputs)
    )
    log.stack(driving)
    findings = [*imported(log.meta.get("findings", ())), *channel_findings(log)]
    broken = order_findings(log)
    if not broken:
        findings += [*clock_findings(log), *_contents(log, driving)]
    left_out = (
        ~apply_masks(log, masks).usable if masks and not broken else np.zeros(len(log), dtype=bool)
    )
    excused = [finding.excused(left_out) for finding in (*findings, *broken)]
    if not broken and any(finding.level == "will mislead" for finding in excused):
        effects = Effects(_without_masked(unwrapped(log), left_out), driving)
        excused = [effects.measured(finding) for finding in excused]
    return Report(log.name, tuple(excused), str(log.meta.get("source", "")))


def _without_masked(log: Log, left_out: np.ndarray) -> Log:
    """Return the log with NaN in the measured channels where the masks leave samples out."""
    if not left_out.any():
        return log
    channels = {
        name: without(values, left_out) if name in MEASURED else values
        for name, values in log.channels.items()
    }
    return log.replace(channels=channels)


def _contents(log: Log, driving: Sequence[str]) -> list[Finding]:
    """Return the findings about what the channels of a log with an increasing clock hold."""
    findings = wrap_findings(log)
    log = unwrapped(log)
    values = value_findings(log, driving)
    return [
        *findings,
        *values,
        *_frames(_trusted(log, values)),
        *fix_findings(log),
        *input_findings(log, driving),
        *_actuators(_trusted(log, values), driving),
        *excitation_findings(log, driving),
    ]


def _trusted(log: Log, findings: Sequence[Finding]) -> Log:
    """Return the log with NaN where a finding about values says that pose or velocity is wrong."""
    doubted = [
        finding.at for finding in findings if finding.at is not None and finding.code in _DOUBTED
    ]
    bad = np.logical_or.reduce(doubted) if doubted else np.zeros(len(log), dtype=bool)
    if bad.mean() > 0.5:
        return log
    return log.replace(
        channels={
            name: without(values, bad) if name in MEASURED else values
            for name, values in log.channels.items()
        }
    )


def _at_samples(finding: Finding, grid: np.ndarray, t: np.ndarray) -> Finding:
    """Return a finding about points of a grid [G] as one about the samples at t [T]."""
    if finding.at is None:
        return finding
    near = np.searchsorted(grid - grid[0], t - t[0] - 1e-9)
    return dataclasses.replace(finding, at=finding.at[np.minimum(near, grid.size - 1)])


def _frames(log: Log) -> list[Finding]:
    try:
        grid = align(log, GridConfig(step=float(np.median(np.diff(log.t)))))
        return [_at_samples(finding, grid.t, log.t) for finding in frame_findings(grid)]
    except DataError as error:
        return [Finding("fatal", "clock_span", f"frames not checked: {error}")]


def _actuators(log: Log, driving: Sequence[str]) -> list[Finding]:
    """Return what the motion says against propellers and rudders."""
    return [
        *propeller_findings(log, driving),
        *rudder_findings(log, driving),
        *timing_findings(log, driving),
    ]


def inspect_together(
    logs: Sequence[Log],
    inputs: Sequence[str] | None = None,
    splits: Mapping[str, str] | None = None,
) -> Report:
    """Examine logs beside each other: copies, runs cut into files, ranges, excitation.

    The last is whether a fit to all of them has something to learn from.

    Args:
        logs: at least one, each with an increasing clock.
        inputs: channels that drive the vessel; None takes all that no sensor of the motion
            measures.
        splits: log's name -> train, validation or test, where a config says.
    """
    sound = [log for log in logs if not order_findings(log)]
    found = [*comparison_findings(sound, splits), *set_findings(sound, inputs)] if sound else []
    found += between_findings(sound, inputs)
    return Report("together", tuple(found))
