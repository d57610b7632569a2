"""Tuning of heading controllers by differential evolution, under stated conditions."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, final

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from residnet.control.heading.conditions import (
    ConditionedFlights,
    ConditionedRun,
    ConditionsConfig,
    HeadingChanges,
)
from residnet.control.heading.controllers import Steering, TunableConfig
from residnet.core.config import Config
from residnet.core.errors import ExportError, FitError

if TYPE_CHECKING:
    from residnet.dynamics.compiled import CompiledRollout

_ROWS = 4096
"""Flights that are flown side by side."""
_LOST = 1e3
"""Cost in s of a flight that is lost, far above that of any other."""


class TuningConfig(Config):
    """Settings of the search for the parameters of classical controllers.

    Attributes:
        flights: that every candidate flies, the same for all.
        population: candidates of a generation per parameter.
        generations: at most.
        tolerance: the search ends where the costs of a generation differ by less than this share.
    """

    flights: int = Field(default=64, ge=2, le=1_000_000)
    population: int = Field(default=8, ge=2, le=10_000)
    generations: int = Field(default=25, ge=1, le=10_000)
    tolerance: float = Field(default=1e-4, ge=0)


@dataclass(frozen=True)
class TuningResult:
    """Tuned parameters, their mean cost [s] over the tuning flights, and the candidates tried."""

    parameters: dict[str, float]
    cost: float
    tried: int


def tune(
    config: TunableConfig,
    steering: Steering,
    conditions: ConditionsConfig,
    settings: TuningConfig,
    seed: int,
    compiler: type[CompiledRollout] | None = None,
) -> TuningResult:
    """Return the missing parameters of least mean cost, by differential evolution.

    What a law may do without is searched with and without it. `compiler` makes the flights of the
    search quick.

    Source: R. Storn and K. Price, 1997; scipy's implementation, over the logarithms.

    Raises:
        FitError: where no candidate gives a finite cost.
    """
    # scipy.optimize takes a third of a second to import
    from scipy.optimize import differential_evolution

    random = torch.Generator().manual_seed(seed)
    changes = conditions.draw(settings.flights, conditions.dt, random)
    given = config.parameters()
    fixed = {name: value for name, value in given.items() if value is not None}
    names = [name for name, value in given.items() if value is None]
    steering = steering._replace(dt=conditions.dt)
    trials = Trials(config, steering, conditions, changes, compiler)

    def costs(points: np.ndarray, /) -> Any:
        searched = torch.from_numpy(np.exp(points.reshape(len(names), -1).T))
        candidates = {name: searched[:, j] for j, name in enumerate(names)}
        candidates |= {
            name: torch.full((len(searched),), value, dtype=torch.float64)
            for name, value in fixed.items()
        }
        return trials.costs(candidates).numpy()

    if not names:
        alone = {name: torch.tensor([value]).double() for name, value in fixed.items()}
        return TuningResult(fixed, float(trials.costs(alone)[0]), 1)
    axes = config.axes(steering.turning)
    bounds: Any = [(math.log(axes[name].low), math.log(axes[name].high)) for name in names]
    found = differential_evolution(
        costs,
        bounds,
        vectorized=True,
        updating="deferred",
        popsize=settings.population,
        maxiter=settings.generations,
        tol=settings.tolerance,
        init="sobol",
        polish=False,
        rng=seed,
    )
    if not found.fun < _LOST:
        raise FitError(
            f"no {config.model_dump()['kind']} controller of {found.nfev} tried holds the vessel"
            " under these conditions; widen the rudder's limit or narrow the conditions"
        )
    best = dict(zip(names, (math.exp(value) for value in found.x), strict=True))
    ordered = {name: best.get(name, fixed.get(name, 0.0)) for name in given}
    result = TuningResult(ordered, float(found.fun), int(found.nfev))
    if not (idle := {name: end for name in names if (end := axes[name].idle) is not None}):
        return result
    simpler = tune(config.tuned(idle), steering, conditions, settings, seed, compiler)
    return min(result, simpler, key=lambda each: each.cost)


@final
class Trials:
    """Flights of candidates for the parameters of a controller, all over the same changes.

    Args:
        steering: its task, at the step of the changes.
        conditions: with the cost.
        compiler: of the flights; None to fly them as they are.
    """

    def __init__(
        self,
        config: TunableConfig,
        steering: Steering,
        conditions: ConditionsConfig,
        changes: HeadingChanges,
        compiler: type[CompiledRollout] | None = None,
    ) -> None:
        self.config, self.steering, self.conditions = config, steering, conditions
        self.changes, self.compiler = changes, compiler
        self.loop: CompiledRollout | None = None
        self.given: dict[int, tuple[HeadingChanges, tuple[Tensor, Tensor, Tensor]]] = {}

    def costs(self, candidates: dict[str, Tensor]) -> Tensor:
        """Return the mean cost [C] in s of candidates, parameters [C] by name.

        One that diverges costs a thousand seconds.
        """
        flights = len(self.changes.heading)
        count = len(next(iter(candidates.values())))
        at_once = max(_ROWS // flights, 1)
        out = []
        for first in range(0, count, at_once):
            some = {name: values[first : first + at_once] for name, values in candidates.items()}
            size = len(next(iter(some.values())))
            rows = {name: values.repeat_interleave(flights) for name, values in some.items()}
            flown = self._flown(rows, size)
            cost = flown.measured(self.conditions)["cost"].reshape(size, flights)
            out.append(cost.double().nan_to_num(_LOST, _LOST).clamp(max=_LOST).mean(1))
        return torch.cat(out)

    def _flown(self, rows: dict[str, Tensor], size: int) -> ConditionedFlights:
        policy = self.config.rows(rows, self.steering).float().requires_grad_(False)
        run = ConditionedRun(self.steering.vessel, policy, self.changes.dt, "heun", torch.float32)
        if size not in self.given:
            again = self.changes.repeated(size)
            x, w, s = run.given(again)
            # rows next to each other in memory, as the compiled flights take them
            self.given[size] = again, (x, w.permute(1, 2, 0).contiguous().permute(2, 0, 1), s)
        changes, given = self.given[size]
        if self.compiler is None:
            return run.fly(changes)
        rollout = run.rollout(max(int(changes.delay.max()), 1))
        try:
            if self.loop is None:
                own = [f"source.policy.{name}" for name in self.config.own]
                self.loop = self.compiler(rollout, *given, own=own)
        except ExportError:
            # what cannot be compiled is flown as it is
            self.compiler = None
            return run.fly(changes)
        return run.flights(changes, *self.loop.of(rollout)(*given)[:2])
