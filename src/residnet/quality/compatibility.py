"""Table of instrument errors of a log, from a reconstruction of its motion (data compatibility)."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import cast

import numpy as np

from residnet.core.errors import DataError
from residnet.core.frames import unwrap_angle
from residnet.core.log import Log
from residnet.core.names import POSE_NAMES
from residnet.preprocessing.channel_values import mask_held_values, nan_median, nan_std
from residnet.preprocessing.compatibility.estimates import Prior
from residnet.preprocessing.compatibility.hypotheses import (
    Hypothesis,
    RankedHypothesis,
    choose_stretch,
    compare,
)
from residnet.preprocessing.compatibility.sensors import CURRENT_NAMES, Sensor, SensorKind
from residnet.quality.records import CompatibilityRow, CurrentTest, InstrumentErrorRow

_MAX_NODES = 300
"""Largest number of nodes of a reconstruction; bounds the computing time of the check."""
_MIN_NODES = 60
"""Smallest number of nodes of a reconstruction, except of logs with fewer samples."""
_STEP_SHARE = 0.3
"""Step between nodes over the time scale of the yaw rate."""
_MAX_CURRENT_P_VALUE = 1e-3
"""Largest p-value of a significant current."""
_MIN_CURRENT_SHARE = 0.02
"""Smallest current that is listed as significant, as a share of the speed."""

_DECLARED = "as declared"
_THROUGH_WATER = "u, v through the water, with a current"
_EARTH_AXES = "u, v in earth axes"
_PRIORS = {
    "yaw rate bias": (Prior(0.0, 0.02), "rad/s"),
    "yaw rate scale": (Prior(0.0, 0.3), "-"),
    "yaw rate clock": (Prior(0.0, 1.0), "s"),
    "heading offset": (Prior(0.0, 0.5), "rad"),
    "position forward": (Prior(0.0, 5.0), "m"),
    "position to starboard": (Prior(0.0, 5.0), "m"),
    "surge scale": (Prior(0.0, 0.3), "-"),
    "sway scale": (Prior(0.0, 0.3), "-"),
    "velocity clock": (Prior(0.0, 1.0), "s"),
    "current_north": (Prior(0.0, 1.0), "m/s"),
    "current_east": (Prior(0.0, 1.0), "m/s"),
}
"""Instrument error -> prior and SI unit."""


def analyse_compatibility(log: Log) -> CompatibilityRow:
    """Estimate the instrument errors of a log, and compare meanings of its velocities.

    The stretch of at most 300 nodes in which the motion varies most is analysed.

    Args:
        log: log in SI units with increasing times.
    """
    missing = [name for name in POSE_NAMES if name not in log.channels]
    if missing:
        return CompatibilityRow(log=log.name, reason=f"no {', '.join(missing)}")
    stretch, step = _select_stretch(log)
    sensors = _make_sensors(stretch)
    names = {name for s in sensors for name in (s.clock, *s.error_names) if name}
    errors = {name: prior for name, (prior, _) in _PRIORS.items() if name in names}
    hypotheses = {_DECLARED: Hypothesis(sensors, errors)}
    has_velocities = {"u", "v"} <= log.channels.keys()
    if has_velocities:
        hypotheses[_THROUGH_WATER] = Hypothesis(
            [replace(s, is_through_water=s.kind in ("surge", "sway")) for s in sensors],
            {**errors, **{name: _PRIORS[name][0] for name in CURRENT_NAMES}},
        )
        kinds: dict[str, SensorKind] = {"surge": "north", "sway": "east"}
        hypotheses[_EARTH_AXES] = Hypothesis(
            [replace(s, kind=kinds.get(s.kind, s.kind)) for s in sensors], errors
        )
    try:
        ranking = compare(hypotheses, step)
    except (DataError, np.linalg.LinAlgError) as error:
        return CompatibilityRow(log=log.name, reason=str(error))
    best = ranking[0].reconstruction
    # a shift by less than half a sample is a convention of the recorder
    min_shift = 0.5 * nan_median(np.diff(log.t))
    rows = [
        InstrumentErrorRow(
            name=name,
            unit=_PRIORS[name][1],
            value=estimate.value,
            standard_error=estimate.standard_error,
            is_determined=estimate.is_determined,
            is_significant=estimate.is_significant
            and (not name.endswith("clock") or abs(estimate.value) > min_shift),
        )
        for name, estimate in best.errors.items()
        if name not in CURRENT_NAMES
    ]
    return CompatibilityRow(
        log=log.name,
        meaning=ranking[0].name if has_velocities else "",
        runner_up=ranking[1].name if has_velocities else "",
        margin=ranking[1].margin if has_velocities else 0.0,
        errors=tuple(rows),
        current=_test_current(ranking, stretch) if has_velocities else None,
    )


def _select_stretch(log: Log) -> tuple[Log, float]:
    """Return the liveliest stretch of a log without held values, and the step between nodes."""
    log = mask_held_values(log)
    interval = nan_median(np.diff(log.t))
    heading = unwrap_angle(log["psi"])
    is_finite = np.isfinite(heading)
    heading = np.interp(log.t, log.t[is_finite], heading[is_finite])
    stride = max(round(1.0 / interval), 1)
    yaw_rate = np.gradient(heading[::stride], log.t[::stride])
    acceleration = np.gradient(yaw_rate, log.t[::stride])
    time_scale = nan_std(yaw_rate) / max(nan_std(acceleration), 1e-12)
    max_step = min(5.0, float(log.t[-1] - log.t[0]) / _MIN_NODES)
    step = max(min(_STEP_SHARE * time_scale, max_step), interval)
    # samples on nodes are cheaper
    step = max(math.floor(step / interval + 1e-6), 1) * interval
    activity = (yaw_rate - yaw_rate.mean()) ** 2
    start, stop = choose_stretch(log.t[::stride], activity, step, _MAX_NODES)
    rows = np.flatnonzero((log.t >= start) & (log.t <= stop))
    # about two samples per node suffice
    return log.select_rows(rows[:: max(round(0.5 * step / interval), 1)]), step


def _make_sensors(log: Log) -> list[Sensor]:
    """Return the sensors of a log with the instrument errors that may be determined."""
    t = log.t
    has_velocities = {"u", "v"} <= log.channels.keys()
    speed = float(np.nanmedian(np.hypot(np.gradient(log["x"], t), np.gradient(log["y"], t))))
    if has_velocities:
        speed = float(np.nanmedian(np.hypot(log["u"], log["v"])))
    speed = max(speed if np.isfinite(speed) else 0.0, 1e-3)
    sensors = [
        Sensor(
            "position",
            t,
            log.stack(["x", "y"]),
            min_noise_std=0.002 * speed,
            lever_arm=("position forward", "position to starboard") if has_velocities else (),
        ),
        Sensor(
            "heading",
            t,
            unwrap_angle(log["psi"]),
            min_noise_std=math.radians(0.05),
            bias="heading offset" if has_velocities else "",
        ),
    ]
    if "r" in log.channels:
        sensors.append(
            Sensor(
                "yaw_rate",
                t,
                log["r"],
                min_noise_std=max(math.radians(0.02), 0.01 * nan_std(log["r"])),
                bias="yaw rate bias",
                scale="yaw rate scale",
                clock="yaw rate clock",
            )
        )
    for kind, name in (("surge", "u"), ("sway", "v")) if has_velocities else ():
        sensors.append(
            Sensor(
                cast("SensorKind", kind),
                t,
                log[name],
                min_noise_std=0.005 * speed,
                scale=f"{kind} scale",
                clock="velocity clock",
            )
        )
    return sensors


def _test_current(ranking: list[RankedHypothesis], log: Log) -> CurrentTest:
    """Test velocities through the water with a current against velocities over ground."""
    by_name = {ranked.name: ranked for ranked in ranking}
    water = by_name[_THROUGH_WATER].reconstruction
    # margins are already reduced by the autocorrelation; two parameters more cost 2 log(n)
    penalty = 2.0 * math.log(max(water.n_measurements, 2))
    statistic = by_name[_DECLARED].margin - by_name[_THROUGH_WATER].margin + penalty
    north, east = (water.errors[name] for name in CURRENT_NAMES)
    standard_error = max(north.standard_error, east.standard_error)
    size = math.hypot(north.value, east.value)
    # survival function of chi-squared with two degrees of freedom
    p_value = math.exp(-0.5 * max(statistic, 0.0))
    speed = float(np.nanmedian(np.hypot(log["u"], log["v"])))
    return CurrentTest(
        north=north.value,
        east=east.value,
        standard_error=standard_error,
        statistic=statistic,
        p_value=p_value,
        is_significant=p_value < _MAX_CURRENT_P_VALUE
        and size > max(3.5 * standard_error, _MIN_CURRENT_SHARE * speed)
        and all(component.is_determined or component.is_significant for component in (north, east)),
    )
