"""Drafting of readers for recordings with topics and messages."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from residnet.core.errors import ResidnetError
from residnet.core.log import Log
from residnet.core.names import CHANNEL_UNITS
from residnet.io.drafting.actuator_fields import (
    concatenate_field,
    find_actuator_fields,
    match_known_command,
)
from residnet.io.drafting.motion_regression import (
    POSE_FRAMES,
    RawTable,
    estimate_motion,
)
from residnet.io.drafting.motion_sources import MotionSources, median_series_step
from residnet.io.drafting.named_fields import find_named_table
from residnet.io.drafting.questions import CHANNELS_KEY, READER_KEY, DraftNotes
from residnet.io.drafting.tables import draft_manoeuvre_setting
from residnet.io.header_vocabulary import guess_scaling, infer_unit
from residnet.io.readers.detect import AutoConfig, detect_external_kind
from residnet.io.readers.messages import extend_with_standard_messages, is_ned_format
from residnet.io.readers.quantities import ChannelPlan
from residnet.io.readers.recording import ALL_FIELDS, Recording
from residnet.io.readers.topics import align_clocks

_MIN_CONSISTENCY = 0.7
"""Smallest cosine between velocities and those of the positions for an unchanged mapping."""


def draft_recordings(
    paths: Sequence[Path], draft_notes: DraftNotes
) -> tuple[dict[str, Any], dict[Path, Recording]]:
    """Draft a reader for recordings of one format.

    Standard messages map automatically. Without a pose of theirs, or if it contradicts their
    velocities, fields are mapped by their names, and their frames are determined as those of
    tables. Inputs are found by their names.

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
    # numbers without a unit may be those of an actuator, by the name of their topic
    used_fields = {
        (entry.topic or "", entry.field)
        for name, entry in plan.channels.items()
        if name in CHANNEL_UNITS or entry.unit not in ("-", "rad")
    }
    used_fields |= {
        (source.topic or "", field) for source in pose_sources for field in source.fields
    }
    steps = [
        median_series_step(aligned[0].series[source.topic])
        for source in pose_sources
        if source.topic in aligned[0].series
    ]
    if not steps and log is not None:
        steps = [float(np.median(np.diff(log.t)))]
    has_pose = log is not None and {"x", "y", "psi"} <= log.channels.keys()
    # formats such as NMEA and ULog define their frames: a contradiction is an error of the sensors
    has_fixed_frame = any(
        is_ned_format(aligned[0].series[source.topic])
        for source in pose_sources
        if source.topic in aligned[0].series
    )
    needs_pose = log is None or not has_pose or not (has_fixed_frame or _is_consistent(log))
    sources = find_named_table(aligned, draft_notes, needs_pose=needs_pose)
    known_channels: set[str] = set()
    if sources is None:
        sources = MotionSources({}, used_fields, max(min(steps, default=1.0), 0.02))
        known_channels = set() if log is None else {*log.channels}
    settings |= sources.settings
    settings["clock"] = {"kind": "uniform", "step": f"{float(f'{sources.step:.2g}'):g} s"}
    draft_notes.add_note((*READER_KEY, "clock"), "rate of the heading or of the position")
    channels = dict(settings.pop("channels", {}))
    for name, (topic, field) in find_actuator_fields(
        aligned, sources.used_fields, plan, draft_notes
    ):
        if name in known_channels or name in channels:
            continue
        key = (*CHANNELS_KEY, name)
        _, entry = match_known_command(aligned[0], topic, field) or ("", {})
        if entry:
            draft_notes.add_note(key, f"the format defines {field} in {entry['unit']}")
        else:
            values = concatenate_field(aligned, topic, field)
            scaling = guess_scaling(name, field, values) or infer_unit(name, field, values)
            entry = scaling.settings
            reasons = filter(None, ("taken by its name", scaling.reason))
            draft_notes.add_guess(key, "; ".join(reasons))
        channels[name] = {"topic": topic, "field": field, **entry, "hold": True}
    return settings | ({"channels": channels} if channels else {}), recordings


def _is_consistent(log: Log) -> bool:
    """Return whether u and v of a log, if measured, are the velocities of its positions."""
    motion = estimate_motion(RawTable(log.t, log.channels), "rad", POSE_FRAMES[0])
    if motion is None or not {"u", "v"} <= log.channels.keys():
        return True
    velocity = np.interp(motion.t, log.t, log["u"]) + 1j * np.interp(motion.t, log.t, log["v"])
    reference = motion.surge_velocity + 1j * motion.sway_velocity
    is_known = np.isfinite(velocity)
    product = np.vdot(velocity[is_known], reference[is_known]).real
    norms = np.linalg.norm(velocity[is_known]) * np.linalg.norm(reference[is_known])
    return bool(product >= _MIN_CONSISTENCY * norms)
