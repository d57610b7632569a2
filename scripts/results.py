"""Rewrites the figures of README and documentation from runs, and says what it did not run.

    python scripts/results.py [--only NAME,...] [--runs runs/results] [--minutes 60]

A figure in a page stands between two comments, of which the first says where it comes from:

    <!--= quickstart metrics.json rows[model=plsr,split=test].nrmse.mean -->0.123<!--/-->

are the name of a source (see `SOURCES`), a file in its run folder (or `stdout`), and a path through
that JSON file, with `[key=value,...]` for the first entry of a list that has these values. For
`stdout` the path is a regular expression in which a space is `\\s`. A fourth word scales it:
`x100` by a factor, `deg` from rad; a fifth is the number of digits, 3 otherwise. Lists stand with
slashes between their entries.

A source that is finished under --runs, with the package and the configs as they are now, is not run
again, so that all figures of a call are of one state; it must be committed. The pages are rewritten
after each source, and a call that is interrupted goes on from there. What fails, such as for want
of data or of a package, or takes longer than --minutes, leaves its figures as they are, and the
last lines name it.
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
MARK = re.compile(r"<!--= (?P<where>.+?) -->(?P<shown>.*?)<!--/-->", re.DOTALL)
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


def pages() -> list[Path]:
    """Return README and all pages of the documentation."""
    return [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


def marks(page: Path) -> list[tuple[str, str]]:
    """Return where each figure of a page comes from, and what stands there."""
    return [(m["where"], m["shown"]) for m in MARK.finditer(page.read_text(encoding="utf-8"))]


def git(*words: str) -> str:
    """Return what git says."""
    said = subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True, check=True)
    return said.stdout.strip()


def state() -> str:
    """Return what the figures depend on: package, configs and scripts as they are committed.

    Raises:
        SystemExit: where something of them is not committed.
    """
    parts = ("src", "configs", "scripts/bench", "tests/support")
    if changed := git("status", "--porcelain", "--", *parts):
        raise SystemExit(f"commit first, so that figures belong to a commit:\n{changed}")
    return git("rev-parse", *(f"HEAD:{part}" for part in parts))


def make(name: str, runs: Path, now: str, minutes: float) -> str:
    """Run a source unless it is finished; return why its figures are not there, or nothing."""
    folder = runs / name
    command = list(SOURCES[name])
    stamp = folder / "state"
    now = f"{now}\n{' '.join(command)}"
    if stamp.is_file() and stamp.read_text(encoding="utf-8") == now:
        return ""
    print(f"running {name}: {' '.join(command)}", flush=True)
    if command[0].endswith(".yaml"):
        overrides = [part for override in command[1:] for part in ("-s", override)]
        command = ["-m", "residnet", "run", command[0], *overrides]
        command += ["--out", str(folder), "--overwrite", "--quiet"]
    call = [sys.executable, *command]
    try:
        ran = subprocess.run(
            call, cwd=ROOT, capture_output=True, text=True, timeout=60 * minutes, check=False
        )
    except subprocess.TimeoutExpired:
        return f"takes longer than {minutes:g} minutes; give --minutes"
    if ran.returncode:
        return f"failed: {(ran.stderr.strip() or 'without a word').splitlines()[-1]}"
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "stdout").write_text(ran.stdout, encoding="utf-8")
    stamp.write_text(now, encoding="utf-8")
    return ""


def figure(where: str, runs: Path) -> str:
    """Return a figure from a run as it stands in a page; a LookupError where it has none."""
    name, file, path, *scale = where.split()
    content = (runs / name / file).read_text(encoding="utf-8")
    if file == "stdout":
        found = re.search(path, content)
        if found is None:
            raise LookupError(f"{where}: the output has no such line")
        return found[1]
    word = scale[0] if scale else "x1"
    digits = int(scale[1]) if len(scale) > 1 else 3
    factor = DEG if word == "deg" else float(word.removeprefix("x"))
    return shown(entry(json.loads(content), path), factor, digits)


def lacking(name: str, runs: Path) -> str:
    """Return the first figure of the pages that the run of a source does not have, or nothing."""
    for page in pages():
        for where, _ in marks(page):
            if where.split()[0] == name:
                try:
                    figure(where, runs)
                except (LookupError, OSError) as error:
                    return f"ran, but has no figure {where}: {error}"
    return ""


def entry(content: Any, path: str) -> Any:
    """Return what a path leads to; a LookupError where it leads nowhere."""
    for key, wanted in re.findall(r"([^.\[\]]+)?(?:\[([^\]]*)\])?(?:\.|$)", path):
        if key:
            content = content[int(key) if isinstance(content, list) else key]
        if wanted:
            pairs = [pair.split("=") for pair in wanted.split(",")]
            rows = [row for row in content if all(str(row.get(k)) == value for k, value in pairs)]
            if not rows:
                raise LookupError(f"no entry with {wanted}")
            content = rows[0]
    return content


def shown(value: Any, factor: float, digits: int = 3) -> str:
    """Return a value, or a list of them, in a number of significant digits."""
    if isinstance(value, dict):
        value = list(value.values())
    if isinstance(value, list):
        return " / ".join(shown(part, factor, digits) for part in value)
    if not isinstance(value, float):
        return str(value)
    return f"{float(f'{factor * value:.{digits}g}'):.10g}"


def rewrite(page: Path, runs: Path, missing: Sequence[str]) -> int:
    """Put the figures of finished sources into a page; return how many changed."""
    text = page.read_text(encoding="utf-8")
    changed = 0

    def put(match: re.Match[str]) -> str:
        nonlocal changed
        if match["where"].split()[0] in missing:
            return match[0]
        new = figure(match["where"], runs)
        changed += new != match["shown"]
        return f"<!--= {match['where']} -->{new}<!--/-->"

    after = MARK.sub(put, text)
    if after != text:
        page.write_text(after, encoding="utf-8")
    return changed


def main() -> None:
    """Run what the figures need, rewrite the pages, and say what was left out."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", help="names of sources, separated by commas; all otherwise")
    parser.add_argument("--runs", type=Path, default=ROOT / "runs" / "results", help="their folder")
    parser.add_argument("--minutes", type=float, default=60, help="that a run may take")
    options = parser.parse_args()
    used = {where.split()[0] for page in pages() for where, _ in marks(page)}
    wanted = set(options.only.split(",")) if options.only else used
    if unknown := wanted - set(SOURCES):
        parser.error(f"no source '{min(unknown)}'; valid: {', '.join(SOURCES)}")
    now = state()
    changed = 0
    reasons = dict.fromkeys(used - wanted, "not asked for")
    for name in sorted(used & wanted):
        reason = make(name, options.runs, now, options.minutes)
        if reason := reason or lacking(name, options.runs):
            reasons[name] = reason
            continue
        # at once, so that a call that is interrupted leaves what it ran
        others = sorted(used - {name})
        changed += sum(rewrite(page, options.runs, others) for page in pages())
    commit = git("rev-parse", "--short", "HEAD")
    print(f"{changed} figures changed; those that were run are of commit {commit}.")
    for name, reason in sorted(reasons.items()):
        print(f"not run: {name}: {reason}")


if __name__ == "__main__":
    main()
