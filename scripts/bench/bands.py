"""How bands hold: coverage by channel and kind, and scores beside a band fitted in hindsight.

Of a finished run, or of what `residnet evaluate` wrote, the selected model's bands are judged on
the stored free runs. With `--cross`, all logs of a config are divided into folds instead: each is
judged with bands of a fit that has seen none of it. With `--kinds` a fold is all logs of a kind of
manoeuvre, so that no band was calibrated on the kind that judges it. With `--alone`, models that
the judged one does not stand on are left out of these fits: networks take most of the time.

    python scripts/bench/bands.py RUN [--split test]
    python scripts/bench/bands.py --cross CONFIG [--model physics] [--alone] [--folds 5] [--kinds]
        [-s K=V]
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from residnet.core.files import read_table
from residnet.core.layout import PLANAR, POSITION
from residnet.core.names import STATE
from residnet.identification.bands import fold_numbers
from residnet.identification.fit import fit
from residnet.identification.identified import unlike_models
from residnet.identification.prepared import prepare_logs
from residnet.judge.band import Band, covered, interval_score, read_bands, worst
from residnet.judge.bands import RunErrors, calibrate, run_errors
from residnet.judge.freerun import spread_of
from residnet.runs.folder import RunFolder
from residnet.runs.model_store import FolderStore
from residnet.tasks.fit import FitConfig
from residnet.tasks.registry import load_task

Judged = tuple[RunErrors, Band]


def stored(run: Path, split: str, model: str, bands: dict[str, Band]) -> dict[str, list[Judged]]:
    """Return the stored free runs of one model with their bands, by protocol."""
    manoeuvres = {
        entry["log"]: entry["manoeuvre"]
        for entry in json.loads((run / "data_quality.json").read_text())
    }
    out: dict[str, list[Judged]] = {}
    store = FolderStore(RunFolder(run))
    unlike = unlike_models(map(store.load, store.names()))
    for file in sorted((run / "rollouts" / split).glob("*.parquet")):
        for (protocol, _), every in read_table(file).groupby(["protocol", "window"]):
            of = dict(iter(every.groupby("model")))
            part, predicted = of[model], [f"{name}_hat" for name in STATE]
            states = part[predicted].to_numpy(float)
            beside = [of[name][predicted].to_numpy(float) for name in unlike]
            spread = spread_of(beside) if len(beside) > 1 else None
            apart = (states - part[list(STATE)].to_numpy(float))[1:]
            error = np.abs(apart[:, [3, 4, 5, 2, 0]])
            error[:, 4] = np.hypot(*apart[:, POSITION].T)
            error[np.ix_(~part["usable"].to_numpy(bool)[1:], [0, 1, 4])] = np.nan
            given = RunErrors(file.stem, manoeuvres[file.stem], error, states, spread)
            out.setdefault(str(protocol), []).append((given, bands[str(protocol)]))
    return out


def alone(config: FitConfig, model: str) -> list[str]:
    """Return overrides that leave out all models of a config that one does not stand on.

    Args:
        config: of a fit.
        model: one of its baselines or heads.

    Raises:
        ValueError: where the model is neither.
    """
    if model not in ("baseline", *config.baselines, *config.heads):
        raise ValueError(f"{model} is no baseline or head of the config")
    needed = {model, config.baseline_name_of(model) if model in config.heads else model}
    out = ["~ensembles"] if config.ensembles else []
    for key in ("heads", "base_of", "training", "baselines", "refit"):
        given = getattr(config, key)
        unused = [name for name in given if name not in needed]
        out += [f"~{key}"] if len(unused) == len(given) > 0 else [f"~{key}.{n}" for n in unused]
    return out


def crossed(
    config: FitConfig, model: str, folds: int, seed: int, by_kind: bool
) -> dict[str, list[Judged]]:
    """Return free runs over all logs of a config with bands of fits that have not seen them."""
    prepared = prepare_logs(config.logs(), config)
    logs = [log for members in prepared.values() for log in members]
    kinds = [log.log.manoeuvre for log in logs]
    number = fold_numbers(kinds, folds, seed)
    if by_kind:
        number = np.unique(kinds, return_inverse=True)[1]
    out: dict[str, list[Judged]] = {}
    for k in range(int(number.max()) + 1):
        others = [log for log, own in zip(logs, number, strict=True) if own != k]
        # every fifth of the others chooses and calibrates, as validation logs do
        inner = fold_numbers([log.log.manoeuvre for log in others], 5, seed + 1)
        parts = {
            "train": [log for log, own in zip(others, inner, strict=True) if own != 0],
            "validation": [log for log, own in zip(others, inner, strict=True) if own == 0],
        }
        held = [log for log, own in zip(logs, number, strict=True) if own == k]
        identified = fit(parts, config)
        judged = identified.evaluate({"test": held})["test"]
        for run in judged.runs:
            found = run_errors(run.windows, run.predictions[model], held)
            band = identified[model].bands[run.protocol]
            out.setdefault(run.protocol, []).extend((own, band) for own in found)
        print(f"fold {k + 1}: {len(held)} logs", flush=True)
    return out


def show(protocol: str, judged: Sequence[Judged]) -> None:
    """Print coverage by kind and channel, and scores beside those of a band fitted in hindsight."""
    runs = [run for run, _ in judged]
    first = judged[0][1]
    widths = [run.within(band) for run, band in judged]
    whole = np.stack(
        [
            worst([run.error], [width])[0] <= band.whole
            for (run, band), width in zip(judged, widths, strict=True)
        ]
    )
    print(f"\n{protocol}: {len(runs)} runs of {len({run.log for run in runs})} logs")
    print(
        f"{'':12s}{'runs':>5s}"
        + "".join(f"{name:>10s}" for name in (*PLANAR.banded, "mean", "whole"))
    )
    for kind in ("all", *sorted({run.manoeuvre for run in runs})):
        chosen = [i for i, run in enumerate(runs) if kind in ("all", run.manoeuvre)]
        held = np.concatenate([covered(runs[i].error, widths[i]) for i in chosen])
        share = np.nanmean(held, axis=0)
        cells = [*share, share.mean(), whole[chosen].mean()]
        print(f"{kind:12s}{len(chosen):5d}" + "".join(f"{cell:10.3f}" for cell in cells))
    own = _score(runs, widths, first.level)
    after = calibrate(runs, first.level, first.step, first.unit)
    peers = {
        "one width": [np.broadcast_to(band.constant, run.error.shape) for run, band in judged],
        "hindsight": [after.tabled(after.plain, len(run)) for run in runs],
    }
    for name, given in peers.items():
        ratio = own / _score(runs, given, first.level)
        cells = [*ratio, ratio.mean()]
        print(f"score over that of {name:12s}" + "".join(f"{cell:8.3f}" for cell in cells))


def _score(runs: Sequence[RunErrors], widths: Sequence[np.ndarray], level: float) -> np.ndarray:
    scores = [
        interval_score(run.error, width, level) for run, width in zip(runs, widths, strict=True)
    ]
    return np.asarray(np.nanmean(np.concatenate(scores), axis=0))


def main() -> None:
    """Read the command line, and print a table for each protocol."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("run", type=Path, nargs="?")
    parser.add_argument("--split", default="test")
    parser.add_argument("--cross", type=Path)
    parser.add_argument("--model")
    parser.add_argument("--alone", action="store_true")
    parser.add_argument("--folds", type=int, default=5)
    parser.add_argument("--kinds", action="store_true")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("-s", dest="overrides", action="append", default=[])
    given = parser.parse_args()
    torch.set_num_threads(1)
    if given.cross is not None:
        config = load_task(given.cross, given.overrides)
        assert isinstance(config, FitConfig)
        if given.alone:
            left_out = alone(config, given.model or "baseline")
            config = load_task(given.cross, [*given.overrides, *left_out])
            assert isinstance(config, FitConfig)
        found = crossed(config, given.model or "baseline", given.folds, given.seed, given.kinds)
    else:
        metrics = json.loads((given.run / "metrics.json").read_text())
        model = given.model or metrics["selected"]
        bands = read_bands(json.loads((given.run / "bands.json").read_text()))[model]
        print(f"model {model}")
        found = stored(given.run, given.split, model, bands)
    for protocol, judged in found.items():
        show(protocol, judged)


if __name__ == "__main__":
    main()
