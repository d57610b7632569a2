"""The channel map of tables that nobody described, with what is not sure about it."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from residnet.core.errors import DataError, ResidnetError, UsageError
from residnet.core.names import CHANNEL_UNITS
from residnet.data.drafting.channels import (
    CHANNELS,
    READER,
    STATE_NAMES,
    drafted_channels,
    levelled,
    quaternions,
)
from residnet.data.drafting.physics import Raw
from residnet.data.drafting.questions import Marks
from residnet.data.drafting.sheets import (
    Clock,
    Sheet,
    clock_of,
    peek,
    refuse_written_positions,
    with_degrees,
)
from residnet.data.drafting.units import other_dimension
from residnet.data.drafting.words import input_channel, state_channel, words_of

_LOOKED_AT = 24
"""Tables whose values are looked at; of the others only the header is."""


def draft_tables(
    files: Sequence[Path], marks: Marks
) -> tuple[dict[str, Any], dict[Path, ResidnetError]]:
    """Return the settings of a reader of tables, and file -> why it is not read.

    They come from names, units in the headers, values and physics.

    Args:
        files: at least one table.
        marks: is told what is not sure.

    Raises:
        UsageError: where the tables have nothing in common.
        DataError: where none can be read, or none has a time.
    """
    sheets, left_out = _sheets(files)
    first, written = with_degrees(sheets[0], marks)
    sheets = [first, *(with_degrees(sheet, Marks())[0] for sheet in sheets[1:])]
    shared = [name for name in first.header if all(name in sheet.header for sheet in sheets)]
    lost = sorted({name for sheet in sheets for name in sheet.header} - set(shared))
    if lost:
        marks.note(CHANNELS, f"not in every file, left out: {', '.join(lost[:12])}")
    clock = clock_of(first)
    if not set(clock.columns) <= set(shared):
        raise UsageError(f"{first.path}: its time '{clock.columns[0]}' is not in every file")
    if clock.guess:
        marks.guess((*READER, "time"), clock.guess)
    numeric = [name for name in shared if name in first.numbers and name not in clock.columns]
    attitudes = quaternions(numeric)
    parts = {column for attitude in attitudes for column in attitude.values()}
    names = named([name for name in numeric if name not in parts], marks)
    refuse_written_positions(first, names)
    if "psi" not in names:
        names |= levelled(attitudes, [one.numbers for one in sheets])
    logs = _raw(sheets, names, left_out)
    cells = [str(text) for texts in first.texts.values() for text in texts.unique()[:20]]
    channels = drafted_channels(names, logs, marks, [*first.header, *cells])
    for entry in channels.values():
        settings = written.get(entry["column"], {})
        entry |= {"column": first.column(entry["column"]), **settings}
    about = {key: value for key, value in first.about.items() if key != "kind"}
    time = {**clock.settings, "column": first.column(clock.settings["column"])}
    content = {"kind": first.about["kind"], **about, "time": time}
    content |= mark_folders(files, marks)
    _unused(first, names, clock, marks)
    return {**content, "channels": channels}, left_out


def mark_folders(files: Sequence[Path], marks: Marks) -> dict[str, str]:
    """Return the setting of files in several folders, whose names tell the manoeuvres."""
    if len({path.resolve().parent for path in files}) < 2:
        return {}
    marks.guess((*READER, "manoeuvre"), "the kind of manoeuvre is taken from the folder's name")
    return {"manoeuvre": "folder"}


def _sheets(files: Sequence[Path]) -> tuple[list[Sheet], dict[Path, ResidnetError]]:
    """Return the first rows of the tables, those of some with all that is looked at."""
    stride = max(1, len(files) // _LOOKED_AT)
    sheets: list[Sheet] = []
    left_out: dict[Path, ResidnetError] = {}
    for number, path in enumerate(files):
        try:
            sheets.append(peek(path) if number % stride == 0 else peek(path, 50))
        except DataError as error:
            left_out[path] = error
    if not sheets:
        raise next(iter(left_out.values()))
    kinds = {tuple(sorted(sheet.about.items())) for sheet in sheets if len(sheet.numbers) > 1}
    if not kinds:
        path, names = sheets[0].path, ", ".join(sheets[0].header[:12])
        raise DataError(
            f"{path}: fewer than two of its columns hold numbers (columns: {names}); check how the"
            " table was exported"
        )
    if len({dict(kind)["kind"] for kind in kinds}) > 1:
        raise UsageError("the tables are of several formats; give those of one format at a time")
    # the form that most of them have: a table of whole numbers shows no decimal sign
    usual = max(kinds, key=lambda kind: (len(kind), sum(s.about == dict(kind) for s in sheets)))
    best = next(i for i, s in enumerate(sheets) if tuple(sorted(s.about.items())) == usual)
    return [sheets[best], *sheets[:best], *sheets[best + 1 :]], left_out


def named(columns: Sequence[str], marks: Marks) -> dict[str, str]:
    """Return channel -> column, by what the columns are called."""
    alone = {re.sub(r"\W*[\[(].*", "", column).strip().lower(): column for column in columns}
    if {"n", "e"} <= set(alone):
        pair = {"x": alone["n"], "y": alone["e"]}
        rest = Marks()
        others = named([name for name in columns if name not in pair.values()], rest)
        if not {"x", "y", "latitude", "longitude"} & set(others):
            # beside E, N counts no revolutions
            marks.extend(rest)
            text = f"'{pair['x']}' and '{pair['y']}' side by side are taken as north and east"
            marks.guess((*CHANNELS, "x"), text)
            return {**pair, **others}
    names: dict[str, str] = {}
    speeds: list[str] = []
    about = {column: words_of(column) for column in columns}
    copied = re.compile(r"\.\d+$")
    # shorter names first: `heading` before `heading of the second compass`
    for column in sorted(columns, key=lambda name: len(about[name].about)):
        channel = state_channel(about[column]) or input_channel(about[column])
        si = CHANNEL_UNITS.get(channel or "")
        other = other_dimension(column, si) if si else None
        if channel == "n" and other == "m":
            channel = "x"
        elif channel and re.match(r"(cmd_)?n(_|$)", channel) and other in ("-", "%", "us"):
            # no revolutions: the share of the throttle, or pulses to it
            channel = re.sub(r"^(cmd_)?n", "throttle", channel)
        elif channel in STATE_NAMES and other:
            marks.note(CHANNELS, f"'{column}' is called as {channel} is, but holds {other}")
            continue
        if channel == "speed":
            speeds.append(column)
        elif channel is not None and channel not in names:
            names[channel] = column
        elif channel is not None and copied.sub("", column) == copied.sub("", names[channel]):
            text = f"the header names it more than once; '{names[channel]}' is the first of them"
            marks.guess((*CHANNELS, channel), text)
        elif channel is not None:
            marks.note(CHANNELS, f"'{column}' may be {channel} as well as '{names[channel]}' is")
    if "u" not in names and "v" in names and speeds:
        names["u"] = speeds[0]
        marks.guess((*CHANNELS, "u"), f"'{speeds[0]}' is taken as the speed forward, not its size")
    order = [*STATE_NAMES, *(name for name in names if name not in STATE_NAMES)]
    return {name: names[name] for name in order if name in names}


def _raw(
    sheets: Sequence[Sheet], names: Mapping[str, str], left_out: dict[Path, ResidnetError]
) -> list[Raw]:
    logs = []
    for sheet in sheets:
        try:
            clock = clock_of(sheet)
        except DataError as error:
            left_out[sheet.path] = error
            continue
        columns = {
            channel: sheet.numbers[column]
            for channel, column in names.items()
            if column in sheet.numbers
        }
        logs.append(Raw(clock.seconds, columns))
    return logs


def _unused(sheet: Sheet, names: Mapping[str, str], clock: Clock, marks: Marks) -> None:
    used = {*names.values(), *clock.columns}
    idle = [name for name in sheet.numbers if name not in used]
    if idle:
        marks.note(CHANNELS, f"columns that no channel takes: {', '.join(idle[:20])}")
    if sheet.texts.keys() - used:
        marks.note(CHANNELS, f"columns of text: {', '.join(list(sheet.texts.keys() - used)[:12])}")
    if sheet.empty:
        marks.note(CHANNELS, f"empty columns: {', '.join(sheet.empty[:12])}")
