"""Variants of one recipe against each other: the same windows, several seeds, paired intervals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from residnet.core.errors import DataError
from residnet.core.names import VELOCITY
from residnet.judge.bootstrap import Blocks, blocks, intervals
from residnet.report.run_reader import RunFiles


@dataclass(frozen=True)
class WindowErrors:
    """NRMSE (mean over u, v, r) of one model by window.

    Attributes:
        keys: (log, number of the window), [W].
        values: [W].
    """

    keys: tuple[tuple[str, int], ...]
    values: np.ndarray


def window_nrmse(run: Path, model: str, split: str) -> dict[str, WindowErrors]:
    """Errors of one model of a finished run by protocol, from its stored rollouts.

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
    found: dict[str, list[tuple[tuple[str, int], float]]] = {}
    for window in files.windows(split):
        if name not in window.predicted:
            raise DataError(f"{run}: no model '{name}' among {', '.join(window.predicted)}")
        found.setdefault(window.protocol, []).append(
            ((window.log, window.number), float((window.rmse(name) / scales).mean()))
        )
    if not found:
        raise DataError(f"{run}: no rollouts of the split '{split}'")
    return {
        protocol: WindowErrors(
            tuple(key for key, _ in pairs), np.array([value for _, value in pairs])
        )
        for protocol, pairs in found.items()
    }


@dataclass(frozen=True)
class Variant:
    """One way to do it: errors [S, W] by protocol over the windows `keys` for S seeds; `seconds` of
    the runs, [S].
    """

    name: str
    overrides: tuple[str, ...]
    errors: Mapping[str, np.ndarray]
    seconds: tuple[float, ...]


def table(
    variants: Sequence[Variant], keys: Mapping[str, Sequence[tuple[str, int]]], reference: str
) -> list[dict[str, Any]]:
    """One row per variant and protocol.

    A row has the mean error over windows and seeds, its standard deviation over seeds (None for one
    seed), the smallest and largest of the seeds, and the difference to the reference variant over
    the same windows, seeds averaged first, with its 95 % interval by blocks of windows.

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
        "nrmse_mean": float(by_seed.mean()),
        "nrmse_sd": float(by_seed.std(ddof=1)) if len(by_seed) > 1 else None,
        "nrmse_range": [float(by_seed.min()), float(by_seed.max())],
        "difference": float(apart.mean()),
        "difference_ci95": None if variant is reference else interval,
        "seconds": float(np.mean(variant.seconds)),
    }


def as_text(rows: Sequence[Mapping[str, Any]], reference: str) -> str:
    """The table in Markdown."""
    protocols = list(dict.fromkeys(row["protocol"] for row in rows))
    head = [
        "variant",
        *(f"{p} NRMSE (sd of seeds) | difference to {reference} [95 %]" for p in protocols),
        "s per run",
        "what changes",
    ]
    lines = ["| " + " | ".join(head) + " |", "|" + " --- |" * (3 + 2 * len(protocols))]
    for name in dict.fromkeys(row["variant"] for row in rows):
        parts = {row["protocol"]: row for row in rows if row["variant"] == name}
        cells = [name]
        for protocol in protocols:
            row = parts[protocol]
            spread = "" if row["nrmse_sd"] is None else f" ({row['nrmse_sd']:.4f})"
            interval = row["difference_ci95"]
            cells.append(f"{row['nrmse_mean']:.4f}{spread}")
            cells.append(
                ""
                if interval is None
                else f"{row['difference']:+.4f} [{interval[0]:+.4f}, {interval[1]:+.4f}]"
            )
        first = parts[protocols[0]]
        cells += [f"{first['seconds']:.0f}", ", ".join(f"`{text}`" for text in first["overrides"])]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def draw(rows: Sequence[Mapping[str, Any]], reference: str, path: Path) -> None:
    """Differences to the reference with their intervals, one row per variant, one panel per
    protocol.
    """
    from matplotlib import rc_context

    from residnet.report.figures.style import RC, new_figure, save

    protocols = list(dict.fromkeys(row["protocol"] for row in rows))
    names = [name for name in dict.fromkeys(row["variant"] for row in rows) if name != reference]
    with rc_context(RC):
        figure = new_figure(0.9 + 0.28 * len(names))
        axes = figure.subplots(1, len(protocols), sharey=True, squeeze=False)[0]
        for axis, protocol in zip(axes, protocols, strict=True):
            for height, name in enumerate(reversed(names)):
                row = next(
                    row for row in rows if row["variant"] == name and row["protocol"] == protocol
                )
                if row["difference_ci95"] is not None:
                    axis.plot(
                        row["difference_ci95"], [height, height], color="black", linewidth=1.2
                    )
                axis.plot(
                    row["difference"],
                    height,
                    marker="o",
                    markersize=4.5,
                    color="#0072B2",
                    linestyle="none",
                )
            axis.axvline(0.0, color="0.4", linewidth=0.8)
            axis.set_xlabel(f"{protocol}: NRMSE minus that of {reference} [-]")
        axes[0].set_yticks(range(len(names)), list(reversed(names)))
        save(
            figure,
            path,
            "Variants of the recipe",
            f"Free-run error of each variant minus that of {reference}, mean over windows and"
            " seeds; bars: 95 % interval over logs.",
        )
