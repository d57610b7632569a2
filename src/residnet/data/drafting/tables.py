"""The channel map of tables that nobody described, with what is not sure about it."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from residnet.core.errors import DataError, ResidnetError, UsageError
from residnet.core.names import CHANNEL_UNITS, shown, si_of
from residnet.core.units import is_unit, to_si
from residnet.data.channels import ALIKE, REGULAR, without_fills
from residnet.data.drafting.channels import (
    CHANNELS,
    MAGNETIC,
    READER,
    STATE_NAMES,
    Raw,
    circles,
    drafted_channels,
    levelled,
    quaternions,
    submerged,
)
from residnet.data.drafting.questions import Marks
from residnet.data.drafting.words import (
    MOTION,
    input_channel,
    other_dimension,
    plain,
    state_channel,
    words_of,
    written_unit,
)
from residnet.data.readers.base import require_file
from residnet.data.readers.quantities import COSINE, QUATERNION, SINE
from residnet.data.readers.tables import TABLES, excel_sheet, json_rows, parquet_rows, sheet_names
from residnet.data.readers.texts import first_rows
from residnet.data.readers.written import (
    Form,
    LetterO,
    date_order,
    degrees_of,
    first_of_copies,
    looks_dated,
    parse_texts,
    side_signs,
    steady_clock,
    unit_of_steps,
    unix_unit,
)

if TYPE_CHECKING:
    import pandas as pd

_FIRST_ROWS = {"parquet": parquet_rows, "json_lines": json_rows}
_BRACKETS = re.compile(r"[\[(]")
_QUOTIENT = re.compile(r"(?P<name>.*\S)\s+/\s+(?P<unit>\S.*)")
_TURNS = re.compile(r"rpm|rev|1/s|hz|turns|u/?min|umdr|drehz|toeren|tours|giri|varv", re.IGNORECASE)
_DRIVEN = re.compile(r"^(?:cmd_)?(?:n(?=_|$)|thrust)")
_PULSES = (900.0, 2100.0)
"""Pulses in us that servos and speed controllers take."""
_PARTS_OF_TIME = (
    *("year", "yyyy", "jahr", "month", "mm", "monat", "day", "dd", "tag", "hour", "hours", "hh"),
    *("stunde", "minute", "minutes", "min", "second", "seconds", "sekunde", "ss"),
)
_DAY = r"\d\s*[-./年]\s*\w{1,9}\s*[-./月]"
_POINTS = r"^\d\d?\.\d\d\.\d\d[.,]"
"""How a time of day begins that has points between its parts."""
_FORMS: tuple[Form, ...] = ("number", "ddmm")
_LARGEST = {"latitude": 90.0, "longitude": 180.0}
_SIDES = {"latitude": {"N", "S"}, "longitude": {"E", "W", "O"}}
_GERMANIC = re.compile(r"breite|l(?:ae|a)nge|breedte|lengte|zeit|tijd|kurs|koers|ruder|roer")
Settings = Mapping[str, Mapping[str, Any]]
"""Column -> what its entry in a channel map says beside column and unit."""
_LOOKED_AT = 24
"""Tables whose values are looked at; of the others only the header is."""


def draft_tables(
    files: Sequence[Path], marks: Marks, *, headed: bool = False
) -> tuple[dict[str, Any], dict[Path, ResidnetError]]:
    """Return the settings of a reader of tables, and file -> why it is not read.

    They come from names, units in the headers, values and physics.

    Args:
        files: at least one table.
        headed: whether other files may tell the heading.

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
        alike = [sheet.path.name for sheet in sheets if sheet.header == first.header]
        raise UsageError(
            f"{first.path}: its time '{clock.columns[0]}' is not in every file, so that these are"
            f" tables of several kinds; give those of one, here {', '.join(alike)[:120]} (parts of"
            " one trip are files whose names differ in one word, each with other quantities)"
        )
    if clock.guess:
        marks.guess((*READER, "time"), clock.guess)
    held = {name for sheet in sheets for name in sheet.numbers}
    numeric = [name for name in shared if name in held and name not in clock.columns]
    minutes = [
        name
        for name in numeric
        if state_channel(words_of(name)) in _LARGEST and written_unit(name, "s") == "min"
    ]
    if minutes:
        raise DataError(
            f"{first.path}: '{minutes[0]}' holds minutes whose degrees stand in another column;"
            " write degrees + minutes / 60 into one column each for latitude and longitude"
        )
    attitudes = quaternions(numeric)
    parts = {column for attitude in attitudes for column in attitude.values()}
    angles = circles(numeric, [one.numbers for one in sheets])
    parts |= {column for pair in angles.values() for column in pair}
    rest = [name for name in numeric if name not in parts]
    psi = any(state_channel(words_of(stem)) == "psi" for stem in angles)
    names = _of_one_vessel(rest, first.numbers, marks, headed=headed or psi or bool(attitudes))
    names = _pulsed(names, sheets)
    names = _angles(names, angles)
    # a vessel without roll is modelled too, so that no log is lost for it
    rolls = [name for name in ("phi", "p") if name in names]
    for name in [one for one in rolls if any(names[one] not in s.numbers for s in sheets)]:
        marks.note(CHANNELS, f"empty in some files, left out: {names.pop(name)}")
    names |= submerged(numeric, names)
    found = [name for name in first.texts if state_channel(words_of(name)) in _LARGEST]
    if found and "x" not in names and not set(_LARGEST) <= set(names):
        cell = first.texts[found[0]].dropna().iloc[0]
        raise DataError(
            f"{first.path}: column '{found[0]}' holds '{shown(str(cell))}', which is no latitude or"
            " longitude beside its other column; forms that are read are 59.90535, 59°54.321'N,"
            " 59 54 19.3 N and 5954.321"
        )
    if "psi" not in names:
        names |= levelled(attitudes, [one.numbers for one in sheets])
    if not names:
        raise DataError(
            f"{first.path}: none of its columns is called as a channel is"
            f" ({', '.join(numeric[:12])}); {_wider(first, clock, numeric)}"
        )
    logs = _raw(sheets, names, left_out)
    cells = [str(text) for texts in first.texts.values() for text in texts.unique()[:20]]
    channels = drafted_channels(names, logs, marks, [*first.header, *cells])
    for channel, entry in channels.items():
        if _on_change(channel, logs):
            entry["hold"] = True
            text = "recorded when it changes: the last value holds until the next"
            marks.guess((*CHANNELS, channel), text)
        settings = written.get(entry["column"], {})
        entry |= {"column": first.column(entry["column"]), **settings}
    about = {key: value for key, value in first.about.items() if key != "kind"}
    time = {**clock.settings, "column": first.column(clock.settings["column"])}
    content = {"kind": first.about["kind"], **about, "time": time}
    content |= mark_folders(files, marks)
    _unused(first, names, clock, marks)
    return {**content, "channels": channels}, left_out


def _wider(sheet: Sheet, clock: Clock, numeric: Sequence[str]) -> str:
    """Return what to do with a table whose columns name no channel."""
    if not numeric:
        return "the files have no column of numbers in common: give those of one kind"
    words = [name for name, cells in sheet.texts.items() if 1 < cells.nunique() <= len(cells) / 4]
    words = [name for name in words if name not in clock.columns]
    if len(numeric) == 1 and words:
        return (
            f"'{words[0]}' says what each row holds: make columns of it, in Python"
            f" pandas.read_csv(file).pivot_table({numeric[0]!r}, {clock.columns[0]!r},"
            f" {words[0]!r}).to_csv('log.csv')"
        )
    if len(numeric) == 1:
        return (
            "where each file holds one quantity, make one table of them, in Python"
            " pandas.concat({file.stem: pandas.read_csv(file, index_col=0).iloc[:, 0] for file in"
            " files}, axis=1).sort_index().to_csv('log.csv')"
        )
    if all(_unit_in(re.sub(r"\.\d+$", "", name)) for name in numeric):
        return "these are units: write each column's name in one cell above its unit, or before it"
    return "name them in a channel map (--config)"


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


def _of_one_vessel(
    columns: Sequence[str], numbers: Mapping[str, np.ndarray], marks: Marks, *, headed: bool
) -> dict[str, str]:
    """Return channel -> column; of `boat1_x` and `boat2_x`, side by side, those of the first.

    The same words stand behind the word of each vessel or sensor, a place and an input among them.
    What rests or is commanded is not taken for a vessel.
    """
    words: dict[str, dict[str, str]] = {}
    for column in columns:
        word, _, rest = re.sub(r"[\W_]+", "\0", column, count=1).partition("\0")
        words.setdefault(word, {})[rest] = column
    for own in words.values():
        alike = {word: its for word, its in words.items() if its.keys() == own.keys()}
        if len(alike) < 2 or any(words_of(word).has("command") for word in alike):
            continue
        found = named([*own], Marks())
        place = next((pair for pair in (("x", "y"), (*_LARGEST,)) if {*pair} <= found.keys()), ())
        if not place or not found.keys() - {*STATE_NAMES, *_LARGEST}:
            continue
        for word, its in alike.items():
            if any(np.nanstd(numbers[its[found[name]]]) > 0.0 for name in place):
                text = (
                    f"the columns of {', '.join(alike)} hold a position each; of these vessels or"
                    f" sensors {word} is read; write the others into tables of their own"
                )
                marks.guess(CHANNELS, text)
                return {channel: its[rest] for channel, rest in named([*its], marks).items()}
    return named(columns, marks, headed=headed)


def named(columns: Sequence[str], marks: Marks, *, headed: bool = True) -> dict[str, str]:
    """Return channel -> column, by what the columns are called.

    A speed is that forward where no position and heading tell it.

    Args:
        headed: whether something else may tell the heading.
    """
    alone = {re.sub(r"\W*[\[(].*|_m$", "", column).strip().lower(): column for column in columns}
    if {"n", "e"} <= set(alone):
        pair = {"x": alone["n"], "y": alone["e"]}
        rest = Marks()
        others = named([name for name in columns if name not in pair.values()], rest, headed=headed)
        if not {"x", "y", "latitude", "longitude"} & set(others):
            # beside E, N counts no revolutions
            marks.extend(rest)
            text = f"'{pair['x']}' and '{pair['y']}' side by side are taken as north and east"
            marks.guess((*CHANNELS, "x"), text)
            return {**pair, **others}
    names: dict[str, str] = {}
    alike: dict[str, list[str]] = {}
    speeds: list[str] = []
    about = {column: words_of(column) for column in columns}
    copied = re.compile(r"\.\d+$")
    # of one vessel only what drives it has a speed to either side
    sides = {"port": "n_port", "starboard": "n_stbd"}
    sided = {
        column: n
        for column, words in about.items()
        for side, n in sides.items()
        if state_channel(words) == "v" and words.has("speed", side) and words.lacks("sway")
    }
    sided = sided if len({*sided.values()}) == 2 else {}

    def order(column: str) -> tuple[bool, bool, int]:
        magnetic = MAGNETIC.search(column) and state_channel(about[column]) == "psi"
        return bool(magnetic), about[column].text not in MOTION, len(about[column].about)

    # true headings first, then a channel's own name, `u` before `vx`, then shorter names: `heading`
    # before `heading of the second compass`
    for column in sorted(columns, key=order):
        channel = sided.get(column) or state_channel(about[column]) or input_channel(about[column])
        if channel is None and about[column].has("pitch") and written_unit(column, "-") == "%":
            # no angle, but that of a propeller's blades
            channel = input_channel(words_of(f"propeller {column}"))
        si = si_of(channel) if channel else None
        other = other_dimension(column, si) if si else None
        if channel == "n" and other == "m":
            channel = "x"
        elif channel and "thrust" in channel and written_unit(column, "1/s"):
            # a thruster that turns, and no force
            channel = channel.replace("thrust", "n")
        elif (
            channel
            and _DRIVEN.match(channel)
            and (other in ("-", "us") or written_unit(column, "-") == "%")
        ):
            # no revolutions and no force: the share of the throttle, or pulses to it
            channel = _DRIVEN.sub("throttle", channel)
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
            alike.setdefault(channel, [names[channel]]).append(column)
    for channel, called in alike.items():
        each = {f"{channel}_{k}": one for k, one in enumerate(sorted(called, key=columns.index), 1)}
        if "thrust" not in channel or names.keys() & each.keys():
            # of a rudder or a shaft that is told twice, one is an indicator
            for column in called[1:]:
                marks.note(CHANNELS, f"'{column}' may be {channel} as well as '{called[0]}' is")
            continue
        # thrusters that no number tells apart
        del names[channel]
        names |= each
        marks.guess((*CHANNELS, f"{channel}_1"), f"{', '.join(called)} are taken for one each")
    placed = bool({"x", "y", "latitude", "longitude"} & names.keys())
    theta = next((column for column in columns if "theta" in about[column].text.split()), None)
    if placed and theta is not None and not {"psi", "phi"} & names.keys():
        names["psi"] = theta
        marks.guess((*CHANNELS, "psi"), f"'{theta}' is taken as the heading, for no other is there")
    for port, stbd in (("delta_port", "delta_stbd"), ("cmd_delta_port", "cmd_delta_stbd")):
        if (port in names) != (stbd in names):
            # one rudder: the side says where positive angles turn it
            side = port if port in names else stbd
            rudder, column = side.rpartition("_")[0], names.pop(side)
            if names.setdefault(rudder, column) != column:
                marks.note(CHANNELS, f"'{column}' may be {rudder} as well as '{names[rudder]}' is")
    headed = headed or "psi" in names or any("course" in words.about for words in about.values())
    if "u" not in names and speeds and ("v" in names or not (placed and headed)):
        names["u"] = speeds[0]
        marks.guess((*CHANNELS, "u"), f"'{speeds[0]}' is taken as the speed forward, not its size")
    listed = [*STATE_NAMES, *(name for name in names if name not in STATE_NAMES)]
    return {name: names[name] for name in listed if name in names}


def _angles(names: dict[str, str], pairs: Mapping[str, tuple[str, str]]) -> dict[str, str]:
    """Return channel -> column with angles that are told by a cosine and a sine.

    A direction of nothing known is that of the wind, where its speed stands alone.
    """
    told = {*names}
    for stem, pair in pairs.items():
        words = words_of(stem)
        channel = state_channel(words)
        if channel is None and told & {"wind_speed", "wind_dir"} == {"wind_speed"}:
            channel = "wind_dir"
        channel = channel or input_channel(words)
        if channel and CHANNEL_UNITS.get(channel, "rad") == "rad" and channel not in told:
            told.add(channel)
            names = {**names, channel + COSINE: pair[0], channel + SINE: pair[1]}
    return names


def _pulsed(names: Mapping[str, str], sheets: Sequence[Sheet]) -> dict[str, str]:
    """Return channel -> column, where pulses to a motor are its throttle, and no revolutions.

    Pulses are whole microseconds between 900 and 2,100, and a share of a motor's or thruster's all
    is one at most; revolutions say in their name what they are, or are zero at rest.
    """
    out = {}
    for channel, column in names.items():
        values = np.concatenate([one.numbers.get(column, np.zeros(0)) for one in sheets])
        values = values[np.isfinite(values)]
        if _DRIVEN.match(channel) and values.size and not _TURNS.search(column):
            whole = bool((values == np.round(values)).all())
            pulses = whole and values.min() >= _PULSES[0] and values.max() <= _PULSES[1]
            motor = words_of(column)
            share = "thrust" in channel or motor.has("engine")
            share &= motor.lacks("revolutions", "propeller", "speed") and not whole
            throttle = _DRIVEN.sub("throttle", channel)
            if throttle not in names and (pulses or (share and np.abs(values).max() <= 1.0)):
                channel = throttle
        out[channel] = column
    return out


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
        # the newest first
        way = -1 if (np.diff(clock.seconds[np.isfinite(clock.seconds)]) < 0.0).all() else 1
        columns = {channel: values[::way] for channel, values in columns.items()}
        t = clock.seconds[::way]
        first = first_of_copies(t, columns.values()) if columns else t == t
        logs.append(Raw(t[first], {name: values[first] for name, values in columns.items()}))
    return logs


def _on_change(channel: str, logs: Sequence[Raw]) -> bool:
    """Return whether a channel that drives the vessel has values at fewer than half of the samples,
    and no interval between them that is usual.
    """
    if channel in (*STATE_NAMES, *QUATERNION, *_LARGEST):
        return False
    known = [
        np.flatnonzero(np.isfinite(raw.columns[channel])) for raw in logs if channel in raw.columns
    ]
    samples = sum(raw.t.size for raw in logs if channel in raw.columns)
    every = np.concatenate([np.diff(at) for at in known]) if known else np.zeros(0)
    if not every.size or 2 * sum(at.size for at in known) >= samples:
        return False
    usual = np.abs(every - np.median(every)) <= ALIKE * np.median(every)
    return bool(usual.mean() < REGULAR)


def _unused(sheet: Sheet, names: Mapping[str, str], clock: Clock, marks: Marks) -> None:
    used = {*names.values(), *clock.columns}
    idle = [name for name in sheet.numbers if name not in used]
    if idle:
        marks.note(CHANNELS, f"columns that no channel takes: {', '.join(idle[:20])}")
    texts = [
        f"{name} ('{shown(str(cells.dropna().iloc[0]), 20)}')"
        for name, cells in sheet.texts.items()
        if name not in used
    ]
    if texts:
        marks.note(CHANNELS, f"columns of text: {', '.join(texts[:12])}")
    if sheet.empty:
        marks.note(CHANNELS, f"empty columns: {', '.join(sheet.empty[:12])}")
    if sheet.others:
        text = f"sheets that are not read: {', '.join(sheet.others)}; write what belongs together"
        marks.note(CHANNELS, f"{text} into one sheet, or each into a file of its own")


@dataclass(frozen=True)
class Sheet:
    """The first rows of one table.

    Attributes:
        path: of the file.
        about: settings of its reader beside time and channels: kind, delimiter, decimal.
        header: names of all columns.
        numbers: values [T] of the columns that hold numbers.
        texts: columns that hold text, dates among them.
        empty: columns that hold nothing.
        columns: what the file calls a column, where its name here has a unit that stands below.
        others: sheets beside it that hold numbers too.
    """

    path: Path
    about: dict[str, Any]
    header: tuple[str, ...]
    numbers: dict[str, np.ndarray]
    texts: dict[str, pd.Series]
    empty: tuple[str, ...]
    columns: dict[str, str]
    others: tuple[str, ...] = ()

    def column(self, name: str) -> str:
        """Return what the file calls a column."""
        return self.columns.get(name, name)


def peek(path: Path, rows: int = 20_000) -> Sheet:
    """Return the first rows of a table, 20,000 where `rows` does not say otherwise."""
    import pandas as pd

    require_file(path)
    kind = TABLES.get(path.suffix.lower(), "csv")
    if kind in _FIRST_ROWS:
        table, about = _FIRST_ROWS[kind](path, rows), {"kind": kind}
    else:
        table, about = _excel(path, rows) if kind == "excel" else first_rows(path, rows)
    columns, others = _described(table), table.attrs.get("others", ())
    # pandas copies all that is told of a table for each of its columns
    table.columns, table.attrs = pd.Index(list(columns)), {}
    if table.empty:
        raise DataError(f"{path}: holds a header and no rows; leave it out")
    numbers: dict[str, np.ndarray] = {}
    texts: dict[str, pd.Series] = {}
    empty = []
    for name, (_, column) in zip(columns, table.items(), strict=True):
        unknown = column.isna().to_numpy()
        if unknown.all():
            empty.append(name)
            continue
        values = pd.to_numeric(column, errors="coerce").to_numpy(dtype=float, na_value=np.nan)
        spoilt = np.isnan(values).sum() > unknown.sum()
        values = without_fills(values)
        if spoilt or column.dtype == bool or pd.api.types.is_datetime64_any_dtype(column):
            texts[name] = column
        else:
            numbers[name] = values
    renamed = {name: column for name, column in columns.items() if name != column}
    return Sheet(path, about, tuple(table.columns), numbers, texts, tuple(empty), renamed, others)


def _described(table: pd.DataFrame) -> dict[str, str]:
    """Return the names of columns with the units beneath them or in cells -> their names alone."""
    held = table.attrs.get("units", ())
    names = [str(name).strip() for name in table.columns]
    rows = [[_unit_in(cell) for cell in row] for row in table.attrs.get("between", [])]
    units = max(rows, key=lambda row: sum(map(bool, row)), default=[])
    units = units if 2 * sum(map(bool, units)) >= len([name for name in names if name]) else []
    units = held if any(held) else units
    out = {}
    for name, below in zip(names, [*units, *[""] * len(names)], strict=False):
        # physicists write a quantity by its unit, `u / m/s`
        match = _QUOTIENT.fullmatch(name)
        alone, unit = (match["name"], _unit_in(match["unit"])) if match else (name, below)
        out[f"{alone} [{unit}]" if unit and not _BRACKETS.search(name) else name] = name
    return out


def _unit_in(cell: str) -> str:
    """Return the unit that a cell beneath a name holds; empty where it holds none."""
    unit = cell.strip(" []()")
    return unit if is_unit(unit) else ""


def _excel(path: Path, rows: int) -> tuple[pd.DataFrame, dict[str, Any]]:
    """Return the first sheet with two columns of numbers, else the first, and its settings."""
    names = sheet_names(path)
    tables = {name: excel_sheet(path, name, rows) for name in names}
    full = [n for n, table in tables.items() if len(table.select_dtypes("number").columns) > 1]
    name = next(iter([*full, *names]))
    table = tables[name]
    table.attrs["others"] = tuple(full[1:])
    return table, {"kind": "excel", **({"sheet": name} if name != names[0] else {})}


@dataclass(frozen=True)
class Clock:
    """The time of a table.

    Attributes:
        settings: `time` of a table's reader.
        seconds: times [T] of the first rows.
        guess: what is not sure about it; empty where all is.
        columns: that it takes.
    """

    settings: dict[str, Any]
    seconds: np.ndarray
    guess: str
    columns: tuple[str, ...]


def clock_of(sheet: Sheet) -> Clock:
    """Return the time of a table."""
    named = [name for name in sheet.header if words_of(name).has("time")]
    parts = [name for name in sheet.numbers if plain(name) in _PARTS_OF_TIME]
    whole = any(sheet.texts[name].astype("string").str.contains(":").any() for name in sheet.texts)
    if len(parts) > 1 and not whole:
        raise DataError(
            f"{sheet.path}: its time stands in parts ({', '.join(parts)}); write it as one column,"
            " such as 2025-06-17 08:30:00.25"
        )
    dated = {name: cells for name, cells in sheet.texts.items() if looks_dated(cells)}
    if dated:
        return _dated(sheet, dated)

    def rises(name: str) -> bool:
        values = sheet.numbers[name]
        known = values[np.isfinite(values)]
        # pandas writes the number of each row under no name, or the time
        return (
            values.size > 1
            and bool((np.diff(steady_clock(known, [known], 1.0)[0]) > 0.0).all())
            and not (name.startswith("Unnamed: ") and bool((np.diff(values) == 1.0).all()))
        )

    called = [name for name in named if name in sheet.numbers]
    # one that is called time and does not increase is refused where it is read; a counter is none
    others = [
        name
        for name in (sheet.numbers if not called else ())
        if words_of(name).lacks("index") and state_channel(words_of(name)) is None and rises(name)
    ]
    others.sort(key=lambda name: _unsteady(sheet.numbers[name]))
    chosen = next(filter(rises, called), next(iter([*called, *others]), None))
    if chosen is None:
        if not named:
            raise DataError(
                f"{sheet.path}: no column is called time or increases as time does; name it in a"
                " channel map (--config)"
            )
        cells = [str(cell) for cell in sheet.texts.get(named[0], ()) if cell == cell]
        odd = [cell for cell in cells if not re.fullmatch(r"[-\d.,]+", cell)]
        told = "write it as numbers, or such as 2025-06-17 08:30:00.25"
        told = told if 2 * len(odd) >= len(cells) else "delete such lines, which are no rows"
        shows = f", such as '{shown(odd[-1])}'" if odd else ""
        raise DataError(
            f"{sheet.path}: column '{named[0]}' holds no times that can be read{shows}; {told}"
        )
    values = sheet.numbers[chosen]
    unit = written_unit(chosen, "s")
    guess = ""
    if unit is None:
        unit, guess = _time_unit(values)
    if chosen not in named:
        guess = f"no column is called time; this one increases as time does. {guess}".strip()
    seconds = _steady(sheet, values * to_si(unit), to_si(unit))
    return Clock({"column": chosen, "unit": unit}, seconds, guess, (chosen,))


def _unsteady(values: np.ndarray) -> float:
    """Return the spread of steps, as a share of the usual one and without the last digit."""
    steps = np.diff(values[np.isfinite(values)])
    return round(float(np.std(steps) / np.median(steps)), 2)


def _steady(sheet: Sheet, t: np.ndarray, tick: float | None = None) -> np.ndarray:
    """Return the times of a sheet as its reader will mend them."""
    known = np.isfinite(t)
    if known.sum() > 1 and sheet.numbers:
        t = t.copy()
        columns = (values[known] for values in sheet.numbers.values())
        t[known] = steady_clock(t[known], columns, tick)[0]
    return t


def _dated(sheet: Sheet, dated: dict[str, pd.Series]) -> Clock:
    """Return the time from one column of dates with times, or from two."""

    def hold(name: str, pattern: str) -> bool:
        return bool(dated[name].dropna().astype("string").str.contains(pattern).all())

    clocks = [name for name in dated if hold(name, rf":|時|\s\d\d?\.\d\d\.\d\d|{_POINTS}")]
    days = [name for name in dated if name not in clocks]
    if not clocks:
        raise DataError(f"{sheet.path}: column '{days[0]}' holds dates without a time of day")
    whole = [name for name in clocks if hold(name, _DAY) and not hold(name, _POINTS)]
    column = (whole or clocks)[0]
    settings: dict[str, Any] = {"column": column, "unit": "date"}
    texts, guess = dated[column], ""
    if not whole and days:
        settings["date"] = days[0]
        texts = dated[days[0]].astype("string") + " " + texts.astype("string")
    order = date_order(texts)
    if order is None and (whole or days):
        order = "dmy"
        guess = "day and month of the dates can be told apart nowhere in the first rows"
    settings |= {"order": order} if order in ("dmy", "mdy") else {}
    stamps = parse_texts(texts, dates=True)
    seconds = _steady(sheet, stamps.since(int(stamps.ns[0])))
    return Clock(settings, seconds, guess, (column, *days[: not whole]))


def _time_unit(values: np.ndarray) -> tuple[str, str]:
    """Return the unit of times without one, and why it is a guess."""
    known = values[np.isfinite(values)]
    step, size = float(np.median(np.diff(known))), float(np.median(np.abs(known)))
    if unix := unix_unit(known):
        return unix, f"times of this size are Unix time in {unix}"
    if step < 1e-3 and (2e4 < size < 7e4 or 6.5e5 < size < 8e5):
        return "day", "times of this size are days as Excel and MATLAB count them"
    unit = unit_of_steps(step)
    return unit, f"the header has no unit; steps of {step:g} would be {unit}"


def with_degrees(sheet: Sheet, marks: Marks) -> tuple[Sheet, Settings]:
    """Return a sheet with its positions as numbers of degrees, and how their columns are read.

    Columns that hold nothing that can be read so stay what they are.
    """
    import pandas as pd

    columns: dict[str, str] = {}
    for column in sheet.header:
        channel = state_channel(words_of(column))
        if channel in _LARGEST and column not in sheet.empty:
            columns.setdefault(channel, column)
    if len(columns) < 2:
        return sheet, {}
    cells = {
        name: pd.Series(sheet.numbers[column]) if column in sheet.numbers else sheet.texts[column]
        for name, column in columns.items()
    }
    sides = {name: _side(sheet, name) for name in columns}
    letter_o, why = _letter_o(sheet, sides["longitude"] or columns["longitude"])
    for form in _FORMS:
        try:
            degrees = {name: degrees_of(cells[name], name, form, letter_o) for name in columns}
        except DataError:
            continue
        largest = {name: np.abs(v[np.isfinite(v)]).max(initial=0) for name, v in degrees.items()}
        if all(largest[name] <= _LARGEST[name] for name in columns):
            break
    else:
        return sheet, {}
    settings: dict[str, dict[str, Any]] = {column: {} for column in columns.values()}
    if form == "ddmm":
        for entry in settings.values():
            entry["form"] = form
        text = "numbers beyond 90 are taken as degrees and minutes in one, 5954.321 for 59° 54.321'"
        marks.guess((*CHANNELS, "latitude"), text)
    for name, side in sides.items():
        if side is not None:
            settings[columns[name]]["hemisphere"] = sheet.column(side)
            degrees[name] = degrees[name] * side_signs(sheet.texts[side], name, letter_o)
    if letter_o is not None:
        settings[columns["longitude"]]["letter_o"] = letter_o
        marks.guess((*CHANNELS, "longitude"), why)
    read = {**sheet.numbers, **{columns[name]: values for name, values in degrees.items()}}
    used = {*columns.values(), *sides.values()}
    return (
        dataclasses.replace(
            sheet,
            numbers={name: read[name] for name in sheet.header if name in read},
            texts={name: cells for name, cells in sheet.texts.items() if name not in used},
        ),
        settings,
    )


def _letter_o(sheet: Sheet, column: str) -> tuple[LetterO | None, str]:
    """Return what O means as a hemisphere, and why; None where no longitude has it.

    Beside W it is the east, and beside E the west. Alone it is as the names of columns have it:
    the east in German and Dutch, the west in Spanish, French, Italian and Portuguese.
    """
    cells = sheet.texts.get(column)
    if cells is None:
        return None, ""
    ends = cells.dropna().astype("string").str.upper().str.extract(r"^\s*([EOW])?.*?([EOW])?\s*$")
    found = {str(letter) for end in ends for letter in ends[end].dropna().unique()}
    if "O" not in found:
        return None, ""
    if len(found) > 1:
        return ("east" if "W" in found else "west"), f"O stands beside {min(found - {'O'})}"
    german = any(_GERMANIC.search(plain(name)) for name in sheet.header)
    means: LetterO = "east" if german else "west"
    return means, f"the letter O is taken as {means}, by the language of the columns' names"


def _side(sheet: Sheet, name: str) -> str | None:
    """Return the column that holds the letters of a channel's hemispheres; None for none."""
    for column, cells in sheet.texts.items():
        letters = set(cells.dropna().astype("string").str.strip().str.upper()) - {""}
        if letters and letters <= _SIDES[name]:
            return column
    return None
