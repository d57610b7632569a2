"""Channels of columns by their names and the units in them."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

import numpy as np

from residnet.core.names import CHANNEL_UNITS, get_si_unit
from residnet.io.drafting.force_columns import match_force_column
from residnet.io.drafting.motion_columns import MAGNETIC_PATTERN, MOTION_AND_WIND_CHANNELS
from residnet.io.drafting.questions import CHANNELS_KEY, DraftNotes
from residnet.io.header_vocabulary import (
    MOTION_CHANNELS,
    REVOLUTION_PATTERN,
    ParsedName,
    find_earth_velocities,
    find_mismatched_unit,
    is_drift_angle,
    is_pulse,
    match_input_channel,
    match_state_channel,
    parse_header_unit,
    parse_name,
)
from residnet.io.readers.quantities import COSINE_SUFFIX, SINE_SUFFIX

_DRIVE_PATTERN = re.compile(r"^(?:cmd_)?(?:n(?=_|$)|thrust)")
_NAME_END = re.compile(r"\W*[\[(].*|_m$")
"""Unit at the end of a name."""
_PORT_LETTER = re.compile(r"(?<![^\W_])P(?![^\W_])")
"""Letter of the port side as a word of a name."""
_SPEED_SYMBOL = re.compile(r"[uv]( ?(s|m|c|0|ship|model|tot|total|abs|res|cg|ms))?")
"""Normalised name of a speed next to a drift angle: a symbol, perhaps with an index."""


def match_channels(
    columns: Sequence[str],
    draft_notes: DraftNotes,
    *,
    has_heading: bool = True,
) -> dict[str, str]:
    """Match columns to channels by their names.

    A speed and the drift angle next to it are the channels `speed` and `drift_angle`, which readers
    resolve to u and v. A speed without a direction is the surge velocity u if position and heading
    do not determine it.

    Args:
        columns: names of the columns.
        draft_notes: receives guesses and notes.
        has_heading: whether another source may have the heading.

    Returns:
        Channel -> column.
    """
    drift_angle = next((column for column in columns if is_drift_angle(column)), None)
    earth_velocities = find_earth_velocities(columns)
    words = _spell_out_letters(columns)
    parsed_names = {
        column: parse_name(words.get(column, column))
        for column in columns
        if column not in (drift_angle, *(earth_velocities or ()))
    }
    names, duplicates, speeds = _assign_columns([*parsed_names], parsed_names, draft_notes)
    _resolve_duplicates(names, duplicates, columns, draft_notes)
    if words.get(names.get("x", "")) == "north":
        text = f"'{names['x']}' is assumed north, next to a column of the letter E"
        draft_notes.add_guess((*CHANNELS_KEY, "x"), text)
    has_position = bool({"x", "y", "latitude", "longitude"} & names.keys())
    theta = next(
        (column for column in parsed_names if "theta" in parsed_names[column].text.split()), None
    )
    if has_position and theta is not None and not {"psi", "phi"} & names.keys():
        names["psi"] = theta
        draft_notes.add_guess(
            (*CHANNELS_KEY, "psi"), f"'{theta}' is assumed the heading, because there is no other"
        )
    _rename_single_rudder(names)
    has_heading = (
        has_heading
        or "psi" in names
        or any("course" in parsed.concepts for parsed in parsed_names.values())
    )
    if earth_velocities and has_heading and not {"u", "v"} & names.keys():
        names |= dict(zip(("u", "v"), earth_velocities, strict=True))
    if drift_angle is not None:
        names |= _pair_speed_with_drift_angle(drift_angle, names, speeds, parsed_names, draft_notes)
    if "speed" in names:
        # u and v follow from speed and drift angle
        for name in {"u", "v"} & names.keys():
            del names[name]
    elif "u" not in names and speeds and ("v" in names or not (has_position and has_heading)):
        # a speed over ground contains drift and current, that of a log along the keel does not
        names["u"] = min(speeds, key=lambda column: "ground" in parsed_names[column].concepts)
        text = f"'{names['u']}' is assumed the surge velocity, not the speed"
        draft_notes.add_guess((*CHANNELS_KEY, "u"), text)
    ordered_channels = [
        *MOTION_AND_WIND_CHANNELS,
        *(name for name in names if name not in MOTION_AND_WIND_CHANNELS),
    ]
    return {name: names[name] for name in ordered_channels if name in names}


def _spell_out_letters(columns: Sequence[str]) -> dict[str, str]:
    """Return columns with letters of directions -> their names with these words.

    Two columns N and E are north and east. A letter of actuators is a side only if another name
    differs in it alone.
    """
    lengths = [column for column in columns if find_mismatched_unit(column, "m") is None]
    names = {_NAME_END.sub("", column).strip().lower(): column for column in lengths}
    words = {}
    if {"n", "e"} <= names.keys() and not {"x", "y"} & names.keys():
        words = {names["n"]: "north", names["e"]: "east"}
    for column in columns:
        channel = _match_name(column, parse_name(column))
        if channel is None or channel in MOTION_AND_WIND_CHANNELS:
            continue
        opposite = _PORT_LETTER.sub("S", column)
        if opposite != column and opposite in columns:
            words[column] = _PORT_LETTER.sub("port", column)
            words[opposite] = _PORT_LETTER.sub("starboard", column)
    return words


def _pair_speed_with_drift_angle(
    drift_angle: str,
    names: Mapping[str, str],
    speeds: Sequence[str],
    parsed_names: Mapping[str, ParsedName],
    draft_notes: DraftNotes,
) -> dict[str, str]:
    """Return the channels of a speed and a drift angle if they are the velocities of a table.

    Args:
        drift_angle: column of the drift angle.
        names: channel -> column by names alone, in which the symbols U and V are u and v.
        speeds: columns of speed.
        parsed_names: other columns and their parsed names.
        draft_notes: receives notes.

    Returns:
        Column by channel `speed` and `drift_angle`; empty if surge and sway velocity are measured.
    """
    velocities = {name: names[name] for name in ("u", "v") if name in names}
    if len(velocities) == 2:
        return {}
    symbols = [
        column
        for column, parsed in parsed_names.items()
        if _SPEED_SYMBOL.fullmatch(parsed.text)
        and (column in velocities.values() or column not in names.values())
        and find_mismatched_unit(column, "m/s") is None
    ]
    speed = next(iter([*speeds, *symbols]), None)
    if speed is None:
        text = f"'{drift_angle}' is not read: no column is the speed next to this drift angle"
        draft_notes.add_note(CHANNELS_KEY, text)
        return {}
    return {"speed": speed, "drift_angle": drift_angle}


def _assign_columns(
    columns: Sequence[str], parsed_names: Mapping[str, ParsedName], draft_notes: DraftNotes
) -> tuple[dict[str, str], dict[str, list[str]], list[str]]:
    """Assign each column to the channel of its name.

    Returns:
        Channel -> first column; channel -> all columns, of channels with several; columns of
        speed.
    """
    names: dict[str, str] = {}
    duplicates: dict[str, list[str]] = {}
    speeds: list[str] = []
    side_velocities = _match_shaft_speeds(parsed_names)

    def sort_key(column: str) -> tuple[bool, bool, int]:
        is_magnetic = (
            MAGNETIC_PATTERN.search(column) and match_state_channel(parsed_names[column]) == "psi"
        )
        return (
            bool(is_magnetic),
            parsed_names[column].text not in MOTION_CHANNELS,
            len(parsed_names[column].concepts),
        )

    has_surge = any(match_state_channel(parsed) == "u" for parsed in parsed_names.values())
    # precedence: true before magnetic headings, then canonical names (`u` before `vx`), then names
    # with fewer concepts (`heading` before `heading of the second compass`)
    for column in sorted(columns, key=sort_key):
        force = match_force_column(column)
        name = side_velocities.get(column) or _match_name(column, parsed_names[column])
        if not force and name is None:
            continue
        channel = force or _correct_by_unit(column, name or "")
        if channel == "v" and not has_surge and _TOTAL_SPEED_PATTERN.match(column):
            # the capital V is the speed, next to which a sway velocity would have a surge velocity
            channel = "speed"
        unit = _find_other_unit(column, channel)
        if channel in MOTION_AND_WIND_CHANNELS and unit is not None:
            draft_notes.add_note(
                CHANNELS_KEY, f"'{column}' has the name of {channel}, but the unit {unit}"
            )
        elif channel == "speed":
            speeds.append(column)
        elif channel not in names:
            names[channel] = column
        else:
            duplicates.setdefault(channel, [names[channel]]).append(column)
    return names, duplicates, speeds


def _match_shaft_speeds(parsed_names: Mapping[str, ParsedName]) -> dict[str, str]:
    """Return the shaft speed channels of columns with speeds of port and starboard.

    Their names match the sway velocity, but a vessel has only one. Both sides must occur.
    """
    shaft_of_side = {"port": "n_port", "starboard": "n_stbd"}
    side_velocities = {
        column: shaft_channel
        for column, parsed in parsed_names.items()
        for side, shaft_channel in shaft_of_side.items()
        if match_state_channel(parsed) == "v"
        and parsed.has_all("speed", side)
        and parsed.has_none("sway")
    }
    return side_velocities if len({*side_velocities.values()}) == 2 else {}


def _match_name(column: str, parsed: ParsedName) -> str | None:
    """Return the state or input that a column name stands for; None for an unknown name."""
    channel = match_state_channel(parsed) or match_input_channel(parsed)
    if channel is None and parsed.has_all("pitch") and parse_header_unit(column, "-") == "%":
        # a pitch in per cent is that of a propeller's blades
        channel = match_input_channel(parse_name(f"propeller {parsed.text}"))
    return channel


def _find_other_unit(column: str, channel: str) -> str | None:
    """Return the unit in the name of a column if the channel has another dimension."""
    expected_unit = get_si_unit(channel)
    return find_mismatched_unit(column, expected_unit) if expected_unit else None


def _correct_by_unit(column: str, channel: str) -> str:
    """Return the channel of a column whose unit decides between two meanings of its name."""
    mismatched_unit = _find_other_unit(column, channel)
    if _DRIVE_PATTERN.match(channel) and (
        mismatched_unit in ("-", "us") or parse_header_unit(column, "-") == "%"
    ):
        # per cent and pulses are a throttle, neither a shaft speed nor a force
        return _DRIVE_PATTERN.sub("throttle", channel)
    return channel


def _resolve_duplicates(
    names: dict[str, str],
    duplicates: Mapping[str, Sequence[str]],
    columns: Sequence[str],
    draft_notes: DraftNotes,
) -> None:
    """Number several thrusters, and note the further columns of other channels.

    Args:
        names: channel -> column; numbered thrusters replace their common channel.
        duplicates: channel -> its columns.
        columns: columns in the order of the table, in which thrusters are numbered.
        draft_notes: receives guesses and notes.
    """
    for channel, duplicate_columns in duplicates.items():
        numbered = {
            f"{channel}_{k}": duplicate
            for k, duplicate in enumerate(sorted(duplicate_columns, key=columns.index), 1)
        }
        if "thrust" not in channel or names.keys() & numbered.keys():
            # the second column of a rudder or a shaft is usually an indicator
            for column in duplicate_columns[1:]:
                draft_notes.add_note(
                    CHANNELS_KEY,
                    f"'{column}' may be {channel} instead of '{duplicate_columns[0]}'",
                )
            continue
        # several thrusters without numbers in their names
        del names[channel]
        names |= numbered
        draft_notes.add_guess(
            (*CHANNELS_KEY, f"{channel}_1"),
            f"{', '.join(duplicate_columns)} are assumed one thruster each",
        )


def _rename_single_rudder(names: dict[str, str]) -> None:
    """Rename the rudder of one side to the only rudder, if the other side has none."""
    for port, stbd in (("delta_port", "delta_stbd"), ("cmd_delta_port", "cmd_delta_stbd")):
        if (port in names) == (stbd in names):
            continue
        # with a single rudder the side is the direction of positive angles
        column = names.pop(port if port in names else stbd)
        names.setdefault(port.removesuffix("_port"), column)


_TOTAL_SPEED_PATTERN = re.compile(r"V\s*(?:[\[(/].*)?$")
"""Name of a column with the symbol V alone, with or without a unit."""


def add_sin_cos_channels(
    names: dict[str, str], sin_cos_pairs: Mapping[str, tuple[str, str]]
) -> dict[str, str]:
    """Add channels of the cosine and sine of angles to a mapping from channel to column.

    An angle with an unknown name is the wind direction if there is a wind speed without one.
    """
    known_channels = {*names}
    for stem, cos_sin in sin_cos_pairs.items():
        parsed_name = parse_name(stem)
        channel = match_state_channel(parsed_name)
        if channel is None and known_channels & {"wind_speed", "wind_dir"} == {"wind_speed"}:
            channel = "wind_dir"
        channel = channel or match_input_channel(parsed_name)
        if channel and CHANNEL_UNITS.get(channel, "rad") == "rad" and channel not in known_channels:
            known_channels.add(channel)
            names = {
                **names,
                channel + COSINE_SUFFIX: cos_sin[0],
                channel + SINE_SUFFIX: cos_sin[1],
            }
    return names


def rename_pulsed_drives(
    names: Mapping[str, str], tables: Sequence[Mapping[str, np.ndarray]]
) -> dict[str, str]:
    """Rename shaft speeds and thrusts whose values are servo pulses or relative to throttle.

    Pulses are integers, see `is_pulse`; relative values of a motor or thruster are at most 1 and no
    integers. Columns with a word for revolutions in their names are not renamed.

    Args:
        names: channel -> column.
        tables: column -> values of each table.
    """
    renamed = {}
    for channel, column in names.items():
        values = np.concatenate([table.get(column, np.zeros(0)) for table in tables])
        values = values[np.isfinite(values)]
        throttle = _DRIVE_PATTERN.sub("throttle", channel)
        is_drive = _DRIVE_PATTERN.match(channel) and not REVOLUTION_PATTERN.search(column)
        if is_drive and values.size and throttle not in names:
            are_integers = bool((values == np.round(values)).all())
            parsed_name = parse_name(column)
            is_motor = "thrust" in channel or parsed_name.has_all("engine")
            is_motor &= parsed_name.has_none("revolutions", "propeller", "speed")
            is_relative = is_motor and not are_integers and bool(np.abs(values).max() <= 1.0)
            if is_relative or (are_integers and is_pulse("throttle", values)):
                channel = throttle
        renamed[channel] = column
    return renamed
