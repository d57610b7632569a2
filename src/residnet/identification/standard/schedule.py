"""Sizes, horizons and trainings of the standard recipe, from sampling and length of the logs."""

from __future__ import annotations

from typing import Any

from residnet.identification.standard.facts import Facts

_LONGEST = 300
"""Steps of the longest rollouts that a network is trained through."""
_REFIT = 200
"""Steps of the free runs of a refit, where its share of the protocol's length is less."""
_EPOCH = 25


def refit_settings(facts: Facts) -> dict[str, Any]:
    """Return the refit of a baseline: several strengths of its prior, one chosen in free run."""
    horizon = min(facts.longest, max(0.2 * facts.length, _REFIT * facts.step))
    return {
        "horizon": readable(horizon),
        "every": readable(0.5 * horizon),
        "prior": [1.0, 1e-2, 1e-4],
        "asymmetric": 0.05,
    }


def hidden_size(facts: Facts) -> int:
    """Return the number of hidden units that so many samples can fill."""
    return 16 if facts.samples < 8_000 else 24 if facts.samples < 20_000 else 32


def training_settings(facts: Facts, effort: float) -> dict[str, Any]:
    """Return the training of a network in free run, over growing horizons."""
    longest = min(facts.longest, _LONGEST * facts.step)
    stages = [
        {"horizon": readable(share * longest), "epochs": epochs, "batch": _batch(facts), **rates}
        for share, epochs, rates in (
            (0.25, 2, {"learning_rate": 3e-3}),
            (0.5, 4, {"learning_rate": 3e-3, "final": 0.5}),
            (1.0, 8, {"learning_rate": 1.5e-3, "final": 0.05}),
        )
    ]
    return {
        "history": readable(facts.history),
        "one_step": {"epochs": 0},
        "multi_step": stages,
        "steps": max(1, round(_EPOCH * effort)),
        "average": 0.98,
        "start_noise": 0.03,
        "weight_decay": 0.001,
        "robust": 0.05,
        "from_baseline": True,
        "patience": 5,
    }


def calibration_settings(facts: Facts, effort: float, begin: str) -> dict[str, Any]:
    """Return the training that moves a network and its baseline together, from a trained one."""
    longest = min(facts.longest, _LONGEST * facts.step)
    stage = {
        "horizon": readable(longest),
        "epochs": 4,
        "batch": _batch(facts),
        "learning_rate": 1e-3,
        "final": 0.05,
    }
    return {
        **training_settings(facts, effort),
        "multi_step": [stage],
        "from_baseline": False,
        "begin_with": begin,
        "refit_baseline": True,
    }


def readable(value: float) -> float:
    """Return a number of at most three digits."""
    return float(f"{value:.3g}")


def _batch(facts: Facts) -> int:
    return 128 if facts.samples < 20_000 else 256
