"""Variants of one recipe over the same windows: several seeds, paired intervals, their report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from residnet.core.errors import DataError
from residnet.core.format import plural, signed
from residnet.judge.metrics import blocks, intervals
from residnet.report.blocks import Cell, Column, Section, Table, Text, paired_interval, table_of
from residnet.report.figure import BLUE, Case, Figure, Look, Panel, joined, names_of, whiskers
from residnet.report.figure_files import write_figures
from residnet.report.run_reader import Content, RunFiles


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
        model: name of a model, `selected` for the one chosen on validation data.

    Raises:
        DataError: where the run holds no such model or split.
    """
    files = RunFiles(run)
    name = files.selected if model == "selected" else model
    live = files.live
    scales = np.array([float(files.metrics["scales"][channel]) for channel in live.channels])
    found: dict[str, list[tuple[tuple[str, int], float, bool]]] = {}
    for window in files.windows(split):
        if name not in window.predicted:
            raise DataError(f"{run}: no model '{name}' among {', '.join(window.predicted)}")
        error, lost = float((window.rmse(name)[live.axes] / scales).mean()), window.diverged[name]
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
        keys: windows of each protocol, in the order of the errors' columns.
        reference: name of the variant that differences are taken to.
    """
    known = next(variant for variant in variants if variant.name == reference)
    out = []
    for variant in variants:
        for protocol, windows in keys.items():
            names = list(dict.fromkeys(log for log, _ in windows))
            together = blocks([names.index(log) for log, _ in windows])
            errors = variant.errors[protocol]
            by_seed = errors.mean(1)
            apart = errors.mean(0) - known.errors[protocol].mean(0)
            (interval,) = intervals(apart[:, None], together)
            out.append(
                {
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
                    "difference_ci95": None if variant is known else interval,
                    "seconds": float(np.mean(variant.seconds)),
                }
            )
    return out


def differences(rows: Sequence[Content], reference: str) -> Figure:
    """Draw the differences to the reference with their intervals, a panel for each protocol.

    Args:
        reference: name of the variant that differences are taken to.
    """
    protocols = list(dict.fromkeys(row["protocol"] for row in rows))
    names = [name for name in dict.fromkeys(row["variant"] for row in rows) if name != reference]
    curves, panels = [], []
    for protocol in protocols:
        found = [row for row in rows if row["protocol"] == protocol and row["variant"] != reference]
        at = [names.index(row["variant"]) for row in found]
        spans = [
            (place, *row["difference_ci95"])
            for place, row in zip(at, found, strict=True)
            if row["difference_ci95"]
        ]
        lines = joined([whiskers(*[[part] for part in span])[::-1] for span in spans])
        points = (np.array([row["difference"] for row in found]), np.array(at, dtype=float))
        curves.append({"interval": lines, "difference": points, "zero": (np.zeros(1), np.zeros(1))})
        label = f"{protocol}: NRMSE minus that of {reference} [-]"
        panels.append(
            Panel(
                "",
                label,
                height=80 + 31 * len(names),
                group=protocol,
                y_names=names_of(names),
                y_limits=(len(names) - 0.5, -0.5),
            )
        )
    return Figure(
        "study",
        "Variants of the recipe",
        f"Free-run error of each variant minus that of {reference}, mean over windows and seeds."
        " The bars are 95 % intervals over logs.",
        {
            "zero": Look("", "#666666", width=0.8, kind="upright", order=1),
            "interval": Look("95 % interval", width=1.2),
            "difference": Look("difference", BLUE, kind="points", size=4.5, order=4),
        },
        panels,
        [Case("", curves)],
        columns=len(protocols),
    )


def sections(run: RunFiles) -> list[Section]:
    """Return the variants with their errors, and the figure that stands in the folder."""
    content = run.json("study.json")
    rows = content["rows"]
    drawn = write_figures(run.path / "figures", [differences(rows, content["reference"])])
    about = [
        f"Free-run NRMSE of model {content['model']} on {content['split']} data, mean over the"
        f" windows and {plural(rows[0]['seeds'], 'seed')}.",
        f"Difference: to {content['reference']} over the same windows, seeds averaged first;"
        " negative is better, and a bold interval excludes 0. Its 95 % interval comes from"
        " blocks of windows.",
    ]
    shown = variants_table(rows, content["reference"])
    return [Section("", [shown, *drawn, Text(about, quiet=True)])]


def variants_table(rows: Sequence[Content], reference: str) -> Table:
    """Return a row for each variant with its error and difference under each protocol.

    Args:
        reference: name of the variant that differences are taken to.
    """
    by_variant: dict[str, dict[str, Content]] = {}
    for row in rows:
        by_variant.setdefault(row["variant"], {})[row["protocol"]] = row
    protocols = list(dict.fromkeys(row["protocol"] for row in rows))

    def error(row: Content) -> Cell:
        # a study of an earlier version does not know what diverged
        lost = int(row.get("diverged", 0))
        note = f"{lost} diverged" if lost else ""
        same = [other for other in rows if other["protocol"] == row["protocol"]]
        least = row["nrmse_mean"] == min(other["nrmse_mean"] for other in same)
        return Cell(f"{row['nrmse_mean']:.4f}", note, "bad" if lost else "best" if least else "")

    heads: list[Column] = [
        ("NRMSE", error),
        ("sd of seeds", lambda row: row["nrmse_sd"], 4),
        (
            "difference",
            lambda row: signed(row["difference"]) if row["difference_ci95"] else "",
            str,
        ),
        ("95 % interval", lambda row: paired_interval(row["difference_ci95"], "")),
    ]
    return table_of(
        by_variant.values(),
        [
            ("variant", lambda row: row[protocols[0]]["variant"]),
            *(
                (title, lambda row, name=name, of=of: of(row[name]), *how)
                for name in protocols
                for title, of, *how in heads
            ),
            ("run [s]", f"{protocols[0]}.seconds", 0),
            ("what changes", lambda row: ", ".join(row[protocols[0]]["overrides"])),
        ],
        groups=[*((f"protocol {name}", len(heads)) for name in protocols), ("", 2)],
        selected=lambda row: row[protocols[0]]["variant"] == reference,
    )
