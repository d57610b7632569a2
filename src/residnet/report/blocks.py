"""What a report page is made of: sections of text, tables, figures and code.

The same objects serve the page (`residnet.report.page.write_page`) and the terminal
(`Table.text`).
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import accumulate
from typing import Any, ClassVar, Literal, Protocol, TypeAlias

from residnet.report.format import fixed

Mark: TypeAlias = Literal["", "bad", "best", "weak", "text"]


_SHEET, _LETTER, _PADDING = 700.0, 5.8, 6.0
"""Pixels of a sheet of A4 between its margins, of a bold letter of a table, and beside a cell."""


class Block(Protocol):
    """A part of a section, drawn by the template macro that bears its `kind`."""

    kind: ClassVar[str]


@dataclass(frozen=True)
class Text:
    """Paragraphs of plain text.

    Attributes:
        paragraphs: one string or several.
        quiet: printed in grey, for explanations that most readers skip.
    """

    kind: ClassVar[str] = "text"
    paragraphs: str | Sequence[str]
    quiet: bool = False

    @property
    def lines(self) -> list[str]:
        """Return the paragraphs that are not empty."""
        given = [self.paragraphs] if isinstance(self.paragraphs, str) else self.paragraphs
        return [paragraph for paragraph in given if paragraph]


@dataclass(frozen=True)
class Bullets:
    """A list of short texts.

    Attributes:
        items: one string for each entry.
        warning: set off by colour, for what a reader must know before using a result.
    """

    kind: ClassVar[str] = "bullets"
    items: Sequence[str]
    warning: bool = False


@dataclass(frozen=True)
class Facts:
    """Names with a description of each.

    Attributes:
        pairs: (name, text); the text of a check may be marked as failed by `failed`.
        failed: names that are set off by colour.
        code: names and texts are printed as code (file names and checksums).
    """

    kind: ClassVar[str] = "facts"
    pairs: Sequence[tuple[str, str]]
    failed: Sequence[str] = ()
    code: bool = False


@dataclass(frozen=True)
class Code:
    """Text in a fixed-width font, exactly as it stands.

    Attributes:
        text: with its line breaks.
        wrap: long lines break at spaces instead of scrolling sideways.
    """

    kind: ClassVar[str] = "code"
    text: str
    wrap: bool = False


@dataclass(frozen=True)
class Cell:
    """One cell of a table.

    Attributes:
        text: a formatted number or a few words.
        note: small print below it.
        mark: `bad`, `best` or `weak` set it off; `text` is aligned to the left and may wrap.
    """

    text: str
    note: str = ""
    mark: Mark = ""


@dataclass(frozen=True)
class Row:
    """One line of a table.

    Attributes:
        label: its first cell.
        cells: the others, in the order of the columns.
        rule: a line is drawn above it, where a group of rows begins.
        selected: it is set off as the one that was chosen.
    """

    label: str
    cells: Sequence[Cell]
    rule: bool = False
    selected: bool = False


class Table:
    """A table with a header, labelled rows and an optional second header line of groups."""

    kind: ClassVar[str] = "table"

    def __init__(
        self,
        columns: Sequence[str],
        rows: Iterable[Row | Sequence[Cell | str]] = (),
        caption: str = "",
        groups: Sequence[tuple[str, int]] = (),
    ) -> None:
        """Make a table; more rows can be added with `add`.

        Args:
            columns: titles with units, the first above the row labels.
            rows: each a `Row`, or its label and cells in one sequence.
            caption: a sentence above the table.
            groups: titles that span several columns after the first, with how many they span.
        """
        self.columns = list(columns)
        self.caption = caption
        self.groups = list(groups)
        spanned = sum(count for _, count in self.groups)
        if self.groups and spanned < len(self.columns) - 1:
            # the line of groups is as long as that of columns
            self.groups.append(("", len(self.columns) - 1 - spanned))
        self.rows: list[Row] = []
        for row in rows:
            if isinstance(row, Row):
                self.rows.append(row)
            else:
                label, *cells = row
                self.add(label.text if isinstance(label, Cell) else label, cells)

    def add(
        self,
        label: str,
        cells: Iterable[Cell | str],
        *,
        rule: bool = False,
        selected: bool = False,
    ) -> None:
        """Add a row; plain strings become cells."""
        made = [cell if isinstance(cell, Cell) else Cell(cell) for cell in cells]
        if len(made) != len(self.columns) - 1:
            raise ValueError(
                f"row '{label}': {len(made)} cells for {len(self.columns) - 1} columns"
            )
        self.rows.append(Row(label, made, rule, selected))

    @property
    def aligned_left(self) -> list[bool]:
        """Return for each column whether it holds words rather than numbers."""
        left = [True]
        for column in range(len(self.columns) - 1):
            marks = [row.cells[column].mark for row in self.rows]
            left.append(bool(marks) and all(mark == "text" for mark in marks))
        return left

    @property
    def pieces(self) -> list[Table]:
        """Return the table in pieces that each fit a sheet of A4, itself where it fits whole.

        Each piece has the labels of the rows; columns of one group stay together where they fit.
        """
        widths = [_narrowest(texts) for texts in self._texts()]
        spans = [count for _, count in self.groups] or [1] * (len(self.columns) - 1)
        stretches: list[list[int]] = [[0, 0]]
        for start, count in zip(accumulate([0, *spans]), spans, strict=False):
            first = stretches[-1][0]
            if first < start and sum(widths[1 + first : 1 + start + count]) + widths[0] > _SHEET:
                stretches.append([start, start])
            stretches[-1][1] = start + count
        if len(stretches) == 1:
            return [self]
        return [self._piece(first, last) for first, last in stretches]

    def _texts(self) -> list[list[str]]:
        """Return for each column all texts in it, its title first."""
        found = [[self.columns[0], *(row.label for row in self.rows)]]
        for column, title in enumerate(self.columns[1:]):
            cells = [row.cells[column] for row in self.rows]
            found.append([title, *(cell.text for cell in cells), *(cell.note for cell in cells)])
        return found

    def _piece(self, first: int, last: int) -> Table:
        """Return the columns from one to before another, the labels' column aside."""
        groups, at = [], 0
        for title, count in self.groups:
            groups += [(title, count)] if first <= at < last else []
            at += count
        rows = [Row(row.label, row.cells[first:last], row.rule, row.selected) for row in self.rows]
        caption = "" if first else self.caption
        columns = [self.columns[0], *self.columns[1 + first : 1 + last]]
        return Table(columns, rows, caption, groups)

    def text(self) -> str:
        """Return the table for a terminal: columns aligned, notes in brackets, groups above."""
        lines = [self.columns]
        lines += [[row.label, *(_plain(cell) for cell in row.cells)] for row in self.rows]
        widths = [max(len(line[k]) for line in lines) for k in range(len(self.columns))]
        start = 1
        spans: list[tuple[str, int]] = []
        for title, count in self.groups:
            # a group is as wide as its columns and the gaps between them
            wanted = len(title) - (sum(widths[start : start + count]) + 2 * (count - 1))
            widths[start] += max(wanted, 0)
            spans.append((title, sum(widths[start : start + count]) + 2 * (count - 1)))
            start += count
        left = self.aligned_left
        out = [self.caption] if self.caption else []
        if spans:
            out.append(
                "  ".join([" " * widths[0], *(f"{title:^{width}}" for title, width in spans)])
            )
        for line in lines:
            parts = [
                f"{text:<{width}}" if to_left else f"{text:>{width}}"
                for text, width, to_left in zip(line, widths, left, strict=True)
            ]
            out.append("  ".join(parts))
        return "\n".join(line.rstrip() for line in out)


Column: TypeAlias = tuple[Any, ...]
"""Of a table: its title, what it shows of a row, how, and a factor; all but the first two may lack.

What it shows is a key, with dots for keys inside, or a function of the row. It is shown by so many
decimals (an int) or by a function of the value that returns text; without either, a cell stands as
it is, and anything else is written as words.
"""


def table_of(
    rows: Iterable[Any],
    columns: Sequence[Column],
    *,
    groups: Sequence[tuple[str, int]] = (),
    caption: str = "",
    selected: Callable[[Any], bool] = lambda row: False,
    rule: Callable[[Any], Any] | None = None,
) -> Table:
    """Return a table with a row for each of the given ones.

    Args:
        rows: mappings, or anything that the columns' functions take.
        columns: the first is that of the labels.
        groups: titles that span several columns, see `Table`.
        caption: a sentence above the table.
        selected: whether a row is set off as the one that was chosen.
        rule: a line is drawn above a row for which this is another than for the row before.

    Example:
        table_of(rows, [("model", "model"), ("time [s]", "time.mean", 2), ("rms", "rms", 1, DEG)])
    """
    table = Table([title for title, *_ in columns], groups=groups, caption=caption)
    last: Any = None
    for row in rows:
        label, *cells = [_cell(row, *rest) for _, *rest in columns]
        group = rule(row) if rule else None
        table.add(label.text, cells, rule=group != last, selected=selected(row))
        last = group
    return table


def _cell(
    row: Any,
    what: str | Callable[[Any], Any],
    how: int | Callable[[Any], str | Cell] | None = None,
    factor: float = 1.0,
) -> Cell:
    value = what(row) if callable(what) else _at(row, what)
    if how is None:
        return value if isinstance(value, Cell) else Cell(str(value), mark="text")
    if value is not None and factor != 1.0:
        value = factor * value
    shown = fixed(value, how) if isinstance(how, int) else how(value)
    return shown if isinstance(shown, Cell) else Cell(shown)


def _at(row: Any, keys: str) -> Any:
    for key in keys.split("."):
        row = row.get(key) if isinstance(row, Mapping) else None
    return row


def nested(keys: Iterable[str], columns: Sequence[Column]) -> list[Column]:
    """Return the columns of what stands below each of some keys of a row."""

    def inside(key: str, column: Column) -> Column:
        title, what, *rest = column

        def of(row: Any) -> Any:
            return what(row[key]) if callable(what) else _at(row[key], what)

        return title, of, *rest

    return [inside(key, column) for key in keys for column in columns]


def bad_where(text: object, bad: object) -> Cell:
    """Return a cell that is set off where something is wrong."""
    return Cell(str(text), mark="bad" if bad else "")


def _narrowest(texts: Iterable[str]) -> float:
    """Return the width in pixels that the longest word of a column takes in print."""
    # names break after underscores and slashes
    words = [word for text in texts for word in re.split(r"[\s_/]", text)]
    return _PADDING + _LETTER * max(map(len, words), default=0)


def _plain(cell: Cell) -> str:
    text = f"{cell.text} ({cell.note})" if cell.note else cell.text
    return f"{text} !" if cell.mark == "bad" else text


@dataclass(frozen=True)
class Section:
    """A titled part of a page; it may hold sections itself.

    Attributes:
        title: a few words.
        blocks: what it shows, from top to bottom.
        folded: closed at first, for what most readers skip.
    """

    kind: ClassVar[str] = "section"
    title: str
    blocks: Sequence[Block | None] = field(default_factory=tuple)
    folded: bool = False

    @property
    def shown(self) -> list[Block]:
        """Return the blocks that are there; a section may be handed None for an absent part."""
        return [block for block in self.blocks if block is not None]
