"""Train a recurrent policy under operating conditions, by gradients through the closed loop."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any, final

import torch
from torch import Tensor, nn

from residnet.autopilot.heading.conditions import (
    ClosedLoopSimulation,
    ClosedLoopTrajectories,
    Compiler,
    ConditionsConfig,
    HeadingStepBatch,
    LimitCycleTest,
    compile_or_fallback,
    count_excess_overshoots,
    with_nominal_rows,
)
from residnet.autopilot.heading.policies import SteeringPolicy
from residnet.autopilot.heading.vessels import SteeredVessel
from residnet.autopilot.training.config import PolicyTraining
from residnet.core.errors import ExportError
from residnet.core.progress import log_message
from residnet.engine.rollout import FreeRun
from residnet.preprocessing.data_module import EpochDataModule
from residnet.training.trainer import EpochTraining, run_epochs

_LATE_FRACTION = 1.0 / 3.0
"""Final fraction of a simulation in which the rudder of a stable loop should be constant."""
_ALL_REJECTED = 1_000_000
"""Number of rejected simulations that stands for an epoch with a higher cost than the initial
policy; larger than any actual number.
"""
_SMALL_STEP_FRACTION = 0.6
"""Fraction of the range of reference changes used for simulations without noise."""
_DIVERGED_COST_RATIO = 1.15
"""Ratio to the initial cost above which an epoch counts as diverged."""
_LEARNING_RATE_FACTOR = 0.5
"""Factor on the learning rate after each diverged epoch."""
_PENALTY_FACTOR = 0.2
"""Factor on the penalty of limit cycles after each diverged epoch."""
_FREE_SWING_FRACTION = 0.5
"""Fraction of the allowed rudder swing that has no penalty in training."""


@final
class PolicyFit(EpochTraining):
    """Training of a policy on random heading changes, with a new sample in every batch.

    Args:
        policy: trained policy, float32.
        vessel: steered vessel.
        settings: settings of the training.
        conditions: operating conditions and cost.
        seed: seed of batches and validation.
        compiler: compiles simulations and their gradients; None for none.
    """

    def __init__(
        self,
        policy: SteeringPolicy,
        vessel: SteeredVessel,
        settings: PolicyTraining,
        conditions: ConditionsConfig,
        seed: int,
        compiler: Compiler | None,
    ) -> None:
        super().__init__(settings, seed)
        self.policy = policy
        self.conditions = conditions
        duration = conditions.duration if settings.duration is None else settings.duration
        lengths = {"hold": min(settings.hold, conditions.hold), "duration": duration}
        self.training_conditions = conditions.model_copy(update=lengths)
        self.vessel = vessel
        self.compiler = compiler
        self._loops: dict[float, tuple[ClosedLoopSimulation, FreeRun]] = {}
        self._use_time_step(settings.dt)
        generator = torch.Generator().manual_seed(seed + 1_000_003)
        self.validation_steps = conditions.sample_steps(
            settings.validation, conditions.dt, generator
        )
        self.limit_cycle_test = None
        if settings.steady is not None:
            self.limit_cycle_test = LimitCycleTest(settings.steady, conditions, seed + 1_500_007)
        self.validation_loop = ClosedLoopSimulation(
            vessel,
            policy,
            conditions.dt,
            dtype=torch.float32,
            compiler=compiler,
            max_delay=max(math.ceil(conditions.delay[1] / conditions.dt), 1),
        )

    def _epoch_time_step(self) -> float:
        """Return the time step of the current epoch in s: a fine one at the end of the training."""
        is_coarse = self.epoch < round(self.settings.epochs * (1.0 - self.settings.fine))
        return self.settings.dt if is_coarse else self.conditions.dt

    def _use_time_step(self, dt: float) -> None:
        """Set the time step, and build the closed loop for a new time step."""
        self.time_step = dt
        self.policy.set_step(dt)
        if dt in self._loops:
            return
        settings = self.settings
        loop = ClosedLoopSimulation(
            self.vessel, self.policy, dt, settings.integrator, torch.float32
        )
        rollout = loop.rollout(max(math.ceil(self.conditions.delay[1] / dt), 1))
        simulate = compile_or_fallback(
            rollout,
            self.compiler,
            loop.rollout_arguments(self._sample_batch(0.0, 2)),
            _warn_not_compiled,
        )
        self._loops[dt] = loop, simulate

    def configure_optimizers(self) -> torch.optim.Optimizer:
        """Return Adam over the policy's parameters."""
        trainable = [p for p in self.policy.parameters() if p.requires_grad]
        return torch.optim.Adam(trainable, lr=self.settings.learning_rate)

    def on_fit_start(self) -> None:
        """Validate the initial policy, so that training never returns a worse one."""
        super().on_fit_start()
        if not self.history:
            self.validate_start()
            self.best_diverged = self.diverged

    def on_train_epoch_start(self) -> None:
        """Set time step and seed of the epoch; restart from the best policy after divergence."""
        self._use_time_step(self._epoch_time_step())
        if self._count_diverged_epochs(self.history[-1:]):
            # gradients far from a good policy are useless, and so are the moments of Adam
            self.policy.load_state_dict(self.best_state)
            self.trainer.optimizers[0].state.clear()
        self.seed_epoch()

    def _count_diverged_epochs(self, epochs: list[dict[str, float]]) -> int:
        """Count epochs whose cost in full conditions is far above the initial cost."""
        settings = self.settings
        initial_cost = self.start_score
        if initial_cost is None or not self.best_state:
            return 0
        first_full_epoch = math.ceil(settings.spread * settings.epochs)
        costs = [
            entry["validation"]
            for entry in epochs
            if "validation" in entry and entry["epoch"] >= first_full_epoch
        ]
        return sum(not cost <= _DIVERGED_COST_RATIO * initial_cost for cost in costs)

    def batch(self, number: int) -> HeadingStepBatch:
        """Sample the heading changes of a batch in the current epoch."""
        settings = self.settings
        share = settings.share(self._training_progress(number))
        return self._sample_batch(share, settings.batch, round(settings.quiet * settings.batch))

    def _training_progress(self, number: int) -> float:
        """Return the completed fraction of the training at a batch."""
        return float((self.epoch + number / self.settings.steps) / self.settings.epochs)

    def transfer_batch_to_device(self, batch: Any, device: torch.device, number: int) -> Any:
        """Return the batch unchanged, because policies are trained on the CPU."""
        return batch

    def training_step(self, changes: HeadingStepBatch, number: int) -> Tensor:
        """Return the loss of one batch of heading changes."""
        settings = self.settings
        progress = self._training_progress(number)
        cosine = 0.5 * (1.0 + math.cos(math.pi * progress))
        rate = settings.learning_rate * _LEARNING_RATE_FACTOR ** self._count_diverged_epochs(
            self.history
        )
        for group in self.trainer.optimizers[0].param_groups:
            group["lr"] = rate * (settings.final + (1.0 - settings.final) * cosine)
        n_quiet = round(settings.quiet * settings.batch)
        loop, simulate = self._loops[self.time_step]
        rollout_results = simulate(*loop.rollout_arguments(changes))
        trajectories = loop.to_trajectories(changes, *rollout_results[:2])
        metrics = trajectories.step_metrics(self.conditions)
        loss: Tensor = (
            metrics["cost"].mean()
            + settings.error_weight(progress)
            / self.conditions.overshoot_unit
            * metrics["iae"].mean()
        )
        if n_quiet > 0:
            loss = loss + self._penalty_weight() * self._limit_cycle_penalty(
                trajectories, metrics["overshoot"], n_quiet
            )
        loss = loss + self._overshoot_penalty(metrics["overshoot"])
        self._losses.append(float(metrics["cost"].detach().mean()))
        return loss

    def _limit_cycle_penalty(
        self, trajectories: ClosedLoopTrajectories, overshoot: Tensor, n_quiet: int
    ) -> Tensor:
        """Return the penalty in s for rudder swing and overshoot without noise.

        Args:
            trajectories: simulations of a batch.
            overshoot: overshoot [B] of the simulations in rad or m.
            n_quiet: number of simulations without noise, which come first.
        """
        settings = self.settings
        steady = self.settings.steady
        # the standard deviation of a sine is its peak-to-peak range divided by 2 sqrt(2)
        free_variance = (
            0.0 if steady is None else (_FREE_SWING_FRACTION * steady.rudder_swing) ** 2 / 8.0
        )
        late_variance = trajectories.late_command_variance(_LATE_FRACTION)[:n_quiet]
        excess = (late_variance - free_variance).clamp(min=0.0)
        # without the nominal vessel, whose large changes may not be complete at the evaluation
        nominal_rows = slice(n_quiet // 2, n_quiet // 2 + n_quiet // 4)
        excess = torch.cat((excess[: nominal_rows.start], excess[nominal_rows.stop :]))
        largest_excess = excess.topk(math.ceil(n_quiet / 4)).values.mean()
        # `calm` is the penalty per deg^2 of variance
        cost: Tensor = math.degrees(math.degrees(settings.calm)) * largest_excess
        if nominal_rows.stop > nominal_rows.start:
            cost = (
                cost
                + settings.exact / self.conditions.overshoot_unit * overshoot[nominal_rows].mean()
            )
        return cost

    def _overshoot_penalty(self, overshoot: Tensor) -> Tensor:
        """Return the penalty in s for overshoot above the limit of its 95th percentile."""
        steady = self.settings.steady
        limit = (
            math.inf if steady is None else steady.limits_for(self.conditions.axis).overshoot_p95
        )
        mean_excess: Tensor = (overshoot - limit).clamp(min=0.0).mean()
        cost: Tensor = self.settings.excess / self.conditions.overshoot_unit * mean_excess
        return cost

    def _penalty_weight(self) -> float:
        """Return the factor on the penalty of limit cycles and overshoot in this epoch.

        It grows with the number of rejected epochs. Epochs that cost more than the initial policy
        are not counted, because a larger penalty would not improve them.
        """
        n_rejected = sum(0 < entry.get("diverged", 0.0) < _ALL_REJECTED for entry in self.history)
        return float(
            self.settings.stricter**n_rejected
            * _PENALTY_FACTOR ** self._count_diverged_epochs(self.history)
        )

    def _sample_batch(self, share: float, rows: int, n_quiet: int = 0) -> HeadingStepBatch:
        """Sample heading changes, the first `n_quiet` of them without noise and slow disturbance.

        Half of the quiet simulations have vessels at corners of the ranges, where limit cycles
        occur first, and a quarter has the nominal vessel. Except for the nominal vessel, quiet
        simulations have only small reference changes, so that the change is complete when limit
        cycles are evaluated. The memory of a policy can sustain a limit cycle after large changes
        that does not occur after small ones, which is why the nominal vessel keeps them.

        Args:
            share: fraction of the deviations from the nominal conditions, 0 to 1.
            rows: number of simulations.
            n_quiet: number of simulations without noise.
        """
        generator = torch.Generator().manual_seed(int(torch.randint(2**62, (1,))))
        conditions = self.training_conditions
        changes = conditions.sample_steps(rows, self.time_step, generator, share)
        changes.noise[:n_quiet] = 0.0
        changes.push[:n_quiet] = 0.0
        n_corner = n_quiet // 2
        n_nominal = n_quiet // 4
        smallest = conditions.step_range[0] * changes.target.sign()
        small_target = smallest + _SMALL_STEP_FRACTION * (changes.target - smallest)
        for quiet_rows in (slice(0, n_corner), slice(n_corner + n_nominal, n_quiet)):
            changes.target[quiet_rows] = small_target[quiet_rows]
        changes = with_nominal_rows(changes, n_corner, n_nominal)
        return conditions.with_corner_rows(changes, n_corner, generator, share)

    def on_after_backward(self) -> None:
        """Discard the gradient of a batch if it is not finite."""
        gradients = [p.grad for p in self.policy.parameters() if p.grad is not None]
        if not all(bool(torch.isfinite(grad).all()) for grad in gradients):
            self.trainer.optimizers[0].zero_grad()

    def _is_improvement(self, score: float) -> bool:
        if not self.best_state or not math.isfinite(score):
            return math.isfinite(score)
        return self._rank_key(self.diverged, score) < self._rank_key(
            self.best_diverged, self.best_score
        )

    def _rank_key(self, n_rejected: int, cost: float) -> tuple[bool, float]:
        """Return the sort key of an epoch: epochs without rejected simulations first, then by cost.

        The cost is increased by the fraction of rejected simulations.
        """
        n_simulations = (
            0
            if self.limit_cycle_test is None
            else self.limit_cycle_test.n_simulations + self.settings.validation
        )
        rejected_fraction = n_rejected / max(n_simulations, 1)
        return n_rejected > 0, cost * (1.0 + rejected_fraction)

    def compute_validation_score(self) -> tuple[nn.Module, float]:
        """Return the policy and its mean cost over the validation simulations.

        Simulations with limit cycles, and overshoots above the limit in excess of 5 %, are counted
        as rejected. An epoch that costs more than the initial policy is rejected as a whole.
        """
        self.policy.set_step(self.validation_steps.dt)
        trajectories = self.validation_loop.simulate(self.validation_steps)
        metrics = trajectories.step_metrics(self.conditions)
        score = float(metrics["cost"].mean())
        if self.limit_cycle_test is not None:
            is_worse = self.start_score is not None and score > self.start_score
            limit = self.limit_cycle_test.limits.limits_for(self.conditions.axis).overshoot_p95
            n_overshoots = count_excess_overshoots(metrics["overshoot"], limit)
            n_limit_cycles = self.limit_cycle_test.count_failures(self.validation_loop)
            self.diverged = _ALL_REJECTED if is_worse else n_limit_cycles + n_overshoots
        self.policy.set_step(self.time_step)
        return self.policy, score


@final
class HeadingChangesData(EpochDataModule):
    """Random heading changes of the training, a new sample in every batch."""

    def __init__(self, fit: PolicyFit) -> None:
        super().__init__(fit.seed, lambda: fit.epoch)
        self.fit = fit

    @property
    def n_batches(self) -> int:
        return int(self.fit.settings.steps)

    def iterate_batches(self, epoch: int) -> Iterator[HeadingStepBatch]:
        return (self.fit.batch(number) for number in range(self.n_batches))


def _warn_not_compiled(error: ExportError) -> None:
    log_message(f"  the simulations are not compiled, training is much slower: {error}")


def train_policy(
    name: str,
    policy: SteeringPolicy,
    vessel: SteeredVessel,
    settings: PolicyTraining,
    conditions: ConditionsConfig,
    seed: int,
    folder: Path | None,
    compiler: Compiler | None = None,
) -> dict[str, Any]:
    """Train a policy in place and load the weights of the best epoch.

    A checkpoint `checkpoints/<name>/last.ckpt` in the folder is resumed.

    Args:
        name: name of the policy.
        policy: trained policy.
        vessel: steered vessel.
        settings: settings of the training.
        conditions: operating conditions and cost.
        seed: seed of the training.
        folder: run folder; None for no checkpoints.
        compiler: compiles simulations and their gradients; None for none.

    Returns:
        The curve by epoch, the initial and the best cost, and the number of rejected simulations
        (`unsteady`).

    Raises:
        FitError: if no epoch has a finite cost.
    """
    fit = PolicyFit(policy.float(), vessel, settings, conditions, seed, compiler)
    notes = run_epochs(name, fit, HeadingChangesData(fit), policy, policy, folder)
    notes |= {"unsteady": fit.best_diverged}
    policy.set_step(conditions.dt)
    return notes
