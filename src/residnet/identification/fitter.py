"""The single steps of a fit: zero, a baseline, a head on a baseline, the mean of models."""

from __future__ import annotations

import copy
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from residnet.baselines import BaselineConfig, Coefficient, ParametricBaseline, StillConfig
from residnet.core.errors import FitError
from residnet.core.samples import Samples
from residnet.data.prepare import Prepared, envelope, samples
from residnet.data.windows import WindowStore
from residnet.dynamics.ensemble import mean_of
from residnet.dynamics.gate import GatedHead
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.store import ModelSpec, rebuilt
from residnet.heads import ClosedFormHead
from residnet.identification.cross_fitting.crossed import Crossed
from residnet.identification.cross_fitting.prior_choice import (
    TAKEN,
    JudgedFold,
    PriorChoice,
    choose_prior,
    judged_over,
)
from residnet.identification.fading import reach_in_free_runs
from residnet.identification.models import FitStore, FittedModel
from residnet.identification.prepared import velocity_limit
from residnet.identification.residuals import least_squares_covariance, residual_samples
from residnet.identification.settings import FitSettings, ForceConfig, GateConfig
from residnet.identification.settling import settled
from residnet.identification.solution_choice import choose_solution
from residnet.identification.validation import ValidationScore
from residnet.training.config import TrainingConfig
from residnet.training.refit import refit


@dataclass(frozen=True)
class FittedPart:
    """A baseline or a head, with what folds of the logs say of it.

    Attributes:
        model: as it was kept.
        crossed: its errors over parts of the logs that it was fitted without; None for none.
        folds: these parts; empty for none.
    """

    model: FittedModel
    crossed: Crossed | None = None
    folds: tuple[JudgedFold, ...] = ()


class Fitter:
    """The single steps of a fit on one set of logs.

    Args:
        logs: prepared logs by split; `train` and `validation` are used.
        settings: of the fit.
        store: keeps every model as it is done.
    """

    def __init__(
        self, logs: Mapping[str, Sequence[Prepared]], settings: FitSettings, store: FitStore
    ) -> None:
        self.store = store
        self.train = logs["train"]
        self.known = [*logs["train"], *logs["validation"]]
        self.signals = settings.signals.build()
        self.low, self.high = envelope(self.train)
        self.limit = velocity_limit(self.low, self.high, settings.evaluation.divergence)
        self.samples = samples(self.train, self.signals)
        self.held_back = samples(logs["validation"], self.signals)
        self.settings = settled(settings, self.samples, self.train)
        self.scales = torch.from_numpy(settings.evaluation.scales.array())
        self.crossed: Crossed | None = None
        self.folds: dict[str, tuple[JudgedFold, ...]] = {}
        self.validate = ValidationScore(
            logs["validation"],
            settings.evaluation,
            settings.prepare.grid.step,
            self.limit,
            dense=settings.recipe is not None,
        )

    def spec(self, name: str, role: str, baseline: BaselineConfig) -> ModelSpec:
        """Return the description of a model of this fit.

        Args:
            name: of the model.
            role: zero, baseline, head or ensemble.
            baseline: that it is or stands on.
        """
        settings = self.settings
        return ModelSpec.model_validate(
            {
                "schema": "residnet.model/1",
                "name": name,
                "role": role,
                "signals": settings.signals.resolved().model_dump(),
                "baseline": baseline.resolved().model_dump(),
                "head": settings.heads[name].model_dump() if role == "head" else None,
                "dt": settings.prepare.grid.step,
                "integrator": settings.integrator,
                "hold": settings.prepare.hold,
                "low": self.low.tolist(),
                "high": self.high.tolist(),
            }
        )

    def zero(self) -> FittedModel:
        """Return the model that holds the velocities."""
        spec = self.spec("zero", "zero", StillConfig())
        return self._kept(FittedModel(spec, spec.build(), {}))

    def baseline(self, name: str = "baseline") -> FittedPart:
        """Identify a baseline; refit it through rollouts where the settings ask for it."""
        spec = self.spec(name, "baseline", self.settings.all_baselines[name])
        model = spec.build()
        started = time.perf_counter()
        solutions = spec.baseline.solutions(model.baseline, self.samples)
        solution, tried = choose_solution(model, model.baseline, solutions, self.validate)
        table, covariance = list(solution.table), None
        notes: dict[str, Any] = {
            "samples": len(self.samples),
            **solution.choice,
            **solution.notes,
            **tried,
            "least_squares": self.validate(model).error,
        }
        choice = None
        if name in self.settings.refit:
            table, covariance, choice = self._refit(name, model, table, notes)
        notes["coefficients"] = [_coefficient_row(entry) for entry in table]
        notes |= self._validated(model)
        notes["seconds"] = round(time.perf_counter() - started, 1)
        kept = self._kept(FittedModel(spec, model, notes, covariance))
        if choice is None:
            return FittedPart(kept)
        own = choice.crossed.renamed({TAKEN: name, "zero": "zero"})
        return FittedPart(kept, own, choice.folds)

    def adopt(self, part: FittedPart) -> None:
        """Take up what folds of the logs say of a baseline."""
        if part.crossed is not None:
            own = part.crossed
            self.crossed = own if self.crossed is None else self.crossed.joined(own)
            self.folds[part.model.name] = part.folds

    def _refit(
        self, name: str, model: HybridDynamics, table: list[Coefficient], notes: dict[str, Any]
    ) -> tuple[list[Coefficient], torch.Tensor | None, PriorChoice | None]:
        """Move a baseline's coefficients through rollouts.

        Returns their new table, their covariance and the choice of a prior, and adds to the notes.
        """
        config, choice = self.settings.refit[name], None
        if len(config.priors) > 1:
            spec = self.spec(name, "baseline", self.settings.all_baselines[name])
            choice = choose_prior(name, spec, config, self.settings, self.known, self.limit)
            notes["prior_choice"] = choice.table
            if choice.prior is None:
                return table, None, choice
            config = config.with_prior(choice.prior)
        store = WindowStore.gather(self.train, torch.float64)
        refitted = refit(model, self.samples, store, config, self.scales)
        assert isinstance(model.baseline, ParametricBaseline)
        notes["prior"] = config.priors[0]
        names = model.baseline.free_names()
        notes["open"] = [
            name for name, lies in zip(names, refitted.open.tolist(), strict=True) if lies
        ]
        notes["feeding"] = [names[i] for i in refitted.notes["at_rest"]]
        notes["refit"] = refitted.notes
        if refitted.offsets.axes:
            notes["offsets"] = refitted.offsets.table([log.log.name for log in self.train])
        table = model.baseline.updated_table(table, refitted.errors)
        return table, refitted.covariance, choice

    def head(
        self, name: str, baseline: FittedModel, begin: FittedModel | None = None
    ) -> FittedModel:
        """Fit one head on top of a baseline, or take it from the store where it is finished there.

        Args:
            name: of the head in the settings.
            baseline: the fitted model that the head stands on.
            begin: whose weights its training starts from; None for random ones.

        Raises:
            FitError: where the data do not determine the head.
        """
        finished = self.store.finished(name)
        if finished is not None:
            return finished
        spec = self.spec(name, "head", self.settings.baseline_of(name))
        # seeded by the head's name, so that adding a head changes no other
        seed = self.settings.seed * 1_000 + sum(map(ord, name))
        torch.manual_seed(seed)
        model = spec.build()
        model.baseline.load_state_dict(copy.deepcopy(baseline.model.baseline.state_dict()))
        residual = residual_samples(model, self.samples)
        started = time.perf_counter()
        if isinstance(model.head, ClosedFormHead):
            model.head.calibrate(residual)
            try:
                solutions = model.head.solutions(residual)
                solution, tried = choose_solution(model, model.head, solutions, self.validate)
            except FitError as error:
                raise FitError(f"head {name}: {error}") from None
            notes = solution.choice | solution.notes | tried
        else:
            if begin is not None:
                model.head.load_state_dict(copy.deepcopy(begin.model.head.state_dict()))
            notes = self._train(name, model, residual, seed, baseline.covariance)
        notes |= {
            "baseline": self.settings.baseline_name_of(name),
            "seconds": round(time.perf_counter() - started, 1),
            **self._validated(model),
        }
        return self._kept(FittedModel(spec, model, notes))

    def with_force(self, name: str, base: FittedModel, config: ForceConfig) -> FittedModel:
        """Return a model with an unknown force, by the observer that validates best.

        Args:
            name: of the model.
            base: fitted model that the force is added to.
            config: time constants to choose from.
        """
        tried = []
        for observer in config.candidates():
            spec = base.spec.model_copy(update={"name": name, "disturbance": observer})
            model = spec.build()
            model.load_state_dict(base.model.state_dict())
            tried.append((self.validate(model), spec, model))
        _, spec, model = min(tried, key=lambda one: one[0])
        if base.name in self.folds and self.crossed is not None:
            # the few validation logs have chosen the time constants; all logs judge the model
            over_folds = judged_over(name, self.folds[base.name], spec, self.settings, self.limit)
            self.crossed = self.crossed.joined(over_folds) or self.crossed
        notes: dict[str, Any] = {
            **{key: base.notes[key] for key in ("refit", "baseline") if key in base.notes},
            "of": base.name,
            "force": spec.model_dump()["disturbance"],
            **self._validated(model),
        }
        return self._kept(FittedModel(spec, model, notes))

    def ensemble(self, name: str, members: Sequence[FittedModel]) -> FittedModel:
        """Return the mean of fitted models as one model."""
        spec = self.spec(name, "ensemble", StillConfig()).model_copy(
            update={"members": tuple(member.spec for member in members)}
        )
        model = mean_of([copy.deepcopy(member.model).to(torch.float64) for member in members])
        notes: dict[str, Any] = {
            "members": [member.name for member in members],
            **self._validated(model),
        }
        return self._kept(FittedModel(spec, model, notes))

    def gated(self, name: str, base: FittedModel, config: GateConfig) -> FittedModel:
        """Return a model whose residual fades to its baseline outside the training range.

        Args:
            name: of the model.
            base: fitted model with the residual.
            config: fades to choose from.
        """
        spec = base.spec.model_copy(update={"name": name, "gated": True})
        inner = copy.deepcopy(base.model).to(torch.float64)
        model = HybridDynamics(
            inner.signals,
            inner.baseline,
            GatedHead(inner.head, inner.signals.count),
            inner.dt,
            inner.integrator,
        )
        assert isinstance(model.head, GatedHead)
        model.head.calibrate(self.samples)
        left = model.head.learn_fade(residual_samples(model, self.held_back), config.fades)
        reached = reach_in_free_runs(model, self.held_back, config.fades, self.validate)
        notes: dict[str, Any] = {
            **{key: base.notes[key] for key in ("baseline", "members") if key in base.notes},
            "of": base.name,
            "fade": model.head.fade.tolist(),
            "fades_tried": left,
            "reaches_tried": reached,
            **self._validated(model),
        }
        return self._kept(FittedModel(spec, model, notes))

    def _train(
        self,
        name: str,
        model: HybridDynamics,
        residual: Samples,
        seed: int,
        covariance: Tensor | None,
    ) -> dict[str, Any]:
        from residnet.training.trainer import train

        settings = self.settings.training.get(name, TrainingConfig())
        dtype = torch.float64 if settings.double else torch.float32
        windows, folder = WindowStore.gather(self.train, dtype), self.store.training_folder
        spread = covariance
        if settings.refit_baseline and spread is None:
            spread = least_squares_covariance(model.baseline, self.samples)
        return train(
            name,
            model,
            residual,
            windows,
            settings,
            self.scales,
            self.validate,
            seed,
            folder,
            spread,
        )

    def _validated(self, model: HybridDynamics) -> dict[str, Any]:
        """Notes on a model's free runs over the validation logs."""
        diverged, error = self.validate(model)
        return {"validation": error, "validation_diverged": diverged}

    def _kept(self, fitted: FittedModel) -> FittedModel:
        """Keep a model and return it as a load gives it back.

        What is judged is then bit for bit what is stored, and a resumed fit judges the same.
        """
        kept = replace(fitted, model=rebuilt(fitted.spec, fitted.model))
        self.store.keep(kept)
        return kept


def _coefficient_row(entry: Coefficient) -> dict[str, Any]:
    return {
        "axis": entry.axis,
        "term": entry.term,
        "value": entry.value,
        "standard_error": entry.error,
    }
