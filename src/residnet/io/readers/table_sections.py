"""Sections of a sheet or a text: the rows of each of several tests in one table.

Tests follow each other below a title, below the column names, behind blank rows, or where the time
restarts; or they are side by side with the same column names.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Literal, NamedTuple

import numpy as np

from residnet.io.header_vocabulary import (
    DATE_PART_NAMES,
    MANOEUVRE_PATTERNS,
    TEST_NAME_PATTERN,
    VESSEL_COLUMN_NAMES,
    VESSEL_TITLE_PATTERN,
    normalize_name,
    parse_name,
)
from residnet.io.readers.cell_values import is_value

RowKind = Literal["blank", "values", "text"]
MIN_ROWS = 10
"""Fewest rows of a test below a title, below column names, or behind a blank row."""
_MIN_ROWS_AT_RESTART = 20
"""Fewest rows before and behind a restart of the time that nothing else marks."""
_MAX_RESTART_SHARE = 0.02
"""Largest distance of a restarted time from the first one, as share of the duration."""
_WRAP_LENGTHS = (2.0**16, 2.0**24, 2.0**32, 43_200.0, 86_400.0, 604_800.0)
"""Range of counters, and of times of the day and of the week in s."""
_WRAP_UNITS = (1e-6, 1e-3, 1.0, 1e3)
"""Factors from these ranges to the times of a file, such as 1e-6 for a counter of microseconds in s
and 1e3 for times of the day in ms."""
_MAX_WRAP_STEPS = 5.0
"""Largest step in median steps at the overflow of a counter."""
_MIN_SIDE_COLUMNS = 3
"""Fewest columns of a table to the right of another one."""
_MIN_COMMON_NAMES = 0.6
"""Smallest share of common column names (Jaccard index) of tests with the same layout."""
_MAX_TITLE_LENGTH = 60
"""Length to which titles are truncated, since a title becomes part of the name of a log."""
_COMMENT_SIGNS = ("#", "%", "//")
_CLOCK_TIME = re.compile(r"(\d{1,2}):(\d\d):(\d\d(?:[.,]\d+)?)")


class Section(NamedTuple):
    """Rows of one test.

    Attributes:
        head_rows: indices of the rows with titles, column names and units.
        start: index of the first row of values.
        stop: index behind the last row of values.
        columns: index of the first column, and behind the last one; None for all columns.
        title: text that names the test; empty if there is none.
        vessel: text that names the vessel; empty if there is none.
        names: cells of the column names and units.
    """

    head_rows: tuple[int, ...]
    start: int
    stop: int
    columns: tuple[int, int] | None
    title: str
    vessel: str
    names: frozenset[str]

    @property
    def is_long(self) -> bool:
        """Whether the section has enough rows for a test."""
        return self.stop - self.start >= MIN_ROWS


class Rows(NamedTuple):
    """Rows of a sheet or of a text.

    Attributes:
        kinds: kind of each row.
        split: index of a row -> its cells without surrounding blanks.
    """

    kinds: Sequence[RowKind]
    split: Callable[[int], Sequence[str]]


def classify_cells(cells: Sequence[str]) -> RowKind:
    """Return the kind of a row: values are at least two cells and half of the filled ones."""
    filled = [cell for cell in cells if cell]
    if not filled:
        return "blank"
    n_values = sum(map(is_value, filled))
    return "values" if n_values >= 2 and 2 * n_values >= len(filled) else "text"


def find_sections(rows: Rows) -> list[Section]:
    """Return the tests of a sheet or a text in order; one section if it has one test.

    Sections of fewer than `MIN_ROWS` rows are no tests but, for example, failed starts of the
    recorder.
    """
    if "values" not in rows.kinds:
        return []
    for i in range(rows.kinds.index("values") - 1, -1, -1):
        tables = _split_columns(rows.split(i))
        if tables:
            return [section for columns in tables for section in _find_in_columns(rows, columns)]
    return _find_stacked(rows)


def _split_columns(names: Sequence[str]) -> list[tuple[int, int]]:
    """Return the columns of tables side by side, which have equal names and a time each."""
    filled = [(i, name) for i, name in enumerate(names) if name]
    if len(filled) < 2 * _MIN_SIDE_COLUMNS:
        return []
    starts = [i for i, name in filled if name == filled[0][1]]
    if len(starts) < 2 or starts[1] - starts[0] < _MIN_SIDE_COLUMNS:
        return []
    limits = [*starts, max(len(names), starts[-1] + starts[1] - starts[0])]
    tables = list(pairwise(limits))
    names_of_tables = [tuple(name for name in names[a:b] if name) for a, b in tables]
    has_time = any(parse_name(name).has_all("time") for name in names_of_tables[0])
    return tables if len({*names_of_tables}) == 1 and has_time else []


def _find_in_columns(rows: Rows, columns: tuple[int, int]) -> list[Section]:
    """Return the tests in some columns of a sheet or a text."""
    table = [rows.split(i)[slice(*columns)] for i in range(len(rows.kinds))]
    part = Rows([classify_cells(cells) for cells in table], table.__getitem__)
    return [section._replace(columns=columns) for section in _find_stacked(part)]


class _Head(NamedTuple):
    """Text rows above values.

    Attributes:
        rows: indices of all text rows.
        names_row: index of the row of column names; None without one.
        title: text that names the test; empty if there is none.
        vessel: text that names the vessel; empty if there is none.
        names: cells of the column names and units.
    """

    rows: tuple[int, ...]
    names_row: int | None
    title: str
    vessel: str
    names: frozenset[str]


def _parse_head(rows: Rows, text_rows: Sequence[int], n_columns: int) -> _Head:
    """Split text rows into titles and column names.

    Args:
        rows: rows of the sheet or text.
        text_rows: indices of the text rows above values.
        n_columns: number of filled cells in the first row of values.
    """
    cells_of_rows = {i: [cell for cell in rows.split(i) if cell] for i in text_rows}
    names_row = next(
        (i for i in text_rows if len(cells_of_rows[i]) >= max(2.0, 0.6 * n_columns)), None
    )
    titles = [" ".join(cells_of_rows[i]) for i in text_rows if names_row is None or i < names_row]
    named_titles = [title for title in titles if _names_test(title)]
    title = named_titles[-1] if named_titles else ""
    vessels = [title for title in titles if VESSEL_TITLE_PATTERN.match(normalize_name(title))]
    vessel = vessels[-1] if vessels else ""
    names = [
        cell for i in text_rows if names_row is not None and i >= names_row
        for cell in cells_of_rows[i]
    ]  # fmt: skip
    return _Head(
        tuple(text_rows),
        names_row,
        title[:_MAX_TITLE_LENGTH],
        vessel[:_MAX_TITLE_LENGTH],
        frozenset(names),
    )


def _names_test(title: str) -> bool:
    """Return whether a text has a word for a test or the name of a manoeuvre."""
    text = normalize_name(title)
    return bool(TEST_NAME_PATTERN.search(text)) or any(
        pattern.search(text) for pattern in MANOEUVRE_PATTERNS.values()
    )


def _find_stacked(rows: Rows) -> list[Section]:
    """Return the tests of a table, one below the other."""
    kinds = rows.kinds
    value_rows = np.flatnonzero([kind == "values" for kind in kinds])
    if not value_rows.size:
        return []
    breaks = np.flatnonzero(np.diff(value_rows) > 1) + 1
    sections: list[Section] = []
    head = _Head((), None, "", "", frozenset())
    vessel = ""
    previous_stop = 0
    clock: _Clock | None = None
    for run in np.split(value_rows, breaks):
        start = int(run[0])
        stop = int(run[-1]) + 1
        text_rows = [i for i in range(previous_stop, start) if kinds[i] == "text"]
        gap = _parse_head(rows, text_rows, sum(map(bool, rows.split(start))))
        previous_stop = stop
        has_names = gap.names_row is not None
        if clock is None or (has_names and gap.names != head.names):
            clock = _Clock.from_names(rows, gap if has_names else head)
        times = clock.parse(rows, start, stop)
        if sections:
            step = float(times[-1] - times[0]) / max(1, len(run) - 1)
            # a recorder that fails at its start writes its column names and the first time again
            is_same = not sections[-1].is_long and bool(times[0] == clock.last)
            # in a table in reverse order of time all times are earlier than the previous one
            is_earlier = bool(times[0] < clock.last) or (has_names and is_same)
            is_earlier &= step > 0.0 or (has_names and len(run) == 1)
            # a counter does not overflow within a few rows
            is_overflow = _is_overflow(clock.last, float(times[0]), step)
            is_earlier &= not (sections[-1].is_long and is_overflow)
            is_new = is_earlier or (has_names and gap.names != sections[-1].names)
            # the mark of an operator in a comment is no title
            is_new |= bool(gap.title) and not gap.title.startswith(_COMMENT_SIGNS)
            # other titles with a word for a vessel are remarks
            is_new |= bool(vessel and gap.vessel) and gap.vessel != vessel
            is_restart = is_earlier and has_names
            if not is_new or (len(run) < MIN_ROWS and not is_restart):
                # marks, comments and repeated names within a test
                sections[-1] = sections[-1]._replace(stop=stop)
                clock.last = clock.latest(times)
                continue
        head_rows = gap.rows if has_names else (*head.rows, *gap.rows)
        head = gap if has_names else head
        vessel = gap.vessel or vessel
        for first, last, label in clock.split(rows, start, stop, times):
            title = gap.title or label
            sections.append(Section(head_rows, first, last, None, title, vessel, head.names))
        clock.last = clock.latest(times)
    return sections


class _Clock:
    """Columns that show where a test begins: the time, and the number or name of the test.

    Attributes:
        last: last time of the current test; NaN if it is unknown.
    """

    def __init__(self, time_column: int | None, test_column: int | None, test_name: str) -> None:
        self.last = float("nan")
        self._time_column = time_column
        self._test_column = test_column
        self._test_name = test_name

    @classmethod
    def from_names(cls, rows: Rows, head: _Head) -> _Clock:
        """Choose the columns by their names; tables of several vessels have no such columns."""
        names = [] if head.names_row is None else list(rows.split(head.names_row))
        normalized = [normalize_name(name) for name in names]
        if {*normalized} & {*VESSEL_COLUMN_NAMES, *DATE_PART_NAMES}:
            return cls(None, None, "")
        time_column = next(
            (i for i, name in enumerate(names) if parse_name(name).has_all("time")), None
        )
        test_column = next(
            (i for i, name in enumerate(normalized) if TEST_NAME_PATTERN.fullmatch(name)), None
        )
        return cls(time_column, test_column, "" if test_column is None else names[test_column])

    @staticmethod
    def latest(times: np.ndarray) -> float:
        """Return the last known time of some rows [T]."""
        known = times[np.isfinite(times)]
        return float(known[-1]) if known.size else float("nan")

    def parse(self, rows: Rows, start: int, stop: int) -> np.ndarray:
        """Return the times [T] of rows in the unit of their column, NaN where unknown."""
        if self._time_column is None:
            return np.full(stop - start, np.nan)
        column = self._time_column
        cells = [rows.split(i)[column : column + 1] for i in range(start, stop)]
        try:
            return np.array([float(cell) for (cell,) in cells])
        except ValueError:
            return np.array([_parse_time(cell[0] if cell else "") for cell in cells])

    def split(
        self, rows: Rows, start: int, stop: int, times: np.ndarray
    ) -> list[tuple[int, int, str]]:
        """Split consecutive rows where the time restarts, or where the number of the test changes.

        Returns:
            First row, row behind the last one, and title of each test.
        """
        labels = [""] * (stop - start)
        if self._test_column is not None:
            column = self._test_column
            labels = [[*rows.split(i), *[""] * (column + 1)][column] for i in range(start, stop)]
        limits = [0, *_find_restarts(times), len(labels)]
        changes = [k for k in range(1, len(labels)) if labels[k] != labels[k - 1]]
        tests = [0, *changes, len(labels)]
        # a number that changes more often than every 20 rows is no number of a test
        if changes and min(b - a for a, b in pairwise(tests)) >= _MIN_ROWS_AT_RESTART:
            limits = sorted({*limits, *tests})
        has_labels = len({labels[a] for a in limits[:-1]}) == len(limits) - 1 > 1
        return [
            (start + a, start + b, f"{self._test_name} {labels[a]}" if has_labels else "")
            for a, b in pairwise(limits)
        ]


def _parse_time(cell: str) -> float:
    """Return a time in the unit of its column, or in s for a time of day; NaN otherwise."""
    try:
        return float(cell.replace(",", "."))
    except ValueError:
        match = _CLOCK_TIME.fullmatch(cell)
    if match is None:
        return float("nan")
    return 3600.0 * int(match[1]) + 60.0 * int(match[2]) + float(match[3].replace(",", "."))


def _find_restarts(times: np.ndarray) -> list[int]:
    """Return the rows [T] at which the time restarts near its first value.

    Corrections of the clock, overflows of counters, and tables in reverse order are no restarts.
    """
    restarts: list[int] = []
    steps = np.diff(times)
    positive_steps = steps[steps > 0.0]
    if not positive_steps.size or not np.isfinite(times).all():
        return []
    median_step = float(np.median(positive_steps))
    start = 0
    for k in np.flatnonzero(steps < 0.0) + 1:
        duration = times[k - 1] - times[start]
        is_wrap = _is_overflow(float(times[k - 1]), float(times[k]), median_step)
        tolerance = max(2.0 * median_step, _MAX_RESTART_SHARE * duration)
        is_near_start = min(abs(times[k] - times[start]), abs(times[k])) <= tolerance
        if is_near_start and not is_wrap and k - start >= _MIN_ROWS_AT_RESTART:
            restarts.append(int(k))
            start = int(k)
    if restarts and len(times) - restarts[-1] < _MIN_ROWS_AT_RESTART:
        restarts.pop()
    return restarts


def _is_overflow(before: float, after: float, step: float) -> bool:
    """Return whether a time that decreases is a counter or a time of the day that overflows."""
    return any(
        abs(before + step - after - length * unit) < _MAX_WRAP_STEPS * step
        for length in _WRAP_LENGTHS
        for unit in _WRAP_UNITS
    )


def select_tests(sections: Sequence[Section]) -> tuple[list[int], int]:
    """Select the tests among sections: those with the most frequent column names.

    Returns:
        The indices of the tests, and the number of shorter sections with the same names. There is
        no test if another group of similar sections is equally large, because its sections may be
        parts of the same tests, or if the only section is the whole table.
    """
    long = [k for k, section in enumerate(sections) if section.is_long]
    groups = [[k for k in long if are_similar(sections[i].names, sections[k].names)] for i in long]
    largest = max(groups, key=len, default=[])
    n_others = max((len(group) for group in groups if not {*group} & {*largest}), default=0)
    if len(largest) <= n_others:
        return [], 0
    names = sections[largest[0]].names
    n_short = sum(not section.is_long and are_similar(section.names, names) for section in sections)
    return (largest, n_short) if len(largest) > 1 or n_short else ([], 0)


def are_similar(first: frozenset[str], second: frozenset[str]) -> bool:
    """Return whether two tables have most column names in common."""
    return len(first & second) >= _MIN_COMMON_NAMES * len(first | second) > 0
