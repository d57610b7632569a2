"""Rewrites the figures of README and documentation from runs, and says what it did not run.

    python scripts/results.py [--only NAME,...] [--runs runs/results] [--minutes 30] [--again]
    python scripts/results.py --list

A figure in a page stands between two comments, of which the first says where it comes from:

    <!--= quickstart metrics.json rows[model=plsr,split=test].nrmse.mean -->0.123<!--/-->

are the name of a source (see `SOURCES`), a file in its run folder (or `stdout`), and a path through
that JSON file, with `[key=value,...]` for the first entry of a list that has these values. For
`stdout` the path is a regular expression in which a space is `\\s`. A fourth word scales it:
`x100` by a factor, `deg` from rad; a fifth is the number of digits, 3 otherwise. Lists stand with
slashes between their entries.

A source that is finished under --runs, with the package and the configs as they are now, is not run
again unless `--again` is given, so that all figures of a call are of one state; it must be
committed. The pages are rewritten after each source, and a call that is interrupted goes on from
there. What needs absent data or an absent package, or takes longer than --minutes on two idle
cores, is not run; its figures stay as they are, and the last lines name them.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import math
import os
import re
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
MARK = re.compile(r"<!--= (?P<where>.+?) -->(?P<shown>.*?)<!--/-->", re.DOTALL)
DIGITS = 3
DEG = 180.0 / math.pi


@dataclass(frozen=True)
class Source:
    """A command that makes figures.

    Attributes:
        command: a config below configs/ with overrides behind it, or a script with its arguments.
        minutes: how long it takes on two idle cores.
        data: folder below RESIDNET_DATA that it needs; empty for none.
        package: optional package that it needs; empty for none.
    """

    command: tuple[str, ...]
    minutes: float
    data: str = ""
    package: str = ""

    @property
    def is_config(self) -> bool:
        """Whether it is a config, and not a script."""
        return self.command[0].endswith(".yaml")


def _study(name: str, minutes: float, *more: str, data: str = "", package: str = "") -> Source:
    return Source((f"configs/studies/{name}.yaml", *more), minutes, data, package)


SOURCES: dict[str, Source] = {
    "quickstart": Source(("configs/quickstart.yaml",), 4),
    "kvlcc2": Source(("configs/kvlcc2.yaml",), 8, data="kvlcc2"),
    "tanker": Source(
        ("configs/esso_osaka.yaml", "~heads", "~base_of", "~ensembles", "~training"),
        9,
        data="esso_osaka",
    ),
    "table_5_2": _study("halvorsen2019/table_5_2", 10, package="deap"),
    "table_5_3": _study("halvorsen2019/table_5_3", 10, package="deap"),
    "table_5_3_small": _study("halvorsen2019/table_5_3_small", 2, package="deap"),
    "input_noise": _study("halvorsen2019/noise", 2, package="deap"),
    "delay": _study("halvorsen2019/delay", 5, package="deap"),
    "force_equations": _study("halvorsen2019/force_equations", 2),
    "jet_equations": _study("halvorsen2019/jet_equations", 3),
    "standard_model": _study("halvorsen2019/standard_model", 5),
    # genetic programming and bands, which change no other model, take most of an hour
    "moreno2019": _study(
        "moreno2019/moreno2019",
        5,
        *("~heads.gptips", "~base_of.gptips", "bands=null"),
        data="esso_osaka",
    ),
    # the document's 500 generations, all of them, without the other models of Tables 2 and 3
    "gptips": _study(
        "moreno2019/moreno2019",
        40,
        "heads.gptips.evolution.patience=500",
        *(f"~heads.{k}" for k in ("rbf_joint", "rbf_each", "p1_joint", "p1_each", "p2_joint")),
        *("~heads.p2_each", "~heads.symbolic", "base_of={gptips: nothing}"),
        *("study=null", "bands=null"),
        data="esso_osaka",
        package="deap",
    ),
    "moreno_equations": Source(("scripts/bench/moreno_equations.py",), 1, data="esso_osaka"),
    "polynomial_wind": _study("moreno2019/polynomial_wind", 3, data="esso_osaka"),
    "azimuth": _study("jervan2020/azimuth", 5),
    "case": _study("jervan2020/case", 3),
    "force_residual": _study("jervan2020/force_residual", 4),
    "operation": _study("jervan2020/operation", 4),
    "noise": _study("jervan2020/noise", 4),
    "disturbance": _study("jervan2020/disturbance", 4),
    "update": _study("jervan2020/update", 4),
    "zigzag": _study("jervan2020/zigzag", 2),
    "measured": _study("jervan2020/measured", 2, data="milliampere"),
    "woo2018": _study("woo2018/woo2018", 30),
    "woo2018_linear": _study(
        "woo2018/woo2018", 2, "~heads", "~training", "study=null", "bands=null"
    ),
    "thrusters": _study("woo2018/thrusters", 1),
    "outside_terms": _study("woo2018/outside_terms", 10),
    "input_sets": Source(("scripts/bench/input_sets.py",), 3),
    "wam_v_equations": Source(("configs/wam_v_equations.yaml",), 3),
    "symbolic": Source(("scripts/bench/symbolic.py",), 6),
    "symbolic_random": Source(
        (
            "scripts/bench/symbolic.py",
            *("--parts", "random,late", "--designs", "20", "--seed", "918273"),
        ),
        5,
    ),
}


def pages() -> list[Path]:
    """Return README and all pages of the documentation."""
    return [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


def marks(page: Path) -> list[tuple[str, str]]:
    """Return where each figure of a page comes from, and what stands there."""
    return [(m["where"], m["shown"]) for m in MARK.finditer(page.read_text(encoding="utf-8"))]


def why_not(source: Source, minutes: float) -> str:
    """Return why a source cannot be run; empty where it can."""
    if source.data:
        folder = os.environ.get("RESIDNET_DATA")
        if folder is None or not (Path(folder) / source.data).is_dir():
            return f"needs {source.data}/ in the folder that RESIDNET_DATA names"
    if source.package and importlib.util.find_spec(source.package) is None:
        return f"needs the package {source.package}"
    if source.minutes > minutes:
        return f"takes {source.minutes:g} minutes; give --minutes {source.minutes:g}"
    return ""


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


def make(name: str, source: Source, runs: Path, now: str, *, again: bool) -> str:
    """Run a source unless it is finished; return why its figures are not there, or nothing."""
    folder = runs / name
    stamp = folder / "state"
    now = f"{now}\n{' '.join(source.command)}"
    if stamp.is_file() and stamp.read_text(encoding="utf-8") == now and not again:
        return ""
    print(f"running {name}: {' '.join(source.command)}", flush=True)
    if source.is_config:
        overrides = [part for override in source.command[1:] for part in ("-s", override)]
        command = ["-m", "residnet.cli", "run", source.command[0], *overrides]
        command += ["--out", str(folder), "--overwrite", "--quiet"]
    else:
        command = list(source.command)
    ran = subprocess.run(
        [sys.executable, *command], cwd=ROOT, capture_output=True, text=True, check=False
    )
    if ran.returncode:
        return f"failed: {(ran.stderr.strip() or 'without a word').splitlines()[-1]}"
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "stdout").write_text(ran.stdout, encoding="utf-8")
    stamp.write_text(now, encoding="utf-8")
    return ""


def figure(where: str, runs: Path) -> str:
    """Return a figure from a run as it stands in a page.

    Raises:
        LookupError: where the run has no such entry.
    """
    name, file, path, *scale = where.split()
    content = (runs / name / file).read_text(encoding="utf-8")
    if file == "stdout":
        found = re.search(path, content)
        if found is None:
            raise LookupError(f"{where}: the output has no such line")
        return found[1]
    word, digits = scale[0] if scale else "x1", int(scale[1]) if len(scale) > 1 else DIGITS
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
    """Return what a path leads to.

    Raises:
        LookupError: where it leads nowhere.
    """
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


def shown(value: Any, factor: float, digits: int = DIGITS) -> str:
    """Return a value, or a list of them, in a number of significant digits."""
    if isinstance(value, dict):
        value = list(value.values())
    if isinstance(value, list):
        return " / ".join(shown(part, factor, digits) for part in value)
    if isinstance(value, str) or value is None:
        return str(value)
    if isinstance(value, int):
        return str(value)
    return f"{float(f'{factor * value:.{digits}g}'):.10g}"


def rewrite(page: Path, runs: Path, missing: Sequence[str]) -> int:
    """Put the figures of finished sources into a page; return how many changed.

    Raises:
        LookupError: where a run has no such entry.
    """
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
    parser.add_argument("--minutes", type=float, default=30, help="longest run that is made")
    parser.add_argument("--again", action="store_true", help="run what is finished again")
    parser.add_argument("--list", action="store_true", help="print the sources and leave")
    options = parser.parse_args()
    used = {where.split()[0] for page in pages() for where, _ in marks(page)}
    if options.list:
        for name in sorted(used):
            print(f"{name:18s} {SOURCES[name].minutes:4g} min  {' '.join(SOURCES[name].command)}")
        return
    wanted = set(options.only.split(",")) if options.only else used
    if unknown := wanted - set(SOURCES):
        parser.error(f"no source '{min(unknown)}'; valid: {', '.join(SOURCES)}")
    now, changed = state(), 0
    reasons = dict.fromkeys(used - wanted, "not asked for")
    for name in sorted(used & wanted, key=lambda name: SOURCES[name].minutes):
        reason = why_not(SOURCES[name], options.minutes)
        reason = reason or make(name, SOURCES[name], options.runs, now, again=options.again)
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
