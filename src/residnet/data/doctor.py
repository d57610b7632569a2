"""The data doctor: what a log holds, what is wrong with it, and whether a fit would be misled."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from residnet.core.errors import DataError
from residnet.core.log import Log
from residnet.core.names import ACCELERATION, STATE
from residnet.data.align import GridConfig, align
from residnet.data.doctor_checks import channel_findings
from residnet.data.doctor_excitation import excitation_findings
from residnet.data.doctor_findings import Finding, Report
from residnet.data.doctor_frames import frame_findings

__all__ = ["Finding", "Report", "inspect"]

_MEASURED = (*STATE, "phi", "p", *ACCELERATION)


def inspect(log: Log, inputs: Sequence[str] | None = None) -> Report:
    """Examine one log as recorded (before masks and grid, whose effect it cannot see).

    Args:
        log: any log.
        inputs: channels that drive the vessel; None takes all that are neither states nor accelerations.

    Raises:
        UsageError: where the log lacks an input that was named.
        DataError: where the log has fewer than two samples, or a channel holds no number.
    """
    if len(log) < 2:
        raise DataError(f"log {log.name}: {len(log)} samples, at least 2 are needed; leave it out")
    for name, values in log.channels.items():
        if not np.isfinite(values).any():
            raise DataError(f"log {log.name}: channel {name} holds no number; take it out of the channel map")
    driving = tuple(name for name in log.channels if name not in _MEASURED) if inputs is None else tuple(inputs)
    log.stack(driving)
    findings = list(channel_findings(log, driving))
    try:
        findings += frame_findings(align(log, GridConfig(step=float(np.median(np.diff(log.t))))))
    except DataError as error:
        findings.append(Finding("error", "clock_span", f"frames not checked: {error}"))
    return Report(log.name, (*findings, *excitation_findings(log, driving)))
