"""Windows are mirrored only if the training logs do not contradict the symmetry of the inputs."""

from __future__ import annotations

import numpy as np
import pytest
from random_vessels import small_boat_logs
from twin_boats import simulate_twin_boats

from residnet.core.config import validate_config
from residnet.core.log import Log
from residnet.core.samples import Samples
from residnet.evaluation.protocol import EvaluationConfig
from residnet.heads.recurrent_config import GRUEnsembleConfig
from residnet.identification.recipe import (
    PreparationPlan,
    TrainingDataSummary,
    make_portfolio,
)
from residnet.identification.symmetry import find_asymmetric_pairs
from residnet.identification.training_schedule import resolve_training
from residnet.physics.signals_config import SignalsConfig
from residnet.preprocessing.prepare import PrepareConfig, PreparedLog, prepare_log
from residnet.preprocessing.samples import make_samples
from residnet.training.config import MultiStep, TrainingConfig

INPUTS = ("n_port", "n_stbd")
N_DRAWS = 20


def prepare_logs(logs: list[Log]) -> list[PreparedLog]:
    settings = PreparationPlan.from_logs(logs, INPUTS).to_config()
    config = validate_config(settings, PrepareConfig, "test")
    return [prepare_log(log, "train", INPUTS, config) for log in logs]


def collect_samples(logs: list[Log]) -> Samples:
    signals = validate_config({"inputs": list(INPUTS)}, SignalsConfig, "test").build()
    return make_samples(prepare_logs(logs), signals)


def test_symmetric_boats_are_mirrored() -> None:
    boats, _ = simulate_twin_boats(1, N_DRAWS)
    assert [find_asymmetric_pairs(collect_samples(logs)) for logs in boats] == [[]] * N_DRAWS


@pytest.mark.parametrize("name", [pytest.param(INPUTS[0], marks=pytest.mark.long), INPUTS[1]])
def test_a_reversed_motor_is_named(name: str) -> None:
    boats, _ = simulate_twin_boats(2, N_DRAWS)
    for logs in boats:
        reversed_logs = [log.replace(channels={**log.channels, name: -log[name]}) for log in logs]
        (pair,) = find_asymmetric_pairs(collect_samples(reversed_logs))
        assert pair.reversed_input == name
        assert pair.is_symmetric_with_sign
        assert pair.proposal == f"reverse the sign of {name}"


def test_unequal_propellers_get_a_gain() -> None:
    """Thrust is quadratic in the revolutions: a gain of them acts with its square root."""
    boats, strengths = simulate_twin_boats(3, N_DRAWS, weakest=0.5, strongest=0.75)
    for logs, strength in zip(boats, strengths, strict=True):
        (pair,) = find_asymmetric_pairs(collect_samples(logs))
        assert not pair.reversed_input
        assert pair.ratio == pytest.approx(np.sqrt(strength), rel=0.15)
        assert f"multiply n_stbd by {pair.ratio:.2f}" in pair.proposal


# 3 s; test_a_reversed_motor_is_named covers boats that also run astern
@pytest.mark.long
def test_boats_that_never_run_astern_are_distinguished() -> None:
    """Their inputs follow from a course controller, and all revolutions have one sign."""
    for seed in range(6):
        logs = small_boat_logs("twin", seed, 5, 60.0)
        assert find_asymmetric_pairs(collect_samples(logs)) == []
        reversed_logs = [
            log.replace(channels={**log.channels, "n_stbd": -log["n_stbd"]}) for log in logs
        ]
        (pair,) = find_asymmetric_pairs(collect_samples(reversed_logs))
        assert pair.reversed_input == "n_stbd"


def test_the_recipe_does_not_mirror_an_asymmetric_pair() -> None:
    (logs,), _ = simulate_twin_boats(4, 1)
    evaluation = {
        "protocols": {"T20": {"kind": "windows", "length": 20.0}},
        "selection": "T20",
        "scales": {"u": 1.0, "v": 1.0, "r": 1.0},
    }
    config = validate_config(evaluation, EvaluationConfig, "test")

    def make_settings(training_logs: list[Log]) -> tuple[bool, bool, float]:
        """Return whether derived and explicit trainings mirror, and the prior of the refit."""
        summary = TrainingDataSummary.from_logs(
            collect_samples(training_logs), prepare_logs(training_logs), config, 0.1
        )
        portfolio = make_portfolio(summary)
        head_settings = portfolio["heads"]["hull_network"]
        head = validate_config(head_settings, GRUEnsembleConfig, "test").build(
            summary.channel_names
        )
        explicit = TrainingConfig(multi_step=(MultiStep(horizon=2.0, epochs=1),), mirror=True)
        return (
            resolve_training(TrainingConfig(), head, summary).mirror,
            resolve_training(explicit, head, summary).mirror,
            portfolio["refit"]["hull"]["asymmetric"],
        )

    assert make_settings(logs) == (True, True, 0.05)
    reversed_logs = [
        log.replace(channels={**log.channels, "n_stbd": -log["n_stbd"]}) for log in logs
    ]
    assert make_settings(reversed_logs) == (False, False, 0.0)
