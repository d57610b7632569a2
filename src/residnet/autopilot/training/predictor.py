"""Training of the predictor of Gouletas 2020: a perceptron learns responses to rudder angles.

Source: sections 6.1.1, 6.1.2, 6.2.1 and 6.2.2.
"""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import Any, NamedTuple, final

import torch
from torch import Tensor, nn

from residnet.autopilot.base import Policy
from residnet.autopilot.heading.controllers import ControlTask
from residnet.autopilot.heading.predictive import (
    NetworkPredictor,
    PredictiveConfig,
    PredictorTraining,
    SimulatedPredictor,
)
from residnet.autopilot.heading.vessels import SteeredVessel
from residnet.core.errors import UsageError
from residnet.core.format import DEGREES_PER_RADIAN
from residnet.core.progress import begin_stage, log_message
from residnet.engine.rollout import Rollout
from residnet.preprocessing.data_module import RowsDataModule
from residnet.runs.folder import RunFolder
from residnet.runs.model_store import RunModelStore
from residnet.training.trainer import EpochTraining, run_epochs


class RudderResponses(NamedTuple):
    """States [S, nx] and their simulated changes [S, 2, C] for each of C rudder angles.

    These are changes of heading [rad] and yaw rate [rad/s].
    """

    x: Tensor
    change: Tensor


def simulate_rudder_responses(
    vessel: SteeredVessel,
    exact_predictor: SimulatedPredictor,
    rudder: Tensor,
    settings: PredictorTraining,
    n_states: int,
    seed: int,
) -> RudderResponses:
    """Return the data of section 6.1.1: random states, simulated with all rudder angles.

    States are sampled from simulations with random angles, since most combinations of velocities
    do not occur. Added noise covers their neighbourhood (`settings.scatter`, relative to the
    standard deviations). An angle is held for `settings.hold` s on average, and a state is sampled
    in the first `settings.wander` s.

    Args:
        vessel: vessel in calm water.
        exact_predictor: simulation of the changes.
        rudder: angles [C] in rad.
        settings: settings of the training.
        n_states: number of states.
        seed: seed of the random numbers.
    """
    generator = torch.Generator().manual_seed(seed)
    dt = min(settings.hold / 10.0, 0.25)
    steps = math.ceil(settings.wander / dt)
    x, w = vessel.straight_course(torch.ones(n_states, dtype=torch.float64))
    # a Poisson process of changes: an angle applies from its switching step to the next one
    is_switch = torch.rand(n_states, steps, generator=generator) < dt / settings.hold
    is_switch[:, 0] = True
    last_switch = torch.where(is_switch, torch.arange(steps), 0).cummax(1).values
    angles = rudder[torch.randint(len(rudder), (n_states, steps), generator=generator)].gather(
        1, last_switch
    )
    inputs = torch.cat((angles.unsqueeze(-1), w[:, None, 1:].expand(-1, steps, -1)), dim=-1)
    # factors of rudder force and time constants, and rudder bias: no variation
    nominal_steering = torch.tensor([[1.0, 1.0, 0.0]], dtype=torch.float64).expand(n_states, -1)
    with torch.no_grad():
        trajectories = Rollout(vessel.model(dt))(x, inputs, vessel.memory(nominal_steering))[0]
        sample_steps = torch.randint(steps + 1, (n_states,), generator=generator)
        x = trajectories[torch.arange(n_states), sample_steps]
        x = x + settings.scatter * x.std(0) * torch.randn(
            x.shape, generator=generator, dtype=torch.float64
        )
        error, rate = exact_predictor(x, x[:, vessel.state_column("psi")], rudder)
    return RudderResponses(
        x, torch.stack((-error, rate - x[:, vessel.state_column("r"), None]), dim=1)
    )


@final
class PredictorFit(EpochTraining):
    """Least-squares training on the changes of heading and yaw rate, scaled by their spread.

    Args:
        predictor: network to train, float64.
        validation_set: states that are not used in training.
        settings: settings of the training.
        seed: seed of the batches.
    """

    def __init__(
        self,
        predictor: NetworkPredictor,
        validation_set: RudderResponses,
        settings: PredictorTraining,
        seed: int,
    ) -> None:
        super().__init__(settings, seed)
        self.predictor = predictor
        self.validation_set = validation_set

    def configure_optimizers(self) -> torch.optim.Optimizer:
        """Return Adam, as in the source."""
        return torch.optim.Adam(self.predictor.parameters(), lr=self.settings.learning_rate)

    def on_train_epoch_start(self) -> None:
        """Set the learning rate."""
        for group in self.trainer.optimizers[0].param_groups:
            group["lr"] = self.settings.rate(self.epoch)

    def training_step(self, rows: tuple[Tensor, Tensor], batch_index: int) -> Tensor:
        """Return the mean squared error of one batch of states and their changes."""
        loss = self._scaled_errors(RudderResponses(*rows)).square().mean()
        self._losses.append(float(loss.detach()))
        return loss

    def _scaled_errors(self, responses: RudderResponses) -> Tensor:
        errors = self.predictor.predict_changes(responses.x) - responses.change
        return errors / self.predictor.scale

    def compute_validation_score(self) -> tuple[nn.Module, float]:
        """Return the predictor and its RMS error on validation states, relative to the spread."""
        with torch.no_grad():
            return self.predictor, float(
                self._scaled_errors(self.validation_set).square().mean().sqrt()
            )


def train_predictor(
    name: str,
    predictor: NetworkPredictor,
    config: PredictiveConfig,
    task: ControlTask,
    seed: int,
    folder: Path,
) -> dict[str, Any]:
    """Train the predictor; it then has the weights of the best validation score.

    The training resumes from `checkpoints/<name>/last.ckpt` if it exists.

    Args:
        name: name of the controller.
        predictor: network to train.
        config: config of the controller and its training.
        task: the vessel in calm water and the limit of its rudder.
        seed: seed of states and batches.
        folder: folder of the run.

    Returns:
        The curve by epoch, the best score, the number of parameters, and the root mean square
        errors of heading [rad] and yaw rate [rad/s] at the end of the horizon on validation states.

    Raises:
        FitError: if no epoch has a finite error.
    """
    settings = config.training
    exact_predictor = config.build_exact_predictor(task)
    rudder = config.build_law(predictor, task).rudder
    train, validation_set = (
        simulate_rudder_responses(
            task.vessel, exact_predictor, rudder, settings, n_states, state_seed
        )
        for n_states, state_seed in (
            (settings.states, 2 * seed),
            (settings.states // 5, 2 * seed + 1),
        )
    )
    predictor = predictor.double()
    predictor.calibrate(*train)
    fit = PredictorFit(predictor, validation_set, settings, seed)
    data = RowsDataModule((train.x, train.change), settings.batch, seed, lambda: fit.epoch)
    notes = run_epochs(name, fit, data, predictor, predictor, folder)
    with torch.no_grad():
        rms_errors = (
            (predictor.predict_changes(validation_set.x) - validation_set.change)
            .square()
            .mean((0, 2))
            .sqrt()
            .tolist()
        )
    return notes | dict(zip(("rms_heading", "rms_yaw_rate"), rms_errors, strict=True))


def train_or_resume_controller(
    name: str, config: PredictiveConfig, task: ControlTask, seed: int, folder: RunFolder
) -> tuple[Policy, dict[str, Any]]:
    """Train a controller, or load the one that an interrupted run has trained.

    Args:
        name: name of the controller.
        config: config of the controller and its training.
        task: the vessel in calm water and the limit of its rudder.
        seed: seed of the weights, the states and the batches.
        folder: folder of the run.

    Returns:
        The controller, and notes on its config and on the errors of its predictions.

    Raises:
        FitError: if training fails.
    """
    torch.manual_seed(seed)
    spec = config.predictor_spec(task)
    store = RunModelStore(folder)
    network = spec.build()
    notes = store.restore_module(name, network)
    if notes is None:
        start_time = time.time()
        begin_stage(f"training {name}")
        notes = train_predictor(name, network, config, task, seed, folder.path)
        notes["seconds"] = round(time.time() - start_time, 1)
        store.save_module(name, spec, network, notes)
    degrees = [DEGREES_PER_RADIAN * notes[key] for key in ("rms_heading", "rms_yaw_rate")]
    log_message(
        f"  {name}: predicts {config.horizon:g} s ahead within {degrees[0]:.2g} deg and"
        f" {degrees[1]:.2g} deg/s (rms), {notes['seconds']:.0f} s"
    )
    return config.build_law(network, task), {"config": config.model_dump(mode="json")} | {
        key: value for key, value in notes.items() if key != "curve"
    }


def load_predictive_controller(
    name: str, config: PredictiveConfig, task: ControlTask, folder: RunFolder
) -> Policy:
    """Return the controller that a finished run has trained.

    Raises:
        UsageError: if the run has no such controller.
    """
    network = config.predictor_spec(task).build()
    if RunModelStore(folder).restore_module(name, network) is None:
        raise UsageError(f"{folder.path}: no trained '{name}' (models/{name}/model.json)")
    return config.build_law(network, task)
