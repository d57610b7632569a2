"""The audit of the five documents: every row is whole, and every command that it names exists."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "documents" / "audit.md"
ROWS = [
    [cell.strip() for cell in line.strip().strip("|").split(" | ")]
    for line in PAGE.read_text(encoding="utf-8").splitlines()
    if line.startswith("| ") and not line.startswith(("| item", "| ---"))
]
COMMANDS = sorted({command for row in ROWS for command in re.findall(r"`([^`]+)`", row[3])})


def test_every_row_is_whole() -> None:
    assert len(ROWS) > 250
    for row in ROWS:
        assert len(row) == 5, row
        item, published, _, command, status = row
        assert item
        assert published
        assert status, f"{item}: a row without a command or a figure says why"
        assert command or status in ("nothing to compute", "used") or len(status) >= 10, row


@pytest.mark.parametrize("command", COMMANDS)
def test_the_command_exists(command: str) -> None:
    program, *words = command.split()
    if program == "residnet":
        assert words[0] == "run"
        assert (ROOT / words[1]).is_file(), command
    elif program == "python":
        source = (ROOT / words[0]).read_text(encoding="utf-8")
        for option in (word for word in words[1:] if word.startswith("--")):
            assert f'"{option}"' in source, f"{command}: no option {option}"
        if "--parts" in words:
            for part in words[words.index("--parts") + 1].split(","):
                assert f'"{part}": ' in source, f"{command}: no part {part}"
    else:
        assert program == "pytest"
        assert all((ROOT / word).exists() for word in words), command
