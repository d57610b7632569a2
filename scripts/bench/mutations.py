"""Damaged tables, mutated configs and mutated run folders: each ends well or in one clear line.

A damaged table is read and looked at by the doctor, every tenth goes through a whole fit. A mutated
config is run: it is a tiny job of one of the tasks. A mutated run folder is reported, evaluated,
exported, resumed or read from Python. Each attempt is a fork of this process. It fails where it
ends with a traceback, a crash file, more than one line or an exit code other than 0, 1 and 2, where
it takes more memory than 6 GB, or where it takes longer than 60 s.

    python scripts/bench/mutations.py [--tables 5000] [--configs 2000] [--folders 500] [--seed 0]
        [--out FOLDER]
"""

from __future__ import annotations

import argparse
import contextlib
import os
import random
import shutil
import signal
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import yaml

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests" / "support"))

from damaged_text import DAMAGES
from forks import Ending, attempt, command
from mutations import mutated_config, mutated_folder
from tiny_tasks import TINY_TASKS, boat, measured, resolved

# imported before the forks, which then begin at once
import residnet
import residnet.api.models
import residnet.api.tasks
import residnet.report.still
import residnet.tasks.fit
import residnet.tasks.inspection
from residnet.core.errors import ResidnetError

LIMIT = 60
"""Seconds of processor time after which an attempt hangs."""


def fault(ending: Ending) -> str:
    """Return what is wrong with an ending; empty where nothing is."""
    last = (ending.error.splitlines() or [""])[-1]
    if ending.code == -signal.SIGXCPU:
        return f"longer than {LIMIT} s"
    if "Traceback" in ending.error or "Exception ignored" in ending.error:
        return "traceback: " + last
    if "this is a defect" in ending.error:
        return last
    if ending.code not in (0, 1, 2):
        return f"exit code {ending.code}: {last}"
    lines = [line for line in ending.error.splitlines() if line.startswith("residnet: ")]
    if ending.code and (len(lines) != 1 or lines[0] != last or len(last) > 2000):
        return f"not one line: {ending.error[-500:]}"
    return ""


def in_python(work: Callable[[], object]) -> Callable[[], None]:
    """Return work that ends as a command does where residnet raises an error of its own."""

    def ended() -> None:
        try:
            work()
        except ResidnetError as error:
            print(f"residnet: {error}", file=sys.stderr)
            sys.exit(error.exit_code)

    return ended


@dataclass
class Tally:
    """The endings of one kind of damage.

    Attributes:
        title: of the kind.
        endings: what was done to each, and how it ended.
    """

    title: str
    endings: list[tuple[str, Ending]] = field(default_factory=list)

    def add(self, told: str, ending: Ending) -> None:
        """Count an ending, and tell at once of a bad one."""
        self.endings.append((told, ending))
        if fault(ending):
            print(f"{self.title} {len(self.endings)}: {told}: {fault(ending)}", flush=True)
        if len(self.endings) % 100 == 0:
            print(f"{self.title}: {len(self.endings)} done", file=sys.stderr, flush=True)

    def close(self) -> int:
        """Print the tally with the slowest case; return the number of bad endings."""
        if not self.endings:
            return 0
        codes = Counter(ending.code for _, ending in self.endings)
        bad = sum(bool(fault(ending)) for _, ending in self.endings)
        told, slowest = max(self.endings, key=lambda entry: entry[1].processor)
        print(
            f"{self.title}: {len(self.endings)}, {bad} bad; exit codes"
            f" {', '.join(f'{code}: {count}' for code, count in sorted(codes.items()))}; slowest"
            f" {slowest.processor:.1f} s ({told})",
            flush=True,
        )
        return bad


def tables(count: int, folder: Path, draw: random.Random) -> Tally:
    """Damage a table of a small boat; read it, inspect it, and now and then fit with it."""
    tally, config = Tally("tables"), measured(folder)
    whole = boat(2).round(6).to_csv(index=False).encode()
    file, fit = folder / "logs" / "log_2.csv", folder / "tables.yaml"
    config["heads"].pop("mlp")
    fit.write_text(yaml.safe_dump({**config, "training": {}}, sort_keys=False))
    before = file.read_bytes()
    for number in range(count):
        data, told = whole, []
        for damage in draw.choices(DAMAGES, k=draw.choice([1, 1, 2])):
            data = damage(data, draw) if data else data
            told.append(damage.__name__)
        file.write_bytes(data)
        words = (
            ("run", fit, "--out", folder / "fitted", "--overwrite")
            if number % 10 == 0
            else ("inspect", file, "--config", fit)
        )
        ending = attempt(command(*words), folder / "error.txt", LIMIT)
        if words[0] == "inspect" and ending.code == 1 and "residnet: " not in ending.error:
            # the doctor's own exit code: the fit would be misled
            ending = replace(ending, code=0)
        tally.add(f"{'+'.join(told)} in {words[0]}", ending)
    file.write_bytes(before)
    return tally


def configs(count: int, folder: Path, draw: random.Random, names: Sequence[str]) -> Tally:
    """Mutate the configs of tiny runs, as written or with every default, and run them."""
    tally, trees = Tally("configs"), {}
    for name in names:
        file = folder / f"{name}.yaml"
        file.write_text(yaml.safe_dump(TINY_TASKS[name](folder), sort_keys=False))
        short = yaml.safe_load(file.read_text())
        trees[name] = (short, yaml.safe_load(resolved(file)))
    file, run = folder / "config.yaml", folder / "run"
    for _ in range(count):
        name = draw.choice(names)
        data, told = mutated_config(draw.choice(trees[name]), draw)
        file.write_bytes(data)
        shutil.rmtree(run, ignore_errors=True)
        ending = attempt(command("run", file, "--out", run), folder / "error.txt", LIMIT)
        tally.add(f"{name}: {told}", ending)
        if fault(ending):
            shutil.copy(file, folder / f"bad_config_{len(tally.endings)}.yaml")
    return tally


def _verbs(run: Path, config: Path, logs: Path) -> dict[str, Callable[[], object]]:
    """Return what may be done with a run folder."""

    def read() -> None:
        for name in (None, "mlp", "ridge"):
            model = residnet.load(run, name)
            model.rollout([0, 0, 0, 1, 0, 0], [[6.0, 0.1]] * 5)
        result = residnet.api.tasks.Result(run, None)
        _ = result.metrics, result.verdict, repr(result)
        for file in result.files:
            result.read(file)

    out = run.parent / "evaluated"
    shutil.rmtree(out, ignore_errors=True)
    return {
        "report": command("report", run),
        "evaluate": command("evaluate", run, "--logs", logs, "--out", out),
        "export": command("export", run, "--model", "selected", "--out", run.parent / "x.pt"),
        "resume": command("run", config, "--out", run, "--resume"),
        "python": in_python(read),
    }


def folders(count: int, folder: Path, draw: random.Random) -> Tally:
    """Damage a file of a finished run, then do something with the run."""
    tally, made = Tally("folders"), {}
    for name in ("measured", "simulated"):
        config = folder / f"whole_{name}.yaml"
        config.write_text(yaml.safe_dump(TINY_TASKS[name](folder), sort_keys=False))
        made[name] = (config, folder / f"whole_{name}")
        words = ("run", config, "--out", made[name][1], "--overwrite")
        ending = attempt(command(*words), folder / "error.txt", LIMIT)
        if ending.code:
            sys.exit(f"the undamaged run fails: {ending.error}")
    config, whole = made["measured"]
    run = folder / "damaged"
    for _ in range(count):
        shutil.rmtree(run, ignore_errors=True)
        shutil.copytree(whole, run)
        told = mutated_folder(run, [made["simulated"][1]], draw)
        verbs = _verbs(run, config, folder / "logs" / "log_5.csv")
        verb = draw.choice(sorted(verbs))
        if verb == "resume":
            # a finished run has nothing left to do
            for name in ("summary.json", "metrics.json"):
                if draw.random() < 0.5 and (run / name).is_file():
                    (run / name).unlink()
        ending = attempt(verbs[verb], folder / "error.txt", LIMIT)
        tally.add(f"{verb}, {told}", ending)
    return tally


@contextlib.contextmanager
def _place(given: Path | None) -> Iterator[Path]:
    """Yield a folder that is current meanwhile, where crash files go."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = (given or Path(temporary)).absolute()
        folder.mkdir(parents=True, exist_ok=True)
        with contextlib.chdir(folder):
            yield folder


def _warm_up(folder: Path) -> None:
    """Run once in this process, so that the forks find everything imported."""
    config = folder / "warm_up.yaml"
    config.write_text(yaml.safe_dump(measured(folder), sort_keys=False))
    with (
        Path(os.devnull).open("w") as nowhere,
        contextlib.suppress(SystemExit),
        contextlib.redirect_stdout(nowhere),
        contextlib.redirect_stderr(nowhere),
    ):
        command("run", config, "--out", folder / "warm_up", "--overwrite")()


def main() -> None:
    """Do what is asked for and print the tallies."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--tables", type=int, default=5000)
    parser.add_argument("--configs", type=int, default=2000)
    parser.add_argument("--folders", type=int, default=500)
    parser.add_argument("--tasks", nargs="*", default=list(TINY_TASKS), choices=list(TINY_TASKS))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    residnet.report.still.DPI = 20  # most of the time would go into the pictures
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    bad = 0
    with _place(given.out) as folder:
        _warm_up(folder)
        work: dict[str, Any] = {
            "tables": lambda draw: tables(given.tables, folder, draw),
            "configs": lambda draw: configs(given.configs, folder, draw, given.tasks),
            "folders": lambda draw: folders(given.folders, folder, draw),
        }
        for name, call in work.items():
            bad += call(random.Random(f"{name} {given.seed}")).close()
    sys.exit(1 if bad else 0)


if __name__ == "__main__":
    main()
