"""Task `fit`: logs to baseline, heads, free-run comparison, report and export."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from pydantic import Field, model_validator

from residnet.core.config import Config
from residnet.data.simulated.trials import SimulatedTrials
from residnet.data.sources import DataConfig, MeasuredLogs
from residnet.documents import StudyName
from residnet.identification.settings import FitSettings, require_known
from residnet.judge.booklet import BookletConfig


class ExportConfig(Config):
    """Which models are exported as TorchScript; `selected` is the one chosen on validation data."""

    models: tuple[str, ...] = ("selected",)


class FitConfig(FitSettings):
    """A complete fit: what is identified, from which logs, and what is made of it.

    Attributes:
        task: the kind of run.
        name: of the run; its folder is runs/<name> unless --out says otherwise.
        description: a sentence about the run.
        study: a published experiment whose figures are drawn too.
        threads: of PyTorch; part of what makes a run repeatable. One is fastest for these small
            products.
        data: logs and splits.
        booklet: standard manoeuvres by one of the refitted baselines, with intervals; null for
            none.
        export: TorchScript.
    """

    task: Literal["fit"]
    name: str = Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$")
    description: str = ""
    study: StudyName | None = None
    threads: int = Field(default=1, ge=1)
    data: DataConfig
    booklet: BookletConfig | None = None
    export: ExportConfig = ExportConfig()

    @model_validator(mode="after")
    def _outputs(self) -> FitConfig:
        if self.booklet is not None:
            require_known("booklet.model", (self.booklet.model,), self.refit, "refitted baseline")
            self.booklet.rudder()
        require_known("export.models", self.export.models, ("selected", *self.model_names), "model")
        if isinstance(self.data, SimulatedTrials):
            self.data.splits(self.data.draw())
            if abs(self.data.step - self.prepare.grid.step) > 1e-9:
                raise ValueError(
                    f"prepare.grid.step ({self.prepare.grid.step:g} s) must equal data.step"
                    f" ({self.data.step:g} s) for simulated trials"
                )
        return self

    def check(self) -> None:
        """What reading the config does not show: that the logs' files are there and no split is
        empty.

        Raises:
            ConfigError: where they are not.
        """
        if isinstance(self.data, MeasuredLogs):
            self.data.split.resolve()

    def run(
        self, *, source: Path, overrides: Sequence[str], out: Path | None, resume: bool
    ) -> None:
        """Carry out the fit; see `residnet.tasks.run.run_fit`."""
        from residnet.tasks.run import run_fit

        run_fit(self, source=source, overrides=overrides, out=out, resume=resume)
