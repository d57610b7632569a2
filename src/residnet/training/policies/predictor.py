"""Training of the predictor of document 004's autopilot on simulated answers.

Sections 6.1.1, 6.1.2, 6.2.1, 6.2.2.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, NamedTuple, final

import torch
from torch import Tensor, nn

from residnet.control.heading.document_autopilot import NetworkPredictor, SimulatedPredictor
from residnet.control.heading.steering import SteeredVessel
from residnet.dynamics.rollout import Rollout
from residnet.training.epochs import EpochTraining
from residnet.training.policies.predictor_config import PredictorTraining
from residnet.training.running import run_epochs


class Answers(NamedTuple):
    """The simulated changes [S, 2, C] that each of C rudder angles brings to states [S, nx].

    Changes are of heading [rad] and yaw rate [rad/s].
    """

    x: Tensor
    change: Tensor


def simulate_answers(
    vessel: SteeredVessel,
    exact: SimulatedPredictor,
    rudder: Tensor,
    settings: PredictorTraining,
    states: int,
    seed: int,
) -> Answers:
    """Return the data of section 6.1.1: random states, simulated under all rudder angles.

    The states are those that the vessel comes through under random angles, since few combinations
    of its velocities can occur, scattered a little beyond.

    Args:
        vessel: in calm water.
        exact: simulates the vessel over the horizon.
        rudder: angles [C] in rad.
        settings: of the states.
        states: how many.
        seed: of them.
    """
    random = torch.Generator().manual_seed(seed)
    dt = min(settings.hold / 10.0, 0.25)
    steps = math.ceil(settings.wander / dt)
    x, w = vessel.start(torch.ones(states, dtype=torch.float64))
    # each angle is held for a random time: an angle that was drawn at a step stays until the next
    # drawing
    drawn = torch.rand(states, steps, generator=random) < dt / settings.hold
    drawn[:, 0] = True
    last = torch.where(drawn, torch.arange(steps), 0).cummax(1).values
    angles = rudder[torch.randint(len(rudder), (states, steps), generator=random)].gather(1, last)
    given = torch.cat((angles.unsqueeze(-1), w[:, None, 1:].expand(-1, steps, -1)), dim=-1)
    nominal = torch.tensor([[1.0, 1.0, 0.0]], dtype=torch.float64).expand(states, -1)
    with torch.no_grad():
        tracks = Rollout(vessel.model(dt))(x, given, vessel.memory(nominal))[0]
        taken = torch.randint(steps + 1, (states,), generator=random)
        x = tracks[torch.arange(states), taken]
        x = x + settings.scatter * x.std(0) * torch.randn(
            x.shape, generator=random, dtype=torch.float64
        )
        error, rate = exact(x, x[:, vessel.column("psi")], rudder)
    return Answers(x, torch.stack((-error, rate - x[:, vessel.column("r"), None]), dim=1))


@final
class PredictorFit(EpochTraining):
    """A training by least squares on the changes of heading and yaw rate.

    Each is taken over its own spread.

    Args:
        predictor: what is trained, float64.
        train: what it is trained on.
        kept: what it is validated on.
        settings: of the training.
        seed: of the batches.
    """

    def __init__(
        self,
        predictor: NetworkPredictor,
        train: Answers,
        kept: Answers,
        settings: PredictorTraining,
        seed: int,
    ) -> None:
        super().__init__(settings, seed)
        self.predictor = predictor
        self.train_answers, self.kept = train, kept

    def train_dataloader(self) -> range:
        """Return the numbers of batches; their states are drawn when the epoch begins."""
        return range(math.ceil(len(self.train_answers.x) / self.settings.batch))

    def configure_optimizers(self) -> torch.optim.Optimizer:
        """Return Adam, as in the source."""
        return torch.optim.Adam(self.predictor.parameters(), lr=self.settings.learning_rate)

    def on_train_epoch_start(self) -> None:
        """Seed the epoch, shuffle, and set the learning rate."""
        self.seed_epoch()
        self.order = torch.randperm(len(self.train_answers.x)).split(self.settings.batch)
        for group in self.trainer.optimizers[0].param_groups:
            group["lr"] = self.settings.rate(self.epoch)

    def training_step(self, number: int, batch_index: int) -> Tensor:
        """Return the mean squared error of one batch of states."""
        rows = self.order[number]
        loss = (
            self._misses(Answers(self.train_answers.x[rows], self.train_answers.change[rows]))
            .square()
            .mean()
        )
        self._losses.append(float(loss.detach()))
        return loss

    def _misses(self, answers: Answers) -> Tensor:
        return (self.predictor.changes(answers.x) - answers.change) / self.predictor.scale

    def validated(self) -> tuple[nn.Module, float]:
        """Return the predictor and its error on fresh states, as a share of the spread.

        The error is the root of the mean square.
        """
        with torch.no_grad():
            return self.predictor, float(self._misses(self.kept).square().mean().sqrt())


def train_predictor(
    name: str,
    predictor: NetworkPredictor,
    vessel: SteeredVessel,
    exact: SimulatedPredictor,
    rudder: Tensor,
    settings: PredictorTraining,
    seed: int,
    folder: Path,
) -> dict[str, Any]:
    """Train the predictor and leave the weights that validated best in it.

    `checkpoints/<name>/last.ckpt` is resumed where it exists.

    Args:
        name: of the controller.
        predictor: untrained.
        vessel: in calm water.
        exact: simulates the vessel over the horizon.
        rudder: angles [C] in rad.
        settings: see there.
        seed: of states and batches.
        folder: of the run.

    Returns:
        The curve by epoch, the best score, the number of parameters, and on states kept back the
        roots of the mean squared errors of heading [rad] and yaw rate [rad/s] at the horizon's end.

    Raises:
        FitError: where no epoch gave a finite error.
    """
    train = simulate_answers(vessel, exact, rudder, settings, settings.states, 2 * seed)
    kept = simulate_answers(vessel, exact, rudder, settings, settings.states // 5, 2 * seed + 1)
    predictor = predictor.double()
    predictor.calibrate(*train)
    notes = run_epochs(
        name, PredictorFit(predictor, train, kept, settings, seed), predictor, predictor, folder
    )
    with torch.no_grad():
        heading, rate = (
            (predictor.changes(kept.x) - kept.change).square().mean((0, 2)).sqrt().tolist()
        )
    return notes | {"rms_heading": heading, "rms_yaw_rate": rate}
