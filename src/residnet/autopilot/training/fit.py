"""Training of a recurrent policy under stated conditions, through the whole closed loop."""

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
from residnet.autopilot.heading.policies import HeadingPolicy
from residnet.autopilot.heading.vessels import SteeredVessel
from residnet.autopilot.training.config import PolicyTraining
from residnet.core.errors import ExportError
from residnet.core.progress import log_message
from residnet.engine.rollout import FreeRun
from residnet.preprocessing.data_module import EpochDataModule
from residnet.training.trainer import EpochTraining, run_epochs

_LATE = 1.0 / 3.0
"""Share of a flight at whose end a quiet one should have come to rest."""
_ALL = 1_000_000
"""Refused flights of an epoch that costs more than the start: more than there are."""
_LITTLE = 0.6
"""Share of the range of changes of heading that flights without noise are drawn from."""
_FAR = 1.15
"""Multiple of the start's cost from which an epoch has left the good policies."""
_SLOWER = 0.5
_LESS = 0.2
"""Factors on the learning rate and on the charge for swinging after every such epoch."""
_FREE = 0.5
"""Share of what the rudder may swing that costs nothing in training."""


@final
class PolicyFit(EpochTraining):
    """Trains a policy on heading changes that are drawn anew for every batch.

    Args:
        policy: what is trained, float32.
        vessel: what it steers.
        settings: of the training.
        conditions: of flights and their cost.
        seed: of batches and validation flights.
        compiler: of the flights; None to fly them as they are.
    """

    def __init__(
        self,
        policy: HeadingPolicy,
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
        self.drawn = conditions.model_copy(update=lengths)
        self.vessel = vessel
        self.compiler = compiler
        self._loops: dict[float, tuple[ClosedLoopSimulation, FreeRun]] = {}
        self._at(settings.dt)
        random = torch.Generator().manual_seed(seed + 1_000_003)
        self.unseen = conditions.sample_steps(settings.validation, conditions.dt, random)
        self.steady = None
        if settings.steady is not None:
            self.steady = LimitCycleTest(settings.steady, conditions, seed + 1_500_007)
        self.test = ClosedLoopSimulation(
            vessel,
            policy,
            conditions.dt,
            dtype=torch.float32,
            compiler=compiler,
            max_delay=max(math.ceil(conditions.delay[1] / conditions.dt), 1),
        )

    def _step(self) -> float:
        """Return the step in s of the present epoch."""
        coarse = self.epoch < round(self.settings.epochs * (1.0 - self.settings.fine))
        return self.settings.dt if coarse else self.conditions.dt

    def _at(self, dt: float) -> None:
        """Fly at a step of dt seconds from now on."""
        self.step_size = dt
        self.policy.set_step(dt)
        if dt in self._loops:
            return
        settings = self.settings
        loop = ClosedLoopSimulation(
            self.vessel, self.policy, dt, settings.integrator, torch.float32
        )
        rollout = loop.rollout(max(math.ceil(self.conditions.delay[1] / dt), 1))
        fly = compile_or_fallback(
            rollout, self.compiler, loop.rollout_arguments(self._batch(0.0, 2)), _slow
        )
        self._loops[dt] = loop, fly

    def configure_optimizers(self) -> torch.optim.Optimizer:
        """Return Adam over the policy's parameters."""
        wanted = [p for p in self.policy.parameters() if p.requires_grad]
        return torch.optim.Adam(wanted, lr=self.settings.learning_rate)

    def on_fit_start(self) -> None:
        """Validate the start too: training is kept where it brings something."""
        super().on_fit_start()
        if not self.history:
            self.validate_start()
            self.best_diverged = self.diverged

    def on_train_epoch_start(self) -> None:
        """Draw the epoch's flights anew, from a seed of its own, at the epoch's step."""
        self._at(self._step())
        if self._spoilt(self.history[-1:]):
            # far from any good policy the gradient leads nowhere; Adam's memory is of that place
            self.policy.load_state_dict(self.best_state)
            self.trainer.optimizers[0].state.clear()
        self.seed_epoch()

    def _spoilt(self, epochs: list[dict[str, float]]) -> int:
        """Return how many of some epochs cost far more than the start in full conditions."""
        settings = self.settings
        start = self.start_score
        if start is None or not self.best_state:
            return 0
        first = math.ceil(settings.spread * settings.epochs)
        costs = [
            entry["validation"]
            for entry in epochs
            if "validation" in entry and entry["epoch"] >= first
        ]
        return sum(not cost <= _FAR * start for cost in costs)

    def batch(self, number: int) -> HeadingStepBatch:
        """Return the heading changes of a batch of the present epoch, drawn anew."""
        settings = self.settings
        share = settings.share(self._progress(number))
        return self._batch(share, settings.batch, round(settings.quiet * settings.batch))

    def _progress(self, number: int) -> float:
        """Return the share of the training that is done at a batch."""
        return float((self.epoch + number / self.settings.steps) / self.settings.epochs)

    def transfer_batch_to_device(self, batch: Any, device: torch.device, number: int) -> Any:
        """Return the batch as it is: policies are trained on the CPU."""
        return batch

    def training_step(self, changes: HeadingStepBatch, number: int) -> Tensor:
        """Return the loss of one batch of heading changes."""
        settings = self.settings
        progress = self._progress(number)
        cosine = 0.5 * (1.0 + math.cos(math.pi * progress))
        rate = settings.learning_rate * _SLOWER ** self._spoilt(self.history)
        for group in self.trainer.optimizers[0].param_groups:
            group["lr"] = rate * (settings.final + (1.0 - settings.final) * cosine)
        quiet = round(settings.quiet * settings.batch)
        loop, fly = self._loops[self.step_size]
        flown = loop.to_trajectories(changes, *fly(*loop.rollout_arguments(changes))[:2])
        found = flown.step_metrics(self.conditions)
        loss: Tensor = (
            found["cost"].mean()
            + settings.guiding(progress) / self.conditions.overshoot_unit * found["iae"].mean()
        )
        if quiet > 0:
            loss = loss + self._strict() * self._unsteady(flown, found["overshoot"], quiet)
        loss = loss + self._beyond(found["overshoot"])
        self._losses.append(float(found["cost"].detach().mean()))
        return loss

    def _unsteady(self, flown: ClosedLoopTrajectories, overshoot: Tensor, quiet: int) -> Tensor:
        """Return what the quiet flights of a batch cost in s for swing and overshoot."""
        settings = self.settings
        steady = self.settings.steady
        # the standard deviation of a sine is its movement peak to peak over two roots of two
        free = 0.0 if steady is None else (_FREE * steady.rudder_swing) ** 2 / 8.0
        swing = (flown.late_command_variance(_LATE)[:quiet] - free).clamp(min=0.0)
        first = quiet // 2
        last = quiet // 2 + quiet // 4
        # large changes of the nominal vessel may still be under way
        swing = torch.cat((swing[:first], swing[last:]))
        worst = swing.topk(math.ceil(quiet / 4)).values.mean()
        cost: Tensor = math.degrees(math.degrees(settings.calm)) * worst
        if last > first:
            cost = (
                cost
                + settings.exact / self.conditions.overshoot_unit * overshoot[first:last].mean()
            )
        return cost

    def _beyond(self, overshoot: Tensor) -> Tensor:
        """Return what overshoots beyond the limit of one flight in twenty cost in s."""
        steady = self.settings.steady
        limit = math.inf if steady is None else steady.of(self.conditions.axis)[2]
        beyond: Tensor = (overshoot - limit).clamp(min=0.0).mean()
        cost: Tensor = self.settings.excess / self.conditions.overshoot_unit * beyond
        return cost

    def _strict(self) -> float:
        """Return the factor on what swing and nominal overshoot cost in this epoch.

        Epochs that cost more than the start do not count: a heavier charge would not cure them.
        """
        refused = sum(0 < entry.get("diverged", 0.0) < _ALL for entry in self.history)
        return float(self.settings.stricter**refused * _LESS ** self._spoilt(self.history))

    def _batch(self, share: float, rows: int, quiet: int = 0) -> HeadingStepBatch:
        """Return heading changes drawn anew, under a share of the conditions.

        The first `quiet` of them are without noise and slow push: first half of these at a corner
        of the spread, where a loop swings first, then a quarter that flies the nominal vessel. All
        but the latter leave out the largest changes of heading, so that the change is over when
        they are looked at for swinging. A policy's memory may keep a loop swinging behind large
        changes that does not swing behind small ones.
        """
        random = torch.Generator().manual_seed(int(torch.randint(2**62, (1,))))
        changes = self.drawn.sample_steps(rows, self.step_size, random, share)
        changes.noise[:quiet] = 0.0
        changes.push[:quiet] = 0.0
        first = quiet // 2
        number = quiet // 4
        least = self.drawn.step_range[0] * changes.target.sign()
        small = least + _LITTLE * (changes.target - least)
        for some in (slice(0, first), slice(first + number, quiet)):
            changes.target[some] = small[some]
        changes = with_nominal_rows(changes, first, number)
        return self.drawn.with_corner_rows(changes, first, random, share)

    def on_after_backward(self) -> None:
        """Reset the gradient of a batch where it is no number."""
        given = [p.grad for p in self.policy.parameters() if p.grad is not None]
        if not all(bool(torch.isfinite(grad).all()) for grad in given):
            self.trainer.optimizers[0].zero_grad()

    def _gains(self, score: float) -> bool:
        if not self.best_state or not math.isfinite(score):
            return math.isfinite(score)
        return self._rank(self.diverged, score) < self._rank(self.best_diverged, self.best_score)

    def _rank(self, refused: int, cost: float) -> tuple[bool, float]:
        """Return the order of epochs: those without refused flights, then by what flights cost.

        A refused flight counts twice.
        """
        flights = 0 if self.steady is None else self.steady.n_simulations + self.settings.validation
        share = refused / max(flights, 1)
        return refused > 0, cost * (1.0 + share)

    def validated(self) -> tuple[nn.Module, float]:
        """Return the policy and its mean cost over the flights that epochs are chosen on.

        Flights that swing are counted, and those beyond one in twenty that overshoot too far. An
        epoch that costs more than the start counts as if more of them swung than there are, so
        that it never takes the start's place.
        """
        self.policy.set_step(self.unseen.dt)
        found = self.test.simulate(self.unseen).step_metrics(self.conditions)
        score = float(found["cost"].mean())
        if self.steady is not None:
            worse = self.start_score is not None and score > self.start_score
            limit = self.steady.limits.limits_for(self.conditions.axis)[2]
            often = count_excess_overshoots(found["overshoot"], limit)
            self.diverged = _ALL if worse else self.steady.count_failures(self.test) + often
        self.policy.set_step(self.step_size)
        return self.policy, score


@final
class HeadingChangesData(EpochDataModule):
    """Heading changes that a policy meets, new ones in every batch."""

    def __init__(self, fit: PolicyFit) -> None:
        super().__init__(fit.seed, lambda: fit.epoch)
        self.fit = fit

    @property
    def n_batches(self) -> int:
        return int(self.fit.settings.steps)

    def iterate_batches(self, epoch: int) -> Iterator[HeadingStepBatch]:
        return (self.fit.batch(number) for number in range(self.n_batches))


def _slow(error: ExportError) -> None:
    log_message(f"  the flights are not compiled, training is much slower: {error}")


def train_policy(
    name: str,
    policy: HeadingPolicy,
    vessel: SteeredVessel,
    settings: PolicyTraining,
    conditions: ConditionsConfig,
    seed: int,
    folder: Path | None,
    compiler: Compiler | None = None,
) -> dict[str, Any]:
    """Train a policy and leave the weights of the epoch with the least cost in it.

    `compiler` makes the flights of the training quick. `checkpoints/<name>/last.ckpt` in the folder
    is resumed where it exists.

    Returns:
        What there is to say: the curve by epoch, the cost at the start and the best one, and how
        many flights are beyond `settings.steady`.

    Raises:
        FitError: where no epoch gave a finite cost.
    """
    fit = PolicyFit(policy.float(), vessel, settings, conditions, seed, compiler)
    notes = run_epochs(name, fit, HeadingChangesData(fit), policy, policy, folder)
    notes |= {"unsteady": fit.best_diverged}
    policy.set_step(conditions.dt)
    return notes
