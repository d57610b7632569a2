"""Drafting of channel maps for tables from names, units, values and physics."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from residnet.core.errors import DataError, ResidnetError, UsageError
from residnet.core.names import truncate
from residnet.io.drafting.channel_map import draft_channel_map
from residnet.io.drafting.column_names import add_sin_cos_channels, rename_pulsed_drives
from residnet.io.drafting.geodetic_columns import (
    MAX_COORDINATES,
    convert_positions_to_degrees,
    refuse_minute_columns,
    refuse_unparsed_positions,
)
from residnet.io.drafting.motion_columns import (
    MOTION_AND_WIND_CHANNELS,
    choose_quaternion_order,
    find_depth_channels,
    find_quaternions,
    find_sin_cos_pairs,
)
from residnet.io.drafting.motion_regression import RawTable
from residnet.io.drafting.questions import (
    CHANNELS_KEY,
    READER_KEY,
    TEXT_COLUMNS,
    UNMAPPED_COLUMNS,
    DraftNotes,
)
from residnet.io.drafting.table_clock import (
    TableClock,
    detect_clock,
    detect_or_ask_clock,
    make_step_clock,
)
from residnet.io.drafting.table_preview import TablePreview, preview_named_tables
from residnet.io.drafting.vessel_rows import (
    drop_ais_turn_rate,
    match_columns_of_one_vessel,
    select_vessel_rows,
)
from residnet.io.header_vocabulary import match_state_channel, parse_name
from residnet.io.readers.base import locate_file
from residnet.io.readers.clock_repair import find_unique_rows
from residnet.io.readers.manoeuvre_kinds import match_manoeuvre_name
from residnet.io.readers.quantities import QUATERNION
from residnet.io.readers.several_tests import list_vessels
from residnet.preprocessing.channel_values import INTERVAL_TOLERANCE, MIN_REGULAR_SHARE


def draft_tables(
    files: Sequence[Path], draft_notes: DraftNotes, *, has_heading: bool = False
) -> tuple[dict[str, Any], dict[Path, ResidnetError]]:
    """Draft a reader for tables from names, units in headers, values and physics.

    Args:
        files: tables; at least one.
        draft_notes: receives guesses and notes.
        has_heading: whether other files may have the heading.

    Returns:
        The settings of the reader, and the error of each table that cannot be read.

    Raises:
        UsageError: if the tables have no common column of time.
        DataError: if no table can be read, or none has a time.
    """
    previews, errors, names = preview_named_tables(files, draft_notes)
    previews, select = select_vessel_rows(previews, draft_notes)
    main_preview, column_settings = convert_positions_to_degrees(previews[0], draft_notes)
    previews = [
        main_preview,
        *(convert_positions_to_degrees(sheet, DraftNotes())[0] for sheet in previews[1:]),
    ]
    clock, step = detect_or_ask_clock(previews, draft_notes)
    common_columns = _find_common_columns(previews, clock, draft_notes)
    if clock.guess:
        draft_notes.add_guess((*READER_KEY, "time"), clock.guess)
    numeric_columns = {name for sheet in previews for name in sheet.numeric_columns}
    common_numeric = [
        name for name in common_columns if name in numeric_columns and name not in clock.columns
    ]
    refuse_minute_columns(main_preview.path, common_numeric)
    if select:
        common_numeric = drop_ais_turn_rate(common_numeric, main_preview, draft_notes)
    logs = _build_raw_tables(previews, common_numeric, errors, step)
    column_by_channel, channels = draft_columns(
        common_numeric,
        logs,
        draft_notes,
        partial(match_columns_of_one_vessel, numeric_columns=main_preview.numeric_columns),
        _collect_texts(main_preview),
        has_heading=has_heading,
    )
    refuse_unparsed_positions(main_preview, column_by_channel)
    if not column_by_channel:
        raise DataError(
            f"{main_preview.path}: no column has the name of a channel"
            f" ({', '.join(common_numeric[:12])});"
            f" {_suggest_table_fix(common_numeric)}"
        )
    for channel, entry in channels.items():
        is_input = channel not in (*MOTION_AND_WIND_CHANNELS, *QUATERNION, *MAX_COORDINATES)
        if is_input and _is_recorded_on_change(entry["column"], logs):
            entry["hold"] = True
            text = "recorded when it changes: zero-order hold between the values"
            draft_notes.add_guess((*CHANNELS_KEY, channel), text)
        entry |= {
            "column": main_preview.original_name(entry["column"]),
            **column_settings.get(entry["column"], {}),
        }
    reader_config = _compose_reader_config(main_preview, clock, names, select, draft_notes)
    reader_config |= {"manoeuvre": "auto"} | draft_manoeuvre_setting(files, draft_notes)
    _note_tests_of_files(files, draft_notes)
    _note_unused_columns(main_preview, column_by_channel, clock, draft_notes, {*select})
    return {**reader_config, "channels": channels}, errors


def draft_columns(
    columns: Sequence[str],
    logs: Sequence[RawTable],
    draft_notes: DraftNotes,
    match_columns: Callable[..., dict[str, str]],
    texts: Sequence[str] = (),
    *,
    has_heading: bool,
) -> tuple[dict[str, str], dict[str, dict[str, Any]]]:
    """Draft the channel map of columns from their names, units, values and physics.

    Args:
        columns: names of the columns of numbers.
        logs: tables with these columns, some of which may be missing.
        draft_notes: receives guesses and notes.
        match_columns: function like `match_channels`.
        texts: names of all columns, and cells, which may contain the name of a frame.
        has_heading: whether other files may have the heading.

    Returns:
        Channel -> column, and channel -> entry; both empty if no name is that of a channel.

    Raises:
        DataError: if the axes or the velocities are no motion of a vessel.
    """
    tables = [log.columns for log in logs]
    attitudes = find_quaternions(columns)
    sin_cos_pairs = find_sin_cos_pairs(columns, tables)
    compound_columns = {column for attitude in attitudes for column in attitude.values()}
    compound_columns |= {column for pair in sin_cos_pairs.values() for column in pair}
    simple_columns = [name for name in columns if name not in compound_columns]
    has_heading |= bool(attitudes)
    has_heading |= any(match_state_channel(parse_name(stem)) == "psi" for stem in sin_cos_pairs)
    names = match_columns(simple_columns, draft_notes, has_heading=has_heading)
    names = rename_pulsed_drives(names, tables)
    names = add_sin_cos_channels(names, sin_cos_pairs)
    for name in ("phi", "p"):
        # roll is optional for a model, so that it is left out rather than the tables without it
        if name in names and any(names[name] not in table for table in tables):
            draft_notes.add_note(CHANNELS_KEY, f"empty in some files, left out: {names.pop(name)}")
    if "psi" not in names:
        names |= choose_quaternion_order(attitudes, tables)
    names |= find_depth_channels(simple_columns, names)
    if not names:
        return {}, {}
    mapped_logs = [
        RawTable(
            log.t,
            {
                channel: log.columns[column]
                for channel, column in names.items()
                if column in log.columns
            },
        )
        for log in logs
    ]
    entries = draft_channel_map(
        names,
        mapped_logs,
        draft_notes,
        texts,
    )
    return names, entries


def _compose_reader_config(
    preview: TablePreview,
    clock: TableClock,
    names: Sequence[str],
    select: Mapping[str, Any],
    draft_notes: DraftNotes,
) -> dict[str, Any]:
    """Return the settings of the reader without its channels and manoeuvre.

    Args:
        preview: first rows of the table with the settings of most tables.
        clock: clock of the tables.
        names: names of all columns of files without a line of names.
        select: column -> value of the rows of one vessel.
        draft_notes: receives the guess of the axes of a motion-capture system.
    """
    settings = {
        # sheets are a list in YAML
        key: list(value) if isinstance(value, tuple) else value
        for key, value in preview.reader_settings.items()
    }
    if "mocap_up" in settings:
        text = (
            f"export of motion capture, by the motion {settings['mocap_up']} points up and"
            f" {settings['mocap_bow']} of the rigid body points forward; x is taken as north"
        )
        draft_notes.add_guess((*READER_KEY, "mocap_up"), text)
    time = dict(clock.settings)
    if "column" in time:
        time["column"] = preview.original_name(time["column"])
    reader_config = {"kind": settings.pop("kind"), **settings}
    reader_config |= {"names": list(names)} if names else {}
    return reader_config | {"time": time, **({"select": select} if select else {})}


def _find_common_columns(
    previews: Sequence[TablePreview], clock: TableClock, draft_notes: DraftNotes
) -> list[str]:
    """Return the columns that all tables have; others are noted.

    Raises:
        UsageError: if a column of the clock is missing in a table.
    """
    main_preview = previews[0]
    common_columns = [
        name
        for name in main_preview.column_names
        if all(name in sheet.column_names for sheet in previews)
    ]
    missing_columns = sorted(
        {name for sheet in previews for name in sheet.column_names} - set(common_columns)
    )
    if missing_columns:
        draft_notes.add_note(
            CHANNELS_KEY, f"not in every file, left out: {', '.join(missing_columns[:12])}"
        )
    if not set(clock.columns) <= set(common_columns):
        same_table_names = [
            sheet.path.name for sheet in previews if sheet.column_names == main_preview.column_names
        ]
        raise UsageError(
            f"{main_preview.path}: the column of time '{clock.columns[0]}' is missing elsewhere,"
            " these are tables of several kinds; give those of one kind, here"
            f" {', '.join(same_table_names)[:120]} (parts of one trip are files whose names differ"
            " in one word, each with other quantities)"
        )
    return common_columns


def _suggest_table_fix(numeric_columns: Sequence[str]) -> str:
    """Return an instruction for a table without channels."""
    if not numeric_columns:
        return "the files have no common column of numbers: give files of one kind"
    if len(numeric_columns) == 1:
        return (
            "if each file has one quantity, join them to one table, in Python"
            " pandas.concat({file.stem: pandas.read_csv(file, index_col=0).iloc[:, 0] for file in"
            " files}, axis=1).sort_index().to_csv('log.csv')"
        )
    return (
        "rename them in the line of names, for example to x [m], y [m], psi [deg], u [m/s],"
        " r [deg/s], rudder [deg], rpm"
    )


def _note_tests_of_files(files: Sequence[Path], draft_notes: DraftNotes) -> None:
    """Note which files have several tests, each of which is a log."""
    for file in dict.fromkeys(path.parent for path in files if locate_file(path) != path):
        tests = [path for path in files if path.parent == file]
        names = truncate(", ".join(path.name for path in tests), 100)
        text = f"{file.name} has {len(tests)} tests, a log each: {names}"
        if vessels := list_vessels(tests):
            text += (
                f"; they name several vessels ({truncate(', '.join(vessels), 80)}), and one config"
                f" describes one: give only its tests, such as {file.name}/{tests[0].name}"
            )
        draft_notes.add_guess(READER_KEY, text)


def draft_manoeuvre_setting(files: Sequence[Path], draft_notes: DraftNotes) -> dict[str, str]:
    """Return the setting `manoeuvre: folder` for files in folders by manoeuvre, else no setting.

    Folders of one file each are trips, unless their names are names of manoeuvres.
    """
    folders = {locate_file(path).resolve().parent for path in files}
    has_manoeuvre_names = any(match_manoeuvre_name(folder.name) for folder in folders)
    if len(folders) < 2 or (len(folders) == len(files) and not has_manoeuvre_names):
        return {}
    draft_notes.add_guess(
        (*READER_KEY, "manoeuvre"), "the type of manoeuvre is taken from the name of the folder"
    )
    return {"manoeuvre": "folder"}


def _collect_texts(preview: TablePreview) -> list[str]:
    """Return the column names of a table and the first different texts of its cells."""
    cells = [str(text) for texts in preview.text_columns.values() for text in texts.unique()[:20]]
    return [*preview.column_names, *cells]


def _build_raw_tables(
    previews: Sequence[TablePreview],
    columns: Sequence[str],
    errors: dict[Path, ResidnetError],
    step: str | None,
) -> list[RawTable]:
    """Return columns of each table on its clock, sorted by time and without copies of rows."""
    logs = []
    for preview in previews:
        try:
            clock = detect_clock(preview) if step is None else make_step_clock(preview, step)
        except DataError as error:
            errors[preview.path] = error
            continue
        # tables in reverse order of time are reversed
        direction = -1 if (np.diff(clock.seconds[np.isfinite(clock.seconds)]) < 0.0).all() else 1
        values = {
            name: preview.numeric_columns[name][::direction]
            for name in columns
            if name in preview.numeric_columns
        }
        t = clock.seconds[::direction]
        is_unique = find_unique_rows(t, values.values()) if values else t == t
        logs.append(
            RawTable(t[is_unique], {name: column[is_unique] for name, column in values.items()})
        )
    return logs


def _is_recorded_on_change(column: str, logs: Sequence[RawTable]) -> bool:
    """Return whether a column has values in less than half of the rows, at irregular intervals."""
    tables = [log.columns[column] for log in logs if column in log.columns]
    filled_rows = [np.flatnonzero(np.isfinite(values)) for values in tables]
    intervals = np.concatenate([np.zeros(0), *map(np.diff, filled_rows)])
    n_rows = sum(values.size for values in tables)
    if not intervals.size or 2 * sum(rows.size for rows in filled_rows) >= n_rows:
        return False
    step = np.median(intervals)
    is_regular = np.abs(intervals - step) <= INTERVAL_TOLERANCE * step
    return bool(is_regular.mean() < MIN_REGULAR_SHARE)


def _note_unused_columns(
    preview: TablePreview,
    names: Mapping[str, str],
    clock: TableClock,
    draft_notes: DraftNotes,
    selected_columns: set[str],
) -> None:
    used_columns = {*names.values(), *clock.columns, *selected_columns}
    texts = [
        f"{name} ('{truncate(str(cells.dropna().iloc[0]), 20)}')"
        for name, cells in preview.text_columns.items()
        if name not in used_columns
    ]
    unused_columns = {
        UNMAPPED_COLUMNS: [name for name in preview.numeric_columns if name not in used_columns],
        TEXT_COLUMNS: texts,
        "empty columns": preview.empty_columns,
    }
    for label, columns in unused_columns.items():
        if columns:
            draft_notes.add_note(CHANNELS_KEY, f"{label}: {', '.join(columns[:20])}")
    if preview.other_sheets:
        text = (
            f"sheets that are not read: {', '.join(preview.other_sheets)}; write the columns of one"
            " log to one sheet, or each log to a separate file"
        )
        draft_notes.add_note(CHANNELS_KEY, text)
