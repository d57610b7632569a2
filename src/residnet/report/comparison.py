"""Variants of one recipe compared over the same windows: several seeds, paired intervals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from residnet.core.errors import DataError
from residnet.core.names import VELOCITY
from residnet.judge.bootstrap import Blocks, blocks, intervals
from residnet.report.run_reader import RunFiles


@dataclass(frozen=True)
class WindowErrors:
    """The NRMSE of one model by window, mean over u, v, r.

    Attributes:
        keys: (log, number of the window), [W].
        values: [W]; a window that diverged has the error of `zero`.
        diverged: whether each did, [W].
    """

    keys: tuple[tuple[str, int], ...]
    values: np.ndarray
    diverged: np.ndarray


def window_nrmse(run: Path, model: str, split: str) -> dict[str, WindowErrors]:
    """Return the errors of one model of a finished run by protocol, from its stored rollouts.

    Args:
        run: run folder.
        model: name of a model, `selected` for the one chosen on validation data.
        split: whose windows.

    Raises:
        DataError: where the run holds no such model or split.
    """
    files = RunFiles(run)
    name = files.selected if model == "selected" else model
    scales = np.array([float(files.metrics["scales"][channel]) for channel in VELOCITY])
    found: dict[str, list[tuple[tuple[str, int], float, bool]]] = {}
    for window in files.windows(split):
        if name not in window.predicted:
            raise DataError(f"{run}: no model '{name}' among {', '.join(window.predicted)}")
        error, lost = float((window.rmse(name) / scales).mean()), window.diverged[name]
        found.setdefault(window.protocol, []).append(((window.log, window.number), error, lost))
    if not found:
        raise DataError(f"{run}: no rollouts of the split '{split}'")
    return {
        protocol: WindowErrors(
            tuple(key for key, _, _ in entries),
            np.array([error for _, error, _ in entries]),
            np.array([lost for _, _, lost in entries]),
        )
        for protocol, entries in found.items()
    }


@dataclass(frozen=True)
class Variant:
    """A variant of a recipe with its errors.

    Attributes:
        name: of the variant.
        overrides: of the recipe's config.
        errors: [S, W] by protocol, NRMSE for S seeds over W windows.
        seconds: that the runs took, [S].
        diverged: number of windows that diverged, of all seeds together, by protocol.
    """

    name: str
    overrides: tuple[str, ...]
    errors: Mapping[str, np.ndarray]
    seconds: tuple[float, ...]
    diverged: Mapping[str, int] = field(default_factory=dict)


def table(
    variants: Sequence[Variant], keys: Mapping[str, Sequence[tuple[str, int]]], reference: str
) -> list[dict[str, Any]]:
    """Return one row per variant and protocol.

    A row has the number of windows that diverged, the mean error over windows and seeds, its
    standard deviation over seeds (None for one seed), the smallest and largest of the seeds, and
    the difference to the reference variant over the same windows, seeds averaged first, with its
    95 % interval by blocks of windows.

    Args:
        variants: what was run.
        keys: windows of each protocol, in the order of the errors' columns.
        reference: name of the variant that differences are taken to.
    """
    known = next(variant for variant in variants if variant.name == reference)
    together: dict[str, Blocks | None] = {}
    for protocol, windows in keys.items():
        logs = [log for log, _ in windows]
        names = list(dict.fromkeys(logs))
        together[protocol] = blocks([names.index(log) for log in logs])
    return [
        _row(variant, known, protocol, together[protocol])
        for variant in variants
        for protocol in keys
    ]


def _row(
    variant: Variant, reference: Variant, protocol: str, together: Blocks | None
) -> dict[str, Any]:
    errors = variant.errors[protocol]
    by_seed = errors.mean(1)
    apart = errors.mean(0) - reference.errors[protocol].mean(0)
    (interval,) = intervals(apart[:, None], together)
    return {
        "variant": variant.name,
        "overrides": list(variant.overrides),
        "protocol": protocol,
        "seeds": len(by_seed),
        "windows": errors.shape[1],
        "diverged": variant.diverged.get(protocol, 0),
        "nrmse_mean": float(by_seed.mean()),
        "nrmse_sd": float(by_seed.std(ddof=1)) if len(by_seed) > 1 else None,
        "nrmse_range": [float(by_seed.min()), float(by_seed.max())],
        "difference": float(apart.mean()),
        "difference_ci95": None if variant is reference else interval,
        "seconds": float(np.mean(variant.seconds)),
    }
