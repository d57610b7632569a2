"""Training of a heading policy through the closed loop.

The one time loop carries gradients through vessel and policy.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, final

import torch
from torch import Tensor, nn

from residnet.control.base import ClosedLoop, GivenReference, Policy
from residnet.control.heading.imitation import SideBySide
from residnet.control.heading.policy import HeadingPolicy
from residnet.control.heading.steering import Measured, SteeredVessel
from residnet.core.frames import wrap
from residnet.dynamics.rollout import Rollout
from residnet.training.epochs import EpochTraining
from residnet.training.policies.autopilot_config import AutopilotTraining, SpreadConfig
from residnet.training.running import run_epochs

Score = Callable[[HeadingPolicy], float]


@final
class AutopilotFit(EpochTraining):
    """Trains a policy on heading changes of varied vessels, drawn anew for every batch.

    Args:
        policy: what is trained, float32.
        vessel: what it steers.
        settings: of the training.
        spread: of vessels, starts and disturbances.
        score: of a policy, for the choice of the best epoch; less is better.
        teacher: a controller to imitate; None to train for fast changes without overshoot.
        seed: of the batches.
    """

    def __init__(
        self,
        policy: HeadingPolicy,
        vessel: SteeredVessel,
        settings: AutopilotTraining,
        spread: SpreadConfig,
        score: Score,
        teacher: Policy | None,
        seed: int,
    ) -> None:
        super().__init__(settings, seed)
        self.policy = policy
        self.vessel, self.spread, self.score, self.teacher = vessel, spread, score, teacher
        self.model = vessel.model(settings.dt, settings.integrator).requires_grad_(False)
        self.seen = Measured(policy, vessel.state, {"psi": spread.noise_psi, "r": spread.noise_r})
        self.columns = vessel.column("psi"), vessel.column("r")

    def train_dataloader(self) -> range:
        """Return the numbers of batches; what is in them is drawn when they are used.

        A loader of PyTorch would draw random numbers of its own.
        """
        return range(self.settings.steps)

    def configure_optimizers(self) -> torch.optim.Optimizer:
        """Return Adam over the policy's parameters."""
        return torch.optim.Adam(self.policy.parameters(), lr=self.settings.learning_rate)

    def on_fit_start(self) -> None:
        """Validate the start too: training is kept where it brings something."""
        super().on_fit_start()
        if not self.history:
            self.validate_start()

    def on_train_epoch_start(self) -> None:
        """Seed the epoch and set the learning rate."""
        self.seed_epoch()
        self.policy.dt = self.settings.dt
        for group in self.trainer.optimizers[0].param_groups:
            group["lr"] = self.settings.rate(self.epoch)

    def training_step(self, number: int, batch_index: int) -> Tensor:
        """Return the loss of one batch of heading changes."""
        rows, steps = self.settings.batch, round(self.settings.horizon / self.settings.dt)
        x, w, heading, variation, calm = self._draw(rows)
        reference = GivenReference(heading[:, None, None])
        w = w.unsqueeze(1).expand(-1, steps, -1)
        if self.teacher is not None:
            difference = SideBySide(self.seen, self.teacher, reference)
            Rollout(self.model, difference)(x, w, self.vessel.memory(variation))
            loss: Tensor = difference.total / (steps * self.policy.limit**2)
        else:
            states, inputs, _ = Rollout(self.model, ClosedLoop(self.seen, reference))(
                x, w, self.vessel.memory(variation)
            )
            error = wrap(heading[:, None] - states[:, 1:, self.columns[0]])
            loss = (
                self.cost(error, heading, variation, calm)
                + self.settings.smoothness
                * (inputs[:, :, 0].diff(dim=1) / self.policy.limit).square().mean()
            )
        self._losses.append(float(loss.detach()))
        return loss

    def on_after_backward(self) -> None:
        """Reset the gradient of a batch where it is no number.

        Through hundreds of steps of a saturated loop a single flight's can overflow.
        """
        given = [p.grad for p in self.policy.parameters() if p.grad is not None]
        if not all(bool(torch.isfinite(grad).all()) for grad in given):
            self.trainer.optimizers[0].zero_grad()

    def _draw(self, rows: int) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """States [B, nx], inputs [B, m], headings [B], variations [B, 3], and which rows start
        straight ahead without disturbance [B].
        """
        spread = self.spread
        low, high = spread.speed
        x, w = self.vessel.start(low + (high - low) * torch.rand(rows))
        heading = spread.heading * (2.0 * torch.rand(rows) - 1.0)
        straight = torch.arange(rows) % 8 < 5
        undisturbed = torch.rand(rows) >= spread.disturbed
        x[:, self.columns[1]] = torch.where(
            straight, 0.0, self.policy.gain * self.policy.limit * (2.0 * torch.rand(rows) - 1.0)
        )
        bias = torch.where(undisturbed, 0.0, spread.bias * (2.0 * torch.rand(rows) - 1.0))
        for name, values in spread.draw_weather(rows).items() if spread.weather else ():
            w[:, self.vessel.inputs.index(name)] = torch.where(undisturbed, 0.0, values)
        return (
            x,
            w,
            heading,
            torch.cat((spread.draw(rows), bias.unsqueeze(1)), dim=1),
            straight & undisturbed,
        )

    def cost(self, error: Tensor, heading: Tensor, variation: Tensor, calm: Tensor) -> Tensor:
        """Return the cost of errors [B, T] after changes of heading [B].

        Time outside the band, absolute error and overshoot count.

        The share |e| / (|e| + band) counts time, so that small changes weigh as much as large ones.
        Where the start already turns or something pushes, the vessel cannot be known in time and an
        overshoot may be unavoidable: these count little.
        """
        settings, size = self.settings, error.abs()
        outside = size / (size + settings.band) + settings.sharp * torch.sigmoid(
            (size - settings.band) * (5.0 / settings.band)
        )
        relative = size / (heading.abs()[:, None] + 5.0 * settings.band)
        over = torch.relu(-error * heading.sign()[:, None] - settings.margin) / settings.band
        most = over.amax(1)
        over = torch.where(calm, most + 5.0 * over.mean(1) + 5.0 * most.square(), 0.05 * most)
        slow = (variation[:, 1] / variation[:, 0]) ** settings.slowest * torch.where(
            calm, 1.0, 0.25
        )
        weight = slow / slow.mean()
        missed = (weight * (outside + 0.5 * relative).mean(1)).mean()
        cost: Tensor = missed + settings.overshoot * over.mean()
        return cost

    def validated(self) -> tuple[nn.Module, float]:
        """Return the policy and its score."""
        score = self.score(self.policy)
        self.policy.float()
        return self.policy, score


def train_autopilot(
    name: str,
    policy: HeadingPolicy,
    vessel: SteeredVessel,
    settings: AutopilotTraining,
    spread: SpreadConfig,
    score: Score,
    seed: int,
    folder: Path,
    teacher: Policy | None = None,
) -> dict[str, Any]:
    """Train a policy and leave the weights that scored best in it.

    `checkpoints/<name>/last.ckpt` in the folder is resumed where it exists.

    Returns:
        What there is to say: the curve by epoch, the best score, the number of parameters.

    Raises:
        FitError: where no epoch gave a finite score.
    """
    fit = AutopilotFit(
        policy.float(),
        vessel,
        settings,
        spread,
        score,
        None if teacher is None else teacher.float(),
        seed,
    )
    return run_epochs(name, fit, policy, policy, folder)
