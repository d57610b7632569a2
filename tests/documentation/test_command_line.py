"""The page on the command line agrees with the commands."""

from __future__ import annotations

import command_reference


def test_reference_of_commands_is_current() -> None:
    text = command_reference.write_page()
    is_current = text == command_reference.PAGE.read_text(encoding="utf-8")
    assert is_current, "run python scripts/ci/command_reference.py"


def test_reference_has_every_command_and_its_options() -> None:
    text = command_reference.write_page()
    for line in ("## residnet plan-trial", "| `--area DISTANCE` |", "## residnet autopilot"):
        assert line in text
    assert "default: 120 s." in text
