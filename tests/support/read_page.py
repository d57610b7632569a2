"""Reading a report page back."""

from __future__ import annotations

import re
from html.parser import HTMLParser
from pathlib import Path

_VOID = {"meta", "img", "br", "hr", "link", "wbr", "input"}


def plain(page: Path) -> str:
    """The text of a page without links to the glossary.

    Numbers and units that are kept together have a plain space between.
    """
    text = page.read_text().replace("\u00a0", " ")
    return re.sub(r'<a class="term"[^>]*>([^<]*)</a>', r"\1", text)


class Page(HTMLParser):
    """A page as tables of cell texts; every tag must be closed where it should be."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tables: list[list[list[str]]] = []
        self.sources: list[str] = []
        self.sections: list[str] = []
        self.feed(text)
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag not in _VOID:
            self.open.append(tag)
        self.sources += [value or "" for name, value in attrs if name in ("src", "href")]
        if tag == "section":
            self.sections.append(str(dict(attrs).get("id")))
        elif tag == "table":
            self.tables.append([])
        elif tag == "tr":
            self.tables[-1].append([])
        elif tag in ("td", "th"):
            self.tables[-1][-1].append("")

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if "td" in self.open or "th" in self.open:
            # a number and its unit are kept together, which no test is about
            text = data.replace("\u00a0", " ")
            self.tables[-1][-1][-1] += ("|" if "small" in self.open else "") + text

    def table(self, corner: str, first: str) -> dict[str, list[str]]:
        """Return the cells by row label of the table with that corner and that row label."""
        for table in self.tables:
            lines = {line[0]: line[1:] for line in table}
            if table[0][0] == corner and first in lines:
                return lines
        raise AssertionError(f"no table {corner} with {first}")
