"""What a command waits for before it answers: which heavy packages it has imported, not seconds."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

HEAVY = ("torch", "lightning", "scipy.stats", "casadi", "matplotlib", "pandas", "sklearn")
TOLD = f"""
import sys
from residnet.__main__ import main
for words in " ".join(sys.argv[1:]).split(" then "):
    sys.argv = ["residnet", *words.split()]
    try:
        main()
    except SystemExit:
        pass
print("loaded:", [name for name in {HEAVY} if name in sys.modules], file=sys.stderr)
"""
NAMES = ("tasks", "heads", "baselines", "manoeuvres", "readers", "vessels", "formats", "configs")


def loaded(*commands: str) -> list[str]:
    """Return the heavy packages that commands have imported when the last one ends."""
    done = subprocess.run(
        [sys.executable, "-c", TOLD, " then ".join(commands)],
        capture_output=True,
        text=True,
        check=False,
    )
    line = done.stderr.splitlines()[-1]
    assert line.startswith("loaded: "), done.stderr
    return [name for name in HEAVY if f"'{name}'" in line]


def test_lists_tables_and_errors_of_files_and_tasks_import_nothing_heavy(tmp_path: Path) -> None:
    wrong = tmp_path / "task.yaml", tmp_path / "twice.yaml"
    for file, text in zip(wrong, ("task: fitt\n", "task: fit\ntask: fit\n"), strict=True):
        file.write_text(text + "name: a\n")
    checks = [f"check {one}" for one in (*wrong, "quickstrat")]
    assert loaded(*(f"list {what}" for what in NAMES), *checks) == []
    rows = [f"{0.1 * k:.1f},{0.1 * k % 3:.3f},{0.01 * (k % 7):.3f}" for k in range(60)]
    (tmp_path / "log.csv").write_text("\n".join(["t [s],u [m/s],delta [rad]", *rows]))
    assert loaded(f"inspect {tmp_path / 'log.csv'}") == ["pandas"]


def test_a_check_and_errors_of_a_fit_import_nothing_heavy() -> None:
    """The parts are checked by their configs; simulated trials are replaced by dummy logs."""
    assert loaded("check quickstart -s nme=3", "check quickstart") == []
