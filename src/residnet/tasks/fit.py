"""Task `fit`: logs to baseline, heads, free-run comparison, report and export."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, model_validator

from residnet.baselines import BaselineConfig, RegressorBaseline
from residnet.core.config import Config
from residnet.core.errors import ConfigError
from residnet.core.names import nearest
from residnet.data.prepare import PrepareConfig
from residnet.data.simulated.trials import SimulatedTrials
from residnet.data.sources import DataConfig, MeasuredLogs
from residnet.documents import StudyName
from residnet.dynamics.base import Integrator
from residnet.heads import HeadConfig
from residnet.judge.booklet import BookletConfig
from residnet.judge.config import EvaluationConfig
from residnet.physics.signals import SignalsConfig
from residnet.training.config import TrainingConfig
from residnet.training.current import CurrentConfig
from residnet.training.refit import RefitConfig

_TAKEN = ("zero", "baseline", "truth")


class ExportConfig(Config):
    """Which models are exported as TorchScript; `selected` is the one chosen on validation data."""

    models: tuple[str, ...] = ("selected",)


def _known(key: str, given: Iterable[str], valid: Iterable[str], what: str) -> None:
    valid = tuple(valid)
    for name in given:
        if name not in valid:
            raise ValueError(f"{key}: no {what} is named '{name}'{nearest(name, valid)}")


class FitConfig(Config):
    """A complete fit.

    Attributes:
        name: of the run; its folder is runs/<name> unless --out says otherwise.
        study: a published experiment whose figures are drawn too.
        seed: of weights and batches.
        threads: of PyTorch; part of what makes a run repeatable. One is fastest for these small
            products.
        data: logs and splits.
        prepare: grid, masks, derivatives.
        signals: inputs of the models.
        integrator: of the models; their step is the grid's.
        baseline: the known part.
        baselines: further baselines by name; free-run beside the first, and heads may stand on
            them.
        current: training and validation logs ran in constant currents that are estimated first;
            null for water at rest.
        refit: baselines (by name, `baseline` for the first) whose coefficients are moved through
            rollouts after least squares.
        heads: residual heads by name.
        base_of: the baseline that a head stands on, by the head's name; `baseline` where absent.
        ensembles: models whose mean acceleration makes another model, by its name.
        training: of network heads by the name of the head; the defaults where absent.
        evaluation: protocols and scales.
        booklet: standard manoeuvres by one of the refitted baselines, with intervals; null for
            none.
        export: TorchScript.
    """

    task: Literal["fit"]
    name: str = Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$")
    description: str = ""
    study: StudyName | None = None
    seed: int = Field(default=0, ge=0)
    threads: int = Field(default=1, ge=1)
    data: DataConfig
    prepare: PrepareConfig
    signals: SignalsConfig
    integrator: Integrator = "rk4"
    baseline: BaselineConfig
    baselines: dict[str, BaselineConfig] = Field(default_factory=dict)
    current: CurrentConfig | None = None
    refit: dict[str, RefitConfig] = Field(default_factory=dict)
    heads: dict[str, HeadConfig] = Field(default_factory=dict)
    base_of: dict[str, str] = Field(default_factory=dict)
    ensembles: dict[str, Annotated[tuple[str, ...], Field(min_length=2)]] = Field(
        default_factory=dict
    )
    training: dict[str, TrainingConfig] = Field(default_factory=dict)
    evaluation: EvaluationConfig
    booklet: BookletConfig | None = None
    export: ExportConfig = ExportConfig()

    @model_validator(mode="after")
    def _combination(self) -> FitConfig:
        baselines = {"baseline": self.baseline, **self.baselines}
        single = (*baselines, *self.heads)
        models = (*single, *self.ensembles)
        for name in (*self.baselines, *self.heads, *self.ensembles):
            if (
                name in _TAKEN
                or models.count(name) > 1
                or not name.replace("_", "").replace("-", "").isalnum()
            ):
                raise ValueError(
                    f"'{name}' cannot name a model; use letters, digits, '-', '_', each name once"
                    f" and none of {', '.join(_TAKEN)}"
                )
        _known("training", self.training, self.heads, "head")
        _known("base_of", self.base_of, self.heads, "head")
        _known("base_of", self.base_of.values(), baselines, "baseline")
        _known("refit", self.refit, baselines, "baseline")
        if self.booklet is not None:
            _known("booklet.model", (self.booklet.model,), self.refit, "refitted baseline")
            self.booklet.rudder()
        _known(
            "ensembles",
            (name for members in self.ensembles.values() for name in members),
            single,
            "model",
        )
        _known("export.models", self.export.models, ("selected", *models), "model")
        names = self.signals.build().names
        for key, part in {**baselines, **self.heads}.items():
            try:
                part.build(names)
            except ConfigError as error:
                raise ValueError(f"{key}: {error}") from None
        for key, config in self.heads.items():
            head, below = (
                config.build(names),
                baselines[self.base_of.get(key, "baseline")].build(names),
            )
            try:
                head.set_mass(below.mass())
            except ConfigError as error:
                raise ValueError(f"heads.{key}: {error}") from None
        if self.current is not None:
            _known("current.baseline", (self.current.baseline,), baselines, "baseline")
            if not isinstance(baselines[self.current.baseline].build(names), RegressorBaseline):
                raise ValueError(
                    f"current.baseline: '{self.current.baseline}' has no regressors to tell a"
                    " current by; name a baseline that has"
                )
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
