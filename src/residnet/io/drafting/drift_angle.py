"""Surge and sway velocity of tables with a speed and a drift angle."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from residnet.core.units import to_si
from residnet.io.drafting.channels import ChannelMapper
from residnet.io.drafting.motion_regression import MIN_CORRELATION, PoseFrame, RawTable
from residnet.io.drafting.questions import CHANNELS_KEY, DraftNotes
from residnet.io.drafting.velocities import (
    MeasuredVelocities,
    choose_drift_angle,
    resolve_drift_angle,
)
from residnet.io.header_vocabulary import guess_unit_from_size, parse_header_unit
from residnet.io.readers.quantities import SPEED_CHANNELS


class DriftAngle(NamedTuple):
    """Columns of speed and drift angle, and their interpretation.

    Attributes:
        speed_column: column of the speed.
        angle_column: column of the drift angle.
        unit: unit of the drift angle.
        sign: 1 if the drift angle is positive with the flow from port, -1 otherwise.
        is_speed: whether the first column is the speed; otherwise it is the surge velocity.
    """

    speed_column: str
    angle_column: str
    unit: str
    sign: int
    is_speed: bool


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
        draft_notes: receives guesses, notes and the question for the meaning of the speed.
        degrees_per_count: unit of the columns x and y, see `ChannelMapper`.
        candidate_frames: possible frames, see `ChannelMapper`.

    Returns:
        Channel -> column with `u` and `v`, tables with these columns, and the drift angle; None
        without a drift angle, or if it is not used.
    """
    if not names.keys() >= {*SPEED_CHANNELS}:
        return dict(names), list(logs), None
    other_names = {name: column for name, column in names.items() if name not in SPEED_CHANNELS}
    measured: list[MeasuredVelocities] = []
    if {"x", "y", "psi"} <= other_names.keys():
        reference = ChannelMapper(
            other_names, logs, DraftNotes(), degrees_per_count, candidate_frames
        )
        reference.choose_frame()
        measured = reference.measure_velocities((*SPEED_CHANNELS,), logs)
    tables = [table for table in logs if table.columns.keys() >= {*SPEED_CHANNELS}]
    drift = _interpret_drift_angle(names, tables, measured, draft_notes)
    if drift is None:
        return other_names, list(logs), None
    derived = []
    for table in logs:
        columns = dict(table.columns)
        if columns.keys() >= {*SPEED_CHANNELS}:
            speed = columns.pop("speed")
            angle = drift.sign * columns.pop("drift_angle") * to_si(drift.unit, "rad")
            u, v = resolve_drift_angle(speed, angle)
            columns |= {"u": u, "v": v} if drift.is_speed else {"u": speed}
        derived.append(RawTable(table.t, columns))
    if not drift.is_speed:
        text = f"'{drift.angle_column}' is not read: '{drift.speed_column}' is the surge velocity"
        draft_notes.add_note(CHANNELS_KEY, text)
        return {**other_names, "u": drift.speed_column}, derived, None
    return {**other_names, **dict.fromkeys(("u", "v"), drift.speed_column)}, derived, drift


def _interpret_drift_angle(
    names: Mapping[str, str],
    tables: Sequence[RawTable],
    measured: Sequence[MeasuredVelocities],
    draft_notes: DraftNotes,
) -> DriftAngle | None:
    """Choose unit and direction of a drift angle, and the meaning of the speed next to it.

    Position and heading determine them. Without these the direction is that in which the stern
    swings out in turns.

    Args:
        names: channel -> column, with `speed` and `drift_angle`.
        tables: tables with both columns.
        measured: motion of the tables with position and heading, and both columns.
        draft_notes: receives guesses, notes and the question for the meaning of the speed.

    Returns:
        The interpretation; None if the columns contradict position and heading.
    """
    speed_column = names["speed"]
    angle_column = names["drift_angle"]
    key = (*CHANNELS_KEY, "drift_angle")
    header_unit = parse_header_unit(angle_column, "rad")
    # the symbol u is that of the surge velocity, U and V are those of the speed
    can_be_surge = speed_column.strip().startswith("u")
    is_speed = True
    if measured:
        units = [header_unit] if header_unit else ["deg", "rad"]
        choice = choose_drift_angle(measured, units, can_be_surge=can_be_surge)
        if not choice.is_consistent:
            text = (
                f"'{speed_column}' and '{angle_column}' are left out: as speed and drift angle they"
                f" differ from position and heading by {100.0 * choice.unexplained_share:.0f} %"
            )
            draft_notes.add_note(CHANNELS_KEY, text)
            return None
        problem = ""
        if choice.slope.is_constant:
            problem = "does not move, but position and heading show sway"
        elif choice.slope.is_unrelated:
            problem = (
                "does not follow position and heading (slope of the sway velocity"
                f" {choice.slope.value:.2f} instead of 1): a frozen sensor, or another clock?"
            )
        if problem:
            text = f"'{angle_column}' {problem}; '{speed_column}' and '{angle_column}' are left out"
            text += ": u and v follow from position and heading"
            draft_notes.add_note(CHANNELS_KEY, text)
            return None
        unit = choice.unit
        sign = choice.slope.sign
        is_speed = choice.is_speed
        unit_reason = f"the header has no unit; position and heading are most consistent in {unit}"
        can_be_surge &= choice.is_ambiguous
    else:
        angles = np.concatenate([table.columns["drift_angle"] for table in tables])
        unit, unit_reason = guess_unit_from_size("drift_angle", angles)
        unit = header_unit or unit
        sign = _find_drift_direction(tables, angle_column, draft_notes)
    if header_unit is None:
        draft_notes.add_guess(key, unit_reason)
    if can_be_surge:
        options = ("speed", "surge velocity")
        reason = f"'{speed_column}' next to the drift angle '{angle_column}' is assumed the speed"
        question = f"meaning of '{speed_column}' next to the drift angle '{angle_column}'"
        answer = draft_notes.ask_question(
            (*CHANNELS_KEY, "speed"), question, options[0], reason, options
        )
        is_speed = answer == options[0]
    return DriftAngle(speed_column, angle_column, unit, sign, is_speed)


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
    key = (*CHANNELS_KEY, "drift_angle")
    product = angle_energy = rate_energy = 0.0
    for table in tables:
        if "r" not in table.columns:
            continue
        is_finite = np.isfinite(table.columns["drift_angle"]) & np.isfinite(table.columns["r"])
        angle = table.columns["drift_angle"][is_finite]
        rate = table.columns["r"][is_finite]
        product += float(angle @ rate)
        angle_energy += float(angle @ angle)
        rate_energy += float(rate @ rate)
    energy = np.sqrt(angle_energy * rate_energy)
    correlation = product / energy if energy > 0.0 else 0.0
    if abs(correlation) < MIN_CORRELATION:
        text = f"'{angle_column}' is assumed positive with the flow from port: v = -U sin(beta)"
        draft_notes.add_guess(key, text)
        return 1
    direction = "port" if correlation > 0.0 else "starboard"
    text = (
        f"'{angle_column}' is positive with the flow from {direction}: so the stern swings out in"
        f" turns (correlation with the yaw rate {correlation:.2f})"
    )
    draft_notes.add_guess(key, text)
    return 1 if correlation > 0.0 else -1


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
