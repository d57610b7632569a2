"""Task `study`: variants of one fit, each over several seeds, in one table with paired intervals
(an ablation).
"""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, model_validator

from residnet.core.config import Config, ExistingPath, dump_config, load_config
from residnet.core.names import nearest
from residnet.runs.folder import RunFolder
from residnet.tasks.fit import FitConfig

_Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]*$")]


class StudyConfig(Config):
    """What each part of a recipe brings.

    Attributes:
        name: of the run.
        base: config of a fit; paths in it are taken from its own folder.
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
    name: str = Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$")
    description: str = ""
    base: ExistingPath
    common: tuple[str, ...] = ()
    variants: dict[_Name, tuple[str, ...]] = Field(min_length=2)
    reference: str
    model: str = "selected"
    split: Literal["validation", "test"] = "test"
    seeds: tuple[Annotated[int, Field(ge=0)], ...] = Field(default=(0, 1, 2), min_length=1)
    workers: int = Field(default=1, ge=1)

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
        """That every variant is a valid fit, holds the model and finds its files.

        Raises:
            ConfigError: where one does not.
            UsageError: where one has no such model.
        """
        from residnet.core.errors import UsageError

        for variant in self.variants:
            fit = load_config(self.base, self.overrides(variant, self.seeds[0]), FitConfig)
            fit.check()
            models = ("selected", "baseline", *fit.baselines, *fit.heads, *fit.ensembles)
            if self.model not in models:
                raise UsageError(
                    f"variant {variant}: no model is named"
                    f" '{self.model}'{nearest(self.model, models)}"
                )

    def run(
        self, *, source: Path, overrides: Sequence[str], out: Path | None, resume: bool
    ) -> RunFolder:
        """Fit all variants and write study.json, study.md and figures/study.png; runs that are
        there already are kept.

        Raises:
            ResidnetError: where a variant cannot be run.
        """
        self.check()
        started = time.time()
        folder = RunFolder.create(out or Path("runs") / self.name, dump_config(self), resume=resume)
        jobs = [
            (self, variant, seed, folder.path / "variants" / f"{variant}.{seed}")
            for variant in self.variants
            for seed in self.seeds
        ]
        if self.workers == 1:
            seconds = [_fit(*job) for job in jobs]
        else:
            with ProcessPoolExecutor(self.workers, mp_context=get_context("spawn")) as pool:
                seconds = list(pool.map(_fit, *zip(*jobs, strict=True)))
        self._write(
            folder,
            dict(zip([(variant, seed) for _, variant, seed, _ in jobs], seconds, strict=True)),
        )
        folder.write_provenance(
            config=source,
            overrides=overrides,
            seed=self.seeds[0],
            files=[self.base],
            started=started,
        )
        return folder

    def _write(self, folder: RunFolder, seconds: dict[tuple[str, int], float]) -> None:
        import numpy as np

        from residnet.report.comparison import Variant, as_text, draw, table, window_nrmse

        found = {
            (variant, seed): window_nrmse(
                folder.path / "variants" / f"{variant}.{seed}", self.model, self.split
            )
            for variant in self.variants
            for seed in self.seeds
        }
        first = next(iter(found.values()))
        keys = {protocol: errors.keys for protocol, errors in first.items()}
        variants = [
            Variant(
                variant,
                self.variants[variant],
                {
                    protocol: np.stack(
                        [found[variant, seed][protocol].values for seed in self.seeds]
                    )
                    for protocol in keys
                },
                tuple(seconds[variant, seed] for seed in self.seeds),
            )
            for variant in self.variants
        ]
        rows = table(variants, keys, self.reference)
        head = {
            "schema": "residnet.study/1",
            "run": self.name,
            "model": self.model,
            "split": self.split,
            "reference": self.reference,
        }
        folder.write_json(folder.path / "study.json", head | {"rows": rows})
        text = as_text(rows, self.reference)
        folder.write(folder.path / "study.md", f"{self.description or self.name}\n\n{text}")
        folder.figures.mkdir(exist_ok=True)
        draw(rows, self.reference, folder.figures / "study.png")
        print(text)
        print(f"study: {folder.path / 'study.md'}")


def _fit(study: StudyConfig, variant: str, seed: int, out: Path) -> float:
    """Run one variant with one seed unless it is finished; returns the seconds that it took."""
    from residnet.tasks.run import run_fit

    if not (out / "metrics.json").is_file():
        overrides = study.overrides(variant, seed)
        run_fit(
            load_config(study.base, overrides, FitConfig),
            source=study.base,
            overrides=overrides,
            out=out,
            resume=True,
            report=False,
        )
    return float(json.loads((out / "provenance.json").read_text())["seconds"])
