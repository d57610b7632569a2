"""Keep what must not change, and compare a later state of the project with it.

    python scripts/ci/frozen.py make DIR        at the state to compare with
    python scripts/ci/frozen.py compare DIR     at a later one: exit 1 where something differs

DIR holds the sample logs themselves, so that both states read the same files; arrays and meta of
every log; what the doctor says; metrics, summary and the words of the page of shortened runs; and
the tracks of exported models. `--only logs,doctor,runs,exports` takes a part.
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

RUNS: dict[str, tuple[str, ...]] = {
    "quickstart": (),
    "wam_v_equations": (),
    "kvlcc2": (),
    # the tanker's physics, refitted, without its networks
    "esso_osaka": (
        "heads={}",
        "training={}",
        "base_of={}",
        "ensembles={}",
        "export.models=[]",
        "evaluation.splits=[validation, test]",
        "bands=null",
    ),
    "studies/jervan2020/case": (),
    "studies/halvorsen2019/force_equations": (),
    "autopilot_conditions": (),
    "simulate_wam_v": (),
    "autopilot_nomoto": (),
    "studies/gouletas2020/table_6_3": (),
    "sweep_quickstart": (),
}
"""Config -> overrides in place of those of its short form; none: its short form as it is."""
FORMATS = ("torchscript", "onnx", "c", "casadi", "fmu", "parameters")
VOLATILE = re.compile(
    r"seconds|elapsed|started|finished_at|created|time_|_time|version|revision|path|folder|sha256"
    r"|peak|memory|python|machine|command|run$|id$|file"
)
"""Keys that differ between two runs of one state."""
LOGS, WORDS, FIGURES = 1e-12, 0.0, 1e-6
"""Relative differences allowed: arrays of logs are read, figures of runs go through optimisers."""


def python(*arguments: str, cwd: Path = ROOT) -> subprocess.CompletedProcess[str]:
    """Run this Python on the project's command line."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "COLUMNS": "200", "NO_COLOR": "1"}
    return subprocess.run(
        [sys.executable, *arguments], cwd=cwd, env=environment, capture_output=True, text=True
    )


def samples(folder: Path) -> None:
    """Write a log in every format that the project reads, and those of the demo."""
    import written_logs
    import written_recorders

    log = written_logs.trial()
    for module in (written_logs, written_recorders):
        for name in SAMPLES[module.__name__]:
            place = folder / name
            place.mkdir(parents=True)
            getattr(module, name)(log, place)
    python("-m", "residnet.cli", "demo", str(folder / "demo"))


SAMPLES = {
    "written_logs": (
        *("csv", "parquet", "json_lines", "excel", "mat5", "mat73", "hdf5", "hdf5_table"),
        *("topics", "bag1", "bag2", "bag2_mcap", "mcap"),
    ),
    "written_recorders": ("nmea", "ulog", "ardupilot"),
}


def recordings(folder: Path) -> Iterator[Path]:
    """Yield what to read: each file or folder of a sample, the demo's files, the field's cases."""
    for sample in sorted(folder.iterdir()):
        if sample.name != "demo":
            yield from sorted(sample.iterdir())[:1]
    yield from sorted((folder / "demo").rglob("*.csv"))[:4]
    field = os.environ.get("RESIDNET_DATA")
    for case in sorted((Path(field).parent / "field").glob("*")) if field else ():
        if case.is_dir():
            yield case


def logs(out: Path, kept: Path) -> None:
    """Read every sample from Python; keep arrays and meta, or the words of the refusal."""
    import residnet

    for number, path in enumerate(recordings(kept / "samples")):
        name = f"{number:02d}_{path.parent.name}_{path.name}"
        try:
            found = residnet.read_logs(str(path))
        except residnet.ResidnetError as error:
            (out / f"{name}.json").write_text(json.dumps({"error": str(error)}))
            continue
        arrays: dict[str, np.ndarray] = {}
        meta = {}
        for log in found:
            arrays[f"{log.name}:t"] = log.t
            arrays |= {f"{log.name}:{key}": values for key, values in log.channels.items()}
            arrays |= {f"{log.name}:mask:{key}": mask for key, mask in log.masks.items()}
            meta[log.name] = {"units": log.units, "manoeuvre": log.manoeuvre, "meta": log.meta}
        np.savez_compressed(out / f"{name}.npz", **arrays)
        (out / f"{name}.json").write_text(json.dumps(meta, default=str, sort_keys=True))


def doctor(out: Path, kept: Path) -> None:
    """Keep what `inspect` prints of every sample."""
    for number, path in enumerate(recordings(kept / "samples")):
        done = python("-m", "residnet.cli", "inspect", str(path))
        said = "".join(line for line in done.stderr.splitlines(True) if "so far" not in line)
        text = f"exit {done.returncode}\n{done.stdout}\n{said}".replace(str(path), "PATH")
        (out / f"{number:02d}_{path.parent.name}_{path.name}.txt").write_text(text)


def page_words(page: str) -> list[str]:
    """Return the sentences of a page, numbers and folders masked, in alphabetical order."""
    page = re.sub(r"<(script|style)\b.*?</\1>", " ", page, flags=re.DOTALL)
    blocks = re.split(
        r"</?(?:p|li|td|th|tr|h\d|figcaption|div|summary|caption|table)\b[^>]*>", page
    )
    words = (" ".join(re.sub(r"<[^>]+>", " ", block).split()) for block in blocks)
    # revisions and checksums, then this state's folder, which a page may break after any slash
    masked = (re.sub(r"\b[0-9a-f]{12,64}\b", "#", text) for text in words if len(text) > 12)
    here = re.compile("/ ?".join(map(re.escape, str(ROOT).split("/"))))
    return sorted({re.sub(r"[-+]?\d[\d.,e+-]*", "#", here.sub("", text)) for text in masked})


def runs(out: Path, kept: Path) -> None:
    """Carry out shortened runs; keep metrics, summary and the words of their pages."""
    import short_configs

    place = out.parent / "runs_whole"
    for name, overrides in RUNS.items():
        short = short_configs.SHORT.get(name)
        folder = place / name.replace("/", "_")
        given = overrides or (short.overrides if short else ())
        command = ["-m", "residnet.cli", "run", str(ROOT / "configs" / f"{name}.yaml")]
        command += ["--out", str(folder), "--overwrite"]
        for override in given:
            command += ["-s", override.replace("{runs}", str(place))]
        done = python(*command)
        key = name.replace("/", "_")
        print(f"  {name}: exit {done.returncode}", flush=True)
        if done.returncode:
            (out / f"{key}.failed.json").write_text(json.dumps(done.stderr[-2000:]))
            continue
        for file in ("metrics.json", "summary.json"):
            if (folder / file).is_file():
                (out / f"{key}.{file}").write_text((folder / file).read_text())
        words = page_words((folder / "report.html").read_text())
        (out / f"{key}.page.txt").write_text("\n".join(words))


def exports(out: Path, kept: Path) -> None:
    """Export models of the shortened runs in every format, whose parity each export checks.

    Tracks are those of TorchScript: 20 s under inputs that stand at half.
    """
    whole = out.parent / "runs_whole"
    for kind in FORMATS:
        for run, model in EXPORTED:
            key = f"{kind}_{run}_{model}"
            with tempfile.TemporaryDirectory() as scratch:
                file = Path(scratch) / ("model.pt" if kind == "torchscript" else "model")
                done = python(
                    *("-m", "residnet.cli", "export", str(whole / run), "--model", model),
                    *("--format", kind, "--out", str(file)),
                )
                (out / f"{key}.json").write_text(json.dumps({"exit": done.returncode}))
                print(f"  {key}: exit {done.returncode}", flush=True)
                if kind == "torchscript" and run == "quickstart" and not done.returncode:
                    np.savez_compressed(out / f"track_{model}.npz", track=track(file))


EXPORTED = (
    *(("quickstart", model) for model in ("baseline", "mlp", "lstm")),
    ("autopilot_conditions", "learned"),
)


def track(file: Path) -> np.ndarray:
    """Return 200 steps of states [T, nx] of an exported model of two inputs."""
    import torch

    module = torch.jit.load(str(file))
    x, w = torch.zeros(1, 6), torch.full((1, 200, 2), 0.5)
    return module.rollout(x, w, module.initial_state(1))[0].numpy()


def differences(old: Any, new: Any, tolerance: float, where: str = "") -> Iterator[str]:
    """Yield where two JSON values differ by more than the tolerance, volatile keys apart."""
    if isinstance(old, dict) and isinstance(new, dict):
        for key in sorted({*old, *new}, key=str):
            if VOLATILE.search(str(key)):
                continue
            if key not in old or key not in new:
                yield f"{where}.{key}: only in the {'new' if key not in old else 'old'} state"
            else:
                yield from differences(old[key], new[key], tolerance, f"{where}.{key}")
    elif isinstance(old, list) and isinstance(new, list):
        if len(old) != len(new):
            yield f"{where}: {len(old)} entries, now {len(new)}"
        for index, (left, right) in enumerate(zip(old, new, strict=False)):
            yield from differences(left, right, tolerance, f"{where}[{index}]")
    elif isinstance(old, int | float) and isinstance(new, int | float):
        if abs(old - new) > tolerance * max(1.0, abs(old)):
            yield f"{where}: {old:.9g}, now {new:.9g}"
    elif old != new:
        yield f"{where}: {str(old)[:160]!r}, now {str(new)[:160]!r}"


def compared(old: Path, new: Path, part: str) -> Iterator[str]:
    """Yield what differs between a kept file and its successor."""
    if old.suffix == ".npz":
        before, after = np.load(old), np.load(new)
        tolerance = LOGS if part == "logs" else FIGURES
        for name in sorted({*before.files, *after.files}):
            if name not in before.files or name not in after.files:
                yield f"{name}: only in the {'new' if name not in before.files else 'old'} state"
            elif before[name].shape != after[name].shape:
                yield f"{name}: shape {before[name].shape}, now {after[name].shape}"
            else:
                a, b = before[name].astype(float), after[name].astype(float)
                if not np.allclose(a, b, rtol=tolerance, atol=tolerance, equal_nan=True):
                    yield f"{name}: differs by up to {np.nanmax(np.abs(a - b)):.3g}"
    elif old.suffix == ".json":
        yield from differences(json.loads(old.read_text()), json.loads(new.read_text()), FIGURES)
    else:
        before_lines, after_lines = old.read_text().splitlines(), new.read_text().splitlines()
        for line in before_lines:
            if line not in after_lines:
                yield f"gone: {line[:200]}"
        for line in after_lines:
            if line not in before_lines:
                yield f"new:  {line[:200]}"


PARTS = {"logs": logs, "doctor": doctor, "runs": runs, "exports": exports}


def main() -> int:
    """Make or compare; returns 1 where something differs."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("verb", choices=("make", "compare"))
    parser.add_argument("folder", type=Path)
    parser.add_argument("--only", default=",".join(PARTS), help="parts, with commas between")
    parser.add_argument("--most", type=int, default=8, help="differences shown of a file")
    given = parser.parse_args()
    kept: Path = given.folder.resolve()
    if given.verb == "make" and not (kept / "samples").is_dir():
        samples(kept / "samples")
    total = 0
    for part in given.only.split(","):
        print(part, flush=True)
        out = kept / ("old" if given.verb == "make" else "new") / part
        out.mkdir(parents=True, exist_ok=True)
        PARTS[part](out, kept)
        if given.verb == "make":
            continue
        old = kept / "old" / part
        for name in sorted({path.name for path in (*old.iterdir(), *out.iterdir())}):
            if not (old / name).is_file() or not (out / name).is_file():
                found = [f"only in the {'new' if not (old / name).is_file() else 'old'} state"]
            else:
                found = list(compared(old / name, out / name, part))
            total += len(found)
            for line in found[: given.most]:
                print(f"  {part}/{name}: {line}")
            if len(found) > given.most:
                print(f"  {part}/{name}: and {len(found) - given.most} more")
    if given.verb == "compare":
        print(f"{total} differences")
    return int(total > 0)


if __name__ == "__main__":
    sys.exit(main())
