"""Rewrite the figures of README and documentation from runs, and list sources that did not run.

    python scripts/results.py [--only NAME,...] [--runs runs/results] [--minutes 60]

A figure in a page is between two comments. The first one has its source:

    <!--= quickstart metrics.json rows[model=plsr,split=test].nrmse.mean -->0.123<!--/-->

These are the name of a source (see `SOURCES`), a file in its run folder (or `stdout`), and a path
in that JSON file, with `[key=value,...]` for the first entry of a list that has these values. For
`stdout` the path is a regular expression in which a space is `\\s`. The optional fourth field is a
scale: `x100` for a factor, `deg` to convert from rad. The fifth is the number of digits; default 3.
Entries of lists are separated by slashes.

All figures of a call are of one state, which must be committed: a source is not run again if it is
finished under --runs with the present package and configs. The pages are rewritten after each
source, so that an interrupted call can be repeated. If a source fails, for example without data or
a package, or takes longer than --minutes, its figures are not changed and the last lines name it.
"""

from __future__ import annotations

import argparse
import json
import math
import re
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
MARK = re.compile(r"<!--= (?P<origin>.+?) -->(?P<text>.*?)<!--/-->", re.DOTALL)
DEG = 180.0 / math.pi


MORENO = "configs/studies/moreno2019/moreno2019.yaml"
SOURCES: dict[str, tuple[str, ...]] = {
    # every config as it is, by its name
    **{
        path.stem: (path.relative_to(ROOT).as_posix(),)
        for path in sorted((ROOT / "configs").rglob("*.yaml"))
        if path.parent.name != "vessels"
    },
    # needs the package examples/residnet_tasks
    "thrusters": ("examples/residnet_tasks/configs/thrusters.yaml",),
    "noise": ("configs/studies/jervan2020/noise.yaml",),
    "input_noise": ("configs/studies/halvorsen2019/noise.yaml",),
    "tanker": ("configs/esso_osaka.yaml", "~heads", "~base_of", "~ensembles", "~training"),
    # genetic programming and bands, which change no other model, take most of an hour
    "moreno2019": (MORENO, "~heads.gptips", "~base_of.gptips", "bands=null"),
    # the document's 500 generations, all of them, without the other models of Tables 2 and 3
    "gptips": (
        *(MORENO, "heads.gptips.evolution.patience=500"),
        *(f"~heads.{k}" for k in ("rbf_joint", "rbf_each", "p1_joint", "p1_each", "p2_joint")),
        *("~heads.p2_each", "~heads.symbolic", "base_of={gptips: nothing}"),
        *("study=null", "bands=null"),
    ),
    "woo2018_linear": (
        *("configs/studies/woo2018/woo2018.yaml", "~heads", "~training"),
        *("study=null", "bands=null"),
    ),
    "moreno_equations": ("scripts/bench/moreno_equations.py",),
    "input_sets": ("scripts/bench/symbolic.py", "--parts", "sets"),
    "symbolic": ("scripts/bench/symbolic.py",),
    "symbolic_random": (
        *("scripts/bench/symbolic.py", "--parts", "random", "late"),
        *("--designs", "20", "--seed", "918273"),
    ),
}
"""Commands that make figures: a config with overrides behind it, or a script with arguments."""


def list_pages() -> list[Path]:
    """Return README and all pages of the documentation."""
    return [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


def find_figures(page: Path) -> list[tuple[str, str]]:
    """Return origin and text of each figure of a page."""
    return [
        (match["origin"], match["text"])
        for match in MARK.finditer(page.read_text(encoding="utf-8"))
    ]


def run_git(*arguments: str) -> str:
    """Return the output of git."""
    completed = subprocess.run(
        ["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=True
    )
    return completed.stdout.strip()


def hash_inputs() -> str:
    """Return the git hashes of package, configs and scripts, on which the figures depend.

    Raises:
        SystemExit: if some of these files are not committed.
    """
    parts = ("src", "configs", "scripts/bench", "tests/support")
    if changed := run_git("status", "--porcelain", "--", *parts):
        raise SystemExit(f"commit first, so that figures belong to a commit:\n{changed}")
    return run_git("rev-parse", *(f"HEAD:{part}" for part in parts))


def run_source(name: str, runs: Path, input_hashes: str, minutes: float) -> str:
    """Run a source unless it is finished; return the reason if it failed, else an empty text."""
    folder = runs / name
    command = list(SOURCES[name])
    stamp = folder / "state"
    state = f"{input_hashes}\n{' '.join(command)}"
    if stamp.is_file() and stamp.read_text(encoding="utf-8") == state:
        return ""
    print(f"running {name}: {' '.join(command)}", flush=True)
    if command[0].endswith(".yaml"):
        overrides = [part for override in command[1:] for part in ("-s", override)]
        command = ["-m", "residnet", "run", command[0], *overrides]
        command += ["--out", str(folder), "--overwrite", "--quiet"]
    call = [sys.executable, *command]
    try:
        completed = subprocess.run(
            call, cwd=ROOT, capture_output=True, text=True, timeout=60 * minutes, check=False
        )
    except subprocess.TimeoutExpired:
        return f"takes longer than {minutes:g} minutes; give --minutes"
    if completed.returncode:
        return f"failed: {(completed.stderr.strip() or 'no message').splitlines()[-1]}"
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "stdout").write_text(completed.stdout, encoding="utf-8")
    stamp.write_text(state, encoding="utf-8")
    return ""


def read_figure(origin: str, runs: Path) -> str:
    """Return the text of a figure from a run.

    Raises:
        LookupError: if the run has no such figure.
    """
    name, file, path, *scale = origin.split()
    content = (runs / name / file).read_text(encoding="utf-8")
    if file == "stdout":
        match = re.search(path, content)
        if match is None:
            raise LookupError(f"{origin}: the output has no such line")
        return match[1]
    unit = scale[0] if scale else "x1"
    digits = int(scale[1]) if len(scale) > 1 else 3
    factor = DEG if unit == "deg" else float(unit.removeprefix("x"))
    return format_value(find_entry(json.loads(content), path), factor, digits)


def find_missing_figure(name: str, runs: Path) -> str:
    """Return the first figure of the pages that a run does not have; empty if it has all."""
    for page in list_pages():
        for origin, _ in find_figures(page):
            if origin.split()[0] == name:
                try:
                    read_figure(origin, runs)
                except (LookupError, OSError) as error:
                    return f"ran, but has no figure {origin}: {error}"
    return ""


def find_entry(content: Any, path: str) -> Any:
    """Return the value at a path of a JSON file.

    Raises:
        LookupError: if there is no such value.
    """
    for key, condition in re.findall(r"([^.\[\]]+)?(?:\[([^\]]*)\])?(?:\.|$)", path):
        if key:
            content = content[int(key) if isinstance(content, list) else key]
        if condition:
            pairs = [pair.split("=") for pair in condition.split(",")]
            rows = [row for row in content if all(str(row.get(k)) == value for k, value in pairs)]
            if not rows:
                raise LookupError(f"no entry with {condition}")
            content = rows[0]
    return content


def format_value(value: Any, factor: float, digits: int = 3) -> str:
    """Return a value, or a list of them, in a number of significant digits."""
    if isinstance(value, dict):
        value = list(value.values())
    if isinstance(value, list):
        return " / ".join(format_value(part, factor, digits) for part in value)
    if not isinstance(value, float):
        return str(value)
    return f"{float(f'{factor * value:.{digits}g}'):.10g}"


def rewrite_page(page: Path, runs: Path, missing: Sequence[str]) -> int:
    """Insert the figures of finished sources into a page; return the number of changed ones."""
    text = page.read_text(encoding="utf-8")
    n_changed = 0

    def replace_figure(match: re.Match[str]) -> str:
        nonlocal n_changed
        if match["origin"].split()[0] in missing:
            return match[0]
        figure = read_figure(match["origin"], runs)
        n_changed += figure != match["text"]
        return f"<!--= {match['origin']} -->{figure}<!--/-->"

    new_text = MARK.sub(replace_figure, text)
    if new_text != text:
        page.write_text(new_text, encoding="utf-8")
    return n_changed


def main() -> None:
    """Run the sources of the figures, rewrite the pages, and list the sources that did not run."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", help="names of sources, separated by commas; all otherwise")
    parser.add_argument("--runs", type=Path, default=ROOT / "runs" / "results", help="their folder")
    parser.add_argument("--minutes", type=float, default=60, help="that a run may take")
    options = parser.parse_args()
    used = {origin.split()[0] for page in list_pages() for origin, _ in find_figures(page)}
    selected = set(options.only.split(",")) if options.only else used
    if unknown := selected - set(SOURCES):
        parser.error(f"no source '{min(unknown)}'; valid: {', '.join(SOURCES)}")
    input_hashes = hash_inputs()
    n_changed = 0
    reasons = dict.fromkeys(used - selected, "not selected")
    for name in sorted(used & selected):
        reason = run_source(name, options.runs, input_hashes, options.minutes)
        if reason := reason or find_missing_figure(name, options.runs):
            reasons[name] = reason
            continue
        # after each source, so that an interrupted call keeps the figures of finished ones
        other_sources = sorted(used - {name})
        n_changed += sum(rewrite_page(page, options.runs, other_sources) for page in list_pages())
    commit = run_git("rev-parse", "--short", "HEAD")
    print(f"{n_changed} figures changed; the figures of this call are of commit {commit}.")
    for name, reason in sorted(reasons.items()):
        print(f"not run: {name}: {reason}")


if __name__ == "__main__":
    main()
