"""Task `study`: variants of one fit, each over several seeds, in one table with paired intervals
(an ablation).
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import Field, model_validator

from residnet.core.config import BaseConfig, load_config
from residnet.core.errors import UsageError
from residnet.core.files import read_json
from residnet.core.names import nearest
from residnet.core.processes import processes
from residnet.core.progress import report
from residnet.report.sections.study import Variant, table, variants_table, window_nrmse
from residnet.runs.folder import RunFolder
from residnet.runs.task import MainFigure, Outcome, PartName, Task
from residnet.tasks.fit import FitConfig


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

    page: ClassVar[str] = "study"

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
        errors = {job: window_nrmse(out, self.model, self.split) for job, out in places.items()}
        protocols = next(iter(errors.values()))
        variants = []
        for variant, overrides in self.variants.items():
            own = [errors[variant, seed] for seed in self.seeds]
            variants.append(
                Variant(
                    variant,
                    overrides,
                    {name: np.stack([one[name].values for one in own]) for name in protocols},
                    tuple(seconds[variant, seed] for seed in self.seeds),
                    {name: sum(int(one[name].diverged.sum()) for one in own) for name in protocols},
                )
            )
        keys = {name: one.keys for name, one in protocols.items()}
        rows = table(variants, keys, self.reference)
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
