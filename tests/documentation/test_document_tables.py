"""Tables of claims of the five documents: rows are complete, and commands in them exist."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PAGES = {
    "000": "halvorsen2019",
    "001": "moreno2019",
    "002": "jervan2020",
    "003": "woo2018",
    "004": "gouletas2020",
}
SECTIONS = {
    document: (ROOT / "docs" / "documents" / f"{page}.md")
    .read_text(encoding="utf-8")
    .partition("## Claims and results")[2]
    for document, page in PAGES.items()
}
COMMAND = re.compile(r"`((?:residnet run|python|pytest) [^`]+)`")
NOT_COMPUTED = ("used", "nothing to compute")
CAPTIONS = {
    "000": {
        "Figure": "1.1 3.1-3.3 4.1 5.1-5.11 6.1-6.9 7.1-7.14 8.1",
        "Table": "5.1-5.3 6.1-6.2 7.1-7.5",
        "Listing": "5.1 9.1",
    },
    "001": {"Figure": "1-8", "Table": "1-3"},
    "002": {"Figure": "1.1 2.1-2.3 3.1-3.5 4.1-4.47 5.1-5.19", "Table": "4.1-4.16 5.1-5.6 A.1"},
    "003": {"Figure": "1-18", "Table": "1"},
    "004": {
        "Figure": "2.1-2.12 3.1-3.9 4.1-4.2 5.1-5.4 6.1-6.22",
        "Table": "3.1 5.1-5.3 6.1-6.8",
        "Listing": "A.1",
    },
}
"""What each document has a caption for: first and last number of each chapter."""


def parse_rows(section: str) -> list[tuple[str, list[str]]]:
    """Return the rows of the tables of claims, each with the heading above its table."""
    heading = ""
    rows = []
    for line in section.splitlines():
        if line.startswith("### "):
            heading = line
        elif line.startswith("| ") and not line.startswith(("| claim", "| ---")):
            rows.append((heading, [cell.strip() for cell in line.strip().strip("|").split(" | ")]))
    return rows


ROWS = {document: parse_rows(section) for document, section in SECTIONS.items()}
COMMANDS = sorted({name for section in SECTIONS.values() for name in COMMAND.findall(section)})


def expand_spans(spans: str) -> set[str]:
    """Return all numbers of spans such as `5.1-5.3 8.1`."""
    numbers = set()
    for span in spans.split():
        first, _, last = span.partition("-")
        chapter, dot, low = first.rpartition(".")
        high = int((last or first).rpartition(".")[2])
        numbers |= {f"{chapter}{dot}{n}" for n in range(int(low), high + 1)}
    return numbers


def read_captions(kind: str, text: str) -> set[str]:
    """Return the numbers of all captions of a kind in text such as `Figures 4.1 to 4.3, 4.5`."""
    number = r"(?:[A-Z]\.)?\d+(?:\.\d+)?"
    span = rf"{number}(?: to {number})?"
    lists = re.findall(rf"\b{kind}s? ({span}(?:, {span})*)", text)
    return expand_spans(" ".join(lists).replace(" to ", "-").replace(",", " "))


@pytest.mark.parametrize("document", CAPTIONS)
def test_every_figure_table_and_listing_has_a_row(document: str) -> None:
    places = [cells[1] for _, cells in ROWS[document]]
    # captions of pictures are listed in one sentence
    places += [
        line for line in SECTIONS[document].splitlines() if line.startswith("Without a computation")
    ]
    for kind, spans in CAPTIONS[document].items():
        missing = sorted(expand_spans(spans) - read_captions(kind, "\n".join(places)))
        assert not missing, f"document {document}: no row for {kind} {', '.join(missing)}"


def test_captions_are_read_from_lists_and_spans() -> None:
    text = "Figures 4.1 to 4.3, 5.1, Table A.1, (4.4); Figure 7, (21)"
    assert read_captions("Figure", text) == {"4.1", "4.2", "4.3", "5.1", "7"}
    assert read_captions("Table", text) == {"A.1"}


def test_every_row_is_complete() -> None:
    rows = [row for document in ROWS.values() for row in document]
    assert len(rows) > 100
    for heading, cells in rows:
        assert len(cells) == 4, cells
        assert all(cells), cells
        has_command = COMMAND.search(f"{heading} {cells[2]}") is not None
        assert has_command or cells[3] in NOT_COMPUTED or len(cells[3]) >= 10, cells


@pytest.mark.parametrize("command", COMMANDS)
def test_the_command_exists(command: str) -> None:
    program, *words = command.split()
    if program == "residnet":
        assert words[0] == "run"
        assert (ROOT / words[1]).is_file(), command
    elif program == "python":
        source = (ROOT / words[0]).read_text(encoding="utf-8")
        named = [f"{word[2:]}=" for word in words[1:] if word.startswith("--")]
        if "--parts" in words:
            named += [f'"{part}": ' for part in words[words.index("--parts") + 1].split(",")]
        assert [name for name in named if name not in source] == [], command
    else:
        assert program == "pytest"
        assert all((ROOT / word).exists() for word in words), command
