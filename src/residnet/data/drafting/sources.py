"""Sources of position, heading and velocities in a recording, and those that fit together best."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from residnet.core.errors import ResidnetError
from residnet.data.drafting.physics import FRAMES, Fit, Motion, Raw, along, follows, motion_of
from residnet.data.drafting.questions import Marks
from residnet.data.drafting.words import state_channel, words_of
from residnet.data.readers.compose import heading_part, position_part
from residnet.data.readers.quantities import (
    Angle,
    Geodetic,
    HeadingConfig,
    Local,
    PositionConfig,
    Quaternion,
)
from residnet.data.readers.recording import Recording, Series

READER = ("data", "reader")
_MOST = 12
_PAIRS = (("x", "y"), ("north", "east"), ("east", "north"))


@dataclass(frozen=True)
class Sources:
    """The part of a reader's settings that says where the motion comes from.

    Attributes:
        content: position, heading, channels and what else goes with them.
        taken: topics and fields that it takes.
        step: the shorter of the usual steps of position and heading, s.
    """

    content: dict[str, Any]
    taken: set[tuple[str, str]]
    step: float


def step_of(series: Series) -> float:
    """Return the usual step of a topic, s."""
    return float(np.median(np.diff(series.clock))) if len(series) > 1 else float("inf")


def found_sources(recording: Recording, marks: Marks, least: float) -> Sources | None:
    """Return the position and heading that fit together best and come most often.

    None where there is no pair of both that fits at least as well as asked.

    Args:
        recording: with its clocks settled.
        marks: is told what is not sure.
        least: how well they must fit together, of 1.
    """
    positions, headings = list(_positions(recording)), list(_headings(recording))
    velocities = list(_velocities(recording))
    best: tuple[float, Any] | None = None
    for position in positions[:_MOST]:
        for heading in headings[:_MOST]:
            pose = _pose(recording, position, heading)
            if pose is None:
                continue
            score, velocity = _score(recording, pose, velocities)
            rates = [step_of(recording[source.topic]) for source in (position, heading)]
            # a pose that comes once a second is worth less than one that comes ten times
            value = score - 0.3 * float(np.log10(max(max(rates), 0.05) / 0.05))
            if best is None or value > best[0]:
                best = value, (position, heading, score, velocity, min(rates))
    if best is None or best[1][2] < least:
        return None
    position, heading, score, velocity, step = best[1]
    marks.guess(
        (*READER, "position"),
        f"of {len(positions)} positions and {len(headings)} headings these fit together and come"
        f" most often (fit {score:.2f} of 1)",
    )
    marks.guess((*READER, "heading"), f"frame {heading.frame}: with it the motion fits")
    content: dict[str, Any] = {
        "standard_messages": False,
        "position": _settings(position),
        "heading": _settings(heading),
    }
    taken = {
        (source.topic or "", field) for source in (position, heading) for field in source.fields
    }
    if velocity is not None:
        marks.note(READER, f"velocities in {velocity} served to check the frames only")
    return Sources(content, taken, max(step, 0.02))


def _measured(series: Series) -> bool:
    """Return whether a topic has enough rows, and is no reference that somebody asks for."""
    words = words_of(series.name)
    return len(series) >= 50 and not words.has("command") and "guidance" not in words.text


def _settings(source: PositionConfig | HeadingConfig) -> dict[str, Any]:
    """Return what a config has to say of a source."""
    return {"kind": source.kind, **source.model_dump(mode="json", exclude_defaults=True)}


def _positions(recording: Recording) -> Iterator[PositionConfig]:
    """Yield the positions that a recording may hold, in both orders of their axes."""
    for series in recording.series.values():
        if not _measured(series):
            continue
        if series.has("latitude") and series.has("longitude"):
            yield Geodetic(topic=series.name)
            continue
        called = {state_channel(words_of(field)): field for field in reversed(series.fields)}
        if {"latitude", "longitude"} <= set(called):
            fixes = called["latitude"], called["longitude"]
            if all(
                0.0 < float(np.nanmax(np.abs(series[name]), initial=0.0)) <= 180.0 for name in fixes
            ):
                yield Geodetic(topic=series.name, latitude=fixes[0], longitude=fixes[1])
                continue
        for prefix in ("pose.pose.position.", "pose.position.", "position.", ""):
            pair = next(
                (
                    (f"{prefix}{a}", f"{prefix}{b}")
                    for a, b in _PAIRS
                    if series.has(f"{prefix}{a}") and series.has(f"{prefix}{b}")
                ),
                None,
            )
            if pair is None or (not prefix and "orientation" in series.name):
                continue
            if all(float(np.nanstd(series[name])) > 0.05 for name in pair):
                yield Local(topic=series.name, north=pair[0], east=pair[1])
                yield Local(topic=series.name, north=pair[1], east=pair[0])
            break


def _headings(recording: Recording) -> Iterator[HeadingConfig]:
    """Yield the headings that a recording may hold, in both frames."""
    for series in recording.series.values():
        if not _measured(series):
            continue
        wholes = [field[:-2] for field in series.fields if field.endswith((".w", "_w"))]
        for whole in wholes:
            if all(series.has(f"{whole}.{axis}") for axis in "xyz") and series[f"{whole}.w"].any():
                yield Quaternion(topic=series.name, field=whole, frame="ned")
                yield Quaternion(topic=series.name, field=whole, frame="enu")
        for field in series.fields:
            if state_channel(words_of(field)) != "psi" or not np.isfinite(series[field]).any():
                continue
            largest = float(np.nanmax(np.abs(series[field])))
            unit = "deg" if largest > 7.0 else "rad"
            if 0.0 < largest <= 400.0:
                yield Angle(topic=series.name, field=field, unit=unit, frame="ned")
                yield Angle(topic=series.name, field=field, unit=unit, frame="enu")


def _velocities(recording: Recording) -> Iterator[tuple[Series, str, str]]:
    """Yield pairs of fields that may be the velocities forward and sideways."""
    for series in recording.series.values():
        for prefix in ("twist.twist.linear.", "twist.linear.", "linear."):
            if series.has(f"{prefix}x") and series.has(f"{prefix}y") and _measured(series):
                yield series, f"{prefix}x", f"{prefix}y"
                break


def _pose(recording: Recording, position: PositionConfig, heading: HeadingConfig) -> Raw | None:
    """Return north, east and heading at the times of the positions; None where they cannot be."""
    try:
        place = position_part(recording, position, 1.0)
        angle = heading_part(recording, heading, 1.0)
    except ResidnetError:
        return None
    psi, t = angle.log["psi"], place.log.t
    known = np.isfinite(psi)
    # a heading that stands still fits a velocity over ground as well as one through the water
    if known.sum() < 50 or float(np.ptp(psi[known])) < 0.3:
        return None
    if angle.log.t[-1] < t[0] or angle.log.t[0] > t[-1]:
        return None
    at = np.interp(t, angle.log.t[known], psi[known], left=np.nan, right=np.nan)
    return Raw(t, {"x": place.log["x"], "y": place.log["y"], "psi": at})


def _score(
    recording: Recording, pose: Raw, velocities: list[tuple[Series, str, str]]
) -> tuple[float, str | None]:
    """Return how well a pose fits the velocities, and the topic of these; itself without any."""
    motion = motion_of(pose, "rad", FRAMES[0])
    if motion is None:
        return -1.0, None
    still = Raw(pose.t, {**pose.columns, "psi": np.zeros(pose.t.size)})
    ground = motion_of(still, "rad", FRAMES[0])
    fits = [
        (_agreement(pose, motion, pair), pair[0].name)
        for pair in velocities
        if ground is None or not _over_ground(still, ground, pair)
    ]
    best = max(fits, default=(-1.0, ""))
    if best[0] > 0.3:
        return best[0], best[1]
    return along([motion]), None


def _over_ground(still: Raw, ground: Motion, pair: tuple[Series, str, str]) -> bool:
    """Return whether a velocity counts along north and east, and says nothing of the heading."""
    series, first, second = pair
    return (
        max(
            _agreement(still, ground, (series, first, second)),
            _agreement(still, ground, (series, second, first)),
        )
        > 0.85
    )


def _agreement(pose: Raw, motion: Motion, pair: tuple[Series, str, str]) -> float:
    """Return the mean correlation of forward and sideways velocity with a pair of fields."""
    series, first, second = pair
    fits: list[Fit] = []
    for name, field in (("u", first), ("v", second)):
        known = np.isfinite(series[field])
        if known.sum() < 50:
            return -1.0
        at = np.interp(pose.t, series.clock[known], series[field][known])
        raw = Raw(pose.t, {**pose.columns, name: at})
        fits.append(follows([raw], [motion], name))
    forward, sideways = fits
    # the speed itself must agree: a heading that is turned by a right angle swaps the two
    return float(0.5 * (forward.correlation * np.sign(forward.factor) + sideways.correlation))
