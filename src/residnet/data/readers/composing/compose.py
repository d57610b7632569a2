"""From a recording to a log: one clock, SI, NED and body axes, the vessel's centre."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any

import numpy as np

from residnet.core.errors import DataError, UsageError
from residnet.core.log import Log
from residnet.core.names import CHANNEL_UNITS
from residnet.data.readers.composing.agreement import agreement
from residnet.data.readers.composing.motion import (
    at_centre,
    body_velocity,
    centre_velocity,
    derive_motion,
)
from residnet.data.readers.composing.parts import (
    Part,
    channel_parts,
    heading_part,
    position_part,
    present,
    velocity_part,
)
from residnet.data.readers.composing.quantities import (
    ClockConfig,
    Derived,
    FieldMap,
    HeadingConfig,
    Lever,
    PositionConfig,
    Uniform,
    VelocityConfig,
)
from residnet.data.readers.composing.traffic import traffic
from residnet.data.readers.recording import Recording, Remark, remark

_STATE = ("x", "y", "psi", "u", "v", "r", "p", "phi")
_NS = 1e-9


@dataclass(frozen=True)
class Plan:
    """Which parts of a recording become which channels.

    Attributes:
        channels: name -> field of a topic.
        position: source of x and y.
        heading: source of psi.
        velocity: source of u, v (and r) where no channels are.
        conversions: what was converted without a setting for it, for the log's meta.
        remarks: what was noticed while deciding.
    """

    channels: Mapping[str, FieldMap] = field(default_factory=dict)
    position: PositionConfig | None = None
    heading: HeadingConfig | None = None
    velocity: VelocityConfig | None = None
    conversions: tuple[str, ...] = ()
    remarks: tuple[Remark, ...] = ()


def compose(recording: Recording, plan: Plan, clock: ClockConfig, longest_gap: float) -> Log:
    """Return the log of a recording whose clocks are settled.

    Time starts at 0 where the recording has dates (`meta["epoch"]`, Unix time in s), else it is the
    recording's own. psi starts in [0, 2 pi). Samples at which a state channel has no value are
    masked as `hard:gap`.

    Raises:
        UsageError: where a topic, field or sender is missing, or a quantity that another one needs.
        DataError: where a topic that is used has no usable time, or the topics share no stretch of
            time.
    """
    parts = _parts(recording, plan, longest_gap)
    if not parts:
        held = ", ".join(recording.series) or "nothing"
        raise UsageError(
            f"{recording.path}: no channel to read; name them under `channels`, `position`,"
            f" `heading` (the recording holds {held})"
        )
    times, step = _times(recording, parts, clock)
    values, units = _values(parts, plan, times, step)
    t = times if recording.epoch is None else _from_zero(times, clock)
    if len(t) < 2:
        raise DataError(
            f"{recording.path}: {len(t)} samples on the log's clock, at least 2 are needed"
        )
    for name, channel in values.items():
        if not np.isfinite(channel).any():
            raise DataError(
                f"{recording.path}: channel {name} holds no number on the log's clock; take it out"
                " of the map, or give its topic's delay"
            )
    states = [values[name] for name in _STATE if name in values]
    lost = np.isnan(np.stack(states)).any(axis=0) if states else np.zeros(len(t), dtype=bool)
    masks = {"hard:gap": lost} if lost.any() else {}
    log = Log(
        recording.path.stem,
        t,
        values,
        units,
        masks=masks,
        meta=_meta(recording, plan, parts, times),
    )
    disagreements = agreement(recording, log, float(times[0]), log.meta["topics_not_used"])
    return log.replace(meta={**log.meta, "findings": [*log.meta["findings"], *disagreements]})


def _parts(recording: Recording, plan: Plan, longest_gap: float) -> list[Part]:
    parts = channel_parts(recording, plan.channels, longest_gap)
    if plan.heading is not None:
        parts.insert(0, heading_part(recording, plan.heading, longest_gap))
    if plan.position is not None:
        parts.insert(0, position_part(recording, plan.position, longest_gap))
    if plan.velocity is not None and not isinstance(plan.velocity, Derived):
        parts.append(velocity_part(recording, plan.velocity, longest_gap))
    for part in parts:
        fatal = next((entry for entry in part.remarks if entry["level"] == "fatal"), None)
        if fatal is not None:
            raise DataError(f"{recording.path}: {fatal['text']}")
    return parts


def _times(
    recording: Recording, parts: Sequence[Part], clock: ClockConfig
) -> tuple[np.ndarray, float]:
    """Return the times of the log's samples on the recording's clock, and their step, s."""
    if not isinstance(clock, Uniform):
        times = parts[0].log.t if clock.topic is None else recording[clock.topic].clock
        return times, float(np.median(np.diff(times))) if times.size > 1 else 1.0
    state = [part for part in parts if part.state]
    moving = state or [part for part in parts if not part.all_held] or list(parts)
    start, stop = max(part.log.t[0] for part in moving), min(part.log.t[-1] for part in moving)
    if stop - start < clock.step:
        spans = "; ".join(
            f"{part.topic} {part.log.t[0]:.1f} to {part.log.t[-1]:.1f} s" for part in moving
        )
        raise DataError(
            f"{recording.path}: the topics share no stretch of time ({spans}); check `zone` and"
            " `delays`"
        )
    # a grid that starts on whole multiples of the step in Unix time lets logs of one day lie on one
    # grid
    ahead = 0.0 if recording.epoch is None else recording.epoch % round(clock.step * 1e9) * _NS
    first = (
        start
        if recording.epoch is None
        else math.ceil((start + ahead) / clock.step - 1e-6) * clock.step - ahead
    )
    count = math.floor((stop - first) / clock.step + 1e-6) + 1
    return first + clock.step * np.arange(count), clock.step


def _from_zero(times: np.ndarray, clock: ClockConfig) -> np.ndarray:
    return clock.step * np.arange(times.size) if isinstance(clock, Uniform) else times - times[:1]


def _values(
    parts: Sequence[Part], plan: Plan, times: np.ndarray, step: float
) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Return the channels [T] and their units on the log's clock."""
    derived = plan.velocity if isinstance(plan.velocity, Derived) else None
    values: dict[str, np.ndarray] = {}
    units: dict[str, str] = {}
    for part in parts:
        if derived is None or not part.pose:
            values.update(part.at(times, step))
            units.update(part.log.units)
    if derived is not None:
        pose = [part for part in parts if part.pose]
        values = {**derive_motion(pose, derived, _lever(plan.position), times, step), **values}
    else:
        _finish(values, plan)
    for name in ("x", "y", "psi", "u", "v", "r"):
        if name in values:
            units[name] = CHANNEL_UNITS[name]
    return values, {name: unit for name, unit in units.items() if name in values}


def _finish(values: dict[str, np.ndarray], plan: Plan) -> None:
    """Return the levers and turned velocities, in place."""
    lever = _lever(plan.position)
    if lever != Lever():
        if "psi" not in values:
            raise UsageError(
                "position.antenna: needs the heading to move the position to the vessel's centre;"
                " give `heading`"
            )
        values["x"], values["y"] = at_centre(values["x"], values["y"], values["psi"], lever)
    if plan.velocity is None or isinstance(plan.velocity, Derived):
        return
    if "psi" not in values:
        raise UsageError(
            "velocity: needs the heading to turn earth-fixed velocities into body axes; give"
            " `heading`"
        )
    u, v = body_velocity(values.pop("north_rate"), values.pop("east_rate"), values["psi"])
    if plan.velocity.antenna != Lever():
        if "r" not in values:
            raise UsageError(
                "velocity.antenna: needs the yaw rate to move the velocity to the vessel's centre;"
                " give channels.r"
            )
        u, v = centre_velocity(u, v, values["r"], plan.velocity.antenna)
    values["u"], values["v"] = u, v


def _lever(position: PositionConfig | None) -> Lever:
    return Lever() if position is None else position.antenna


def _meta(
    recording: Recording, plan: Plan, parts: Sequence[Part], times: np.ndarray
) -> dict[str, Any]:
    remarks: list[Remark] = [*recording.remarks, *plan.remarks]
    topics: dict[str, Any] = {}
    for series in recording.series.values():
        found = traffic(series)
        named = sum(e.topic == series.name and e.sender is not None for e in plan.channels.values())
        remarks += series.remarks
        # senders that each have a channel are told apart already
        remarks += [r for r in found if not (named > 1 and r["code"] == "several_publishers")]
        topics[series.name] = {
            "kind": series.kind,
            "rows": len(series),
            **next((r["figures"] for r in found if r["code"] == "topic_rate"), {}),
        }
    absent = [name for name in plan.channels if name not in present(recording, plan.channels)]
    if absent:
        text = (
            f"channels {', '.join(absent)} are not in the recording or hold no number; the log"
            " lacks them (they are not required)"
        )
        remarks.append(remark("note", "missing_channels", text, channels=len(absent)))
    used = {part.topic for part in parts}
    remarks += [entry for part in parts for entry in part.remarks if entry not in remarks]
    idle = [name for name in (*recording.series, *recording.listed) if name not in used]
    meta: dict[str, Any] = {
        "findings": remarks,
        "topics": topics,
        "topics_not_used": idle,
        "frames": [*plan.conversions, *(text for part in parts for text in part.conversion)],
    }
    rows = {part.topic: len(part.log) for part in parts}
    meta |= {
        "rows_read": sum(len(series) for series in recording.series.values()),
        "rows_dropped": 0,
        "rows_used": sum(rows.values()),
    }
    if recording.epoch is not None:
        start = recording.epoch + int(np.rint(times[0] * 1e9))
        meta |= {"epoch": start * _NS, "epoch_ns": start, "start_utc": _utc(start)}
    return meta


def _utc(ns: int) -> str:
    """Return the date and time of Unix time in ns."""
    return (
        datetime.fromtimestamp(ns // 10**9, UTC).strftime("%Y-%m-%dT%H:%M:%S")
        + f".{ns % 10**9:09d}Z"
    )
