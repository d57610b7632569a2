"""Record results of a state of the project, and compare those of a later state with them.

    python scripts/ci/frozen.py make DIR        records the results of the present state
    python scripts/ci/frozen.py compare DIR     compares; exit code 1 if something differs

DIR contains the sample logs, so that both states read the same files; arrays and meta of all logs;
the findings of the data checks; metrics, summary and the text of the page of shortened runs; and
the exit codes of their exports, each of which checks its parity. `--only logs,doctor,runs,exports`
selects some of these.
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
LOG_TOLERANCE = 1e-12
"""Relative difference that is allowed in logs, which are only read."""
FIGURE_TOLERANCE = 1e-6
"""Relative difference that is allowed in figures, which are results of optimisers."""
MAX_SHOWN_DIFFERENCES = 8
"""Largest number of differences that are printed for one file."""


def run_residnet(*arguments: object) -> subprocess.CompletedProcess[str]:
    """Run the command line of residnet."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "COLUMNS": "200", "NO_COLOR": "1"}
    call = [sys.executable, "-m", "residnet", *map(str, arguments)]
    return subprocess.run(call, cwd=ROOT, env=environment, capture_output=True, text=True)


def write_samples(folder: Path) -> None:
    """Write a log in all formats that the project reads, and the logs of the demo."""
    import written_logs

    log = written_logs.trial()
    for module, names in SAMPLES.items():
        for name in names:
            (folder / name).mkdir(parents=True)
            getattr(__import__(module), name)(log, folder / name)
    run_residnet("demo", folder / "demo")


def iterate_samples(folder: Path) -> Iterator[tuple[str, Path]]:
    """Yield name and path of all sample logs: formats, the demo, and the cases of the field."""
    for sample in sorted(folder.iterdir()):
        if sample.name != "demo":
            yield from ((sample.name, path) for path in sorted(sample.iterdir())[:1])
    yield from (("demo", path) for path in sorted((folder / "demo").rglob("*.csv"))[:4])
    field = Path(os.environ.get("RESIDNET_DATA", "/nowhere")).parent / "field"
    yield from (("field", case) for case in sorted(field.glob("*/")))


def read_samples(folder: Path) -> Iterator[tuple[str, Any]]:
    """Read all samples in Python; yield arrays and meta, or the message of the error."""
    from residnet import ResidnetError, read_logs

    for name, path in iterate_samples(folder / "samples"):
        content: dict[str, Any] = {}
        try:
            for log in read_logs(str(path)):
                arrays = {"t": log.t, **log.channels, "masks": dict(log.masks)}
                meta = json.dumps([log.units, log.manoeuvre, log.meta], default=str, sort_keys=True)
                content[log.name] = {**arrays, "meta": json.loads(meta)}
        except ResidnetError as error:
            content["refused"] = str(error)
        yield f"{name} {path.name}", content


def inspect_samples(folder: Path) -> Iterator[tuple[str, Any]]:
    """Yield the output of `residnet inspect` for all samples."""
    for name, path in iterate_samples(folder / "samples"):
        completed = run_residnet("inspect", path)
        # progress lines depend on the load of the machine
        errors = "".join(line for line in completed.stderr.splitlines(True) if "so far" not in line)
        output = f"exit {completed.returncode}\n{completed.stdout}\n{errors}"
        text = output.replace(str(path), "PATH")
        yield f"{name} {path.name}", text.splitlines()


def extract_page_text(page: str) -> list[str]:
    """Return the lines of text of a page without numbers and folders, in alphabetical order."""
    text = re.sub(r"(?s)<(script|style)\b.*?</\1>|<[^>]+>", "\n", page)
    # the folder of this checkout, which a page may break after a slash; revisions and checksums
    text = re.sub("/ ?".join(map(re.escape, str(ROOT).split("/"))), "", text)
    text = re.sub(r"\b[0-9a-f]{12,64}\b|[-+]?\d[\d.,e+-]*", "#", text)
    return sorted({" ".join(line.split()) for line in text.splitlines() if len(line) > 12})


def run_short_configs(folder: Path) -> Iterator[tuple[str, Any]]:
    """Run shortened configs; yield metrics, summary and the text of their pages."""
    from short_configs import shorten_config

    for name in RUNS:
        run = folder / "runs" / name.replace("/", "_")
        overrides = [
            override.replace("{runs}", str(folder / "runs"))
            for override in shorten_config(name).overrides
        ]
        arguments = ["run", ROOT / "configs" / f"{name}.yaml", "--out", run, "--overwrite"]
        completed = run_residnet(*arguments, *(part for o in overrides for part in ("-s", o)))
        print(f"  {name}: exit {completed.returncode}", flush=True)
        content: dict[str, Any] = {"said": completed.stderr[-2000:]} if completed.returncode else {}
        for file in ("metrics.json", "summary.json"):
            if (run / file).is_file():
                content[file.removesuffix(".json")] = json.loads((run / file).read_text())
        if (run / "report.html").is_file():
            content["page"] = extract_page_text((run / "report.html").read_text())
        yield name, content


def export_models(folder: Path) -> Iterator[tuple[str, Any]]:
    """Export models of the shortened runs in all formats; yield the exit codes."""
    for file_format in FORMATS:
        for run, model in EXPORTED:
            with tempfile.TemporaryDirectory() as scratch:
                file = Path(scratch) / ("model.pt" if file_format == "torchscript" else "model")
                options = ("--model", model, "--format", file_format, "--out", file)
                completed = run_residnet("export", folder / "runs" / run, *options)
            print(f"  {file_format} {run} {model}: exit {completed.returncode}", flush=True)
            yield f"{file_format} {run} {model}", completed.returncode


def find_differences(old: Any, new: Any, tolerance: float, path: str = "") -> Iterator[str]:
    """Yield the keys at which two values differ by more than a tolerance, but `VOLATILE` ones."""
    if isinstance(old, dict) and isinstance(new, dict):
        for key in sorted({*old, *new}, key=str):
            if VOLATILE.search(str(key)):
                continue
            if key not in old or key not in new:
                yield f"{path}.{key}: only in the {'new' if key not in old else 'old'} state"
            else:
                yield from find_differences(old[key], new[key], tolerance, f"{path}.{key}")
    elif isinstance(old, list) and isinstance(new, list):
        yield from compare_lists(old, new, tolerance, path)
    elif isinstance(old, np.ndarray | int | float) and type(old) is type(new):
        yield from compare_numbers(old, new, tolerance, path)
    elif old != new:
        yield f"{path}: {str(old)[:160]!r}, now {str(new)[:160]!r}"


def compare_lists(old: list[Any], new: list[Any], tolerance: float, path: str) -> Iterator[str]:
    """Yield the lines that only one of two texts has, or the differences of other lists."""
    if all(isinstance(line, str) for line in (*old, *new)):
        yield from (f"{path}: gone: {line[:200]}" for line in old if line not in new)
        yield from (f"{path}: new:  {line[:200]}" for line in new if line not in old)
    elif all(isinstance(number, int | float) for number in (*old, *new)):
        yield from find_differences(np.array(old), np.array(new), tolerance, path)
    else:
        yield from find_differences(dict(enumerate(old)), dict(enumerate(new)), tolerance, path)


def compare_numbers(old: Any, new: Any, tolerance: float, path: str) -> Iterator[str]:
    """Yield the largest difference of two numbers or arrays if it exceeds the tolerance."""
    a = np.asarray(old, dtype=float)
    b = np.asarray(new, dtype=float)
    if a.shape != b.shape:
        yield f"{path}: shape {a.shape}, now {b.shape}"
    elif not np.allclose(a, b, rtol=tolerance, atol=tolerance, equal_nan=True):
        difference = np.nanmax(np.abs(a - b))
        yield f"{path}: differs by up to {difference:.3g}" + f" ({old!r})" * (a.ndim == 0)


PARTS = {
    "logs": read_samples,
    "doctor": inspect_samples,
    "runs": run_short_configs,
    "exports": export_models,
}
"""Functions that compute the recorded results of the folder, by name."""


def main() -> int:
    """Record or compare results; return 1 if something differs."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("verb", choices=("make", "compare"))
    parser.add_argument("folder", type=Path)
    parser.add_argument("--only", default=",".join(PARTS), help="results, separated by commas")
    arguments = parser.parse_args()
    folder = arguments.folder.resolve()
    n_differences = 0
    if not (folder / "samples").is_dir():
        write_samples(folder / "samples")
    for part in arguments.only.split(","):
        print(part, flush=True)
        file = folder / f"{part}.json"
        text = json.dumps(dict(PARTS[part](folder)), default=np.ndarray.tolist)
        if arguments.verb == "make":
            file.write_text(text)
            continue
        recorded = json.loads(file.read_text())
        current = json.loads(text)
        for name in sorted({*recorded, *current}):
            tolerance = LOG_TOLERANCE if part == "logs" else FIGURE_TOLERANCE
            lines = list(find_differences(recorded.get(name), current.get(name), tolerance))
            n_differences += len(lines)
            for line in lines[:MAX_SHOWN_DIFFERENCES]:
                print(f"  {part}, {name}{line}")
            if len(lines) > MAX_SHOWN_DIFFERENCES:
                print(f"  {part}, {name}: and {len(lines) - MAX_SHOWN_DIFFERENCES} more")
    if arguments.verb == "compare":
        print(f"{n_differences} differences")
    return int(n_differences > 0)


if __name__ == "__main__":
    sys.exit(main())
