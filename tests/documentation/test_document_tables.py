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
TABLES = {
    document: (ROOT / "docs" / "documents" / f"{page}.md")
    .read_text(encoding="utf-8")
    .partition("## Claims and results, row by row")[2]
    for document, page in PAGES.items()
}
ROWS = [
    [cell.strip() for cell in line.strip().strip("|").split(" | ")]
    for table in TABLES.values()
    for line in table.splitlines()
    if line.startswith("| ") and not line.startswith(("| item", "| ---"))
]
COMMANDS = sorted({command for row in ROWS for command in re.findall(r"`([^`]+)`", row[3])})
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


def numbers(spans: str) -> set[str]:
    """Return all numbers of spans such as `5.1-5.3 8.1`."""
    found = set()
    for span in spans.split():
        first, _, last = span.partition("-")
        chapter, dot, low = first.rpartition(".")
        high = int((last or first).rpartition(".")[2])
        found |= {f"{chapter}{dot}{n}" for n in range(int(low), high + 1)}
    return found


@pytest.mark.parametrize("document", CAPTIONS)
def test_every_figure_table_and_listing_has_a_row(document: str) -> None:
    lines = TABLES[document].splitlines()
    items = "\n".join(line.split(" | ")[0] for line in lines if line.startswith("| "))
    # captions of pictures stand in one sentence, each with its kind
    items += "".join(line for line in lines if line.startswith("Without a computation"))
    for kind, spans in CAPTIONS[document].items():
        # "Figure 8 (a), 11 (a)" and "Figure 7, (21), (22)": numbers of equations are in brackets
        named = re.findall(rf"{kind} (\S+(?: \(a\), \d+)?)", items)
        named += re.findall(rf", {kind} (\S+)", items)
        have = {n.strip(",") for text in named for n in re.findall(r"(?<!\()[A-Z0-9.]+", text)}
        missing = sorted(numbers(spans) - {n.strip(".") for n in have})
        assert not missing, f"document {document}: no row for {kind} {', '.join(missing)}"


def test_every_row_is_whole() -> None:
    assert len(ROWS) > 200
    for row in ROWS:
        assert len(row) == 5, row
        item, published, _, command, status = row
        assert all((item, published, status)), f"{item}: without a command or a figure it says why"
        assert command or status in ("nothing to compute", "used") or len(status) >= 10, row


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
