"""The config of the task `fit`: settings of the fit, logs, and what is made of them."""

from __future__ import annotations

from pathlib import Path

from pydantic import model_validator

from residnet.core.config import Config
from residnet.data.simulated.trials import SimulatedTrials
from residnet.data.sources import DataConfig, input_files
from residnet.documents import STUDY_MODELS, StudyName
from residnet.identification.settings import FitSettings, require_known
from residnet.judge.booklet import BookletConfig
from residnet.runs.task import ComputingTask


class ExportConfig(Config):
    """Models that are exported as TorchScript when the run ends.

    Attributes:
        models: their names; `selected` is the one chosen on validation data.
    """

    models: tuple[str, ...] = ("selected",)


class FitTaskSettings(FitSettings, ComputingTask):
    """The config of a complete fit.

    Attributes:
        study: a published experiment whose figures are drawn too; null for none.
        data: logs and splits.
        booklet: standard manoeuvres by one of the refitted baselines, with intervals; null for
            none.
        export: models that are exported when the run ends.
    """

    study: StudyName | None = None
    data: DataConfig
    booklet: BookletConfig | None = None
    export: ExportConfig = ExportConfig()

    @model_validator(mode="after")
    def _outputs(self) -> FitTaskSettings:
        if self.booklet is not None:
            require_known("booklet.model", (self.booklet.model,), self.refit, "refitted baseline")
            self.booklet.rudder()
        if self.study is not None:
            absent = [m for m in STUDY_MODELS[self.study] if m not in self.model_names]
            if absent:
                raise ValueError(
                    f"study: {self.study} shows the models {', '.join(STUDY_MODELS[self.study])};"
                    f" '{absent[0]}' is absent; give it, or leave the study out (study=null)"
                )
        require_known("export.models", self.export.models, ("selected", *self.model_names), "model")
        if isinstance(self.data, SimulatedTrials):
            self.data.splits(self.data.draw())
            if abs(self.data.step - self.prepare.grid.step) > 1e-9:
                raise ValueError(
                    f"prepare.grid.step ({self.prepare.grid.step:g} s) must equal data.step"
                    f" ({self.data.step:g} s) for simulated trials"
                )
        return self

    def input_files(self) -> list[Path]:
        """Return the files of the measured logs."""
        return input_files(self.data)

    def recorded_seed(self) -> int:
        """Return the seed of weights and batches."""
        return self.seed
