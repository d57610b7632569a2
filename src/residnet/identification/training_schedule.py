"""Training schedules of networks that follow from the training logs and the selection protocol.

A config, `residnet.fit` and the standard recipe share this schedule.
"""

from __future__ import annotations

import math
from typing import Any

from residnet.core.config import validate_config
from residnet.heads.base import ResidualHead
from residnet.heads.recurrent import GRUEnsembleHead
from residnet.identification.recipe import (
    TrainingDataSummary,
    has_long_logs,
    round_to_three_digits,
)
from residnet.physics.symmetry import mirror_channels
from residnet.training.config import TrainingConfig

_BATCH_PER_NETWORK = 32
"""Windows in a batch for each network of an ensemble."""
_BATCHES_PER_EPOCH = 15
"""Batches in each of twenty epochs of an ensemble, for short logs."""
_BATCHES_PER_EPOCH_LONG = 40
"""Batches in each of twenty epochs of an ensemble, for long logs."""


def resolve_training(
    config: TrainingConfig, head: ResidualHead, summary: TrainingDataSummary, effort: float = 1.0
) -> TrainingConfig:
    """Return the settings of a training with the stages and keys that follow from the logs.

    Args:
        config: settings as set by the user; its keys take precedence, except that an asymmetric
            pair of inputs prevents mirrored windows. A config with a stage is otherwise returned
            as it is.
        head: the network.
        summary: properties of the training logs and of the selection protocol.
        effort: factor of the number of batches.
    """
    if config.is_derived:
        if isinstance(head, GRUEnsembleHead):
            derived_settings = _schedule_coarse_ensemble(head, summary, effort)
        else:
            derived_settings = _schedule_network(head, summary, effort)
        config = validate_config(
            derived_settings | config.model_dump(mode="json"), TrainingConfig, "training"
        )
    # mirrored windows of an asymmetric vessel are wrong, whoever asked for them
    return config.model_copy(update={"mirror": False}) if summary.asymmetric_pairs else config


def _schedule_coarse_ensemble(
    head: GRUEnsembleHead, summary: TrainingDataSummary, effort: float
) -> dict[str, Any]:
    """Return the training of an ensemble at its coarse step: free runs over growing horizons.

    At this step a free run of the protocol's length has some hundred steps, so that the horizon can
    reach it without a teacher-forced stage. The length is fixed, and the last weights are taken.
    """
    stages = [
        {
            "horizon": round_to_three_digits(
                max(horizon_share * summary.max_free_run_length, 2.0 * head.training_step)
            ),
            "epochs": epochs,
            "batch": _BATCH_PER_NETWORK * head.batch_ensemble_size,
            "learning_rate": learning_rate,
            "final": final_rate_share,
        }
        # one cosine over all stages, down to a fiftieth
        for horizon_share, epochs, learning_rate, final_rate_share in (
            (0.3, 5, 3.0e-3, 0.854),
            (0.6, 5, 2.56e-3, 0.586),
            (1.0, 10, 1.5e-3, 0.04),
        )
    ]
    n_batches = _BATCHES_PER_EPOCH_LONG if has_long_logs(summary) else _BATCHES_PER_EPOCH
    return {
        "history": round_to_three_digits(summary.history),
        "multi_step": stages,
        "steps": max(1, round(n_batches * effort)),
        "start_noise": 0.03,
        "weight_decay": 0.001,
        "robust": 0.05,
        "mirror": mirror_channels(summary.channel_names) is not None,
        "validate_every": 20,
    }


_VISITS_PER_SAMPLE = 100
"""How often the teacher-forced stage visits each training sample, within the limits below."""
_MIN_BATCHES = 400
"""Smallest number of batches of the teacher-forced stage; with fewer the optimiser has not
converged.
"""
_MAX_BATCHES = 1_600
"""Largest number of batches of the teacher-forced stage; more take longer than a minute."""
_TERMS_OF_FIVE_CHANNELS = math.comb(5 + 3, 3)
"""Products up to degree 3 of three velocities and two inputs, for which these numbers were chosen.

More channels need more batches in proportion to their products: with the batches of five channels,
the free-run error of an MLP of a ferry with two azimuth thrusters (seven channels) was still
decreasing, and was twice that of three times as many batches.
"""
_MAX_CHANNEL_FACTOR = 3.0
"""Largest factor of the batches by the number of channels; it limits the duration."""
_ONE_STEP_EPOCHS = 10
"""Number of validations in the teacher-forced stage."""
_WINDOW_SAMPLES = 32
"""Samples of a teacher-forced window that the loss includes."""
_MAX_WASHOUT_SAMPLES = 32
"""Largest number of samples that fill the memory at the start of a teacher-forced window."""
_ONE_STEP_BATCH = 64
"""Windows in a batch of the teacher-forced stage."""
_FREE_RUN_STAGES = (
    # samples of a rollout, epochs, batch, learning rate at the beginning, final share of it
    (40, 2, 64, 1e-3, 0.9),
    (200, 4, 32, 1e-3, 0.05),
)
"""Free-run stages. Rollouts are at most as long as the free runs of the protocol."""


def _schedule_network(
    head: ResidualHead, summary: TrainingDataSummary, effort: float
) -> dict[str, Any]:
    """Return the training of a network at the step of the model.

    Accelerations are learned first, because a batch of them is ten times faster than a batch of
    rollouts. Rollouts follow, over two horizons, and average the noise of differentiated
    velocities. The weights with the smallest free-run error on the validation logs are taken.
    """
    dt = summary.dt
    max_horizon_samples = max(2, int(summary.max_free_run_length / dt))
    n_history = round(summary.history / dt)
    n_washout = min(n_history, _MAX_WASHOUT_SAMPLES) if head.n_state > 0 else 0
    n_window = min(_WINDOW_SAMPLES, max_horizon_samples) + n_washout
    n_visits = _VISITS_PER_SAMPLE * summary.n_samples / (_ONE_STEP_BATCH * _WINDOW_SAMPLES)
    n_terms = math.comb(len(summary.channel_names) + 3, 3)
    channel_factor = min(max(n_terms / _TERMS_OF_FIVE_CHANNELS, 1.0), _MAX_CHANNEL_FACTOR)
    n_batches = effort * channel_factor * min(max(n_visits, _MIN_BATCHES), _MAX_BATCHES)
    return {
        "history": n_history * dt,
        "steps": max(1, round(n_batches / _ONE_STEP_EPOCHS)),
        "one_step": {
            "epochs": _ONE_STEP_EPOCHS,
            "window": n_window * dt,
            "washout": n_washout * dt,
            "batch": _ONE_STEP_BATCH,
            "learning_rate": 4e-3,
            "final": 0.05,
        },
        "multi_step": [
            {
                "horizon": min(n_horizon, max_horizon_samples) * dt,
                "epochs": epochs,
                "batch": batch,
                "learning_rate": learning_rate,
                "final": final_rate_share,
            }
            for n_horizon, epochs, batch, learning_rate, final_rate_share in _FREE_RUN_STAGES
        ],
        "weight_decay": 0.001,
        "require_improvement": True,
    }
