"""What a report page is made of: sections of text, tables, figures and code.

The same objects serve the page (`residnet.report.page.write_page`) and the terminal
(`Table.text`).
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import accumulate
from typing import Any, ClassVar, Literal, Protocol, TypeAlias

from residnet.core.format import DASH, fixed, signed

EXPORTS = "exports.json"
"""File of a run folder that says what came of each export."""
Mark: TypeAlias = Literal["", "bad", "best", "weak", "text"]


_SHEET, _LETTER, _PADDING = 700.0, 5.8, 6.0
"""Pixels of a sheet of A4 between its margins, of a bold letter of a table, and beside a cell."""


_WIDE = 6
"""Columns of a table that half of a page, 34 rem, no longer holds at 5 to 6 rem each."""


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
        si: the number in its SI unit where it stands in another, shown under the pointer.
    """

    text: str
    note: str = ""
    mark: Mark = ""
    si: str = ""


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
        self, columns: Sequence[str], caption: str = "", groups: Sequence[tuple[str, int]] = ()
    ) -> None:
        """Make a table without rows.

        Args:
            columns: titles with units, the first above the row labels.
            caption: a sentence above the table.
            groups: titles that span several columns after the first, with how many they span.
        """
        self.columns, self.caption, self.groups = list(columns), caption, list(groups)
        left = len(self.columns) - 1 - sum(count for _, count in self.groups)
        if self.groups and left:
            # the line of groups is as long as that of columns
            self.groups.append(("", left))
        self.rows: list[Row] = []

    def add(
        self, label: str, cells: Iterable[Cell | str], *, rule: bool = False, selected: bool = False
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
        marks = zip(*([cell.mark for cell in row.cells] for row in self.rows), strict=True)
        words = [all(mark == "text" for mark in column) for column in marks]
        return [True, *(words or [False] * (len(self.columns) - 1))]

    def part(self, first: int, last: int) -> Table:
        """Return the table with the columns from `first` up to `last`, those of labels aside."""
        groups, at = [], 0
        for title, count in self.groups:
            held = min(at + count, last) - max(at, first)
            at += count
            groups += [(title, held)] if held > 0 else []
        part = Table([self.columns[0], *self.columns[1 + first : 1 + last]], "", groups)
        part.rows = [replace(row, cells=row.cells[first:last]) for row in self.rows]
        return part

    @property
    def pieces(self) -> list[Table]:
        """Return the table in pieces that each fit a sheet of A4, itself where it fits whole.

        Each piece has the labels of the rows; columns of one group stay together where they fit.
        """
        lines = [self.columns]
        lines += [[row.label, *(f"{c.text} {c.note}" for c in row.cells)] for row in self.rows]
        # names break after underscores and slashes
        words = [re.split(r"[\s_/]", " ".join(column)) for column in zip(*lines, strict=True)]
        widths = [_PADDING + _LETTER * max(map(len, column)) for column in words]
        ends = [*accumulate(count for _, count in self.groups)] or [*range(1, len(self.columns))]
        stretches, at = [[0, 0]], 0
        for end in ends:
            first = stretches[-1][0]
            if first < at and widths[0] + sum(widths[1 + first : 1 + end]) > _SHEET:
                stretches.append([at, at])
            stretches[-1][1] = at = end
        if len(stretches) < 2:
            return [self]
        out: list[Table] = []
        for first, last in stretches:
            piece = self.part(first, last)
            piece.caption = "" if out else self.caption
            out.append(piece)
        return out

    def text(self) -> str:
        """Return the table for a terminal: columns aligned, notes in brackets, groups above."""
        lines = [self.columns]
        lines += [[row.label, *(_plain(cell) for cell in row.cells)] for row in self.rows]
        widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
        spans, start = [" " * widths[0]], 1
        for title, count in self.groups:
            # a group is as wide as its columns and the gaps between them
            width = sum(widths[start : start + count]) + 2 * (count - 1)
            widths[start] += max(len(title) - width, 0)
            spans.append(f"{title:^{width}}")
            start += count
        out = [self.caption] if self.caption else []
        out += ["  ".join(spans)] if self.groups else []
        out += [
            "  ".join(
                f"{text:<{width}}" if left else f"{text:>{width}}"
                for text, width, left in zip(line, widths, self.aligned_left, strict=True)
            )
            for line in lines
        ]
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


def paired_interval(bounds: Sequence[float] | None, absent: str = DASH) -> Cell:
    """Return the interval of a difference, set off where it excludes zero."""
    if not bounds:
        return Cell(absent)
    text = " to ".join(map(signed, bounds))
    return Cell(text, mark="best" if bounds[0] > 0 or bounds[1] < 0 else "")


def bad_where(text: object, bad: object) -> Cell:
    """Return a cell that is set off where something is wrong."""
    return Cell(str(text), mark="bad" if bad else "")


def _plain(cell: Cell) -> str:
    text = f"{cell.text} ({cell.note})" if cell.note else cell.text
    return f"{text} !" if cell.mark == "bad" else text


@dataclass(frozen=True)
class Section:
    """A titled part of a page; it may hold sections itself.

    Attributes:
        title: a few words; empty for the rest of a page's first screen.
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

    @property
    def beside(self) -> bool:
        """Return whether its parts stand beside each other, each in half of the page."""
        tables = [block for block in self.shown if isinstance(block, Table)]
        return len(self.shown) > 1 and all(len(table.columns) < _WIDE for table in tables)
