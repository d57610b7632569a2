"""Drafting of readers for recordings with topics and messages."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from residnet.core.errors import ResidnetError
from residnet.core.log import Log
from residnet.io.drafting.actuator_fields import (
    concatenate_field,
    find_actuator_fields,
    match_known_command,
    name_bare_numbers,
)
from residnet.io.drafting.motion_regression import (
    POSE_FRAMES,
    RawTable,
    estimate_motion,
    fit_to_motion,
    forward_alignment,
)
from residnet.io.drafting.motion_sources import MotionSources, median_series_step
from residnet.io.drafting.named_fields import find_named_table
from residnet.io.drafting.pose_search import find_best_pose
from residnet.io.drafting.questions import CHANNELS_KEY, READER_KEY, DraftNotes
from residnet.io.drafting.tables import draft_manoeuvre_setting
from residnet.io.header_vocabulary import guess_scaling, infer_unit
from residnet.io.readers.detect import AutoConfig, detect_external_kind
from residnet.io.readers.messages import extend_with_standard_messages, is_ned_format
from residnet.io.readers.quantities import ChannelPlan
from residnet.io.readers.recording import ALL_FIELDS, Recording
from residnet.io.readers.topics import align_clocks

# smallest consistency (0 to 1) of position, heading and velocities for an unchanged mapping
_MIN_CONSISTENCY = 0.7
# median step in s above which a pose with a higher rate is searched
_MAX_POSE_INTERVAL = 0.6


def draft_recordings(
    paths: Sequence[Path], draft_notes: DraftNotes
) -> tuple[dict[str, Any], dict[Path, Recording]]:
    """Draft a reader for recordings of one format.

    Standard messages map automatically. If their position, heading and velocities are inconsistent,
    or the rate of the pose is low, other topics and frames are tested unless the format defines its
    frames. Inputs are found by their names.

    Args:
        paths: recordings.
        draft_notes: receives guesses and notes.

    Returns:
        The settings of the reader, and the recordings that were loaded.

    Raises:
        UsageError: if the first recording cannot be read.
        DataError: if it has no usable contents.
    """
    # three recordings are loaded, because a constant signal of one may vary in another
    stride = max(1, (len(paths) - 1) // 2)
    auto = AutoConfig()
    recordings = {path: auto.load(path, ALL_FIELDS) for path in (paths[0], *paths[::stride])}
    aligned = [align_clocks(recording, {}, None) for recording in recordings.values()]
    external_kind = detect_external_kind(paths[0])
    settings: dict[str, Any] = {
        "kind": external_kind or "auto",
        **draft_manoeuvre_setting(paths, draft_notes),
    }
    try:
        log = auto.build().to_log(recordings[paths[0]])
    except ResidnetError:
        log = None
    plan = extend_with_standard_messages(aligned[0], ChannelPlan())
    pose_sources = [source for source in (plan.position, plan.heading) if source is not None]
    used_fields = {(entry.topic or "", entry.field) for entry in plan.channels.values()}
    used_fields |= {
        (source.topic or "", field) for source in pose_sources for field in source.fields
    }
    steps = [
        median_series_step(aligned[0].series[s.topic])
        for s in pose_sources
        if s.topic in aligned[0].series
    ]
    sample_step = max(min(steps), 0.02) if steps else 1.0
    if not steps and log is not None:
        sample_step = float(np.median(np.diff(log.t)))
    sources = _choose_motion_sources(
        aligned,
        log,
        MotionSources({}, used_fields, sample_step),
        draft_notes,
        is_frame_fixed=any(is_ned_format(aligned[0][source.topic]) for source in pose_sources),
    )
    settings |= sources.settings
    settings["clock"] = {"kind": "uniform", "step": f"{float(f'{sources.step:.2g}'):g} s"}
    draft_notes.add_note((*READER_KEY, "clock"), "rate of the heading or of the position")
    uses_standard_messages = "standard_messages" not in settings
    known_channels = set(log.channels) if log is not None and uses_standard_messages else set()
    channels = dict(settings.pop("channels", {}))
    renamed_fields = name_bare_numbers(aligned[0], plan.channels) if uses_standard_messages else ()
    for name, (topic, field) in (
        *renamed_fields,
        *find_actuator_fields(aligned, sources.used_fields, plan, draft_notes),
    ):
        if name in known_channels or name in channels:
            continue
        if (command_of_format := match_known_command(aligned[0], topic, field)) is not None:
            settings_of_format = command_of_format[1]
            scale_text = f"{settings_of_format.get('scale', 1.0):g} " * (
                "scale" in command_of_format[1]
            )
            text = f"the format defines {field} in {scale_text}{settings_of_format['unit']}"
            draft_notes.add_note((*CHANNELS_KEY, name), text)
            channels[name] = {"topic": topic, "field": field, **settings_of_format, "hold": True}
            continue
        values = concatenate_field(aligned, topic, field)
        scaling = guess_scaling(name, field, values) or infer_unit(name, field, values)
        reason = f"taken by its name; {scaling.reason}" if scaling.reason else "taken by its name"
        draft_notes.add_guess((*CHANNELS_KEY, name), reason)
        channels[name] = {"topic": topic, "field": field, **scaling.settings, "hold": True}
    return settings | ({"channels": channels} if channels else {}), recordings


def _choose_motion_sources(
    recordings: Sequence[Recording],
    log: Log | None,
    standard_sources: MotionSources,
    draft_notes: DraftNotes,
    *,
    is_frame_fixed: bool,
) -> MotionSources:
    """Return the sources of position and heading: the standard messages, or better ones.

    Args:
        recordings: recordings with aligned clocks.
        log: log of the first recording from its standard messages; None if they are not sufficient.
        standard_sources: fields of the standard messages.
        draft_notes: receives guesses and notes.
        is_frame_fixed: whether the format defines the frame of its poses.
    """
    has_pose = log is not None and {"x", "y", "psi"} <= set(log.channels)
    if named_sources := find_named_table(recordings, draft_notes, needs_pose=not has_pose):
        return named_sources
    if log is None or not has_pose or not _is_consistent(log, draft_notes):
        other_sources = None
        if not (has_pose and is_frame_fixed):
            min_consistency = _MIN_CONSISTENCY if has_pose else 0.0
            other_sources = find_best_pose(recordings[0], draft_notes, min_consistency)
        if other_sources is None and has_pose:
            text = "position, heading and velocities are inconsistent: check the frames"
            draft_notes.add_guess(READER_KEY, text)
        return other_sources or standard_sources
    if standard_sources.step > _MAX_POSE_INTERVAL and not is_frame_fixed:
        candidate_notes = DraftNotes()
        other_sources = find_best_pose(recordings[0], candidate_notes, _MIN_CONSISTENCY)
        # the new sources have no measured velocities, so that they must have a higher rate
        if other_sources is not None and other_sources.step < 0.9 * standard_sources.step:
            draft_notes.extend(candidate_notes)
            return other_sources
    return standard_sources


def _is_consistent(log: Log, draft_notes: DraftNotes) -> bool:
    """Return whether position, heading and velocities of a log are consistent.

    A guess is noted if they are inconsistent and no other frame is better.
    """
    table = RawTable(log.t, log.channels)
    motions = [estimate_motion(table, "rad", frame) for frame in POSE_FRAMES]
    if None in motions:
        return True
    scores = []
    for motion in motions:
        velocity_fits = [
            fit_to_motion([table], [motion], name) for name in ("u", "v") if name in log.channels
        ]
        velocity_score = sum(f.correlation * np.sign(f.factor) for f in velocity_fits) / 2
        scores.append(velocity_score if len(velocity_fits) == 2 else forward_alignment([motion]))
    if scores[0] < _MIN_CONSISTENCY and max(scores) > scores[0] + 0.1:
        return False
    if scores[0] < 0.3:
        if forward_alignment(motions[:1]) > _MIN_CONSISTENCY:
            # the pose is consistent in itself: the velocities are not in body axes
            return False
        text = f"position, heading and velocities are inconsistent ({scores[0]:.2f} of 1)"
        draft_notes.add_guess(READER_KEY, f"{text}: check the frames")
    return True
