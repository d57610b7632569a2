"""Keep what must not change, and compare a later state of the project with it.

    python scripts/ci/frozen.py make DIR        at the state to compare with
    python scripts/ci/frozen.py compare DIR     at a later one: exit 1 where something differs

DIR holds the sample logs themselves, so that both states read the same files; arrays and meta of
every log; what the doctor says; metrics, summary and the words of the page of shortened runs; and
how their exports end, each of which checks its parity. `--only logs,doctor,runs,exports` takes a
part.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT / "tests" / "support"), str(ROOT / "scripts" / "ci")]

RUNS = (
    *("quickstart", "wam_v_equations", "kvlcc2", "esso_osaka", "autopilot_conditions"),
    *("simulate_wam_v", "autopilot_nomoto", "sweep_quickstart", "studies/jervan2020/case"),
    *("studies/halvorsen2019/force_equations", "studies/gouletas2020/table_6_3"),
)
FORMATS = ("torchscript", "onnx", "c", "casadi", "fmu2", "parameters")
EXPORTED = (
    *(("quickstart", model) for model in ("baseline", "mlp", "lstm")),
    ("autopilot_conditions", "learned"),
)
SAMPLES = {
    "written_logs": (
        *("csv", "parquet", "json_lines", "excel", "mat5", "mat73", "hdf5", "hdf5_table"),
        *("topics", "bag1", "bag2", "bag2_mcap", "mcap"),
    ),
    "written_recorders": ("nmea", "ulog", "ardupilot"),
}
VOLATILE = re.compile(
    r"seconds|elapsed|started|finished_at|created|time_|_time|version|revision|path|folder|sha256"
    r"|peak|memory|python|machine|command|run$|id$|file"
)
"""Keys that differ between two runs of one state."""
LOGS = 1e-12
FIGURES = 1e-6
SHOWN = 8
"""Relative differences allowed in logs, which are read, and in figures, which go through
optimisers; and how many of a file are shown."""


def residnet(*words: object) -> subprocess.CompletedProcess[str]:
    """Give the command line some words."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "COLUMNS": "200", "NO_COLOR": "1"}
    call = [sys.executable, "-m", "residnet", *map(str, words)]
    return subprocess.run(call, cwd=ROOT, env=environment, capture_output=True, text=True)


def samples(folder: Path) -> None:
    """Write a log in every format that the project reads, and those of the demo."""
    import written_logs

    log = written_logs.trial()
    for module, names in SAMPLES.items():
        for name in names:
            (folder / name).mkdir(parents=True)
            getattr(__import__(module), name)(log, folder / name)
    residnet("demo", folder / "demo")


def recordings(folder: Path) -> Iterator[tuple[str, Path]]:
    """Yield what to read: each file or folder of a sample, the demo's files, the field's cases."""
    for sample in sorted(folder.iterdir()):
        if sample.name != "demo":
            yield from ((sample.name, path) for path in sorted(sample.iterdir())[:1])
    yield from (("demo", path) for path in sorted((folder / "demo").rglob("*.csv"))[:4])
    field = Path(os.environ.get("RESIDNET_DATA", "/nowhere")).parent / "field"
    yield from (("field", case) for case in sorted(field.glob("*/")))


def logs(kept: Path) -> Iterator[tuple[str, Any]]:
    """Read every sample from Python; yield arrays and meta, or the words of the refusal."""
    from residnet import ResidnetError, read_logs

    for name, path in recordings(kept / "samples"):
        content: dict[str, Any] = {}
        try:
            for log in read_logs(str(path)):
                arrays = {"t": log.t, **log.channels, "masks": dict(log.masks)}
                meta = json.dumps([log.units, log.manoeuvre, log.meta], default=str, sort_keys=True)
                content[log.name] = {**arrays, "meta": json.loads(meta)}
        except ResidnetError as error:
            content["refused"] = str(error)
        yield f"{name} {path.name}", content


def doctor(kept: Path) -> Iterator[tuple[str, Any]]:
    """Yield what `inspect` prints of every sample."""
    for name, path in recordings(kept / "samples"):
        done = residnet("inspect", path)
        said = "".join(line for line in done.stderr.splitlines(True) if "so far" not in line)
        text = f"exit {done.returncode}\n{done.stdout}\n{said}".replace(str(path), "PATH")
        yield f"{name} {path.name}", text.splitlines()


def page_words(page: str) -> list[str]:
    """Return the pieces of text of a page, numbers and folders masked, in alphabetical order."""
    text = re.sub(r"(?s)<(script|style)\b.*?</\1>|<[^>]+>", "\n", page)
    # this state's folder, which a page may break after any slash, then revisions and checksums
    text = re.sub("/ ?".join(map(re.escape, str(ROOT).split("/"))), "", text)
    text = re.sub(r"\b[0-9a-f]{12,64}\b|[-+]?\d[\d.,e+-]*", "#", text)
    return sorted({" ".join(line.split()) for line in text.splitlines() if len(line) > 12})


def runs(kept: Path) -> Iterator[tuple[str, Any]]:
    """Carry out shortened runs; yield metrics, summary and the words of their pages."""
    from short_configs import SHORT

    for name in RUNS:
        folder = kept / "runs" / name.replace("/", "_")
        overrides = [one.replace("{runs}", str(kept / "runs")) for one in SHORT[name].overrides]
        words = ["run", ROOT / "configs" / f"{name}.yaml", "--out", folder, "--overwrite"]
        done = residnet(*words, *(word for one in overrides for word in ("-s", one)))
        print(f"  {name}: exit {done.returncode}", flush=True)
        content: dict[str, Any] = {"said": done.stderr[-2000:]} if done.returncode else {}
        for file in ("metrics.json", "summary.json"):
            if (folder / file).is_file():
                content[file.removesuffix(".json")] = json.loads((folder / file).read_text())
        if (folder / "report.html").is_file():
            content["page"] = page_words((folder / "report.html").read_text())
        yield name, content


def exports(kept: Path) -> Iterator[tuple[str, Any]]:
    """Export models of the shortened runs in every format, whose parity each export checks."""
    for kind in FORMATS:
        for run, model in EXPORTED:
            with tempfile.TemporaryDirectory() as scratch:
                file = Path(scratch) / ("model.pt" if kind == "torchscript" else "model")
                words = ("--model", model, "--format", kind, "--out", file)
                done = residnet("export", kept / "runs" / run, *words)
            print(f"  {kind} {run} {model}: exit {done.returncode}", flush=True)
            yield f"{kind} {run} {model}", done.returncode


def differences(old: Any, new: Any, tolerance: float, where: str = "") -> Iterator[str]:
    """Yield where two values differ by more than the tolerance, volatile keys apart."""
    if isinstance(old, dict) and isinstance(new, dict):
        for key in sorted({*old, *new}, key=str):
            if VOLATILE.search(str(key)):
                continue
            if key not in old or key not in new:
                yield f"{where}.{key}: only in the {'new' if key not in old else 'old'} state"
            else:
                yield from differences(old[key], new[key], tolerance, f"{where}.{key}")
    elif isinstance(old, list) and isinstance(new, list):
        yield from list_differences(old, new, tolerance, where)
    elif isinstance(old, np.ndarray | int | float) and type(old) is type(new):
        yield from number_differences(old, new, tolerance, where)
    elif old != new:
        yield f"{where}: {str(old)[:160]!r}, now {str(new)[:160]!r}"


def list_differences(old: list[Any], new: list[Any], tolerance: float, where: str) -> Iterator[str]:
    """Yield the lines that only one of two texts has, or the differences of other lists."""
    if all(isinstance(line, str) for line in (*old, *new)):
        yield from (f"{where}: gone: {line[:200]}" for line in old if line not in new)
        yield from (f"{where}: new:  {line[:200]}" for line in new if line not in old)
    elif all(isinstance(number, int | float) for number in (*old, *new)):
        yield from differences(np.array(old), np.array(new), tolerance, where)
    else:
        yield from differences(dict(enumerate(old)), dict(enumerate(new)), tolerance, where)


def number_differences(old: Any, new: Any, tolerance: float, where: str) -> Iterator[str]:
    """Yield the largest difference of two numbers or arrays if it exceeds the tolerance."""
    a = np.asarray(old, dtype=float)
    b = np.asarray(new, dtype=float)
    if a.shape != b.shape:
        yield f"{where}: shape {a.shape}, now {b.shape}"
    elif not np.allclose(a, b, rtol=tolerance, atol=tolerance, equal_nan=True):
        difference = np.nanmax(np.abs(a - b))
        yield f"{where}: differs by up to {difference:.3g}" + f" ({old!r})" * (a.ndim == 0)


PARTS = {"logs": logs, "doctor": doctor, "runs": runs, "exports": exports}


def main() -> int:
    """Make or compare; returns 1 where something differs."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("verb", choices=("make", "compare"))
    parser.add_argument("folder", type=Path)
    parser.add_argument("--only", default=",".join(PARTS), help="parts, with commas between")
    given = parser.parse_args()
    kept = given.folder.resolve()
    total = 0
    if not (kept / "samples").is_dir():
        samples(kept / "samples")
    for part in given.only.split(","):
        print(part, flush=True)
        file = kept / f"{part}.json"
        text = json.dumps(dict(PARTS[part](kept)), default=np.ndarray.tolist)
        if given.verb == "make":
            file.write_text(text)
            continue
        before = json.loads(file.read_text())
        found = json.loads(text)
        for name in sorted({*before, *found}):
            tolerance = LOGS if part == "logs" else FIGURES
            told = list(differences(before.get(name), found.get(name), tolerance))
            total += len(told)
            for line in told[:SHOWN]:
                print(f"  {part}, {name}{line}")
            if len(told) > SHOWN:
                print(f"  {part}, {name}: and {len(told) - SHOWN} more")
    if given.verb == "compare":
        print(f"{total} differences")
    return int(total > 0)


if __name__ == "__main__":
    sys.exit(main())
