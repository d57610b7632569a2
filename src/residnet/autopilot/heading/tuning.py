"""Tune the constants of classical heading laws by differential evolution."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, final

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from residnet.autopilot.heading.conditions import (
    ClosedLoopSimulation,
    ClosedLoopTrajectories,
    ConditionsConfig,
    HeadingStepBatch,
)
from residnet.autopilot.heading.controllers import ControlTask, TunableConfig
from residnet.core.config import Config
from residnet.core.errors import ExportError, FitError
from residnet.core.progress import report_progress

if TYPE_CHECKING:
    from residnet.engine.compiled import CompiledRollout


_BATCH_SIZE = 4096
"""Number of simulations per batch."""
_DIVERGED_COST = 1e3
"""Cost in s of a diverged simulation, far above all others."""


class TuningConfig(Config):
    """Settings of the differential evolution that tunes classical controllers.

    Attributes:
        flights: number of simulations per candidate; all candidates use the same ones.
        population: candidates per generation and parameter.
        generations: largest number of generations.
        tolerance: relative spread of the costs of a generation at which the search ends.
    """

    flights: int = Field(default=64, ge=2, le=1_000_000)
    population: int = Field(default=8, ge=2, le=10_000)
    generations: int = Field(default=25, ge=1, le=10_000)
    tolerance: float = Field(default=1e-4, ge=0)


@dataclass(frozen=True)
class TuningResult:
    """Tuned parameters, their mean cost in s over the simulations, and the number of candidates."""

    parameters: dict[str, float]
    cost: float
    n_candidates: int


def tune_parameters(
    config: TunableConfig,
    task: ControlTask,
    conditions: ConditionsConfig,
    settings: TuningConfig,
    seed: int,
    compiler: type[CompiledRollout] | None = None,
    stage: str = "tuning",
) -> TuningResult:
    """Tune the missing parameters of a controller for the lowest mean cost.

    The method is differential evolution (R. Storn and K. Price, 1997; scipy's implementation) over
    the logarithms of the parameters. A parameter that can be disabled is searched with and without.

    Args:
        config: controller with None for the parameters to tune.
        task: vessel, rudder limit and time step.
        conditions: operating conditions and cost.
        settings: settings of the search.
        seed: seed of conditions and search.
        compiler: compiles the simulations; None for none.
        stage: name of the progress reports, one per generation.

    Raises:
        FitError: if no candidate has a finite cost.
    """
    # scipy.optimize takes a third of a second to import
    from scipy.optimize import differential_evolution

    generator = torch.Generator().manual_seed(seed)
    steps = conditions.sample_steps(settings.flights, conditions.dt, generator)
    parameters = config.parameter_values()
    fixed = {name: value for name, value in parameters.items() if value is not None}
    names = [name for name, value in parameters.items() if value is None]
    task = task._replace(dt=conditions.dt)
    evaluation = CandidateEvaluation(config, task, conditions, steps, compiler)

    def costs(points: np.ndarray, /) -> Any:
        """Return the costs of candidates, given as logarithms of the tuned parameters [P, B]."""
        candidate_values = torch.from_numpy(np.exp(points.reshape(len(names), -1).T))
        candidates = {name: candidate_values[:, j] for j, name in enumerate(names)}
        candidates |= {
            name: torch.full((len(candidate_values),), value, dtype=torch.float64)
            for name, value in fixed.items()
        }
        return evaluation.mean_costs(candidates).numpy()

    # without a parameter to tune, only the cost is computed
    if not names:
        fixed_candidate = {name: torch.tensor([value]).double() for name, value in fixed.items()}
        return TuningResult(fixed, float(evaluation.mean_costs(fixed_candidate)[0]), 1)
    axes = config.search_ranges(task.nomoto)
    n_generations = 0

    def report_generation(*_: Any, **__: Any) -> None:
        nonlocal n_generations
        n_generations += 1
        report_progress(stage, n_generations, settings.generations)

    bounds: Any = [(math.log(axes[name].lower), math.log(axes[name].upper)) for name in names]
    result_de = differential_evolution(
        costs,
        bounds,
        vectorized=True,
        updating="deferred",
        popsize=settings.population,
        maxiter=settings.generations,
        tol=settings.tolerance,
        init="sobol",
        polish=False,
        callback=report_generation,
        rng=seed,
    )
    if not result_de.fun < _DIVERGED_COST:
        raise FitError(
            f"none of {result_de.nfev} {config.model_dump()['kind']} controllers stabilises the"
            " vessel under these conditions; widen the rudder's limit or narrow the conditions"
        )
    best_parameters = dict(zip(names, (math.exp(value) for value in result_de.x), strict=True))
    ordered_parameters = {
        name: best_parameters.get(name, fixed.get(name, 0.0)) for name in parameters
    }
    tuned = TuningResult(ordered_parameters, float(result_de.fun), int(result_de.nfev))
    if not (
        disabled_parameters := {
            name: disabled for name in names if (disabled := axes[name].disabled_value) is not None
        }
    ):
        return tuned
    # the search is over logarithms, which exclude the value that disables a parameter
    simpler_result = tune_parameters(
        config.with_parameters(disabled_parameters),
        task,
        conditions,
        settings,
        seed,
        compiler,
        stage,
    )
    return min(tuned, simpler_result, key=lambda result: result.cost)


@final
class CandidateEvaluation:
    """Simulations of candidate parameters of a controller over the same heading changes.

    Args:
        config: controller.
        task: vessel, rudder limit and time step of the changes.
        conditions: operating conditions with the cost.
        steps: heading changes, the same for all candidates.
        compiler: compiles the simulations; None for none.
    """

    def __init__(
        self,
        config: TunableConfig,
        task: ControlTask,
        conditions: ConditionsConfig,
        steps: HeadingStepBatch,
        compiler: type[CompiledRollout] | None = None,
    ) -> None:
        self.config = config
        self.task = task
        self.conditions = conditions
        self.steps = steps
        self.compiler = compiler
        self.compiled_rollout: CompiledRollout | None = None
        self.cached_arguments: dict[
            int, tuple[HeadingStepBatch, tuple[Tensor, Tensor, Tensor]]
        ] = {}

    def mean_costs(self, candidates: dict[str, Tensor]) -> Tensor:
        """Return the mean cost [C] in s of candidates given as parameters [C] by name.

        A diverged simulation costs 1000 s.
        """
        n_simulations = len(self.steps.target)
        n_total = len(next(iter(candidates.values())))
        candidates_per_batch = max(_BATCH_SIZE // n_simulations, 1)
        costs_found = []
        for first_candidate in range(0, n_total, candidates_per_batch):
            candidate_batch = {
                name: values[first_candidate : first_candidate + candidates_per_batch]
                for name, values in candidates.items()
            }
            n_candidates = len(next(iter(candidate_batch.values())))
            row_parameters = {
                name: values.repeat_interleave(n_simulations)
                for name, values in candidate_batch.items()
            }
            trajectories = self._simulate_candidates(row_parameters, n_candidates)
            cost = trajectories.step_metrics(self.conditions)["cost"].reshape(
                n_candidates, n_simulations
            )
            costs_found.append(
                cost.double()
                .nan_to_num(_DIVERGED_COST, _DIVERGED_COST)
                .clamp(max=_DIVERGED_COST)
                .mean(1)
            )
        return torch.cat(costs_found)

    def _simulate_candidates(
        self, row_parameters: dict[str, Tensor], n_candidates: int
    ) -> ClosedLoopTrajectories:
        """Simulate all candidates in one batch, compiled if possible.

        Args:
            row_parameters: value of each parameter for each row of the batch.
            n_candidates: number of candidates, which have the same simulations each.
        """
        policy = self.config.build_batched(row_parameters, self.task).float().requires_grad_(False)
        simulation = ClosedLoopSimulation(
            self.task.vessel, policy, self.steps.dt, "heun", torch.float32
        )
        if n_candidates not in self.cached_arguments:
            repeated_steps = self.steps.repeat(n_candidates)
            x, w, s = simulation.rollout_arguments(repeated_steps)
            # contiguous rows, as the compiled simulation requires
            self.cached_arguments[n_candidates] = (
                repeated_steps,
                (x, w.permute(1, 2, 0).contiguous().permute(2, 0, 1), s),
            )
        steps, arguments = self.cached_arguments[n_candidates]
        if self.compiler is None:
            return simulation.simulate(steps)
        rollout = simulation.rollout(max(int(steps.delay_steps.max()), 1))
        try:
            if self.compiled_rollout is None:
                per_row_names = [f"source.policy.{name}" for name in self.config.batched_parameters]
                self.compiled_rollout = self.compiler(
                    rollout, *arguments, row_tensors=per_row_names
                )
        except ExportError:
            # a loop that cannot be compiled is simulated in torch
            self.compiler = None
            return simulation.simulate(steps)
        return simulation.to_trajectories(
            steps, *self.compiled_rollout.with_rollout(rollout)(*arguments)[:2]
        )
