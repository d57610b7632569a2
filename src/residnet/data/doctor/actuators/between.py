"""What the inputs of one log say against those of the others of the same vessel."""

from __future__ import annotations

from collections.abc import Sequence

from residnet.core.log import Log
from residnet.data.doctor.actuators.propeller import propellers, units_between
from residnet.data.doctor.actuators.rudder import neutrals_between
from residnet.data.doctor.actuators.timing import delays_between
from residnet.data.doctor.findings import Finding
from residnet.data.doctor.signals import MEASURED


def between_findings(logs: Sequence[Log], inputs: Sequence[str] | None) -> list[Finding]:
    """Return the logs whose inputs have another unit, zero or clock than those of the others."""
    if len(logs) < 3:
        return []
    common = [
        name
        for name in (inputs if inputs is not None else logs[0].channels)
        if name not in MEASURED and all(name in log.channels for log in logs)
    ]
    turning = [name for name in common if all(name in propellers(log, common) for log in logs)]
    with_speed = all("u" in log.channels for log in logs)
    return [
        *(units_between(logs, turning) if with_speed else ()),
        *neutrals_between(logs, common),
        *delays_between(logs, common),
    ]
