"""Search for the most consistent pair of position and heading in a recording."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Literal

import numpy as np

from residnet.core.errors import ResidnetError
from residnet.io.drafting.motion_regression import (
    POSE_FRAMES,
    Motion,
    RawTable,
    ScaleFit,
    estimate_motion,
    fit_to_motion,
    forward_alignment,
)
from residnet.io.drafting.motion_sources import MIN_MOTION_ROWS, MotionSources, median_series_step
from residnet.io.drafting.questions import READER_KEY, DraftNotes
from residnet.io.header_vocabulary import match_state_channel, parse_name
from residnet.io.readers.compose import extract_heading, extract_position
from residnet.io.readers.messages import is_ned_format
from residnet.io.readers.quantities import (
    AngleHeading,
    GeodeticPosition,
    HeadingConfig,
    LocalPosition,
    PositionConfig,
    QuaternionHeading,
)
from residnet.io.readers.recording import Recording, Series

_MAX_POSE_CANDIDATES = 12
"""Largest number of positions and of headings whose combinations are tested."""
_AXIS_PAIRS = (("x", "y"), ("north", "east"), ("east", "north"))


def find_best_pose(
    recording: Recording, draft_notes: DraftNotes, min_score: float
) -> MotionSources | None:
    """Return the most consistent pair of position and heading, with preference for high rates.

    Args:
        recording: recording with aligned clocks.
        draft_notes: receives guesses and notes.
        min_score: smallest consistency, at most 1.

    Returns:
        The sources; None if no pair reaches the smallest consistency.
    """
    positions = list(_iter_position_sources(recording))
    headings = list(_iter_heading_sources(recording))
    velocities = list(_iter_velocity_fields(recording))
    best_candidate: tuple[float, Any] = (-np.inf, None)
    for position in positions[:_MAX_POSE_CANDIDATES]:
        for heading in headings[:_MAX_POSE_CANDIDATES]:
            pose = extract_pose(recording, position, heading)
            if pose is None:
                continue
            score, velocity = _score_pose(pose, velocities)
            source_steps = [
                median_series_step(recording[source.topic]) for source in (position, heading)
            ]
            # a tenth of the rate costs .3 of the score
            score_with_rate = score - 0.3 * float(np.log10(max(max(source_steps), 0.05) / 0.05))
            if score_with_rate > best_candidate[0]:
                best_candidate = (
                    score_with_rate,
                    (position, heading, score, velocity, min(source_steps)),
                )
    if best_candidate[1] is None or best_candidate[1][2] < min_score:
        return None
    position, heading, score, velocity, step = best_candidate[1]
    text = f"most consistent pair of {len(positions)} positions and {len(headings)} headings"
    draft_notes.add_guess((*READER_KEY, "position"), f"{text} (consistency {score:.2f} of 1)")
    draft_notes.add_guess(
        (*READER_KEY, "heading"), f"frame {heading.frame}: consistent with the motion"
    )
    if velocity is not None:
        draft_notes.add_note(
            READER_KEY, f"velocities in {velocity} were used to check the frames only"
        )
    settings: dict[str, Any] = {"standard_messages": False}
    for name, source in (("position", position), ("heading", heading)):
        source_settings = source.model_dump(mode="json", exclude_defaults=True)
        settings[name] = {"kind": source.kind, **source_settings}
    used_fields = {
        (source.topic, field) for source in (position, heading) for field in source.fields
    }
    return MotionSources(settings, used_fields, max(step, 0.02))


def _iter_measured_series(recording: Recording) -> Iterator[Series]:
    """Yield the series with sufficient rows that are no setpoints."""
    for series in recording.series.values():
        parsed_name = parse_name(series.name)
        if (
            len(series) >= MIN_MOTION_ROWS
            and not parsed_name.has_all("command")
            and "guidance" not in parsed_name.text
        ):
            yield series


def _iter_position_sources(recording: Recording) -> Iterator[PositionConfig]:
    """Yield possible positions of a recording, local ones in both orders of their axes."""
    for series in _iter_measured_series(recording):
        if series.has_field("latitude") and series.has_field("longitude"):
            yield GeodeticPosition(topic=series.name)
            continue
        field_by_channel = {
            match_state_channel(parse_name(field)): field for field in reversed(series.fields)
        }
        if {"latitude", "longitude"} <= set(field_by_channel):
            fix_fields = field_by_channel["latitude"], field_by_channel["longitude"]
            largest = [float(np.nanmax(np.abs(series[name]), initial=0.0)) for name in fix_fields]
            if min(largest) > 0.0 and max(largest) <= 180.0:
                yield GeodeticPosition(
                    topic=series.name, latitude=fix_fields[0], longitude=fix_fields[1]
                )
                continue
        prefixes = ("pose.pose.position.", "pose.position.", "position.", "")
        pairs = ((f"{p}{a}", f"{p}{b}") for p in prefixes for a, b in _AXIS_PAIRS)
        axis_pair = next(
            (axis_pair for axis_pair in pairs if all(map(series.has_field, axis_pair))), None
        )
        if axis_pair is None or ("." not in axis_pair[0] and "orientation" in series.name):
            continue
        if all(float(np.nanstd(series[name])) > 0.05 for name in axis_pair):
            yield LocalPosition(topic=series.name, north=axis_pair[0], east=axis_pair[1])
            if not is_ned_format(series):
                yield LocalPosition(topic=series.name, north=axis_pair[1], east=axis_pair[0])


def _iter_heading_sources(recording: Recording) -> Iterator[HeadingConfig]:
    """Yield possible headings of a recording: quaternions and angles, in both frames."""
    for series in _iter_measured_series(recording):
        frames: tuple[Literal["ned", "enu"], ...] = (
            ("ned",) if is_ned_format(series) else ("ned", "enu")
        )
        for quaternion_path in [
            field[:-2] for field in series.fields if field.endswith((".w", "_w"))
        ]:
            if (
                all(series.has_field(f"{quaternion_path}.{axis}") for axis in "xyz")
                and series[f"{quaternion_path}.w"].any()
            ):
                for frame in frames:
                    yield QuaternionHeading(topic=series.name, field=quaternion_path, frame=frame)
        for field in series.fields:
            if match_state_channel(parse_name(field)) == "psi" and np.isfinite(series[field]).any():
                max_angle = float(np.nanmax(np.abs(series[field])))
                unit = "deg" if max_angle > 7.0 else "rad"
                if 0.0 < max_angle <= 400.0:
                    for frame in frames:
                        yield AngleHeading(topic=series.name, field=field, unit=unit, frame=frame)


def _iter_velocity_fields(recording: Recording) -> Iterator[tuple[Series, str, str]]:
    """Yield series and fields of possible velocities forward and sideways."""
    for series in _iter_measured_series(recording):
        prefixes = ("twist.twist.linear.", "twist.linear.", "linear.")
        prefix = next(
            (p for p in prefixes if series.has_field(f"{p}x") and series.has_field(f"{p}y")), None
        )
        if prefix is not None:
            yield series, f"{prefix}x", f"{prefix}y"


def extract_pose(
    recording: Recording, position: PositionConfig, heading: HeadingConfig
) -> RawTable | None:
    """Return north, east and heading at the times of the positions, or None.

    None means that a source cannot be read, the clocks do not overlap, or the heading is constant.
    """
    try:
        position_log = extract_position(recording, position).log
        heading_log = extract_heading(recording, heading).log
    except ResidnetError:
        return None
    is_finite = np.isfinite(heading_log["psi"])
    # with a constant heading, velocities in body axes and in earth axes are equally consistent
    if is_finite.sum() < MIN_MOTION_ROWS or float(np.ptp(heading_log["psi"][is_finite])) < 0.3:
        return None
    if heading_log.t[-1] < position_log.t[0] or heading_log.t[0] > position_log.t[-1]:
        return None
    heading_at_positions = np.interp(
        position_log.t,
        heading_log.t[is_finite],
        heading_log["psi"][is_finite],
        left=np.nan,
        right=np.nan,
    )
    return RawTable(
        position_log.t,
        {"x": position_log["x"], "y": position_log["y"], "psi": heading_at_positions},
    )


def _score_pose(
    pose: RawTable, velocities: list[tuple[Series, str, str]]
) -> tuple[float, str | None]:
    """Return the consistency of a pose, at most 1, and the topic of the velocities used for it.

    Without suitable velocities the consistency is the forward alignment of the motion.

    Args:
        pose: table with x, y, psi.
        velocities: series and fields of possible velocities forward and sideways.
    """
    motion = estimate_motion(pose, "rad", POSE_FRAMES[0])
    if motion is None:
        return -1.0, None
    unrotated_pose = RawTable(pose.t, {**pose.columns, "psi": np.zeros(pose.t.size)})
    earth_fixed_motion = estimate_motion(unrotated_pose, "rad", POSE_FRAMES[0])
    scored_topics = [(-1.0, "")]
    for series, first_field, second_field in velocities:
        field_orders = [(first_field, second_field), (second_field, first_field)]
        earth_fixed_scores = (
            [
                _mean_velocity_correlation(unrotated_pose, earth_fixed_motion, series, *pair)
                for pair in field_orders
            ]
            if earth_fixed_motion
            else [0.0]
        )
        # velocities in earth axes do not depend on the heading
        if max(earth_fixed_scores) <= 0.85:
            scored_topics.append(
                (
                    _mean_velocity_correlation(pose, motion, series, first_field, second_field),
                    series.name,
                )
            )
    best_fit = max(scored_topics)
    return best_fit if best_fit[0] > 0.3 else (forward_alignment([motion]), None)


def _mean_velocity_correlation(
    pose: RawTable, motion: Motion, series: Series, forward_field: str, sideways_field: str
) -> float:
    """Return the mean correlation of surge and sway velocity with a pair of fields."""
    velocity_fits: list[ScaleFit] = []
    for name, field in (("u", forward_field), ("v", sideways_field)):
        is_finite = np.isfinite(series[field])
        if is_finite.sum() < MIN_MOTION_ROWS:
            return -1.0
        interpolated = np.interp(pose.t, series.clock[is_finite], series[field][is_finite])
        velocity_fits.append(
            fit_to_motion([RawTable(pose.t, {**pose.columns, name: interpolated})], [motion], name)
        )
    forward_fit, sideways_fit = velocity_fits
    # the sign of the forward factor counts: a heading that is off by 90 deg exchanges both
    return float(
        0.5 * (forward_fit.correlation * np.sign(forward_fit.factor) + sideways_fit.correlation)
    )
