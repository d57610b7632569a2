"""Building blocks of a report page: sections with text, tables, figures and code.

The same objects serve the page (`residnet.report.page.write_page`) and the terminal
(`Table.text`).
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import accumulate
from typing import Any, ClassVar, Literal, Protocol, TypeAlias, TypeVar

from residnet.core.format import DASH, format_fixed, format_signed

CellMark: TypeAlias = Literal["", "bad", "best", "weak", "text"]


_PAGE_WIDTH = 700.0
"""Text width of an A4 page in pixels."""
_LETTER_WIDTH = 5.8
"""Width of a bold letter in a table in pixels."""
_CELL_PADDING = 6.0
"""Padding of a cell in pixels."""


_MIN_WIDE_COLUMNS = 6
"""Number of columns from which a table needs the full width of a page: half of a page is 34 rem,
and a column 5 to 6 rem wide.
"""


class Block(Protocol):
    """A part of a section, drawn by the template macro whose name is its `kind`."""

    kind: ClassVar[str]


@dataclass(frozen=True)
class Text:
    """Paragraphs of plain text.

    Attributes:
        paragraphs: a single paragraph or several.
        is_secondary: whether the text is grey, for explanations that most readers skip.
    """

    kind: ClassVar[str] = "text"
    paragraphs: str | Sequence[str]
    is_secondary: bool = False

    @property
    def nonempty_paragraphs(self) -> list[str]:
        """Return the paragraphs of the text as a list, without empty ones."""
        paragraphs = [self.paragraphs] if isinstance(self.paragraphs, str) else self.paragraphs
        return [paragraph for paragraph in paragraphs if paragraph]


@dataclass(frozen=True)
class Bullets:
    """A list of short texts.

    Attributes:
        items: texts of the entries.
        is_warning: whether the list is highlighted, for facts that a reader must know before using
            a result.
    """

    kind: ClassVar[str] = "bullets"
    items: Sequence[str]
    is_warning: bool = False


@dataclass(frozen=True)
class Facts:
    """Names with a description of each.

    Attributes:
        pairs: (name, text); the text of a check may be marked as failed by `failed`.
        failed: names that are highlighted by colour.
        is_code: whether names and texts are printed as code (file names and checksums).
    """

    kind: ClassVar[str] = "facts"
    pairs: Sequence[tuple[str, str]]
    failed: Sequence[str] = ()
    is_code: bool = False


@dataclass(frozen=True)
class Code:
    """Verbatim text in a fixed-width font.

    Attributes:
        text: the text with its line breaks.
        wraps_lines: whether long lines break at spaces instead of scrolling sideways.
    """

    kind: ClassVar[str] = "code"
    text: str
    wraps_lines: bool = False


@dataclass(frozen=True)
class Cell:
    """One cell of a table.

    Attributes:
        text: a formatted number or a few words.
        note: small text below the cell.
        mark: `bad`, `best` or `weak` colour the cell; `text` aligns it to the left and lets it
            wrap.
        si: the number in SI units, shown as a tooltip if the cell uses another unit.
    """

    text: str
    note: str = ""
    mark: CellMark = ""
    si: str = ""


@dataclass(frozen=True)
class Row:
    """One line of a table.

    Attributes:
        label: text of the first cell.
        cells: the other cells, in the order of the columns.
        has_rule: whether a line is drawn above the row, at the start of a group of rows.
        is_selected: whether the row is highlighted as the selected one.
    """

    label: str
    cells: Sequence[Cell]
    has_rule: bool = False
    is_selected: bool = False


class Table:
    """A table with a header, labelled rows and an optional second header line of groups."""

    kind: ClassVar[str] = "table"

    def __init__(
        self, columns: Sequence[str], caption: str = "", groups: Sequence[tuple[str, int]] = ()
    ) -> None:
        """Create a table without rows.

        Args:
            columns: titles with units, the first above the row labels.
            caption: a sentence above the table.
            groups: titles that span several columns after the first, and the number of columns of
                each.
        """
        self.columns = list(columns)
        self.caption = caption
        self.groups = list(groups)
        n_ungrouped = len(self.columns) - 1 - sum(count for _, count in self.groups)
        if self.groups and n_ungrouped:
            # the line of groups is as long as that of columns
            self.groups.append(("", n_ungrouped))
        self.rows: list[Row] = []

    def add_row(
        self,
        label: str,
        cells: Iterable[Cell | str],
        *,
        has_rule: bool = False,
        is_selected: bool = False,
    ) -> None:
        """Add a row; plain strings become cells."""
        row_cells = [cell if isinstance(cell, Cell) else Cell(cell) for cell in cells]
        if len(row_cells) != len(self.columns) - 1:
            raise ValueError(
                f"row '{label}': {len(row_cells)} cells for {len(self.columns) - 1} columns"
            )
        self.rows.append(Row(label, row_cells, has_rule, is_selected))

    @property
    def text_columns(self) -> list[bool]:
        """Whether each column contains words, which are aligned to the left, instead of numbers."""
        marks = zip(*([cell.mark for cell in row.cells] for row in self.rows), strict=True)
        is_text = [all(mark == "text" for mark in column) for column in marks]
        return [True, *(is_text or [False] * (len(self.columns) - 1))]

    def select_columns(self, first_column: int, last_column: int) -> Table:
        """Return a table with the data columns `first_column` to `last_column` (exclusive)."""
        groups = []
        column = 0
        for title, count in self.groups:
            n_overlap = min(column + count, last_column) - max(column, first_column)
            column += count
            groups += [(title, n_overlap)] if n_overlap > 0 else []
        selection = Table(
            [self.columns[0], *self.columns[1 + first_column : 1 + last_column]], "", groups
        )
        selection.rows = [
            replace(row, cells=row.cells[first_column:last_column]) for row in self.rows
        ]
        return selection

    @property
    def split_to_width(self) -> list[Table]:
        """Split the table into tables that each fit the text width of an A4 page.

        Each table repeats the row labels. The columns of a group are kept in one table if they fit.
        """
        lines = [self.columns]
        lines += [[row.label, *(f"{c.text} {c.note}" for c in row.cells)] for row in self.rows]
        # names break after underscores and slashes
        cell_words = [re.split(r"[\s_/]", " ".join(column)) for column in zip(*lines, strict=True)]
        widths = [_CELL_PADDING + _LETTER_WIDTH * max(map(len, column)) for column in cell_words]
        break_columns = [*accumulate(count for _, count in self.groups)] or [
            *range(1, len(self.columns))
        ]
        column_ranges = [[0, 0]]
        previous_end = 0
        for end in break_columns:
            first_column = column_ranges[-1][0]
            if (
                first_column < previous_end
                and widths[0] + sum(widths[1 + first_column : 1 + end]) > _PAGE_WIDTH
            ):
                column_ranges.append([previous_end, previous_end])
            column_ranges[-1][1] = previous_end = end
        if len(column_ranges) < 2:
            return [self]
        tables: list[Table] = []
        for first_column, last_column in column_ranges:
            table = self.select_columns(first_column, last_column)
            table.caption = "" if tables else self.caption
            tables.append(table)
        return tables

    def to_text(self) -> str:
        """Return the table for a terminal: columns aligned, notes in brackets, groups above."""
        lines = [self.columns]
        lines += [[row.label, *(_cell_text(cell) for cell in row.cells)] for row in self.rows]
        widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
        group_titles = [" " * widths[0]]
        start = 1
        for title, count in self.groups:
            # the width of a group is that of its columns and the gaps between them
            width = sum(widths[start : start + count]) + 2 * (count - 1)
            widths[start] += max(len(title) - width, 0)
            group_titles.append(f"{title:^{width}}")
            start += count
        text_lines = [self.caption] if self.caption else []
        text_lines += ["  ".join(group_titles)] if self.groups else []
        text_lines += [
            "  ".join(
                f"{text:<{width}}" if is_left else f"{text:>{width}}"
                for text, width, is_left in zip(line, widths, self.text_columns, strict=True)
            )
            for line in lines
        ]
        return "\n".join(line.rstrip() for line in text_lines)


RowT = TypeVar("RowT")
ColumnValue: TypeAlias = Callable[[RowT], object] | str
"""The value of a row in a column: a function of the row, or a key of a row that is a mapping (dots
separate nested keys).
"""
ColumnFormat: TypeAlias = int | Callable[[Any], str | Cell]
"""The format of a value: a number of decimals, or a function that maps the value to text.

The argument is Any, because the type of a value that a key selects is not known statically.
"""
Column: TypeAlias = (
    tuple[str, ColumnValue[RowT]]
    | tuple[str, ColumnValue[RowT], ColumnFormat]
    | tuple[str, ColumnValue[RowT], ColumnFormat, float]
)
"""A table column: title, value, format and factor; format and factor are optional.

Without a format a `Cell` is used unchanged and any other value is converted to text.
"""


def build_table(
    rows: Iterable[RowT],
    columns: Sequence[Column[RowT]],
    *,
    groups: Sequence[tuple[str, int]] = (),
    caption: str = "",
    is_selected: Callable[[RowT], bool] = lambda row: False,
    group_key: Callable[[RowT], object] | None = None,
) -> Table:
    """Build a table with one line for each element of `rows`.

    Args:
        rows: mappings or records, or any objects that the functions of the columns accept.
        columns: the first column holds the row labels.
        groups: titles that span several columns, see `Table`.
        caption: a sentence above the table.
        is_selected: predicate that highlights a row.
        group_key: a rule is drawn above each row whose key differs from the previous row's key.

    Example:
        build_table(rows, [("model", "model"), ("time [s]", "time.mean", 2), ("rms", "rms", 1,
        DEG)])
    """
    table = Table([column[0] for column in columns], groups=groups, caption=caption)
    previous_group: object = None
    for row in rows:
        label, *cells = [_build_cell(row, *column[1:]) for column in columns]
        group = group_key(row) if group_key else None
        table.add_row(
            label.text, cells, has_rule=group != previous_group, is_selected=is_selected(row)
        )
        previous_group = group
    return table


def _build_cell(
    row: RowT,
    key: ColumnValue[RowT],
    formatter: ColumnFormat | None = None,
    factor: float = 1.0,
) -> Cell:
    value: Any = _get_nested(row, key) if isinstance(key, str) else key(row)
    if formatter is None:
        return value if isinstance(value, Cell) else Cell(str(value), mark="text")
    if value is not None and factor != 1.0:
        value = factor * value
    formatted = format_fixed(value, formatter) if isinstance(formatter, int) else formatter(value)
    return formatted if isinstance(formatted, Cell) else Cell(formatted)


def _get_nested(row: object, keys: str) -> object:
    """Return a key of a mapping or an attribute of a record; None if a part of the path is None."""
    value = row
    for key in keys.split("."):
        if value is None:
            return None
        value = value.get(key) if isinstance(value, Mapping) else getattr(value, key)
    return value


def format_paired_interval(bounds: Sequence[float] | None, absent_text: str = DASH) -> Cell:
    """Return the cell of the interval of a difference, highlighted if it excludes zero."""
    if not bounds:
        return Cell(absent_text)
    text = " to ".join(map(format_signed, bounds))
    return Cell(text, mark="best" if bounds[0] > 0 or bounds[1] < 0 else "")


def flag_cell(text: object, is_flagged: object) -> Cell:
    """Return a cell that is highlighted as bad if `is_flagged`."""
    return Cell(str(text), mark="bad" if is_flagged else "")


def _cell_text(cell: Cell) -> str:
    text = f"{cell.text} ({cell.note})" if cell.note else cell.text
    return f"{text} !" if cell.mark == "bad" else text


@dataclass(frozen=True)
class Section:
    """A titled part of a page, which may contain nested sections.

    Attributes:
        title: a few words; empty for the content of the first screen.
        blocks: content from top to bottom.
        is_folded: whether the section is collapsed initially.
    """

    kind: ClassVar[str] = "section"
    title: str
    blocks: Sequence[Block | None] = field(default_factory=tuple)
    is_folded: bool = False

    @property
    def present_blocks(self) -> list[Block]:
        """Return the blocks that are not None; None stands for a part that a run does not have."""
        return [block for block in self.blocks if block is not None]

    @property
    def is_facts(self) -> bool:
        """Return whether the section has a list of facts only, in the full width of the page."""
        blocks = self.present_blocks
        return len(blocks) == 1 and isinstance(blocks[0], Facts)

    @property
    def is_side_by_side(self) -> bool:
        """Return whether the blocks are laid out in two columns."""
        tables = [block for block in self.present_blocks if isinstance(block, Table)]
        return len(self.present_blocks) > 1 and all(
            len(table.columns) < _MIN_WIDE_COLUMNS for table in tables
        )
