"""Surge and sway velocity of tables with a speed and a drift angle."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from residnet.core.units import to_si
from residnet.io.drafting.channels import ChannelMapper
from residnet.io.drafting.motion_regression import MIN_CORRELATION, PoseFrame, RawTable
from residnet.io.drafting.questions import CHANNELS_KEY, DraftNotes
from residnet.io.drafting.velocities import BODY_AXES, compute_unexplained_share
from residnet.io.header_vocabulary import infer_unit
from residnet.io.readers.quantities import SPEED_CHANNELS

_MAX_UNEXPLAINED_SHARE = 0.95
"""Unexplained share of the sway velocity above which the drift angle is of another motion."""


class DriftAngle(NamedTuple):
    """Columns of speed and drift angle, and their interpretation.

    Attributes:
        speed_column: column of the speed.
        angle_column: column of the drift angle.
        unit: unit of the drift angle.
        sign: 1 if the drift angle is assumed positive with the flow from port, -1 otherwise.
    """

    speed_column: str
    angle_column: str
    unit: str
    sign: int


def derive_drift_velocities(
    names: Mapping[str, str],
    logs: Sequence[RawTable],
    draft_notes: DraftNotes,
    degrees_per_count: float,
    candidate_frames: Sequence[PoseFrame],
) -> tuple[dict[str, str], list[RawTable], DriftAngle | None]:
    """Replace speed and drift angle by surge and sway velocity, in the unit of the speed.

    Args:
        names: channel -> column, perhaps with `speed` and `drift_angle`.
        logs: tables.
        draft_notes: receives guesses and notes.
        degrees_per_count: unit of the columns x and y, see `ChannelMapper`.
        candidate_frames: possible frames, see `ChannelMapper`.

    Returns:
        Channel -> column with `u` and `v`, tables with these columns, and the drift angle; None
        without a drift angle, or if it is not used.
    """
    if not names.keys() >= {*SPEED_CHANNELS}:
        return dict(names), list(logs), None
    other_names = {name: column for name, column in names.items() if name not in SPEED_CHANNELS}
    speed_column = names["speed"]
    angle_column = names["drift_angle"]
    tables = [table for table in logs if table.columns.keys() >= {*SPEED_CHANNELS}]
    angles = np.concatenate([table.columns["drift_angle"] for table in tables])
    scaling = infer_unit("drift_angle", angle_column, angles)
    unit = str(scaling.settings["unit"])
    has_pose = {"x", "y", "psi"} <= other_names.keys()
    # with a pose the sign follows from the sway velocity, see `restore_drift_angle`
    sign = 1 if has_pose else _find_drift_direction(tables, angle_column, draft_notes)
    derived = []
    for table in logs:
        columns = dict(table.columns)
        if columns.keys() >= {*SPEED_CHANNELS}:
            speed = columns.pop("speed")
            angle = sign * columns.pop("drift_angle") * to_si(unit, "rad")
            columns |= {"u": speed * np.cos(angle), "v": -speed * np.sin(angle)}
        derived.append(RawTable(table.t, columns))
    if has_pose:
        reference = ChannelMapper(
            other_names, derived, DraftNotes(), degrees_per_count, candidate_frames
        )
        reference.choose_frame()
        measured = reference.measure_velocities(("u", "v"), derived)
        share = compute_unexplained_share(measured, ("v",), BODY_AXES.components)
        if measured and share > _MAX_UNEXPLAINED_SHARE:
            text = (
                f"'{speed_column}' and '{angle_column}' are left out: as speed and drift angle they"
                " do not follow the sway velocity from position and heading (unexplained"
                f" {100.0 * share:.0f} %): a frozen sensor, another angle or another clock?"
            )
            draft_notes.add_note(CHANNELS_KEY, text)
            return other_names, derived, None
    if scaling.reason:
        draft_notes.add_guess((*CHANNELS_KEY, "drift_angle"), scaling.reason)
    # the symbol u is that of the surge velocity, U and V are those of the speed
    if speed_column.strip().startswith("u"):
        text = (
            f"'{speed_column}' next to the drift angle '{angle_column}' is assumed the speed; if it"
            " is the surge velocity, call its channel u and delete the channel drift_angle"
        )
        draft_notes.add_guess((*CHANNELS_KEY, "speed"), text)
    drift = DriftAngle(speed_column, angle_column, unit, sign)
    return {**other_names, **dict.fromkeys(("u", "v"), speed_column)}, derived, drift


def _find_drift_direction(
    tables: Sequence[RawTable], angle_column: str, draft_notes: DraftNotes
) -> int:
    """Return the direction of a drift angle without position: 1 if positive by SNAME, else -1.

    In a turn to starboard the stern swings out to port, so that the flow comes from port forward of
    the pivot point and the drift angle of SNAME has the sign of the yaw rate.

    Args:
        tables: tables with the columns `drift_angle` and perhaps `r`.
        angle_column: column of the drift angle, for the guess.
        draft_notes: receives the guess.
    """
    pairs = [
        np.stack((table.columns["drift_angle"], table.columns["r"]))
        for table in tables
        if "r" in table.columns
    ]
    samples = np.concatenate([np.zeros((2, 0)), *pairs], axis=1)
    angle, rate = samples[:, np.isfinite(samples).all(axis=0)]
    energy = float(np.linalg.norm(angle) * np.linalg.norm(rate))
    correlation = float(angle @ rate) / energy if energy > 0.0 else 0.0
    text = f"'{angle_column}' is assumed positive with the flow from port: v = -U sin(beta)"
    if abs(correlation) >= MIN_CORRELATION:
        text = (
            f"'{angle_column}' is positive with the flow from"
            f" {'port' if correlation > 0.0 else 'starboard'}: so the stern swings out in turns"
            f" (correlation with the yaw rate {correlation:.2f})"
        )
    draft_notes.add_guess((*CHANNELS_KEY, "drift_angle"), text)
    return -1 if correlation <= -MIN_CORRELATION else 1


def restore_drift_angle(
    entries: dict[str, dict[str, Any]], drift: DriftAngle | None, draft_notes: DraftNotes
) -> dict[str, dict[str, Any]]:
    """Replace the entries of derived velocities by entries of speed and drift angle.

    Args:
        entries: channel -> entry, with u and v of the drift angle unless these were left out.
        drift: columns and interpretation of the drift angle; None changes nothing.
        draft_notes: notes on u become notes on the speed; those on the derived v are discarded.
    """
    if drift is None:
        return entries
    others = {name: entry for name, entry in entries.items() if name not in ("u", "v")}
    if len(others) > len(entries) - 2 or "frame" in entries["u"]:
        text = (
            f"'{drift.speed_column}' and '{drift.angle_column}' are left out: u and v follow from"
            " position and heading"
        )
        draft_notes.add_note(CHANNELS_KEY, text)
        return others
    speed_sign = entries["u"].get("sign", 1)
    angle_sign = drift.sign * speed_sign * entries["v"].get("sign", 1)
    draft_notes.move_key((*CHANNELS_KEY, "u"), (*CHANNELS_KEY, "speed"))
    # v has the unit of the speed, so that a guess of its unit is no guess on the drift angle
    draft_notes.discard_key((*CHANNELS_KEY, "v"))
    text = (
        f"u = U cos(beta) and v = -U sin(beta) follow from the speed U '{drift.speed_column}' and"
        f" the drift angle beta '{drift.angle_column}'"
    )
    draft_notes.add_note((*CHANNELS_KEY, "speed"), text)
    signs = [{"sign": -1} if sign < 0 else {} for sign in (speed_sign, angle_sign)]
    velocities = {
        "speed": {"column": drift.speed_column, "unit": entries["u"]["unit"], **signs[0]},
        "drift_angle": {"column": drift.angle_column, "unit": drift.unit, **signs[1]},
    }
    return {**others, **velocities}
