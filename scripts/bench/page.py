"""How soon the report of a fit with many logs opens in a browser without a screen.

    python scripts/bench/page.py [--logs 200] [--runs 5] [--report FILE]

Writes the page of a made-up run, or takes a report that is given, opens it in Chromium and prints
its size, how long writing took, and how much more processor time the browser and its helpers need
until its interactive figures are drawn than for an empty page: time by the clock would measure what
else runs on the machine. Chromium must be on the path.
"""

from __future__ import annotations

import argparse
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tests" / "support"))
import made_run  # noqa: E402
from browser import browser  # noqa: E402

from residnet.report.fit import write_fit_report  # noqa: E402

_WATCH = """<script>
const watched = () => {
  if (document.querySelector(".explorer")
      && !document.documentElement.classList.contains("drawn")) return setTimeout(watched, 10);
  const note = document.createElement("pre");
  note.id = "opened";
  document.body.appendChild(note);
};
watched();
</script>"""
_EMPTY = "<!DOCTYPE html><html><body></body></html>"


def many_logs(folder: Path, count: int) -> Path:
    """Return the report of a made-up run with so many test logs."""
    kinds = ("zigzag", "turning", "three_two_one_one")
    made_run.KINDS.clear()
    made_run.KINDS.update({f"{kinds[k % 3]}_{k:03d}": kinds[k % 3] for k in range(count)})
    run = made_run.made_run(folder / "run")
    made_run.residuals().to_parquet(run / "residuals.parquet")
    begun = time.process_time()
    page = write_fit_report(run)
    print(f"{count} logs: the page took {time.process_time() - begun:.1f} s to write")
    return page


def opened(program: str, text: str, folder: Path) -> float:
    """Return the seconds of processor time from the browser's start until a page is drawn."""
    watched = folder / "watched.html"
    watched.write_text(text.replace("</body>", f"{_WATCH}</body>"))
    command = [program, "--headless", "--no-sandbox", "--disable-gpu"]
    # the clock of the page leaps while it waits, so that only its work takes time
    command += ["--virtual-time-budget=60000", f"--user-data-dir={folder / 'profile'}"]
    begun = _used()
    dump = subprocess.run(
        [*command, "--dump-dom", watched.as_uri()], capture_output=True, text=True, check=True
    ).stdout
    taken = _used() - begun
    if '<pre id="opened">' not in dump:
        sys.exit("page.py: the browser did not draw the page")
    return taken


def _used() -> float:
    """Return the processor time in s of all programs that this one has run."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--logs", type=int, default=200)
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--report", type=Path)
    given = parser.parse_args()
    program = browser()
    if program is None:
        sys.exit("page.py: no Chromium was found on the path")
    with tempfile.TemporaryDirectory() as name:
        page = given.report or many_logs(Path(name), given.logs)
        text = page.read_text()
        folder = Path(name)
        apart = [
            opened(program, text, folder) - opened(program, _EMPTY, folder)
            for _ in range(given.runs + 1)
        ]
    # the first start of a browser makes its profile
    middle = statistics.median(apart[1:])
    print(f"{len(text) / 1e6:.2f} MB, {middle:.2f} s of processor time (median of {given.runs})")


if __name__ == "__main__":
    main()
