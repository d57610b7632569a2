"""Task `breeding`: how often genetic programming finds the mass-spring-damper, over a grid of two
settings (document 000 chapter 5).
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, ValidationError, model_validator

from residnet.core.config import Config, dump_config
from residnet.documents.halvorsen2019.breeding.search import (
    NoiseConfig,
    RecordConfig,
    Trial,
    as_text,
    attempt,
    draw,
)
from residnet.heads.genetic import GeneticConfig
from residnet.runs.folder import RunFolder

Value = int | float | str
Matrix = tuple[tuple[float | None, ...], ...]


class Axis(Config):
    """One setting and the values that it takes: a dotted key of the task, such as
    `head.evolution.population`.
    """

    key: str = Field(pattern=r"^(head|noise|record)\.[a-z_.]+$")
    values: Annotated[tuple[Value, ...], Field(min_length=1)]


class BreedingTaskConfig(Config):
    """Every combination of two settings, several times each.

    Attributes:
        name: of the run.
        record: the data.
        noise: on them.
        head: how the equation is searched; `final: null` keeps the individual as it was bred, as
            the document does.
        rows, columns: the two settings.
        repeats: runs of each combination, seeds 0, 1, ...
        threshold: mean square error on the test record below which the equation counts as found
            (section 5.2.2).
        published: the document's numbers of found runs, one row for each row of the grid;
            combinations without a number (null) are left out.
        published_error: its mean square errors.
    """

    task: Literal["breeding"]
    name: str = Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$")
    description: str = ""
    record: RecordConfig = Field(default_factory=RecordConfig)
    noise: NoiseConfig = Field(default_factory=NoiseConfig)
    head: GeneticConfig = Field(default_factory=GeneticConfig)
    rows: Axis
    columns: Axis
    repeats: int = Field(default=10, ge=1)
    threshold: float = Field(default=5e-6, gt=0)
    published: Matrix | None = None
    published_error: Matrix | None = None

    @model_validator(mode="after")
    def _grid(self) -> BreedingTaskConfig:
        for name, table in (
            ("published", self.published),
            ("published_error", self.published_error),
        ):
            if table is not None and [len(row) for row in table] != [
                len(self.columns.values)
            ] * len(self.rows.values):
                raise ValueError(
                    f"{name}: expected {len(self.rows.values)} rows of {len(self.columns.values)}"
                    " numbers, as rows and columns have values"
                )
        for row, column in self._cells():
            try:
                self._cell(row, column)
            except (ValidationError, KeyError) as error:
                what = (
                    error.errors()[0]["msg"]
                    if isinstance(error, ValidationError)
                    else f"no key {error}"
                )
                raise ValueError(
                    f"{self.rows.key}={self.rows.values[row]},"
                    f" {self.columns.key}={self.columns.values[column]}: {what}"
                ) from None
        return self

    def _cells(self) -> list[tuple[int, int]]:
        grid = [
            (i, j) for i in range(len(self.rows.values)) for j in range(len(self.columns.values))
        ]
        return [
            (i, j) for i, j in grid if self.published is None or self.published[i][j] is not None
        ]

    def _cell(self, row: int, column: int) -> tuple[RecordConfig, NoiseConfig, GeneticConfig]:
        parts: dict[str, Any] = {
            name: getattr(self, name).model_dump() for name in ("record", "noise", "head")
        }
        for axis, number in ((self.rows, row), (self.columns, column)):
            *path, last = axis.key.split(".")
            place = parts
            for key in path:
                place = place[key]
            if last not in place:
                raise KeyError(axis.key)
            place[last] = axis.values[number]
        return (
            RecordConfig.model_validate(parts["record"]),
            NoiseConfig.model_validate(parts["noise"]),
            GeneticConfig.model_validate(parts["head"]),
        )

    def check(self) -> None:
        """That DEAP is there.

        Raises:
            UsageError: where it is not installed.
        """
        from residnet.regression.genetic.evolution import require_deap

        require_deap()

    def run(
        self, *, source: Path, overrides: Sequence[str], out: Path | None, resume: bool
    ) -> RunFolder:
        """Run the grid and write study.json, study.md and figures/study.png.

        Raises:
            ResidnetError: where DEAP is not installed or the data do not determine an equation.
        """
        self.check()
        started = time.time()
        folder = RunFolder.create(out or Path("runs") / self.name, dump_config(self), resume=resume)
        rows = [self._row(i, j) for i, j in self._cells()]
        keys = (self.rows.key, self.columns.key)
        folder.write_json(
            folder.path / "study.json",
            {"schema": "residnet.breeding/1", "run": self.name, "keys": keys, "rows": rows},
        )
        text = as_text(rows, keys, self.repeats, self.threshold)
        folder.write(folder.path / "study.md", f"{self.description or self.name}\n\n{text}")
        folder.figures.mkdir(exist_ok=True)
        draw(rows, keys, self.repeats, folder.figures / "study.png")
        folder.write_provenance(
            config=source, overrides=overrides, seed=0, files=[], started=started
        )
        print(text)
        print(f"study: {folder.path / 'study.md'}")
        return folder

    def _row(self, i: int, j: int) -> dict[str, Any]:
        settings = self._cell(i, j)
        started = time.process_time()
        trials: list[Trial] = [attempt(*settings, seed) for seed in range(self.repeats)]
        errors = [trial.error for trial in trials]
        return {
            "row": self.rows.values[i],
            "column": self.columns.values[j],
            "found": sum(error < self.threshold for error in errors),
            "published_found": None if self.published is None else self.published[i][j],
            "right": sum(trial.right for trial in trials),
            "error": sum(errors) / len(errors),
            "published_error": None if self.published_error is None else self.published_error[i][j],
            "seconds": (time.process_time() - started) / self.repeats,
            "equations": [dict(zip(trial.terms, trial.values, strict=True)) for trial in trials],
        }
