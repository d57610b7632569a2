"""Settings of policy training; this module does not import Lightning, to keep `check` fast."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, model_validator

from residnet.autopilot.heading.conditions import SteadinessLimits
from residnet.core.config import Seconds
from residnet.training.config import OneStage


class PolicyTraining(OneStage):
    """Settings of the training by gradients through the closed loop under operating conditions.

    The loss of a batch is the mean cost of its simulations, plus the weighted integral of the
    absolute error, whose weight decreases to zero, plus penalties of limit cycles and overshoot in
    simulations without noise. Every batch is a new random sample. The training of a policy without
    a control law can start with the nominal vessel in calm water (`nominal`, `spread`).

    Attributes:
        epochs: largest number of epochs; each ends with a validation.
        learning_rate: initial learning rate of Adam, with cosine annealing. An epoch in full
            conditions that costs 15 % more than the initial policy is discarded: the next epoch
            starts from the best policy with half of the learning rate and a fifth of `calm` and
            `exact`.
        final: final learning rate as a fraction of the initial one.
        steps: number of batches per epoch.
        batch: number of simulations per batch.
        dt: time step in s of vessel and controller in training, except at its end.
        fine: fraction of the training, at its end, with the time step of the conditions; a limit
            cycle can be damped by a large step and appear at a small one.
        integrator: integration method of the vessel in training.
        hold: longest time in s before the change of heading in training.
        duration: time in s from the change to the end of a simulation in training; null for the
            duration of the conditions. It should be longer than the largest changes take, because
            the policy is not trained beyond it.
        nominal: fraction of the training, at its start, with the nominal vessel in calm water. It
            should be zero for a policy that starts from a tuned law.
        spread: fraction of the training after which the full conditions are used, at least
            `nominal`.
        guide: initial weight of the integral of the absolute error in deg s.
        faded: fraction of the training after which that weight is zero.
        outlying: largest gradient of one simulation as a multiple of the median of its batch; near
            instability a single gradient can be millions of times larger than the others. Only
            compiled simulations are limited.
        quiet: fraction of the simulations of a batch without noise and slow disturbance, which show
            limit cycles; half of them have vessels at corners of the ranges, a quarter has the
            nominal vessel without delay.
        calm: penalty in s of a variance of 1 deg^2 of the rudder command in the last third of these
            simulations, averaged over the worst quarter; half of the swing that `steady` allows has
            no penalty.
        exact: penalty in s of one degree of overshoot of the nominal vessel.
        excess: additional penalty in s of one degree of overshoot above `steady.overshoot_p95`, in
            all simulations.
        stricter: factor on `calm` and `exact` after every epoch that violates `steady` although it
            costs less than the initial policy.
        steady: limits that a policy must meet without noise. Epochs that meet them are preferred;
            otherwise the cost is increased by the fraction of rejected simulations. Null to select
            epochs by the cost alone.
        validation: number of simulations for the selection of the epoch.
        compiled: whether simulations and gradients are compiled as C, which needs a C compiler;
            without one the training is about 30 times slower and prints a message.
    """

    epochs: int = Field(default=18, ge=1, le=100_000)
    learning_rate: float = Field(default=4e-3, gt=0)
    final: float = Field(default=0.0, ge=0, le=1)
    steps: int = Field(default=100, ge=1, le=100_000)
    batch: int = Field(default=384, ge=2, le=1_000_000)
    dt: Seconds = Field(default=0.04, gt=0)
    fine: float = Field(default=0.3, ge=0, le=1)
    integrator: Annotated[str, Field(pattern="^(rk4|heun)$")] = "heun"
    hold: Seconds = Field(default=2.0, ge=0)
    duration: Seconds | None = Field(default=None, gt=0)
    nominal: float = Field(default=0.0, ge=0, le=1)
    spread: float = Field(default=0.0, ge=0, le=1)
    guide: float = Field(default=0.01, ge=0)
    faded: float = Field(default=0.6, gt=0, le=1)
    outlying: float = Field(default=4.0, ge=1)
    quiet: float = Field(default=0.1, ge=0, le=1)
    calm: float = Field(default=0.5, ge=0)
    exact: float = Field(default=1.0, ge=0)
    excess: float = Field(default=1.0, ge=0)
    stricter: float = Field(default=1.2, ge=1, le=10)
    steady: SteadinessLimits | None = SteadinessLimits()
    validation: int = Field(default=512, ge=2, le=1_000_000)
    compiled: bool = True

    @model_validator(mode="after")
    def _ramp(self) -> PolicyTraining:
        if self.nominal > self.spread:
            raise ValueError(
                f"nominal ({self.nominal:g}) must not be larger than spread ({self.spread:g}):"
                " the conditions grow from the end of the one to the end of the other"
            )
        return self

    def share(self, progress: float) -> float:
        """Return the fraction of the deviations from nominal conditions at a progress 0 to 1."""
        if progress >= self.spread:
            return 1.0
        return max(progress - self.nominal, 0.0) / max(self.spread - self.nominal, 1e-9)

    def error_weight(self, progress: float) -> float:
        """Return the weight of the integral of the absolute error at a progress 0 to 1."""
        return self.guide * max(1.0 - progress / self.faded, 0.0)
