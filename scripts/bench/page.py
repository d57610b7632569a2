"""How large the page of a fit is, and how soon a browser shows its first screen.

python scripts/bench/page.py [--logs 68] [--times 5]

The run is made up: as many logs of 6 s under two protocols, five models. The time counts from the
navigation to the first screen with its picture drawn, in a browser that has started before, as a
reader's has; the least of several counts, since other work of the machine only adds to it. Beside
it stands the processor time of the process that draws, its start included. Needs Linux, and
Chromium or Chrome.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import threading
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

sys.path.insert(0, str(Path(__file__).parents[2] / "tests" / "support"))

import made_run
from browser import browser

from residnet.report.fit import write_fit_figures
from residnet.report.run_reader import RunFiles

_TOLD = """<script>(function wait() {
  const parts = [...document.querySelectorAll(".live .opening .explorer")];
  if (!parts.length || !parts.every(part => part.classList.contains("drawn")))
    return setTimeout(wait, 5);
  requestAnimationFrame(() => fetch("/done?ms=" + performance.now()));
})();</script>"""
_BEFORE = b"<script>setTimeout(() => location = '/report.html', 2000);</script>"


def used(profile: str) -> float:
    """Return the processor time in ms of the drawing processes of a browser with that profile."""
    ticks = 0
    for place in Path("/proc").glob("[0-9]*"):
        try:
            words = (place / "cmdline").read_text()
            fields = (place / "stat").read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if "--type=renderer" in words and profile in words:
            ticks = max(ticks, int(fields[11]) + int(fields[12]))
    return 1e3 * ticks / os.sysconf("SC_CLK_TCK")


def opened(program: str, page: Path) -> tuple[float, float]:
    """Return ms of the clock and of the processor until a browser shows the first screen."""
    told: list[float] = []
    done = threading.Event()

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            asked = urlsplit(self.path)
            self.send_response(200)
            self.send_header("Content-Type", "text/html")
            self.end_headers()
            if asked.path == "/done":
                told.append(float(parse_qs(asked.query)["ms"][0]))
                done.set()
            elif asked.path == "/report.html":
                self.wfile.write(page.read_bytes() + _TOLD.encode())
            elif asked.path == "/":
                self.wfile.write(_BEFORE)

        def log_message(self, format: str, *arguments: object) -> None:
            """Say nothing."""

    server = HTTPServer(("127.0.0.1", 0), Handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        command = [program, "--headless", "--no-sandbox", "--disable-gpu"]
        command += [
            f"--user-data-dir={profile}",
            f"http://127.0.0.1:{server.server_port}/",
        ]
        with subprocess.Popen(command, stderr=subprocess.DEVNULL) as process:
            done.wait(120)
            spent = used(profile)
            process.terminate()
    server.shutdown()
    if not told:
        raise SystemExit("the page was not drawn within 120 s")
    return told[0], spent


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--logs", type=int, default=68)
    parser.add_argument("--times", type=int, default=5)
    given = parser.parse_args()
    program = browser()
    if program is None:
        raise SystemExit("install Chromium or Chrome")
    kinds = ("zigzag", "turning", "three_two_one_one", "spiral")
    logs = [f"{kinds[i % len(kinds)]}_{i:02d}" for i in range(given.logs)]
    made_run.KINDS = {name: name.rpartition("_")[0] for name in logs}
    with tempfile.TemporaryDirectory() as folder:
        run = RunFiles(made_run.made_run(Path(folder) / "run"))
        write_fit_figures(run)
        page = made_run.write_fit_page(run)
        size = page.stat().st_size
        times = sorted(opened(program, page) for _ in range(given.times))
    print(
        f"{given.logs} logs: {size / 1e6:.2f} MB, first screen after {times[0][0]:.0f} ms"
        f" (all: {', '.join(f'{time:.0f}' for time, _ in times)} ms), of which"
        f" {min(spent for _, spent in times):.0f} ms of processor time"
    )


if __name__ == "__main__":
    main()
