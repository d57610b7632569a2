"""Manoeuvres to choose the next trial from, within limits, and how the inputs follow them."""

from __future__ import annotations

import math
from collections.abc import Mapping

from pydantic import Field

from residnet.core.config import Config, Metres, MetresPerSecond, Seconds
from residnet.core.errors import UsageError
from residnet.dynamics.gear import InputShare
from residnet.dynamics.store import ModelSpec
from residnet.manoeuvres import (
    AccelerationDeceleration,
    Manoeuvre,
    MultiSine,
    ThreeTwoOneOne,
    TurningCircle,
    Zigzag,
)

_SIDES = {"port": 1.0, "stbd": -1.0, "starboard": -1.0, "left": 1.0, "right": -1.0}
"""Which way more of a side's thrust turns the vessel."""


class TrialLimits(Config):
    """What a trial may use.

    Attributes:
        time: that each candidate lasts, in s.
        area: largest distance from the start, in m; none where not given.
        speed: largest speed in m/s; none where not given.
        rudder: largest share of full steer.
        count: number of trials to choose.
    """

    time: Seconds = Field(default=120.0, gt=0)
    area: Metres | None = Field(default=None, gt=0)
    speed: MetresPerSecond | None = Field(default=None, gt=0)
    rudder: float = Field(default=1.0, gt=0, le=1)
    count: int = Field(default=3, ge=1)


def candidates(limits: TrialLimits) -> list[Manoeuvre]:
    """Return zigzags, turns, 3-2-1-1, multi-sines and speed changes at several drives."""
    out: list[Manoeuvre] = []
    time, full = limits.time, limits.rudder
    for drive in (0.4, 0.7, 1.0):
        per = f"{round(100 * drive)}"
        for angle in (10.0, 20.0):
            for share in (0.5, 1.0):
                name = f"zigzag_{angle:.0f}_steer_{round(100 * share * full)}_drive_{per}"
                out.append(
                    Zigzag(
                        name=name,
                        drive=drive,
                        steer=share * full,
                        heading=math.radians(angle),
                        start=0.1 * time,
                        duration=time,
                    )
                )
        for side in (1.0, -1.0):
            name = f"turn_{'starboard' if side > 0 else 'port'}_drive_{per}"
            out.append(
                TurningCircle(
                    name=name, drive=drive, steer=side * full, start=0.1 * time, duration=time
                )
            )
        for unit in (0.02, 0.05):
            out.append(
                ThreeTwoOneOne(
                    name=f"3211_{unit * time:.0f}s_drive_{per}",
                    drive=drive,
                    steer=full,
                    unit=unit * time,
                    start=0.05 * time,
                    duration=time,
                )
            )
        out.append(
            MultiSine(
                name=f"multi_sine_drive_{per}",
                drive=0.5 * drive,
                drive_amplitude=0.5 * drive,
                steer_amplitude=full,
                band=(2.0 / time, 20.0 / time),
                duration=time,
            )
        )
    levels = (1.0, 0.0, 0.6, 0.2)
    times = tuple(0.25 * time * k for k in range(4))
    out.append(
        AccelerationDeceleration(name="speed_changes", times=times, levels=levels, duration=time)
    )
    return out


def shares_of(spec: ModelSpec) -> Mapping[str, InputShare]:
    """Return how the inputs of a model follow drive and steer, within what its data have seen.

    Raises:
        UsageError: where no input can be told to steer.
    """
    units, ranges, out = spec.signals.units(), spec.ranges, {}
    for name in spec.signals.inputs:
        most = max(map(abs, ranges[name]))
        side = next((sign for word, sign in _SIDES.items() if word in name.split("_")), 0.0)
        if units.get(name) == "rad" or name == "tau_n":
            out[name] = InputShare(steer=most, limit=most)
        elif side:
            out[name] = InputShare(drive=0.6 * most, steer=0.6 * side * most, limit=most)
        else:
            out[name] = InputShare(drive=most, limit=most)
    if not any(share.steer for share in out.values()):
        raise UsageError(
            f"model {spec.name}: none of {', '.join(spec.signals.inputs)} is known to steer; say"
            " how inputs follow drive and steer in the run's `booklet.inputs`"
        )
    return out
