"""Task `study`: variants of one fit, each over several seeds, in one table with paired intervals
(an ablation).
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from pydantic import Field, model_validator

from residnet.core.config import BaseConfig, load_config
from residnet.core.errors import DataError, UsageError
from residnet.core.files import read_json
from residnet.core.format import plural, signed
from residnet.core.names import nearest
from residnet.core.processes import processes
from residnet.core.progress import report
from residnet.judge.metrics import blocks, intervals
from residnet.report.blocks import Cell, Column, Section, Table, Text, paired_interval, table_of
from residnet.report.figure import BLUE, Case, Figure, Look, Panel, joined, names_of, whiskers
from residnet.report.figure_files import write_figures
from residnet.report.run_reader import Content, RunFiles
from residnet.runs.folder import RunFolder
from residnet.runs.task import MainFigure, Outcome, PartName, Task
from residnet.tasks.fit import FitConfig

if TYPE_CHECKING:
    import pandas as pd


class StudyConfig(Task):
    """Variants of one fit, each over several seeds, compared window by window.

    Attributes:
        base: config of a fit, by its path or by the name of one that comes with residnet; paths in
            it are taken from its own folder.
        common: overrides of the base for all variants.
        variants: overrides by the variant's name; the files differ in nothing else.
        reference: the variant that the others are compared with.
        model: whose free-run errors are compared; `selected` for the one that each run selects on
            validation data.
        split: whose windows.
        seeds: each variant is fitted with each of them.
        workers: runs at a time, one process each.
    """

    task: Literal["study"]
    base: BaseConfig
    common: tuple[str, ...] = ()
    variants: dict[PartName, tuple[str, ...]] = Field(min_length=2)
    reference: str
    model: str = "selected"
    split: Literal["validation", "test"] = "test"
    seeds: tuple[Annotated[int, Field(ge=0)], ...] = Field(default=(0, 1, 2), min_length=1)
    workers: int = Field(default=1, ge=1, le=1_024)

    @model_validator(mode="after")
    def _combination(self) -> StudyConfig:
        if self.reference not in self.variants:
            raise ValueError(
                "reference: no variant is named"
                f" '{self.reference}'{nearest(self.reference, self.variants)}"
            )
        if len(set(self.seeds)) < len(self.seeds):
            raise ValueError(f"seeds: each only once, given {list(self.seeds)}")
        return self

    def overrides(self, variant: str, seed: int) -> list[str]:
        """Overrides of the base for one run."""
        return [
            *self.common,
            *self.variants[variant],
            f"name={self.name}.{variant}.{seed}",
            f"seed={seed}",
        ]

    def check(self) -> None:
        """Check that every variant is a valid fit, holds the model and finds its files.

        Raises:
            ConfigError: where one does not.
            UsageError: where one has no such model.
        """
        for variant in self.variants:
            fit = load_config(self.base, self.overrides(variant, self.seeds[0]), FitConfig)
            fit.check()
            models = ("selected", *fit.model_names)
            if self.model not in models:
                raise UsageError(
                    f"variant {variant}: no model is named"
                    f" '{self.model}'{nearest(self.model, models)}"
                )

    def input_files(self) -> list[Path]:
        return [self.base]

    def recorded_seed(self) -> int:
        return self.seeds[0]

    def carry_out(self, folder: RunFolder) -> Outcome:
        """Fit all variants and write the comparison; runs that are there already are kept.

        Raises:
            ResidnetError: where a variant cannot be run, or the system ends a process.
        """
        places = {
            (variant, seed): folder.path / "variants" / f"{variant}.{seed}"
            for variant in self.variants
            for seed in self.seeds
        }
        seconds = dict[tuple[str, int], float]()
        if self.workers == 1:
            for number, (job, out) in enumerate(places.items()):
                report("fits of the study", number, len(places))
                seconds[job] = _fit(self, *job, out)
            report("fits of the study", len(places), len(places))
        else:
            with processes(self.workers) as pool:
                work = [(self, *job, out) for job, out in places.items()]
                found = pool.map(_fit, *zip(*work, strict=True))
                seconds = dict(zip(places, found, strict=True))
        import pandas as pd

        errors = pd.concat(
            {job: window_nrmse(out, self.model, self.split) for job, out in places.items()},
            names=["variant", "seed"],
        )
        rows = variant_rows(errors, self.reference)
        for row in rows:
            row["overrides"] = list(self.variants[row["variant"]])
            row["seconds"] = float(np.mean([seconds[row["variant"], seed] for seed in self.seeds]))
        content = {
            "schema": "residnet.study/1",
            "run": self.name,
            "model": self.model,
            "split": self.split,
            "reference": self.reference,
            "rows": rows,
        }
        folder.write_json(folder.path / "study.json", content)
        figures = {
            f"nrmse_{row['variant']}_{row['protocol']}": MainFigure(row["nrmse_mean"])
            for row in rows
        }
        text = variants_table(rows, self.reference).text()
        return Outcome(_verdict(rows, self.reference), figures, text)

    @classmethod
    def report_sections(cls, run: RunFolder) -> Sequence[Section]:
        content = RunFiles(run.path).json("study.json")
        rows = content["rows"]
        drawn = write_figures(run.figures, [differences(rows, content["reference"])])
        about = [
            f"Free-run NRMSE of model {content['model']} on {content['split']} data, mean over the"
            f" windows and {plural(rows[0]['seeds'], 'seed')}.",
            f"Difference: to {content['reference']} over the same windows, seeds averaged first;"
            " negative is better, and a bold interval excludes 0. Its 95 % interval comes from"
            " blocks of windows.",
        ]
        shown = variants_table(rows, content["reference"])
        return [Section("", [shown, *drawn, Text(about, quiet=True)])]


def _verdict(rows: Sequence[dict[str, Any]], reference: str) -> list[str]:
    """Return for each protocol which variant has the least error, and by how much."""
    sentences = []
    for protocol in dict.fromkeys(row["protocol"] for row in rows):
        found = [row for row in rows if row["protocol"] == protocol]
        # the error of runs that diverged is that of zero: a steady variant comes before them
        best = min(found, key=lambda row: (int(row["diverged"]) > 0, float(row["nrmse_mean"])))
        steady = " of the steady ones" if any(row["diverged"] for row in found) else ""
        sentence = (
            f"{protocol}: '{best['variant']}' has the least free-run NRMSE{steady},"
            f" {best['nrmse_mean']:.4f}"
        )
        if best["diverged"]:
            sentence = (
                f"{protocol}: EVERY VARIANT DIVERGED in some windows; of the errors, which count"
                f" those windows as zero does, that of '{best['variant']}' is the least,"
                f" {best['nrmse_mean']:.4f}"
            )
        interval = best["difference_ci95"]
        if best["variant"] != reference and interval is not None:
            sentence += (
                f"; that is {best['difference']:+.4f} [{interval[0]:+.4f}, {interval[1]:+.4f}]"
                f" from '{reference}'"
            )
        sentences.append(f"{sentence}.")
        lost = [row for row in found if row["diverged"]]
        if lost:
            named = ", ".join(f"'{row['variant']}' in {row['diverged']} windows" for row in lost)
            sentences.append(f"{protocol}: free runs DIVERGED: {named}.")
    return sentences


def _fit(study: StudyConfig, variant: str, seed: int, out: Path) -> float:
    """Run one variant with one seed unless it is finished; returns the seconds that it took."""
    if not RunFolder(out).finished:
        overrides = study.overrides(variant, seed)
        load_config(study.base, overrides, FitConfig).run(
            source=study.base, overrides=overrides, out=out, resume=True, report=False
        )
    return float(read_json(RunFolder(out).provenance)["seconds"])


def window_nrmse(run: Path, model: str, split: str) -> pd.DataFrame:
    """Return the errors of one model of a finished run, from its stored rollouts.

    Args:
        model: name of a model, `selected` for the one chosen on validation data.

    Returns:
        A row for each window: protocol, log, window, nrmse (mean over what moves; a window that
        diverged has the error of `zero`) and diverged.

    Raises:
        DataError: where the run holds no such model or split.
    """
    import pandas as pd

    files = RunFiles(run)
    name = files.selected if model == "selected" else model
    windows = files.windows(split)
    if not windows:
        raise DataError(f"{run}: no rollouts of the split '{split}'")
    if name is None or name not in windows[0].predicted:
        raise DataError(f"{run}: no model '{name}' among {', '.join(windows[0].predicted)}")
    scales = {name: float(files.metrics["scales"][name]) for name in files.live.channels}
    return pd.DataFrame(
        {
            "protocol": one.protocol,
            "log": one.log,
            "window": one.number,
            "nrmse": one.nrmse(name, scales),
            "diverged": one.diverged[name],
        }
        for one in windows
    )


def variant_rows(errors: pd.DataFrame, reference: str) -> list[dict[str, Any]]:
    """Return one row per variant and protocol.

    A row has the number of windows that diverged, the mean error over windows and seeds, its
    standard deviation over seeds (None for one seed), the smallest and largest of the seeds, and
    the difference to the reference variant over the same windows, seeds averaged first, with its
    95 % interval by blocks of windows.

    Args:
        errors: as of `window_nrmse`, by variant and seed.
        reference: name of the variant that differences are taken to.
    """
    import pandas as pd

    out = []
    for (variant, protocol), own in errors.groupby(["variant", "protocol"], sort=False):
        known = errors.loc[reference]
        apart, level = (
            of.groupby(["log", "window"], sort=False)["nrmse"].mean()
            for of in (own, known[known["protocol"] == protocol])
        )
        apart -= level
        logs = pd.factorize(apart.index.get_level_values("log"))[0]
        (interval,) = intervals(apart.to_numpy()[:, None], blocks(logs))
        by_seed = own.groupby("seed")["nrmse"].mean()
        out.append(
            {
                "variant": variant,
                "protocol": protocol,
                "seeds": len(by_seed),
                "windows": len(apart),
                "diverged": int(own["diverged"].sum()),
                "nrmse_mean": float(by_seed.mean()),
                "nrmse_sd": float(by_seed.std()) if len(by_seed) > 1 else None,
                "nrmse_range": [float(by_seed.min()), float(by_seed.max())],
                "difference": float(apart.mean()),
                "difference_ci95": None if variant == reference else interval,
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
