"""What a command waits for before it answers: which heavy packages it has imported, not seconds."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

HEAVY = ("torch", "lightning", "scipy.stats", "casadi", "matplotlib", "pandas", "sklearn")
TOLD = f"""
import sys
from residnet.__main__ import main
try:
    main()
finally:
    print("loaded:", [name for name in {HEAVY} if name in sys.modules], file=sys.stderr)
"""
NAMES = (
    *("tasks", "heads", "baselines", "manoeuvres", "readers", "vessels", "formats", "configs"),
)


def loaded(*words: str) -> list[str]:
    """Return the heavy packages that a command has imported when it ends."""
    done = subprocess.run(
        [sys.executable, "-c", TOLD, *words], capture_output=True, text=True, check=False
    )
    line = done.stderr.splitlines()[-1]
    assert line.startswith("loaded: "), done.stderr
    return [name for name in HEAVY if f"'{name}'" in line]


@pytest.mark.parametrize("what", NAMES)
def test_lists_import_nothing_heavy(what: str) -> None:
    assert loaded("list", what) == []


def test_errors_of_files_and_tasks_import_nothing_heavy(tmp_path: Path) -> None:
    config = tmp_path / "wrong.yaml"
    for text in ("task: fitt\nname: a\n", "task: fit\ntask: fit\n"):
        config.write_text(text)
        assert loaded("check", str(config)) == []
    assert loaded("check", "quickstrat") == []


def test_errors_of_a_fit_import_torch_alone() -> None:
    """Its models are built as they are read, so that what does not fit together is refused."""
    assert loaded("check", "quickstart", "-s", "nme=3") == ["torch"]


def test_a_check_trains_and_draws_nothing() -> None:
    assert loaded("check", "quickstart") == ["torch"]
