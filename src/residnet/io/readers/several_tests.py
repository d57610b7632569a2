"""Files with several tests, each of which is a log with its own path below the path of the file.

The path of a test is `book.xlsx/Test_3_Zigzag_10_10`. Commands and configs find the tests of a
file by `expand_files`; the readers of tables read them like files.
"""

from __future__ import annotations

import itertools
import re
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from residnet.core.errors import ResidnetError, UsageError
from residnet.core.log import Remark, make_remark
from residnet.core.names import suggest_name
from residnet.io.header_vocabulary import MANOEUVRE_PATTERNS, normalize_name
from residnet.io.readers.base import locate_file
from residnet.io.readers.cell_values import is_value
from residnet.io.readers.excel_cells import list_worksheets, read_cells
from residnet.io.readers.table_lines import WHITESPACE_DELIMITER, split_line
from residnet.io.readers.table_sections import (
    MIN_ROWS,
    RowKind,
    Rows,
    Section,
    are_similar,
    classify_cells,
    find_sections,
    select_tests,
)
from residnet.io.readers.text_encoding import open_as_utf8

if TYPE_CHECKING:
    import pandas as pd

_TEXT_ENDINGS = (".csv", ".tsv", ".txt", ".dat")
_MAX_TEXT_BYTES = 64_000_000
"""Largest size of a text that is searched for several tests; a larger text is one log."""
_SAMPLED_LINES = 300
"""Number of first lines from which the separator of cells is determined."""
_CLASSIFIED_LINES = 60
"""Number of lines among these, evenly spread, whose cells are counted."""
_NUMBERS_AT_START = re.compile(r"\s*[\"']?[-+]?\.?\d")
_WORD = re.compile(r"[^\W\d_]{3}")
_NUMBERS = re.compile(r"[-+]?\.?\d[\d.,;|+\-eE \t]*")
"""Line of numbers; a test of its characters is faster than that of its cells."""


class PlacedTest(NamedTuple):
    """Place of one test in a file.

    Attributes:
        name: name of the test, without characters that have a meaning in paths.
        sections: name of its sheet -> its rows and columns, of several sheets whose rows are joined
            by their times; the name is empty for a text.
        delimiter: separator of cells; empty for a sheet.
        vessel: title with its vessel if the file names several vessels; otherwise empty.
        n_short: number of sections of the file that are too short for tests.
    """

    name: str
    sections: Mapping[str, Section]
    delimiter: str
    vessel: str
    n_short: int

    @property
    def section(self) -> Section:
        """Rows and columns of a test in one sheet or text."""
        return next(iter(self.sections.values()))


def expand_files(paths: Iterable[Path]) -> list[Path]:
    """Return paths with the tests of each file that has several in its place."""
    return [test for path in paths for test in (list_tests(path) or [path])]


def list_tests(path: Path) -> list[Path]:
    """Return the paths of the tests of a file; empty if it has one test or cannot be read."""
    if path.suffix.lower() not in (*_TEXT_ENDINGS, ".xlsx") or not path.is_file():
        return []
    try:
        return [path / test.name for test in _find_tests_of(path)]
    except (ResidnetError, OSError):
        # the reader of the file says what is wrong
        return []


def find_test(path: Path) -> PlacedTest | None:
    """Return the place of a test in its file; None for a path of a file.

    Raises:
        UsageError: if the file has no test of this name.
    """
    file = locate_file(path)
    if file == path:
        return None
    tests = {test.name: test for test in _find_tests_of(file)}
    if path.name not in tests:
        raise UsageError(f"{path}: no test of this name{suggest_name(path.name, tests)}")
    return tests[path.name]


def list_vessels(tests: Iterable[Path]) -> list[str]:
    """Return the titles that name the vessels of tests if they are several; empty otherwise."""
    placed_tests = [find_test(path) for path in tests]
    vessels = [*dict.fromkeys(test.vessel for test in placed_tests if test and test.vessel)]
    return vessels if len(vessels) > 1 else []


def describe_short_sections(path: Path) -> list[Remark]:
    """Return the remark that a file has sections too short for tests; empty without them."""
    test = find_test(path)
    if test is None or not test.n_short:
        return []
    text = (
        f"starts of the recorder with fewer than {MIN_ROWS} rows are left out: {test.n_short} in"
        f" {locate_file(path).name}"
    )
    return [make_remark("note", "short_sections", text, count=float(test.n_short))]


@contextmanager
def open_test_as_utf8(path: Path, encoding: str | None = None) -> Iterator[tuple[Path, int]]:
    """Provide the text of a file, or of one of its tests, in UTF-8.

    Args:
        path: path of a file or a test.
        encoding: see `open_as_utf8`.

    Yields:
        The file with the text, and the number to add to its rows to get the rows of the file.

    Raises:
        UsageError: if the test does not exist.
        DataError: if the file is no text in this encoding.
    """
    test = find_test(path)
    with open_as_utf8(locate_file(path), encoding) as file:
        if test is None:
            yield file, 0
            return
        section = test.section
        with file.open(encoding="utf-8-sig") as stream:
            lines = stream.read().splitlines()
        indices = [*section.head_rows, *range(section.start, section.stop)]
        if section.columns is None:
            text_lines = [lines[i] for i in indices]
        else:
            columns = slice(*section.columns)
            text_lines = [
                test.delimiter.join(split_line(lines[i], test.delimiter)[columns]) for i in indices
            ]
        with tempfile.TemporaryDirectory() as folder:
            copy = Path(folder) / f"{path.name}{locate_file(path).suffix}"
            copy.write_text("\n".join([*text_lines, ""]), encoding="utf-8")
            yield copy, _row_offset(section)


def read_excel_cells(path: Path, sheet: str | None, rows: int | None) -> tuple[pd.DataFrame, int]:
    """Return the cells of a sheet, or of one test of an Excel file.

    Args:
        path: path of a file or a test.
        sheet: name of the sheet; None takes the sheet of the test, or the first one.
        rows: largest number of rows to read; None reads all.

    Returns:
        The cells, and the number to add to their rows to get the rows of the sheet.
    """
    test = find_test(path)
    if test is None:
        return read_cells(path, list_worksheets(path)[0] if sheet is None else sheet, rows), 0
    sheet = next(iter(test.sections)) if sheet is None else sheet
    section = test.sections[sheet]
    cells = read_cells(locate_file(path), sheet, None)
    row_indices = [*section.head_rows, *range(section.start, section.stop)][:rows]
    columns = slice(None) if section.columns is None else slice(*section.columns)
    selected = cells.iloc[row_indices, columns].reset_index(drop=True)
    return selected, _row_offset(section)


def _row_offset(section: Section) -> int:
    """Return the number to add to a row of an extracted test to get its row in the file."""
    return section.start - len(section.head_rows)


def _find_tests_of(file: Path) -> tuple[PlacedTest, ...]:
    stat = file.stat()
    return _find_tests_of_version(file, stat.st_mtime_ns, stat.st_size)


@lru_cache(maxsize=256)
def _find_tests_of_version(file: Path, modified_ns: int, size: int) -> tuple[PlacedTest, ...]:
    """Find the tests of a file; `modified_ns` and `size` distinguish its versions."""
    if file.suffix.lower() == ".xlsx":
        places = []
        for sheet in list_worksheets(file):
            sections = find_sections(_rows_of_cells(read_cells(file, sheet, None)))
            title = sheet if sum(section.is_long for section in sections) == 1 else ""
            places += [(title, sheet, section, "") for section in sections]
    elif size <= _MAX_TEXT_BYTES:
        with open_as_utf8(file) as text_file, text_file.open(encoding="utf-8-sig") as stream:
            lines = stream.read().splitlines()
        delimiter = _choose_delimiter(lines)
        sections = find_sections(_rows_of_lines(lines, delimiter)) if delimiter else []
        places = [("", "", section, delimiter) for section in sections]
    else:
        return ()
    similar, n_short = select_tests([section for _, _, section, _ in places])
    if not similar:
        return _join_sheets(places)
    vessels = {places[k][2].vessel for k in similar}
    names: list[str] = []
    tests = []
    for number, k in enumerate(similar, 1):
        sheet_title, sheet, section, delimiter = places[k]
        # the only test of a file has its name
        default = f"test_{number}" if len(similar) > 1 else file.stem
        vessel = section.vessel if len(vessels) > 1 else ""
        title = f"{vessel} {section.title}".strip()
        name = _name_test(sheet_title, title, default)
        name = name if name not in names else f"{name}_{number}"
        names.append(name)
        tests.append(PlacedTest(name, {sheet: section}, delimiter, vessel, n_short))
    return tuple(tests)


def _join_sheets(places: Sequence[tuple[str, str, Section, str]]) -> tuple[PlacedTest, ...]:
    """Return tests with several sheets each, as `T1 motion`, `T1 control`, `T2 motion`, ...

    The sheets of each kind have the same column names and a common word in their names. Without
    this word their names are the names of the tests, which each kind of sheets has.

    Args:
        places: title, sheet, section and delimiter of each section; a title is the name of a sheet
            with one section.
    """
    sections = {sheet: section for title, sheet, section, _ in places if title and section.is_long}
    kinds: list[list[str]] = []
    for sheet, section in sections.items():
        same_kind = [kind for kind in kinds if are_similar(sections[kind[0]].names, section.names)]
        if same_kind:
            same_kind[0].append(sheet)
        else:
            kinds.append([sheet])
    sheets_by_test: dict[str, dict[str, Section]] = {}
    for kind in kinds:
        words = [re.findall(r"[^\W_]+", sheet) for sheet in kind]
        common_words = set.intersection(*map(set, words))
        for sheet, sheet_words in zip(kind, words, strict=True):
            test = "_".join(word for word in sheet_words if word not in common_words)
            sheets_by_test.setdefault(test, {})[sheet] = sections[sheet]
    is_complete = all(len(sheets) == len(kinds) for sheets in sheets_by_test.values())
    if len(kinds) < 2 or len(sheets_by_test) < 2 or not is_complete or "" in sheets_by_test:
        return ()
    return tuple(PlacedTest(name, sheets, "", "", 0) for name, sheets in sheets_by_test.items())


def list_joined_sheets(path: Path) -> list[str]:
    """Return the names of the sheets of a test that are joined; empty for one sheet or a file."""
    test = find_test(path)
    return [*test.sections] if test is not None and len(test.sections) > 1 else []


def _name_test(sheet: str, title: str, default: str) -> str:
    """Return the name of a test from its sheet and title; `default` without both.

    The sheet names the test, and the title adds the manoeuvre that it lacks.
    """
    kinds = [
        kind
        for kind, pattern in MANOEUVRE_PATTERNS.items()
        if pattern.search(normalize_name(title)) and not pattern.search(normalize_name(sheet))
    ]
    title = re.sub(r"^(?:type|test type)\W+", "", title, flags=re.IGNORECASE)
    title = title.removeprefix(sheet).strip(" :,;-")
    text = f"{sheet} {title if kinds else ''}" if sheet else title
    # names of paths have neither separators nor points, which would begin an extension
    return re.sub(r"[^\w+-]+", "_", text).strip("_") or re.sub(r"[^\w+-]+", "_", default)


def _rows_of_cells(cells: pd.DataFrame) -> Rows:
    """Return the rows of a sheet as texts."""
    table = [
        ["" if cell is None or cell != cell else str(cell).strip() for cell in row]
        for row in cells.itertuples(index=False)
    ]
    return Rows([classify_cells(row) for row in table], table.__getitem__)


def _rows_of_lines(lines: Sequence[str], delimiter: str) -> Rows:
    """Return the rows of a text, which are split into cells when they are needed."""

    def classify(i: int) -> RowKind:
        line = lines[i]
        is_number_first = _NUMBERS_AT_START.match(line) and delimiter in line
        if is_number_first and not _WORD.search(line):
            return "values"
        return "text" if line.lstrip()[:1] in ("#", "%") else classify_cells(split(i))

    def split(i: int) -> Sequence[str]:
        line = lines[i]
        if '"' in line or delimiter == WHITESPACE_DELIMITER:
            return split_line(line, delimiter)
        cells = line.split(delimiter)
        return [cell.strip() for cell in cells] if " " in line or "\t" in line else cells

    # most lines are numbers only
    kinds: list[RowKind] = [
        "values" if _NUMBERS.fullmatch(line) and delimiter in line else classify(i)
        for i, line in enumerate(lines)
    ]
    return Rows(kinds, split)


def _choose_delimiter(lines: Sequence[str]) -> str:
    """Return the separator with most rows of values; empty if there are no such rows."""
    filled_lines = (line for line in lines if line.strip())
    sample = [*itertools.islice(filled_lines, _SAMPLED_LINES)]
    sample = sample[:: max(len(sample) // _CLASSIFIED_LINES, 1)]

    def count_values(delimiter: str) -> int:
        is_whitespace = delimiter == WHITESPACE_DELIMITER
        # a line without the separator is one cell
        rows = [
            split_line(line, delimiter) for line in sample if is_whitespace or delimiter in line
        ]
        return sum(len(cells) > 1 and 2 * sum(map(is_value, cells)) > len(cells) for cells in rows)

    counts = {delimiter: count_values(delimiter) for delimiter in (";", "\t", "|", ",")}
    best = max(counts, key=lambda delimiter: counts[delimiter])
    if not counts[best]:
        best = WHITESPACE_DELIMITER
        return best if count_values(best) else ""
    return best
