"""Drafting of channel maps for tables from names, units, values and physics."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from residnet.core.errors import DataError, ResidnetError, UsageError
from residnet.core.names import CHANNEL_UNITS, get_si_unit, truncate
from residnet.core.units import is_unit, si_unit, to_si
from residnet.io.drafting.channel_map import draft_channel_map
from residnet.io.drafting.motion_columns import (
    MAGNETIC_PATTERN,
    MOTION_AND_WIND_CHANNELS,
    choose_quaternion_order,
    find_depth_channels,
    find_quaternions,
    find_sin_cos_pairs,
    is_vertical_axis_up,
)
from residnet.io.drafting.motion_regression import RawTable
from residnet.io.drafting.problems import (
    UnreadableLogsError,
    raise_unreadable,
    strip_file_name,
)
from residnet.io.drafting.questions import (
    CHANNELS_KEY,
    READER_KEY,
    TEXT_COLUMNS,
    UNMAPPED_COLUMNS,
    DraftNotes,
)
from residnet.io.drafting.vertical import (
    VERTICAL_CHANNELS,
    draft_vertical_motion,
    project_on_horizontal,
    refuse_vertical_y,
)
from residnet.io.header_vocabulary import (
    DATE_PART_NAMES,
    GERMANIC_PATTERN,
    MOTION_CHANNELS,
    REVOLUTION_PATTERN,
    VESSEL_COLUMN_NAMES,
    ParsedName,
    find_mismatched_unit,
    is_drift_angle,
    match_input_channel,
    match_state_channel,
    normalize_name,
    parse_header_unit,
    parse_name,
)
from residnet.io.readers.angles import AngleForm, LetterO, hemisphere_signs, parse_degrees
from residnet.io.readers.base import require_file
from residnet.io.readers.clock_repair import find_unique_rows, repair_clock
from residnet.io.readers.excel_tables import join_excel_sheets, list_sheet_names, read_excel_sheet
from residnet.io.readers.json_tables import read_json_head
from residnet.io.readers.manoeuvre_kinds import match_manoeuvre_name
from residnet.io.readers.quantities import (
    COSINE_SUFFIX,
    QUATERNION,
    SINE_SUFFIX,
)
from residnet.io.readers.tables import TABLE_KINDS, read_parquet_head
from residnet.io.readers.text_tables import HeaderlessTableError, read_table_head
from residnet.io.readers.timestamps import (
    detect_date_order,
    detect_unix_unit,
    infer_time_unit,
    is_date_column,
    parse_texts,
)
from residnet.preprocessing.channel_values import (
    INTERVAL_TOLERANCE,
    MIN_REGULAR_SHARE,
    is_ais_sentinel,
    mask_fill_values,
)

if TYPE_CHECKING:
    import pandas as pd

_HEAD_READERS = {"parquet": read_parquet_head, "json_lines": read_json_head}
_OPENING_BRACKET = re.compile(r"[\[(]")
_NAME_OVER_UNIT = re.compile(r"(?P<name>.*\S)\s+/\s+(?P<unit>\S.*)")
_DRIVE_PATTERN = re.compile(r"^(?:cmd_)?(?:n(?=_|$)|thrust)")
_PULSE_RANGE = (900.0, 2100.0)
"""Range of the pulses of servos and speed controllers in us."""
_DATE_PATTERN = r"\d\s*[-./年]\s*\w{1,9}\s*[-./月]"
_DOTTED_TIME_PATTERN = r"^\d\d?\.\d\d\.\d\d[.,]"
"""Start of a time of day with points between its parts."""
_ANGLE_FORMS: tuple[AngleForm, ...] = ("number", "ddmm")
_MAX_ANGLE = {"latitude": 90.0, "longitude": 180.0}
"""Largest absolute value of a coordinate in deg."""
_HEMISPHERES = {"latitude": {"N", "S"}, "longitude": {"E", "W", "O"}}
ColumnSettings = Mapping[str, Mapping[str, Any]]
"""Column -> further settings of its entry in a channel map."""
_MAX_FULL_PREVIEWS = 24
"""Number of tables whose values are loaded; of other tables only the first rows are."""


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
    previews, errors, names = _preview_named_tables(files, draft_notes)
    previews, select = _select_vessel_rows(previews, draft_notes)
    main_preview, column_settings = convert_positions_to_degrees(previews[0], draft_notes)
    previews = [
        main_preview,
        *(convert_positions_to_degrees(sheet, DraftNotes())[0] for sheet in previews[1:]),
    ]
    clock, step = _detect_or_ask_clock(previews, draft_notes)
    common_columns = _find_common_columns(previews, clock, draft_notes)
    if clock.guess:
        draft_notes.add_guess((*READER_KEY, "time"), clock.guess)
    numeric_columns = {name for sheet in previews for name in sheet.numeric_columns}
    common_numeric = [
        name for name in common_columns if name in numeric_columns and name not in clock.columns
    ]
    _refuse_minute_columns(main_preview.path, common_numeric)
    attitudes = find_quaternions(common_numeric)
    compound_columns = {column for attitude in attitudes for column in attitude.values()}
    sin_cos_pairs = find_sin_cos_pairs(
        common_numeric, [preview.numeric_columns for preview in previews]
    )
    compound_columns |= {column for pair in sin_cos_pairs.values() for column in pair}
    simple_columns = [name for name in common_numeric if name not in compound_columns]
    has_sin_cos_heading = any(
        match_state_channel(parse_name(stem)) == "psi" for stem in sin_cos_pairs
    )
    column_by_channel = _select_one_vessel(
        simple_columns,
        main_preview.numeric_columns,
        draft_notes,
        has_heading=has_heading or has_sin_cos_heading or bool(attitudes),
        with_drift_angle=True,
    )
    if select:
        _drop_ais_turn_rate(column_by_channel, main_preview, draft_notes)
    column_by_channel = rename_pulsed_drives(
        column_by_channel, [preview.numeric_columns for preview in previews]
    )
    column_by_channel = _add_sin_cos_channels(column_by_channel, sin_cos_pairs)
    _drop_incomplete_roll(column_by_channel, previews, draft_notes)
    column_by_channel |= find_depth_channels(simple_columns, column_by_channel)
    _refuse_unparsed_positions(main_preview, column_by_channel)
    if "psi" not in column_by_channel:
        column_by_channel |= choose_quaternion_order(
            attitudes, [preview.numeric_columns for preview in previews]
        )
    if not column_by_channel:
        raise DataError(
            f"{main_preview.path}: no column has the name of a channel"
            f" ({', '.join(common_numeric[:12])});"
            f" {_suggest_table_fix(main_preview, clock, common_numeric)}"
        )
    logs = _build_raw_tables(previews, column_by_channel, errors, step)
    tables = [preview.numeric_columns for preview in previews]
    refuse_vertical_y(main_preview.path, simple_columns, tables, column_by_channel)
    channels = draft_channel_map(
        column_by_channel,
        project_on_horizontal(simple_columns, tables, logs, column_by_channel),
        draft_notes,
        _collect_texts(main_preview),
        is_up_positive=is_vertical_axis_up(
            simple_columns,
            column_by_channel,
            tables,
        ),
    )
    channels |= draft_vertical_motion(
        simple_columns,
        tables,
        logs,
        channels,
        draft_notes,
    )
    column_by_channel |= {
        name: entry["column"] for name, entry in channels.items() if name in VERTICAL_CHANNELS
    }
    for channel, entry in channels.items():
        if _is_recorded_on_change(channel, logs):
            entry["hold"] = True
            text = "recorded when it changes: zero-order hold between the values"
            draft_notes.add_guess((*CHANNELS_KEY, channel), text)
        entry |= {
            "column": main_preview.original_name(entry["column"]),
            **column_settings.get(entry["column"], {}),
        }
    reader_config = _compose_reader_config(main_preview, clock, names, select, draft_notes)
    reader_config |= draft_manoeuvre_setting(files, draft_notes)
    _note_unused_columns(main_preview, column_by_channel, clock, draft_notes, {*select})
    return {**reader_config, "channels": channels}, errors


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
    if "motive_up" in settings:
        text = (
            f"export of OptiTrack Motive, by the motion {settings['motive_up']} points up and"
            f" {settings['motive_bow']} of the rigid body points forward; x is taken as north"
        )
        draft_notes.add_guess((*READER_KEY, "motive_up"), text)
    time = dict(clock.settings)
    if "column" in time:
        time["column"] = preview.original_name(time["column"])
    reader_config = {"kind": settings.pop("kind"), **settings}
    reader_config |= {"names": list(names)} if names else {}
    return reader_config | {"time": time, **({"select": select} if select else {})}


def _detect_or_ask_clock(
    previews: Sequence[TablePreview], draft_notes: DraftNotes
) -> tuple[TableClock, str | None]:
    """Return the clock of tables, and the time between rows that the user gives for others.

    Raises:
        DataError: if the tables have no clock, and nobody gives the time between rows.
    """
    main_preview = previews[0]
    key = (*READER_KEY, "time", "step")
    error = DataError("the time between two rows is empty")
    if not draft_notes.has_answer(key):
        try:
            return detect_clock(main_preview), None
        except MissingClockError as missing_clock:
            message = strip_file_name([main_preview.path], str(missing_clock))
        error = UnreadableLogsError(
            {sheet.path: DataError(f"{sheet.path}: {message}") for sheet in previews}
        )
    step = draft_notes.require_answer(
        key,
        f"{main_preview.path.name} and the other tables have no column of time; time between two"
        " rows, for example 0.1 s",
        error,
    )
    return make_step_clock(main_preview, step), step


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


def _refuse_minute_columns(path: Path, columns: Sequence[str]) -> None:
    """Refuse positions with degrees and minutes in separate columns.

    Raises:
        DataError: if a column has minutes of latitude or longitude.
    """
    minute_columns = [
        name
        for name in columns
        if match_state_channel(parse_name(name)) in _MAX_ANGLE
        and parse_header_unit(name, "s") == "min"
    ]
    if minute_columns:
        raise DataError(
            f"{path}: '{minute_columns[0]}' has minutes whose degrees are in another"
            " column; write degrees + minutes / 60 to one column each for latitude and longitude"
        )


def _drop_incomplete_roll(
    column_by_channel: dict[str, str], previews: Sequence[TablePreview], draft_notes: DraftNotes
) -> None:
    """Remove roll channels that are empty in some tables.

    Roll is optional for a model, so that it is left out rather than the tables without it.
    """
    for name in ("phi", "p"):
        column = column_by_channel.get(name)
        if column is not None and any(column not in sheet.numeric_columns for sheet in previews):
            del column_by_channel[name]
            draft_notes.add_note(CHANNELS_KEY, f"empty in some files, left out: {column}")


def _refuse_unparsed_positions(preview: TablePreview, column_by_channel: Mapping[str, str]) -> None:
    """Refuse positions in a notation that `convert_positions_to_degrees` does not know.

    Raises:
        DataError: if a column of text is a latitude or longitude, and there is no other position.
    """
    position_texts = [
        name for name in preview.text_columns if match_state_channel(parse_name(name)) in _MAX_ANGLE
    ]
    if (
        position_texts
        and "x" not in column_by_channel
        and not set(_MAX_ANGLE) <= set(column_by_channel)
    ):
        example = preview.text_columns[position_texts[0]].dropna().iloc[0]
        raise DataError(
            f"{preview.path}: column '{position_texts[0]}' contains"
            f" '{truncate(str(example))}', which is no latitude or longitude; accepted are"
            " 59.90535, 59°54.321'N, 59 54 19.3 N and 5954.321"
        )


def _suggest_table_fix(
    preview: TablePreview, clock: TableClock, numeric_columns: Sequence[str]
) -> str:
    """Return an instruction for a table without channels."""
    if not numeric_columns:
        return "the files have no common column of numbers: give files of one kind"
    category_columns = [
        name
        for name, cells in preview.text_columns.items()
        if 1 < cells.nunique() <= len(cells) / 4
    ]
    category_columns = [name for name in category_columns if name not in clock.columns]
    if len(numeric_columns) == 1 and category_columns:
        return (
            f"'{category_columns[0]}' names the quantity of each row: make columns of it, in Python"
            f" pandas.read_csv(file).pivot_table({numeric_columns[0]!r}, {clock.columns[0]!r},"
            f" {category_columns[0]!r}).to_csv('log.csv')"
        )
    if len(numeric_columns) == 1:
        return (
            "if each file has one quantity, join them to one table, in Python"
            " pandas.concat({file.stem: pandas.read_csv(file, index_col=0).iloc[:, 0] for file in"
            " files}, axis=1).sort_index().to_csv('log.csv')"
        )
    if all(_parse_unit_cell(re.sub(r"\.\d+$", "", name)) for name in numeric_columns):
        return "these are units: write each column's name in a cell above its unit, or before it"
    return (
        "rename them in the line of names, for example to x [m], y [m], psi [deg], u [m/s],"
        " r [deg/s], rudder [deg], rpm"
    )


def draft_manoeuvre_setting(files: Sequence[Path], draft_notes: DraftNotes) -> dict[str, str]:
    """Return the setting `manoeuvre: folder` for files in folders by manoeuvre, else no setting.

    Folders of one file each are trips, unless their names are those of manoeuvres.
    """
    folders = {path.resolve().parent for path in files}
    has_manoeuvre_names = any(match_manoeuvre_name(folder.name) for folder in folders)
    if len(folders) < 2 or (len(folders) == len(files) and not has_manoeuvre_names):
        return {}
    draft_notes.add_guess(
        (*READER_KEY, "manoeuvre"), "the type of manoeuvre is taken from the name of the folder"
    )
    return {"manoeuvre": "folder"}


class HeaderlessTablesError(UnreadableLogsError):
    """Tables of the same number of columns, all without column names.

    Attributes:
        first_error: error of the first table.
    """

    def __init__(
        self, first_error: HeaderlessTableError, errors: Mapping[Path, ResidnetError]
    ) -> None:
        self.first_error = first_error
        super().__init__(errors)


def _preview_named_tables(
    files: Sequence[Path], draft_notes: DraftNotes
) -> tuple[list[TablePreview], dict[Path, ResidnetError], Sequence[str]]:
    """Load the first rows of tables, whose names are asked for if the files have none.

    Returns:
        The previews, the error of each table that cannot be read, and the names of all columns;
        empty if the tables have lines of names.

    Raises:
        UsageError: if the tables have several formats.
        DataError: if no table can be read, or its columns have no names.
    """
    key = (*READER_KEY, "names")
    if not draft_notes.has_answer(key):
        try:
            return *_preview_tables(files), ()
        except HeaderlessTablesError as error:
            refusal = error
        headerless = refusal.first_error
        text = f"{files[0].name} has {headerless.n_columns} columns without names; names, in order"
        if headerless.proposed_names:
            answer = draft_notes.ask_question(
                key,
                text,
                ", ".join(headerless.proposed_names),
                "the files have no line of names; these words stand above the numbers",
            )
        else:
            answer = draft_notes.require_answer(key, text, refusal)
    else:
        answer = draft_notes.require_answer(key, "", DataError("the names are empty"))
    # names with blanks are separated by commas
    separator = r"[,;]" if re.search(r"[,;]", answer) else r"\s+"
    names = [name.strip() for name in re.split(separator, answer) if name.strip()]
    return *_preview_tables(files, names), names


def _preview_tables(
    files: Sequence[Path], names: Sequence[str] | None = None
) -> tuple[list[TablePreview], dict[Path, ResidnetError]]:
    """Load the first rows of tables, 20,000 rows of up to 48 tables and 50 of the others.

    Returns:
        The previews, first one with the settings of most tables, and the error of each table that
        cannot be read.

    Raises:
        UsageError: if the tables have several formats.
        DataError: if no table can be read.
    """
    stride = max(1, len(files) // _MAX_FULL_PREVIEWS)
    previews: list[TablePreview] = []
    errors: dict[Path, ResidnetError] = {}
    for number, path in enumerate(files):
        try:
            previews.append(preview_table(path, 20_000 if number % stride == 0 else 50, names))
        except DataError as error:
            errors[path] = error
    if not previews:
        first_error = next(iter(errors.values()))
        n_columns = {getattr(error, "n_columns", 0) for error in errors.values()}
        if isinstance(first_error, HeaderlessTableError) and len(n_columns) == 1:
            raise HeaderlessTablesError(first_error, errors)
        raise_unreadable(errors)
    reader_settings = {
        tuple(sorted(sheet.reader_settings.items()))
        for sheet in previews
        if len(sheet.numeric_columns) > 1
    }
    if not reader_settings:
        path = previews[0].path
        names = ", ".join(previews[0].column_names[:12])
        raise DataError(
            f"{path}: fewer than two columns contain numbers (columns: {names}); check the"
            " export of the table"
        )
    if len({dict(settings_items)["kind"] for settings_items in reader_settings}) > 1:
        raise UsageError("the tables have several formats, one was expected; give those of one")
    # the most detailed settings: a table of integers, for example, has no decimal sign
    common_settings = max(
        reader_settings,
        key=lambda kind: (len(kind), sum(s.reader_settings == dict(kind) for s in previews)),
    )
    best_index = next(
        i
        for i, s in enumerate(previews)
        if tuple(sorted(s.reader_settings.items())) == common_settings
    )
    return [previews[best_index], *previews[:best_index], *previews[best_index + 1 :]], errors


def _select_vessel_rows(
    previews: list[TablePreview], draft_notes: DraftNotes
) -> tuple[list[TablePreview], dict[str, Any]]:
    """Select the rows of one vessel of tables with a column that identifies vessels, as in AIS.

    Args:
        previews: first rows of the tables.
        draft_notes: receives the question for the vessel and notes.

    Returns:
        The previews with the rows of the vessel, without codes of missing values, and the key
        `select` of the reader; empty if no column identifies vessels.
    """
    import pandas as pd

    columns = {normalize_name(name): name for name in previews[0].column_names}
    column = next((columns[name] for name in VESSEL_COLUMN_NAMES if name in columns), None)
    if column is None or column in previews[0].empty_columns:
        return previews, {}

    def identities(preview: TablePreview) -> pd.Series:
        numbers = preview.numeric_columns.get(column)
        cells = preview.text_columns.get(column) if numbers is None else pd.Series(numbers)
        if cells is None:
            return pd.Series(dtype="string")
        return cells.astype("string").str.strip().str.removesuffix(".0")

    cells_of_tables = [identities(preview) for preview in previews]
    counts = pd.concat(cells_of_tables).value_counts()
    vessels = [str(vessel) for vessel in counts.index]
    if not vessels:
        return previews, {}
    key = (*READER_KEY, "select")
    vessel = vessels[0]
    if len(vessels) > 1:
        names = truncate(", ".join(vessels), 80)
        reason = (
            f"'{column}' has {len(vessels)} vessels ({names}), and one config reads one of them:"
            f" {vessel}"
        )
        text = f"vessel of column '{column}' to read"
        vessel = draft_notes.ask_question(key, text, vessel, reason, tuple(vessels[:20]))
    selected = []
    for preview, cells in zip(previews, cells_of_tables, strict=True):
        rows = np.flatnonzero((cells == vessel).to_numpy(dtype=bool, na_value=False))
        numeric = {name: values[rows] for name, values in preview.numeric_columns.items()}
        texts = {name: cell.iloc[rows] for name, cell in preview.text_columns.items()}
        for name, values in numeric.items():
            channel = match_state_channel(parse_name(name)) or ""
            numeric[name] = np.where(is_ais_sentinel(channel, "deg", values), np.nan, values)
        if rows.size:
            selected.append(
                dataclasses.replace(preview, numeric_columns=numeric, text_columns=texts)
            )
    value: Any = int(vessel) if re.fullmatch(r"\d{1,15}", vessel) else vessel
    return selected, {previews[0].original_name(column): value}


def _drop_ais_turn_rate(
    column_by_channel: dict[str, str], preview: TablePreview, draft_notes: DraftNotes
) -> None:
    """Remove the yaw rate if its values are coded as in AIS: integers from -128 to 127."""
    column = column_by_channel.get("r", "")
    if normalize_name(column) not in ("rot", "rate of turn", "rateofturn"):
        return
    values = preview.numeric_columns[column]
    values = values[np.isfinite(values)]
    is_coded = (values == np.round(values)) & (values >= -128.0) & (values <= 127.0)
    if is_coded.all():
        del column_by_channel["r"]
        draft_notes.add_note(
            CHANNELS_KEY,
            f"'{column}' is coded as in AIS, 4.733 sqrt(deg/min) and -128 for unknown; it is left"
            " out, r follows from the heading",
        )


def _select_one_vessel(
    columns: Sequence[str],
    numeric_columns: Mapping[str, np.ndarray],
    draft_notes: DraftNotes,
    *,
    has_heading: bool,
    with_drift_angle: bool = False,
) -> dict[str, str]:
    """Match columns to channels, using one vessel of tables with several.

    The columns of several vessels or sensors have the same suffixes behind different prefixes, as
    in `boat1_x` and `boat2_x`, including a position and an input. Prefixes of commands and constant
    positions are excluded.

    Args:
        columns: names of the columns.
        numeric_columns: column -> values.
        draft_notes: receives guesses and notes.
        has_heading: whether another source may have the heading.
        with_drift_angle: see `match_channels`.

    Returns:
        Channel -> column.
    """
    columns_by_prefix: dict[str, dict[str, str]] = {}
    for column in columns:
        prefix, _, suffix = re.sub(r"[\W_]+", "\0", column, count=1).partition("\0")
        columns_by_prefix.setdefault(prefix, {})[suffix] = column
    for suffixes in columns_by_prefix.values():
        same_suffix_groups = {
            prefix: prefix_columns
            for prefix, prefix_columns in columns_by_prefix.items()
            if prefix_columns.keys() == suffixes.keys()
        }
        if len(same_suffix_groups) < 2 or any(
            parse_name(prefix).has_all("command") for prefix in same_suffix_groups
        ):
            continue
        channels = match_channels([*suffixes], DraftNotes())
        position_pair = next(
            (pair for pair in (("x", "y"), (*_MAX_ANGLE,)) if {*pair} <= channels.keys()), ()
        )
        if not position_pair or not channels.keys() - {*MOTION_AND_WIND_CHANNELS, *_MAX_ANGLE}:
            continue
        for prefix, prefix_columns in same_suffix_groups.items():
            if any(
                np.nanstd(numeric_columns[prefix_columns[channels[name]]]) > 0.0
                for name in position_pair
            ):
                text = (
                    f"the columns of {', '.join(same_suffix_groups)} have a position each; of these"
                    f" vessels or sensors {prefix} is read; write the others to separate tables"
                )
                draft_notes.add_guess(CHANNELS_KEY, text)
                matched = match_channels(
                    [*prefix_columns], draft_notes, with_drift_angle=with_drift_angle
                )
                return {channel: prefix_columns[suffix] for channel, suffix in matched.items()}
    return match_channels(
        columns, draft_notes, has_heading=has_heading, with_drift_angle=with_drift_angle
    )


def _collect_texts(preview: TablePreview) -> list[str]:
    """Return the column names of a table and the first different texts of its cells."""
    cells = [str(text) for texts in preview.text_columns.values() for text in texts.unique()[:20]]
    return [*preview.column_names, *cells]


_SPEED_SYMBOL = re.compile(r"[uv]( ?(s|m|c|0|ship|model|tot|total|abs|res|cg|ms))?")
"""Normalised name of a speed next to a drift angle: a symbol, perhaps with an index."""


def match_channels(
    columns: Sequence[str],
    draft_notes: DraftNotes,
    *,
    has_heading: bool = True,
    with_drift_angle: bool = False,
) -> dict[str, str]:
    """Match columns to channels by their names.

    A speed without a direction is the surge velocity u if position and heading do not determine it.

    Args:
        columns: names of the columns.
        draft_notes: receives guesses and notes.
        has_heading: whether another source may have the heading.
        with_drift_angle: whether a speed and the drift angle next to it may be the channels
            `speed` and `drift_angle`, which readers of tables resolve to u and v.

    Returns:
        Channel -> column.
    """
    column_by_bare_name = {
        re.sub(r"\W*[\[(].*|_m$", "", column).strip().lower(): column for column in columns
    }
    if {"n", "e"} <= set(column_by_bare_name):
        north_east = {"x": column_by_bare_name["n"], "y": column_by_bare_name["e"]}
        other_notes = DraftNotes()
        other_channels = match_channels(
            [name for name in columns if name not in north_east.values()],
            other_notes,
            has_heading=has_heading,
            with_drift_angle=with_drift_angle,
        )
        if not {"x", "y", "latitude", "longitude"} & set(other_channels):
            # next to a column E, N is no shaft speed
            draft_notes.extend(other_notes)
            text = f"'{north_east['x']}' and '{north_east['y']}' are assumed north and east"
            draft_notes.add_guess((*CHANNELS_KEY, "x"), text)
            return {**north_east, **other_channels}
    drift_angle = next((column for column in columns if is_drift_angle(column)), None)
    parsed_names = {column: parse_name(column) for column in columns if column != drift_angle}
    names, duplicates, speeds = _assign_columns([*parsed_names], parsed_names, draft_notes)
    _resolve_duplicates(names, duplicates, columns, draft_notes)
    has_position = bool({"x", "y", "latitude", "longitude"} & names.keys())
    theta = next(
        (column for column in parsed_names if "theta" in parsed_names[column].text.split()), None
    )
    if has_position and theta is not None and not {"psi", "phi"} & names.keys():
        names["psi"] = theta
        draft_notes.add_guess(
            (*CHANNELS_KEY, "psi"), f"'{theta}' is assumed the heading, because there is no other"
        )
    _rename_single_rudder(names, draft_notes)
    has_heading = (
        has_heading
        or "psi" in names
        or any("course" in parsed.concepts for parsed in parsed_names.values())
    )
    if drift_angle is not None and with_drift_angle:
        names |= _pair_speed_with_drift_angle(drift_angle, names, speeds, parsed_names, draft_notes)
    if "speed" in names:
        # u and v follow from speed and drift angle
        for name in {"u", "v"} & names.keys():
            del names[name]
    elif "u" not in names and speeds and ("v" in names or not (has_position and has_heading)):
        names["u"] = speeds[0]
        text = f"'{speeds[0]}' is assumed the surge velocity, not the speed"
        if drift_angle is not None and "v" not in names:
            # readers of recordings have no channel of the drift angle
            text = (
                f"'{speeds[0]}' is read as the surge velocity, '{drift_angle}' is not read; write"
                " columns u = V cos(beta) and v = -V sin(beta) for speed V and drift angle beta"
                " (positive with the flow from port)"
            )
        draft_notes.add_guess((*CHANNELS_KEY, "u"), text)
    ordered_channels = [
        *MOTION_AND_WIND_CHANNELS,
        *(name for name in names if name not in MOTION_AND_WIND_CHANNELS),
    ]
    return {name: names[name] for name in ordered_channels if name in names}


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
    for column in velocities.values():
        if column != speed:
            text = f"'{column}' is left out: u and v follow from '{speed}' and '{drift_angle}'"
            draft_notes.add_note(CHANNELS_KEY, text)
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
    copy_suffix = re.compile(r"\.\d+$")
    side_velocities = _match_shaft_speeds(parsed_names)
    wrench = find_wrench_columns(columns)

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
        channel = (
            side_velocities.get(column)
            or wrench.get(column)
            or _match_name(column, parsed_names[column])
            or _match_force_column(column)
        )
        if channel is None:
            continue
        channel = (
            _match_force_column(column) or wrench.get(column) or _correct_by_unit(column, channel)
        )
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
        elif copy_suffix.sub("", column) == copy_suffix.sub("", names[channel]):
            text = f"the header has it more than once; '{names[channel]}' is the first one"
            draft_notes.add_guess((*CHANNELS_KEY, channel), text)
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
    """Return the channel of a column by its name, or None."""
    channel = match_state_channel(parsed) or match_input_channel(parsed)
    if channel is None and parsed.has_all("pitch") and parse_header_unit(column, "-") == "%":
        # a pitch in per cent is that of a propeller's blades
        channel = match_input_channel(parse_name(f"propeller {column}"))
    return channel


def _find_other_unit(column: str, channel: str) -> str | None:
    """Return the unit in the name of a column if its dimension is not that of the channel."""
    expected_unit = get_si_unit(channel)
    return find_mismatched_unit(column, expected_unit) if expected_unit else None


def _correct_by_unit(column: str, channel: str) -> str:
    """Return the channel of a column whose unit decides between two meanings of its name."""
    mismatched_unit = _find_other_unit(column, channel)
    if channel == "n" and mismatched_unit == "m":
        # north in m, not a shaft speed
        return "x"
    if "thrust" in channel and parse_header_unit(column, "1/s"):
        # a thruster in rpm is a shaft speed, not a force
        return channel.replace("thrust", "n")
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


def _rename_single_rudder(names: dict[str, str], draft_notes: DraftNotes) -> None:
    """Rename the rudder of one side to the only rudder, if the other side has none."""
    for port, stbd in (("delta_port", "delta_stbd"), ("cmd_delta_port", "cmd_delta_stbd")):
        if (port in names) == (stbd in names):
            continue
        # with a single rudder the side is the direction of positive angles
        sided_channel = port if port in names else stbd
        rudder = sided_channel.rpartition("_")[0]
        column = names.pop(sided_channel)
        if names.setdefault(rudder, column) != column:
            draft_notes.add_note(
                CHANNELS_KEY, f"'{column}' may be {rudder} instead of '{names[rudder]}'"
            )


_TOTAL_SPEED_PATTERN = re.compile(r"V\s*(?:[\[(/].*)?$")
"""Name of a column with the symbol V alone, with or without a unit."""
_FORCE_AXES = {
    "N": {
        **dict.fromkeys(("u", "x", "surge"), "tau_x"),
        **dict.fromkeys(("v", "y", "sway"), "tau_y"),
    },
    "N m": dict.fromkeys(("r", "n", "z", "yaw", "psi"), "tau_n"),
}
"""SI unit of a force or moment -> last word of a name -> channel."""


_WRENCH_PATTERN = re.compile(
    r"(?P<stem>(?:.*[\W_])?)(?P<quantity>force|torque|moment)s?[\W_]*(?P<axis>[xyz])"
    r"(?:[\W_]*\[.*\])?",
    re.IGNORECASE,
)
_WRENCH_AXES = {("force", "x"): "tau_x", ("force", "y"): "tau_y", ("moment", "z"): "tau_n"}
_MIN_WRENCH_PARTS = 2
"""Fewest parts by which a force and a moment are those of the vessel, not of one load cell."""


def find_wrench_columns(columns: Sequence[str]) -> dict[str, str]:
    """Return column -> channel of the forces and the moment on a vessel, such as `force.x`.

    Columns of one stem are a wrench; those of thrusters, rudders and wind are no total forces.
    """
    groups: dict[str, dict[str, str]] = {}
    for column in columns:
        match = _WRENCH_PATTERN.fullmatch(column.strip())
        if match is None or not parse_name(column).has_none(*_PARTIAL_FORCES):
            continue
        quantity = "force" if match["quantity"].lower() == "force" else "moment"
        channel = _WRENCH_AXES.get((quantity, match["axis"].lower()))
        if channel is not None:
            groups.setdefault(match["stem"].lower(), {}).setdefault(channel, column)
    complete = [group for group in groups.values() if len(group) >= _MIN_WRENCH_PARTS]
    return {column: channel for channel, column in complete[0].items()} if complete else {}


_PARTIAL_FORCES = (
    "wind",
    "thrust",
    "propeller",
    "rudder",
    "planes",
    "engine",
    "azimuth",
    "command",
)
"""Concepts of forces that act on a part of the vessel."""


def _match_force_column(column: str) -> str | None:
    """Return the channel of a force or moment whose unit is in its header, such as `T_u [N]`."""
    unit = parse_header_unit(column, None)
    parsed_name = parse_name(column)
    is_part = not parsed_name.has_none(*_PARTIAL_FORCES)
    if unit is None or is_part:
        return None
    words = parsed_name.text.split()
    if not words or "_".join(words) in CHANNEL_UNITS:
        # a canonical name such as acting_tau_x has its own channel
        return None
    axis = re.sub(r"^[fmt](?=[xyzuvrn]$)", "", words[-1])
    if words == [axis]:
        # a letter alone may be a load that was measured
        return None
    return _FORCE_AXES.get(si_unit(unit), {}).get(axis)


def _add_sin_cos_channels(
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

    Pulses are integers between 900 and 2,100 us; relative values of a motor or thruster are at most
    1 and no integers. Columns with a word for revolutions in their names are not renamed.

    Args:
        names: channel -> column.
        tables: column -> values of each table.
    """
    renamed = {}
    for channel, column in names.items():
        values = np.concatenate([table.get(column, np.zeros(0)) for table in tables])
        values = values[np.isfinite(values)]
        if _DRIVE_PATTERN.match(channel) and values.size and not REVOLUTION_PATTERN.search(column):
            are_integers = bool((values == np.round(values)).all())
            are_pulses = (
                are_integers and values.min() >= _PULSE_RANGE[0] and values.max() <= _PULSE_RANGE[1]
            )
            parsed_name = parse_name(column)
            is_share = "thrust" in channel or parsed_name.has_all("engine")
            is_share &= (
                parsed_name.has_none("revolutions", "propeller", "speed") and not are_integers
            )
            throttle = _DRIVE_PATTERN.sub("throttle", channel)
            if throttle not in names and (are_pulses or (is_share and np.abs(values).max() <= 1.0)):
                channel = throttle
        renamed[channel] = column
    return renamed


def _build_raw_tables(
    sheets: Sequence[TablePreview],
    names: Mapping[str, str],
    errors: dict[Path, ResidnetError],
    step: str | None,
) -> list[RawTable]:
    """Return the mapped columns of each table on its clock, sorted by time and without copies."""
    logs = []
    for preview in sheets:
        try:
            clock = detect_clock(preview) if step is None else make_step_clock(preview, step)
        except DataError as error:
            errors[preview.path] = error
            continue
        columns = {
            channel: preview.numeric_columns[column]
            for channel, column in names.items()
            if column in preview.numeric_columns
        }
        # tables in reverse order of time are reversed
        direction = -1 if (np.diff(clock.seconds[np.isfinite(clock.seconds)]) < 0.0).all() else 1
        columns = {channel: values[::direction] for channel, values in columns.items()}
        t = clock.seconds[::direction]
        is_unique = find_unique_rows(t, columns.values()) if columns else t == t
        logs.append(
            RawTable(t[is_unique], {name: values[is_unique] for name, values in columns.items()})
        )
    return logs


def _is_recorded_on_change(channel: str, logs: Sequence[RawTable]) -> bool:
    """Return whether an input is recorded when it changes.

    Such a channel has values in less than half of the rows, at irregular intervals.
    """
    if channel in (*MOTION_AND_WIND_CHANNELS, *QUATERNION, *_MAX_ANGLE):
        return False
    filled_rows = [
        np.flatnonzero(np.isfinite(table.columns[channel]))
        for table in logs
        if channel in table.columns
    ]
    samples = sum(table.t.size for table in logs if channel in table.columns)
    intervals = (
        np.concatenate([np.diff(rows) for rows in filled_rows]) if filled_rows else np.zeros(0)
    )
    if not intervals.size or 2 * sum(rows.size for rows in filled_rows) >= samples:
        return False
    is_regular = np.abs(intervals - np.median(intervals)) <= INTERVAL_TOLERANCE * np.median(
        intervals
    )
    return bool(is_regular.mean() < MIN_REGULAR_SHARE)


def _note_unused_columns(
    preview: TablePreview,
    names: Mapping[str, str],
    clock: TableClock,
    draft_notes: DraftNotes,
    selected_columns: set[str],
) -> None:
    used_columns = {*names.values(), *clock.columns, *selected_columns}
    unused_columns = [name for name in preview.numeric_columns if name not in used_columns]
    if unused_columns:
        draft_notes.add_note(CHANNELS_KEY, f"{UNMAPPED_COLUMNS}: {', '.join(unused_columns[:20])}")
    texts = [
        f"{name} ('{truncate(str(cells.dropna().iloc[0]), 20)}')"
        for name, cells in preview.text_columns.items()
        if name not in used_columns
    ]
    if texts:
        draft_notes.add_note(CHANNELS_KEY, f"{TEXT_COLUMNS}: {', '.join(texts[:12])}")
    if preview.empty_columns:
        draft_notes.add_note(
            CHANNELS_KEY, f"empty columns: {', '.join(preview.empty_columns[:12])}"
        )
    if preview.other_sheets:
        text = (
            f"sheets that are not read: {', '.join(preview.other_sheets)}; write the columns of one"
            " log to one sheet, or each log to a separate file"
        )
        draft_notes.add_note(CHANNELS_KEY, text)


@dataclass(frozen=True)
class TablePreview:
    """First rows of one table.

    Attributes:
        path: path of the file.
        reader_settings: settings `kind`, `delimiter`, `decimal` and `sheet` of its reader.
        column_names: names of all columns, with a unit from the row below in brackets.
        numeric_columns: column -> numbers [T].
        text_columns: column -> texts [T], including dates.
        empty_columns: names of columns without values.
        original_names: column -> name in the file, if they differ.
        other_sheets: further sheets of the file with numbers.
    """

    path: Path
    reader_settings: dict[str, Any]
    column_names: tuple[str, ...]
    numeric_columns: dict[str, np.ndarray]
    text_columns: dict[str, pd.Series]
    empty_columns: tuple[str, ...]
    original_names: dict[str, str]
    other_sheets: tuple[str, ...] = ()

    def original_name(self, name: str) -> str:
        """Return the name of a column in the file."""
        return self.original_names.get(name, name)


def preview_table(
    path: Path, rows: int = 20_000, names: Sequence[str] | None = None
) -> TablePreview:
    """Load the first rows of a table.

    Args:
        path: file of the table.
        rows: largest number of rows to load.
        names: names of all columns of a text table without a line of names.

    Raises:
        DataError: if the table has no rows or cannot be read.
    """
    import pandas as pd

    require_file(path)
    table_kind = TABLE_KINDS.get(path.suffix.lower(), "csv")
    if table_kind in _HEAD_READERS:
        table = _HEAD_READERS[table_kind](path, rows)
        reader_settings = {"kind": table_kind}
    else:
        table, reader_settings = (
            _preview_excel(path, rows)
            if table_kind == "excel"
            else read_table_head(path, rows, names)
        )
    columns = _append_units(table)
    other_sheets = table.attrs.get("other_sheets", ())
    table.columns = pd.Index(list(columns))
    # pandas would copy the attrs of a table to each of its columns
    table.attrs = {}
    if table.empty:
        raise DataError(f"{path}: has a header and no rows; leave the file out")
    numeric_columns: dict[str, np.ndarray] = {}
    text_columns: dict[str, pd.Series] = {}
    empty_columns = []
    for name, (_, column) in zip(columns, table.items(), strict=True):
        is_empty = column.isna().to_numpy()
        if is_empty.all():
            empty_columns.append(name)
            continue
        values = pd.to_numeric(column, errors="coerce").to_numpy(dtype=float, na_value=np.nan)
        has_text = np.isnan(values).sum() > is_empty.sum()
        values = mask_fill_values(values)
        if has_text or column.dtype == bool or pd.api.types.is_datetime64_any_dtype(column):
            text_columns[name] = column
        else:
            numeric_columns[name] = values
    renamed = {name: column for name, column in columns.items() if name != column}
    return TablePreview(
        path,
        reader_settings,
        tuple(table.columns),
        numeric_columns,
        text_columns,
        tuple(empty_columns),
        renamed,
        other_sheets,
    )


def _append_units(table: pd.DataFrame) -> dict[str, str]:
    """Return the column names with units from the row below or from cells -> original names."""
    cell_units = table.attrs.get("units", ())
    names = [str(name).strip() for name in table.columns]
    unit_rows = [
        [_parse_unit_cell(cell) for cell in row] for row in table.attrs.get("unit_rows", [])
    ]
    units = max(unit_rows, key=lambda row: sum(map(bool, row)), default=[])
    units = units if 2 * sum(map(bool, units)) >= len([name for name in names if name]) else []
    units = cell_units if any(cell_units) else units
    original_names = {}
    for name, unit_below in zip(names, [*units, *[""] * len(names)], strict=False):
        # notation of physics: a quantity divided by its unit, `u / m/s`
        match = _NAME_OVER_UNIT.fullmatch(name)
        bare_name, unit = (
            (match["name"], _parse_unit_cell(match["unit"])) if match else (name, unit_below)
        )
        original_names[
            f"{bare_name} [{unit}]" if unit and not _OPENING_BRACKET.search(name) else name
        ] = name
    return original_names


def _parse_unit_cell(cell: str) -> str:
    """Return the unit in a cell below a column name, or an empty string."""
    unit = cell.strip(" []()")
    return unit if is_unit(unit) else ""


def are_parts_of_recording(sheets: Sequence[pd.DataFrame]) -> bool:
    """Return whether sheets are parts of one recording.

    They have the same first column, their times overlap by half, and no other column is in two.
    """
    import pandas as pd

    if len(sheets) < 2:
        return False
    names = [[str(name) for name in sheet.columns] for sheet in sheets]
    other_names = [name for columns in names for name in columns[1:] if name]
    if len({columns[0] for columns in names}) > 1 or len(set(other_names)) < len(other_names):
        return False
    ranges = []
    for sheet in sheets:
        times = pd.to_numeric(sheet.iloc[:, 0], errors="coerce").dropna()
        if times.empty or not times.is_monotonic_increasing:
            return False
        ranges.append((float(times.iloc[0]), float(times.iloc[-1])))
    overlap = min(end for _, end in ranges) - max(start for start, _ in ranges)
    return overlap > 0.5 * max(end - start for start, end in ranges)


def _preview_excel(path: Path, rows: int) -> tuple[pd.DataFrame, dict[str, Any]]:
    """Load the first sheet with two or more columns of numbers, otherwise the first sheet.

    Further sheets of the same recording are joined.

    Raises:
        DataError: if several sheets have the same columns, such as a sheet for each test.
    """
    names = list_sheet_names(path)
    tables = {name: read_excel_sheet(path, name, rows) for name in names}
    numeric_sheets = [
        n for n, table in tables.items() if len(table.select_dtypes("number").columns) > 1
    ]
    if are_parts_of_recording([tables[name] for name in numeric_sheets]):
        joined = join_excel_sheets(path, {name: tables[name] for name in numeric_sheets})
        return joined, {"kind": "excel", "sheet": tuple(numeric_sheets)}
    name = next(iter([*numeric_sheets, *names]))
    table = tables[name]
    groups = (
        [other for other in numeric_sheets if tables[other].columns.equals(tables[first].columns)]
        for first in numeric_sheets
    )
    similar_sheets = max(groups, key=len, default=[])
    if len(similar_sheets) > 1:
        raise DataError(
            f"{path}: sheets {truncate(', '.join(similar_sheets), 60)} have the same columns, one"
            " log per file was expected; write each sheet to a file, in Python"
            " [sheet.to_csv(f'{name}.csv', index=False, header=False) for name, sheet in"
            f" pandas.read_excel({path.name!r}, sheet_name={similar_sheets!r},"
            " header=None).items()]"
        )
    table.attrs["other_sheets"] = tuple(numeric_sheets[1:])
    return table, {"kind": "excel", **({"sheet": name} if name != names[0] else {})}


@dataclass(frozen=True)
class TableClock:
    """Clock of a table.

    Attributes:
        settings: `time` of the reader.
        seconds: times of the first rows [T] in s.
        guess: reason for a guess; empty if there is none.
        columns: names of the columns of time and date.
    """

    settings: dict[str, Any]
    seconds: np.ndarray
    guess: str
    columns: tuple[str, ...]


class MissingClockError(DataError):
    """A table without a column of time."""


def make_step_clock(preview: TablePreview, step: str) -> TableClock:
    """Return the clock of a table whose rows are a constant time apart.

    Args:
        preview: first rows of the table.
        step: time between two rows with its unit, for example `0.1 s`.

    Raises:
        UsageError: if the step is no positive time.
    """
    match = re.fullmatch(r"\s*([\d.eE+-]+)\s*([a-zµ]*)\s*", step)
    try:
        seconds = float(match[1]) * to_si(match[2] or "s") if match else 0.0
    except (ValueError, ResidnetError):
        seconds = 0.0
    if not 0.0 < seconds < np.inf:
        raise UsageError(
            f"the time between two rows '{truncate(step, 40)}' is no time; write it as '0.1 s'"
        )
    columns: list[Any] = [*preview.numeric_columns.values(), *preview.text_columns.values()]
    settings = {"step": f"{seconds:.12g} s"}
    return TableClock(settings, seconds * np.arange(len(columns[0])), "", ())


def detect_clock(preview: TablePreview) -> TableClock:
    """Detect the column of time and its unit.

    It is a column of dates, else a column with a word for time, else one that increases regularly.

    Raises:
        MissingClockError: if no column is a clock.
        DataError: if the clock is not readable, or its parts are in several columns.
    """
    time_columns = [name for name in preview.column_names if parse_name(name).has_all("time")]
    part_columns = [
        name for name in preview.numeric_columns if normalize_name(name) in DATE_PART_NAMES
    ]
    has_time_text = any(
        preview.text_columns[name].astype("string").str.contains(":").any()
        for name in preview.text_columns
    )
    if len(part_columns) > 1 and not has_time_text:
        raise DataError(
            f"{preview.path}: date and time are in several columns ({', '.join(part_columns)});"
            " write them to one column, for example 2025-06-17 08:30:00.25"
        )
    date_columns = {
        name: cells for name, cells in preview.text_columns.items() if is_date_column(cells)
    }
    if date_columns:
        return _detect_date_clock(preview, date_columns)

    def is_increasing(name: str) -> bool:
        values = preview.numeric_columns[name]
        finite_values = values[np.isfinite(values)]
        # a column without a name may be the index of pandas: row numbers or the time
        return (
            values.size > 1
            and bool((np.diff(repair_clock(finite_values, [finite_values], 1.0)[0]) > 0.0).all())
            and not (name.startswith("Unnamed: ") and bool((np.diff(values) == 1.0).all()))
        )

    numeric_time_columns = [name for name in time_columns if name in preview.numeric_columns]
    # the time of the measurement precedes that of its arrival
    numeric_time_columns.sort(key=lambda name: not normalize_name(name).endswith("header stamp"))
    # only without a column called time, others are searched; counters are excluded
    increasing_columns = [
        name
        for name in (preview.numeric_columns if not numeric_time_columns else ())
        if parse_name(name).has_none("index")
        and match_state_channel(parse_name(name)) is None
        and is_increasing(name)
    ]
    increasing_columns.sort(key=lambda name: _relative_step_spread(preview.numeric_columns[name]))
    clock_column = next(
        filter(is_increasing, numeric_time_columns),
        next(iter([*numeric_time_columns, *increasing_columns]), None),
    )
    if clock_column is None:
        if not time_columns:
            raise MissingClockError(
                f"{preview.path}: no column has a name of time or increases like a clock; if the"
                " rows are evenly spaced, give the time between them: residnet new --step '0.1 s',"
                " or time: {step: 0.1 s} of the reader in a config; in Python"
                " read_logs(files, time={'step': '0.1 s'})"
            )
        cells = [
            str(cell) for cell in preview.text_columns.get(time_columns[0], ()) if cell == cell
        ]
        unparsed_cells = [cell for cell in cells if not re.fullmatch(r"[-\d.,]+", cell)]
        advice = "write numbers, or dates such as 2025-06-17 08:30:00.25"
        advice = (
            advice
            if 2 * len(unparsed_cells) >= len(cells)
            else "delete such lines, which are no rows"
        )
        example = f", such as '{truncate(unparsed_cells[-1])}'" if unparsed_cells else ""
        raise DataError(
            f"{preview.path}: column '{time_columns[0]}' has times in an unknown notation{example};"
            f" {advice}"
        )
    values = preview.numeric_columns[clock_column]
    unit = parse_header_unit(clock_column, "s")
    guess = ""
    if unit is None:
        unit, guess = _guess_time_unit(values)
    if clock_column not in time_columns:
        guess = f"no column has a name of time; this one increases like a clock. {guess}".strip()
    seconds, interpolation = _repair_preview_clock(preview, values * to_si(unit), to_si(unit))
    guess = ". ".join(filter(None, (guess, interpolation)))
    return TableClock({"column": clock_column, "unit": unit}, seconds, guess, (clock_column,))


def _relative_step_spread(values: np.ndarray) -> float:
    """Return the standard deviation of the steps divided by their median, with two decimals."""
    time_steps = np.diff(values[np.isfinite(values)])
    return round(float(np.std(time_steps) / np.median(time_steps)), 2)


def _repair_preview_clock(
    preview: TablePreview, t: np.ndarray, clock_resolution: float | None = None
) -> tuple[np.ndarray, str]:
    """Return the times [T] in s of a table with the corrections that its reader will apply.

    The second value says how rows with the same stamp are interpolated; empty without such rows.
    """
    is_finite = np.isfinite(t)
    if is_finite.sum() < 2 or not preview.numeric_columns:
        return t, ""
    t = t.copy()
    columns = (values[is_finite] for values in preview.numeric_columns.values())
    t[is_finite], remarks = repair_clock(t[is_finite], columns, clock_resolution)
    texts = (
        remark["text"] for remark in remarks if remark["code"] in ("printed_clock", "coarse_stamps")
    )
    return t, next(texts, "")


def _detect_date_clock(preview: TablePreview, date_columns: dict[str, pd.Series]) -> TableClock:
    """Return the clock from one column of dates with times of day, or from two columns.

    Raises:
        DataError: if the dates have no time of day.
    """

    def all_match(name: str, pattern: str) -> bool:
        return bool(date_columns[name].dropna().astype("string").str.contains(pattern).all())

    time_columns = [
        name
        for name in date_columns
        if all_match(name, rf":|時|\s\d\d?\.\d\d\.\d\d|{_DOTTED_TIME_PATTERN}")
    ]
    date_only_columns = [name for name in date_columns if name not in time_columns]
    if not time_columns:
        raise DataError(
            f"{preview.path}: column '{date_only_columns[0]}' has dates without a time of day; add"
            " a column with the time"
        )
    complete_columns = [
        name
        for name in time_columns
        if all_match(name, _DATE_PATTERN) and not all_match(name, _DOTTED_TIME_PATTERN)
    ]
    column = (complete_columns or time_columns)[0]
    settings: dict[str, Any] = {"column": column, "unit": "date"}
    texts = date_columns[column]
    guess = ""
    if not complete_columns and date_only_columns:
        settings["date"] = date_only_columns[0]
        texts = date_columns[date_only_columns[0]].astype("string") + " " + texts.astype("string")
    order = detect_date_order(texts)
    if order is None and (complete_columns or date_only_columns):
        order = "dmy"
        guess = "day and month of the dates are ambiguous in the first rows"
    settings |= {"order": order} if order in ("dmy", "mdy") else {}
    stamps = parse_texts(texts, has_only_dates=True)
    seconds, interpolation = _repair_preview_clock(preview, stamps.seconds_since(int(stamps.ns[0])))
    guess = ". ".join(filter(None, (guess, interpolation)))
    return TableClock(
        settings, seconds, guess, (column, *date_only_columns[: not complete_columns])
    )


def _guess_time_unit(values: np.ndarray) -> tuple[str, str]:
    """Guess the unit of times [T] from their size and step; return the unit and the reason."""
    finite_values = values[np.isfinite(values)]
    step = float(np.median(np.diff(finite_values)))
    median_size = float(np.median(np.abs(finite_values)))
    if unix_unit := detect_unix_unit(finite_values):
        return unix_unit, f"numbers of this size are Unix time in {unix_unit}"
    if step < 1e-3 and (2e4 < median_size < 7e4 or 6.5e5 < median_size < 8e5):
        return "day", "numbers of this size are the days of Excel or MATLAB"
    unit = infer_time_unit(step)
    return unit, f"the header has no unit; steps of {step:g} would be {unit}"


def convert_positions_to_degrees(
    preview: TablePreview, draft_notes: DraftNotes
) -> tuple[TablePreview, ColumnSettings]:
    """Convert columns of latitude and longitude to degrees.

    Args:
        preview: first rows of a table.
        draft_notes: receives guesses.

    Returns:
        The table with degrees, and the settings `form`, `hemisphere` and `letter_o` of its columns.
        Tables without both columns in a known notation are unchanged.
    """
    import pandas as pd

    columns: dict[str, str] = {}
    for column in preview.column_names:
        channel = match_state_channel(parse_name(column))
        if channel in _MAX_ANGLE and column not in preview.empty_columns:
            columns.setdefault(channel, column)
    if len(columns) < 2:
        return preview, {}
    cells = {
        name: pd.Series(preview.numeric_columns[column])
        if column in preview.numeric_columns
        else preview.text_columns[column]
        for name, column in columns.items()
    }
    hemisphere_columns = {name: _find_hemisphere_column(preview, name) for name in columns}
    letter_o, reason = _guess_letter_o(
        preview, hemisphere_columns["longitude"] or columns["longitude"]
    )
    parsed_positions = _parse_positions(cells, letter_o)
    if parsed_positions is None:
        return preview, {}
    form, degrees = parsed_positions
    settings: dict[str, dict[str, Any]] = {column: {} for column in columns.values()}
    if form == "ddmm":
        for entry in settings.values():
            entry["form"] = form
        text = "numbers above 90 are assumed degrees and minutes in one, 5954.321 for 59° 54.321'"
        draft_notes.add_guess((*CHANNELS_KEY, "latitude"), text)
    for name, hemisphere_column in hemisphere_columns.items():
        if hemisphere_column is not None:
            settings[columns[name]]["hemisphere"] = preview.original_name(hemisphere_column)
            degrees[name] = degrees[name] * hemisphere_signs(
                preview.text_columns[hemisphere_column], name, letter_o
            )
    if letter_o is not None:
        settings[columns["longitude"]]["letter_o"] = letter_o
        draft_notes.add_guess((*CHANNELS_KEY, "longitude"), reason)
    converted = {
        **preview.numeric_columns,
        **{columns[name]: values for name, values in degrees.items()},
    }
    used_columns = {*columns.values(), *hemisphere_columns.values()}
    return (
        dataclasses.replace(
            preview,
            numeric_columns={
                name: converted[name] for name in preview.column_names if name in converted
            },
            text_columns={
                name: cells
                for name, cells in preview.text_columns.items()
                if name not in used_columns
            },
        ),
        settings,
    )


def _parse_positions(
    cells: Mapping[str, pd.Series], letter_o: LetterO | None
) -> tuple[AngleForm, dict[str, np.ndarray]] | None:
    """Return the first notation in which all cells are angles in range, and the degrees [T].

    Args:
        cells: cells of latitude and longitude.
        letter_o: meaning of the letter O as a hemisphere.

    Returns:
        None if there is no such notation.
    """
    for form in _ANGLE_FORMS:
        try:
            degrees = {
                name: parse_degrees(texts, name, form, letter_o) for name, texts in cells.items()
            }
        except DataError:
            continue
        max_angles = {name: np.abs(v[np.isfinite(v)]).max(initial=0) for name, v in degrees.items()}
        if all(max_angles[name] <= _MAX_ANGLE[name] for name in cells):
            return form, degrees
    return None


def _guess_letter_o(preview: TablePreview, column: str) -> tuple[LetterO | None, str]:
    """Guess the meaning of the letter O as a hemisphere.

    With W in other cells it means east, with E west. Otherwise the language of the column names
    decides: east in German and Dutch, west in Spanish, French, Italian and Portuguese.

    Returns:
        The meaning and the reason; None if no longitude has the letter O.
    """
    cells = preview.text_columns.get(column)
    if cells is None:
        return None, ""
    first_and_last_letters = (
        cells.dropna().astype("string").str.upper().str.extract(r"^\s*([EOW])?.*?([EOW])?\s*$")
    )
    letters = {
        str(letter)
        for position in first_and_last_letters
        for letter in first_and_last_letters[position].dropna().unique()
    }
    if "O" not in letters:
        return None, ""
    if len(letters) > 1:
        other_letter = min(letters - {"O"})
        return ("east" if "W" in letters else "west"), f"other cells have {other_letter}"
    is_germanic = any(
        GERMANIC_PATTERN.search(normalize_name(name)) for name in preview.column_names
    )
    meaning: LetterO = "east" if is_germanic else "west"
    return meaning, f"the letter O is assumed {meaning}, by the language of the column names"


def _find_hemisphere_column(preview: TablePreview, name: str) -> str | None:
    """Return the column with the hemispheres of latitude or longitude, or None."""
    for column, cells in preview.text_columns.items():
        letters = set(cells.dropna().astype("string").str.strip().str.upper()) - {""}
        if letters and letters <= _HEMISPHERES[name]:
            return column
    return None
