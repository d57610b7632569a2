"""Fitted models, who keeps them, and the single steps of a fit: zero, a baseline, a head on a
baseline, the mean of models.
"""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from residnet.baselines import BaselineConfig
from residnet.baselines.given import StillConfig
from residnet.core.arrays import paged
from residnet.core.errors import FitError
from residnet.core.progress import say
from residnet.core.samples import Samples
from residnet.data.prepare import Prepared, envelope, samples
from residnet.data.windows import WindowStore
from residnet.dynamics.ensemble import MeanOfTrajectories, mean_of
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.store import ModelSpec, rebuilt
from residnet.heads.base import ClosedFormHead
from residnet.identification.prepared import PreparedSplits, velocity_limit
from residnet.identification.recipe import Facts
from residnet.identification.settings import FitSettings
from residnet.judge.band import Band
from residnet.judge.freerun import Candidate, Errors, free_run
from residnet.judge.protocol import EvaluationConfig, all_windows
from residnet.regression.estimator import Coefficient, Solution
from residnet.regression.sparse import coefficient_row
from residnet.training.config import TrainingConfig
from residnet.training.refit import free_run_starts, parametric, refit
from residnet.training.score import Score, Shown


@dataclass(frozen=True)
class FittedModel:
    """A model with the notes of its fit.

    Attributes:
        spec: everything that determines the model but its numbers.
        model: with its numbers filled in.
        notes: about the fit, as JSON takes them: coefficients, validation error, seconds, ...
        covariance: of the coefficients of a baseline that was refitted through rollouts, [P, P];
            None where there was no refit.
        bands: of its free runs by protocol; empty where none were calibrated.
    """

    spec: ModelSpec
    model: HybridDynamics
    notes: dict[str, Any]
    covariance: Tensor | None = None
    bands: Mapping[str, Band] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """Name of the model."""
        return self.spec.name


class FitStore:
    """Where the models of a fit are kept as they are done, so that a broken fit can go on.

    This one keeps no model.

    Args:
        training_folder: for checkpoints and the TensorBoard log; None for neither.
    """

    def __init__(self, training_folder: Path | None = None) -> None:
        self.training_folder = training_folder

    def finished(self, name: str) -> FittedModel | None:
        """Return a head that an earlier, interrupted fit had finished; None where it had not."""
        return None

    def keep(self, fitted: FittedModel) -> None:
        """Keep a model that is done."""


_FIRST = "baseline"


def references(models: Iterable[FittedModel]) -> dict[str, str]:
    """Return the name of each model's reference.

    A head is compared with the baseline that it was fitted on; an ensemble, which stands on none,
    with the baseline of the run that does best on the validation data; any other model with the
    run's first baseline, which itself has no reference.
    """
    known = {one.name: one for one in models}
    # a baseline that diverged is the worse one, whatever its error
    validated = {
        name: (
            int(one.notes.get("validation_diverged", 0)),
            float(one.notes.get("validation", math.inf)),
        )
        for name, one in known.items()
        if one.spec.role == "baseline"
    }
    best = min(validated, key=lambda name: validated[name], default=_FIRST)
    out = {}
    for name, one in known.items():
        named = {"head": str(one.notes.get("baseline", _FIRST)), "ensemble": best}
        reference = named.get(one.spec.role, _FIRST)
        if name != reference and reference in known:
            out[name] = reference
    return out


def residual_samples(model: HybridDynamics, known: Samples) -> Samples:
    """Return samples whose target is what the model's baseline leaves.

    That is an acceleration (document 003 (19)) or a force (document 002 (3.20)), as the model's
    head wants it.

    Args:
        model: with its baseline filled in.
        known: samples whose target is the measured acceleration.
    """
    with torch.no_grad():
        explained = paged.rows(len(known), known.target.shape[1])
        for rows in paged.row_pieces(len(known)):
            explained[rows] = model.baseline(known.z[rows])
            paged.forget()
        return model.head.residual_target(known, explained)


class ValidationScore:
    """The free-run score of a model on the validation logs; the windows are laid out once.

    Args:
        config: its `selection` protocol and scales are used.
        step: of the grid in s.
        limit: size of what moves [n] beyond which a free run has diverged.
        dense: windows overlap, so that few logs tell more.

    Raises:
        DataError: where no log holds a window of the protocol.
    """

    def __init__(
        self,
        logs: Sequence[Prepared],
        config: EvaluationConfig,
        step: float,
        limit: np.ndarray,
        *,
        dense: bool = False,
    ) -> None:
        self.logs = logs
        self.step = step
        self.limit = limit
        self.scales = config.scales.array()
        protocol = config.protocols[config.selection]
        self.windows = all_windows(protocol, logs, step, config.selection, dense=dense)

    def __call__(self, model: HybridDynamics) -> Score:
        """Return the divergences and the mean nrmse of the validation windows, run in float32."""
        candidate = Candidate("validated", "head", model)
        predictions = free_run(
            [candidate], self.windows, self.logs, self.step, self.limit, dtype=torch.float32
        )
        errors = Errors.of(self.windows, predictions["validated"], self.logs)
        diverged = sum(prediction.diverged for prediction in predictions["validated"])
        live = errors.live
        axes = (errors.rmse.mean(0) / self.scales)[live.axes]
        window, states = self.windows[0], predictions["validated"][0].states
        measured = self.logs[window.log].y[window.start : window.start + len(states)]
        pairs = (torch.from_numpy(part[:, live.columns]).T for part in (measured, states))
        columns = dict(zip(live.moving, zip(*pairs, strict=True), strict=True))
        columns = {name: columns[name] for name in live.channels}
        shown = Shown(self.step * torch.arange(len(states)), columns)
        named = dict(zip(live.channels, axes.tolist(), strict=True))
        return Score(diverged, float(axes.mean()), named, shown)


def burden(members: Sequence[FittedModel]) -> FittedModel | None:
    """Return the member that errs most, where it harms the mean even if errors are independent.

    The variance of a mean of K is the sum of theirs over K**2: to leave out the largest lowers it
    where that is larger than (2 K - 1) / (K - 1)**2 times the sum of the others'.
    """
    if len(members) < 2:
        return None
    worst = max(members, key=lambda one: one.notes["validation"])
    others = sum(one.notes["validation"] ** 2 for one in members if one is not worst)
    count = len(members)
    most = (2 * count - 1) / (count - 1) ** 2 * others
    return worst if worst.notes["validation"] ** 2 > most else None


def choose_solution(
    model: HybridDynamics,
    part: nn.Module,
    solutions: Sequence[Solution],
    score: Callable[[HybridDynamics], Score],
) -> tuple[Solution, dict[str, Any]]:
    """Fill a part of the model with the solution whose free run is best.

    What lies around the best is tried for as long as it gains.

    Args:
        part: its baseline or head, which the solutions belong to.
        solutions: at least one; a single one is taken as it is.
        score: of a model's free runs on validation data; fewer divergences come before less error.

    Returns:
        The solution, and for fit.json the free-run error of each; empty where there was nothing to
        choose.
    """
    tried: list[tuple[Solution, Score]] = []

    def attempt(batch: Sequence[Solution]) -> None:
        for solution in batch:
            part.load_state_dict(solution.state, strict=False)
            tried.append((solution, score(model)))

    attempt(solutions if len(solutions) > 1 else ())
    centre = _best_with_neighbours(tried)
    while centre is not None and centre[0].neighbours is not None:
        choices = [solution.choice for solution, _ in tried]
        attempt([solution for solution in centre[0].neighbours() if solution.choice not in choices])
        better = _best_with_neighbours(tried)
        if better is centre:
            break
        centre = better
    best = min(tried, key=itemgetter(1))[0] if tried else solutions[0]
    part.load_state_dict(best.state, strict=False)
    scores = [
        {**solution.choice, "validation": found.error, "diverged": found.diverged}
        for solution, found in tried
    ]
    return best, {"free_run_choice": scores} if scores else {}


def _best_with_neighbours(tried: Sequence[tuple[Solution, Score]]) -> tuple[Solution, Score] | None:
    """The best of those that have neighbours; one that has none, such as no residual at all, does
    not end the search.
    """
    return min(
        (pair for pair in tried if pair[0].neighbours is not None), key=itemgetter(1), default=None
    )


class Fitter:
    """The single steps of a fit on one set of logs.

    Args:
        logs: prepared logs by split; `train` and `validation` are used.
        store: keeps every model as it is done.
        settle: whether the recipe's parts are yet to follow from the logs.
        seen: the validation logs are among those of training, and judge nothing.
    """

    def __init__(
        self,
        logs: Mapping[str, Sequence[Prepared]],
        settings: FitSettings,
        store: FitStore,
        *,
        settle: bool = True,
        seen: bool = False,
    ) -> None:
        self.store, self.seen = store, seen
        self.train = logs["train"]
        self.signals = settings.signals.build()
        self.low, self.high = envelope(self.train)
        self.limit = velocity_limit(
            self.low, self.high, settings.evaluation.divergence, settings.signals.live
        )
        self.samples = samples(self.train, self.signals)
        self.held_back = samples(logs["validation"], self.signals)
        if settle and settings.recipe is not None:
            step = settings.prepare.grid.step
            facts = Facts.of(self.samples, self.train, settings.evaluation, step)
            settings = settings.with_parts(facts)
        self.settings = settings
        self.scales = torch.from_numpy(settings.evaluation.scales.array())
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
            role: zero, baseline, head or ensemble.
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

    def baseline(self, name: str = "baseline") -> FittedModel:
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
        if name in self.settings.refit:
            table, covariance = self._refit(name, model, table, notes)
        notes["coefficients"] = [coefficient_row(entry) for entry in table]
        notes |= self._validated(model)
        notes["seconds"] = round(time.perf_counter() - started, 1)
        return self._kept(FittedModel(spec, model, notes, covariance))

    def _refit(
        self, name: str, model: HybridDynamics, table: list[Coefficient], notes: dict[str, Any]
    ) -> tuple[list[Coefficient], torch.Tensor]:
        """Move coefficients through rollouts, to their new table and covariance."""
        config = self.settings.refit[name]
        store = WindowStore.gather(self.train, torch.float64)
        refitted = refit(model, self.samples, store, config, self.scales)
        baseline = parametric(model)
        notes["prior"] = config.prior
        names = baseline.free_names()
        notes["open"] = [
            name for name, lies in zip(names, refitted.unidentifiable.tolist(), strict=True) if lies
        ]
        notes["feeding"] = [names[i] for i in refitted.notes["at_rest"]]
        notes["refit"] = refitted.notes
        return baseline.updated_table(table, refitted.standard_errors), refitted.covariance

    def head(self, name: str, baseline: FittedModel) -> FittedModel:
        """Fit one head on top of a baseline, or take it from the store where it is finished there.

        Args:
            baseline: the fitted model that the head stands on.

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
        model = spec.single()
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
            # its module imports Lightning, which a fit without networks must not wait for
            from residnet.training.heads import train

            settings = self.settings.training.get(name, TrainingConfig())
            dtype = torch.float64 if settings.double else torch.float32
            windows, folder = WindowStore.gather(self.train, dtype), self.store.training_folder

            def validate(trained: HybridDynamics) -> Score:
                return self.validate(spec.as_one(trained))

            notes = train(
                name, model, residual, windows, settings, self.scales, validate, seed, folder
            )
        notes |= {
            "baseline": self.settings.baseline_name_of(name),
            "seconds": round(time.perf_counter() - started, 1),
            **self._validated(spec.as_one(model)),
        }
        return self._kept(FittedModel(spec, spec.as_one(model), notes))

    def ensemble(self, name: str, members: Sequence[FittedModel]) -> FittedModel:
        """Return the mean acceleration of fitted models as one model."""
        return self._kept(self._mean_of(name, members, "accelerations"))

    def mean(self, name: str, members: Sequence[FittedModel]) -> FittedModel:
        """Return the mean of what fitted models predict, each running by itself.

        Members that diverge on a validation window are left out, and so is one that errs so much
        more than the others that it harms a mean even where their errors are independent, unless
        the mean of the others errs more. Logs that the members have seen tell nothing of that.

        Raises:
            FitError: where less than two are left.
        """
        kept = [one for one in members if not one.notes.get("validation_diverged")]
        left = [one.name for one in members if one not in kept]
        if left:
            say(f"  {name}: {', '.join(left)} diverged on validation logs and is left out")
        found = self._mean_of(name, kept) if len(kept) > 1 else None
        while found is not None and not self.seen and (worst := burden(kept)) is not None:
            others = [one for one in kept if one is not worst]
            alone = self._mean_of(name, others) if len(others) > 1 else others[0]
            if alone.notes["validation"] >= found.notes["validation"]:
                break
            say(f"  {name}: without {worst.name} it errs less on validation logs")
            left, kept = [*left, worst.name], others
            found = alone if len(kept) > 1 else None
        if found is None:
            raise FitError("no mean errs less on validation logs than one of its members")
        found.notes["left_out"] = left
        return self._kept(found)

    def _mean_of(
        self, name: str, members: Sequence[FittedModel], of: str = "trajectories"
    ) -> FittedModel:
        spec = self.spec(name, "ensemble", StillConfig()).model_copy(
            update={"members": tuple(one.spec for one in members), "of": of}
        )
        parts = [copy.deepcopy(one.model).to(torch.float64) for one in members]
        single = [p.members[0] if isinstance(p, MeanOfTrajectories) else p for p in parts]
        model = spec.mean(single) if of == "trajectories" else mean_of(parts)
        notes = {"members": [one.name for one in members], **self._validated(model)}
        return FittedModel(spec, model, notes)

    def _validated(self, model: HybridDynamics) -> dict[str, Any]:
        """Notes on a model's free runs over the validation logs."""
        found = self.validate(model)
        return {"validation": found.error, "validation_diverged": found.diverged}

    def _kept(self, fitted: FittedModel) -> FittedModel:
        """Keep a model and return it as a load gives it back.

        What is judged is then bit for bit what is stored, and a resumed fit judges the same.
        """
        kept = replace(fitted, model=rebuilt(fitted.spec, fitted.model))
        self.store.keep(kept)
        return kept


def require_fit(logs: PreparedSplits, settings: FitSettings) -> Fitter:
    """Check that prepared logs hold the manoeuvres, folds and windows that a fit asks for.

    The fit itself calls the same functions, so that it refuses with the same lines.

    Returns:
        What would fit the parts, nothing fitted yet.

    Raises:
        DataError: where a split holds no sample, or no window of a protocol or of a training.
        FitError: where manoeuvres are missing that a baseline is fitted on, are too few for the
            folds of a head, or too short for a refit.
    """
    fitter = Fitter(logs, settings, FitStore())
    # with the parts of the recipe for these logs, where it is asked for
    settings = fitter.settings
    step, windows = settings.prepare.grid.step, WindowStore.gather(fitter.train)
    for baseline in settings.all_baselines.values():
        baseline.require_samples(fitter.samples)
    for moved in settings.refit.values():
        free_run_starts(windows, moved, step)
    for name, config in settings.heads.items():
        head = config.build(fitter.signals.names)
        if isinstance(head, ClosedFormHead):
            try:
                head.require_samples(fitter.samples)
            except FitError as error:
                raise FitError(f"head {name}: {error}") from None
        else:
            training = settings.training.get(name, TrainingConfig())
            for stage in training.windows(step):
                if stage is not None:
                    stage.sources(windows, training.steps)
    return fitter
