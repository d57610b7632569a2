"""Tuning and training of roll-reduction policies over random seas."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, final

import numpy as np
import torch
from torch import Tensor, nn

from residnet.autopilot.roll import RollPolicy, RollRuns, RollSimulation
from residnet.autopilot.roll_config import (
    GAIN_NAMES,
    RollTraining,
    RollTuning,
    RollWeights,
    Sea,
)
from residnet.core.progress import report_progress
from residnet.preprocessing.data_module import EpochDataModule
from residnet.training.trainer import EpochTraining, run_epochs

_DEFAULT_WEIGHTS: Final = RollWeights()
_DEFAULT_TUNING: Final = RollTuning()
_DIVERGED_COST: Final = 1e6
"""Cost of a simulation that is not finite."""
_WORSE_LOSS_RATIO: Final = 1.03
"""Validation loss relative to the best one above which an epoch is discarded."""
SEARCH_RANGES: Final[Mapping[str, tuple[float, float]]] = {
    "heading_gain": (0.05, 3.0),
    "yaw_rate_gain": (0.05, 20.0),
    "filter_share": (0.005, 1.0),
    "rudder_roll_rate_gain": (0.01, 5.0),
    "rudder_roll_gain": (0.003, 3.0),
    "fin_roll_rate_gain": (0.05, 20.0),
    "fin_roll_gain": (0.01, 10.0),
}
"""Ranges of the search of each constant; the search is over logarithms."""


@final
class RollFit(EpochTraining):
    """Training of a roll policy on random seas, with new realisations in every batch.

    Args:
        policy: trained policy, float32.
        simulation: simulations of the vessel.
        seas: conditions, all in every batch.
        weights: weights of the cost.
        settings: settings of the training.
        seed: seed of batches and validation.
        start_law: law whose heading error the policy should not exceed; None for no such law.
    """

    def __init__(
        self,
        policy: RollPolicy,
        simulation: RollSimulation,
        seas: Sequence[Sea],
        weights: RollWeights,
        settings: RollTraining,
        seed: int,
        start_law: RollPolicy | None = None,
    ) -> None:
        super().__init__(settings, seed)
        self.policy = policy
        self.simulation = simulation
        self.seas = list(seas)
        self.weights = weights
        self.validation_inputs, self.validation_heights = simulation.sample_inputs(
            seas, settings.validation_rows, seed + 1_000_003
        )
        # in a tuple, because the law is no part of the trained module
        self._start_laws = () if start_law is None else (start_law,)

    def compute_loss(self, runs: RollRuns, inputs: Tensor, heights: Tensor) -> Tensor:
        """Return the mean cost, plus the penalty of a larger heading error than the start law has.

        Args:
            runs: simulations of the policy.
            inputs: their inputs, with which the start law is simulated as well.
            heights: wave heights [B] in m, which are equal within a sea state.
        """
        loss = runs.costs(heights, self.weights).mean()
        for start_law in self._start_laws:
            with torch.no_grad():
                law_runs = self.simulation.simulate(start_law, inputs)
            for height in heights.unique():
                is_state = heights == height
                policy_square, law_square = (
                    simulated.heading[is_state].square().mean() for simulated in (runs, law_runs)
                )
                excess = (policy_square / law_square).sqrt() - 1.0
                loss = loss + self.settings.heading_excess * excess.clamp(min=0.0)
        return loss

    def configure_optimizers(self) -> torch.optim.Optimizer:
        """Return Adam over the constants of the law and the network."""
        return torch.optim.Adam(self.policy.parameters(), lr=self.settings.learning_rate)

    def on_fit_start(self) -> None:
        """Validate the initial law, so that training never returns a worse policy."""
        super().on_fit_start()
        if not self.history:
            self.validate_start()

    def on_train_epoch_start(self) -> None:
        """Set the learning rate of the epoch; restart from the best policy after a worse one."""
        self.seed_epoch()
        is_worse = self.find_worse_epochs()
        optimizer = self.trainer.optimizers[0]
        if is_worse and is_worse[-1]:
            # gradients far from a good policy are useless, and so are the moments of Adam
            self.policy.load_state_dict(self.best_state)
            optimizer.state.clear()
        for group in optimizer.param_groups:
            group["lr"] = self.settings.rate(self.epoch) * 0.5 ** sum(is_worse)

    def find_worse_epochs(self) -> list[bool]:
        """Return which epochs have a validation loss far above the best before them."""
        best_loss = math.inf if self.start_score is None else self.start_score
        is_worse = []
        for entry in self.history:
            loss = entry.get("validation", best_loss)
            is_worse.append(not loss <= _WORSE_LOSS_RATIO * best_loss)
            best_loss = min(best_loss, loss)
        return is_worse

    def transfer_batch_to_device(self, batch: Any, device: torch.device, number: int) -> Any:
        """Return the batch unchanged, because policies are trained on the CPU."""
        return batch

    def training_step(self, batch: tuple[Tensor, Tensor], number: int) -> Tensor:
        """Return the loss of a batch of inputs and wave heights."""
        inputs, heights = batch
        loss = self.compute_loss(self.simulation.simulate(self.policy, inputs), inputs, heights)
        self._losses.append(float(loss.detach()))
        return loss

    def compute_validation_score(self) -> tuple[nn.Module, float]:
        """Return the policy and its loss over the validation seas."""
        with torch.no_grad():
            runs = self.simulation.simulate(self.policy, self.validation_inputs)
            loss = self.compute_loss(runs, self.validation_inputs, self.validation_heights)
        return self.policy, float(loss)


@final
class RandomSeas(EpochDataModule):
    """Random realisations of the seas of a training, new ones in every batch."""

    def __init__(self, fit: RollFit) -> None:
        super().__init__(fit.seed, lambda: fit.epoch)
        self.fit = fit

    @property
    def n_batches(self) -> int:
        return int(self.fit.settings.steps)

    def iterate_batches(self, epoch: int) -> Iterator[tuple[Tensor, Tensor]]:
        for number in range(self.n_batches):
            seed = (self.seed * 1_000 + epoch) * 1_000 + number
            yield self.fit.simulation.sample_inputs(
                self.fit.seas, self.fit.settings.rows_per_sea, seed
            )


def train_roll_policy(
    name: str,
    policy: RollPolicy,
    simulation: RollSimulation,
    seas: Sequence[Sea],
    settings: RollTraining,
    *,
    weights: RollWeights = _DEFAULT_WEIGHTS,
    seed: int = 0,
    folder: Path | None = None,
) -> dict[str, Any]:
    """Train a policy in place by the trainer of all networks, and load the best epoch.

    Args:
        name: name of the policy.
        policy: trained policy; without a network the constants of the law are trained.
        simulation: simulations of the vessel.
        seas: conditions of the training.
        settings: settings of the training.
        weights: weights of the cost.
        seed: seed of the training.
        folder: folder of the checkpoint; None for none.

    Returns:
        The curve by epoch, and the loss at the start and of the best epoch: the mean cost and the
        penalty of a larger heading error.
    """
    start_law = policy.copy_law() if policy.units > 0 else None
    fit = RollFit(policy, simulation, seas, weights, settings, seed, start_law)
    notes: dict[str, Any] = run_epochs(name, fit, RandomSeas(fit), policy, policy, folder)
    return notes


def tune_roll_law(
    simulation: RollSimulation,
    seas: Sequence[Sea],
    limits: tuple[float, float],
    tuned: Sequence[str] = GAIN_NAMES,
    *,
    weights: RollWeights = _DEFAULT_WEIGHTS,
    settings: RollTuning = _DEFAULT_TUNING,
    seed: int = 0,
) -> tuple[dict[str, float], float]:
    """Tune constants of the classical law by differential evolution; the others are zero.

    Args:
        simulation: simulations of the vessel.
        seas: conditions; all candidates are simulated in the same realisations.
        limits: limits of rudder and fins in rad.
        tuned: names of the tuned constants.
        weights: weights of the cost.
        settings: size of the search.
        seed: seed of the search.

    Returns:
        The constants by name, and their mean cost.
    """
    from scipy.optimize import differential_evolution

    inputs, heights = simulation.sample_inputs(seas, 1, seed + 11)
    n_seas = len(inputs)
    n_generations = 0

    def mean_costs(points: np.ndarray, /) -> Any:
        nonlocal n_generations
        candidates = torch.from_numpy(np.exp(points.reshape(len(tuned), -1))).float()
        n_candidates = candidates.shape[1]
        gains = {
            name: (
                candidates[tuned.index(name)]
                if name in tuned
                else torch.full((n_candidates,), float(name == "filter_share"))
            ).repeat_interleave(n_seas)
            for name in GAIN_NAMES
        }
        policy = RollPolicy(gains, limits, 0, simulation.dt)
        with torch.no_grad():
            runs = simulation.simulate(policy, inputs.repeat(n_candidates, 1, 1))
            costs = runs.costs(heights.repeat(n_candidates), weights)
        n_generations += 1
        n_expected = settings.generations + 1
        report_progress("tuning the roll law", min(n_generations, n_expected), n_expected)
        finite_costs = costs.nan_to_num(_DIVERGED_COST, _DIVERGED_COST)
        return finite_costs.reshape(n_candidates, n_seas).mean(1).double().numpy()

    bounds: Any = [
        (math.log(lower), math.log(upper)) for lower, upper in (SEARCH_RANGES[n] for n in tuned)
    ]
    result = differential_evolution(
        mean_costs,
        bounds,
        vectorized=True,
        updating="deferred",
        popsize=settings.population,
        maxiter=settings.generations,
        init="sobol",
        polish=False,
        rng=seed,
    )
    gains = {name: float(name == "filter_share") for name in GAIN_NAMES}
    gains |= dict(zip(tuned, (math.exp(value) for value in result.x), strict=True))
    return gains, float(result.fun)
