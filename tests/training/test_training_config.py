"""Stages of training, and combinations that cannot be trained."""

from __future__ import annotations

import subprocess
import sys

import pytest

from residnet.core.config import validate
from residnet.core.errors import ConfigError
from residnet.training.config import TrainingConfig


def config(one_step: int, *multi_step: int) -> TrainingConfig:
    stages = [{"horizon": 1.0 + i, "epochs": epochs} for i, epochs in enumerate(multi_step)]
    return TrainingConfig.model_validate({"one_step": {"epochs": one_step}, "multi_step": stages})


@pytest.mark.parametrize(
    ("lengths", "expected"),
    [
        ((2,), [(0, 0), (0, 1)]),
        ((2, 1, 3), [(0, 0), (0, 1), (1, 0), (2, 0), (2, 1), (2, 2)]),
        ((0, 2, 1), [(1, 0), (1, 1), (2, 0)]),
    ],
)
def test_stage_of_each_epoch(lengths: tuple[int, ...], expected: list[tuple[int, int]]) -> None:
    settings = config(*lengths)
    assert settings.epochs == len(expected)
    assert [settings.stage(epoch) for epoch in range(settings.epochs)] == expected


def test_after_the_last_epoch_stands_the_last_stage() -> None:
    assert config(2, 3).stage(5)[0] == config(2, 3).stage(50)[0] == 1
    assert config(2).stage(2)[0] == 0


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (
            {"one_step": {"epochs": 0}},
            "nothing to train: one_step.epochs is 0 and multi_step is empty",
        ),
        (
            {"one_step": {"window": "2 s", "washout": "2 s"}},
            r"one_step: washout \(2 s\) must be shorter than window \(2 s\)",
        ),
        (
            {"multi_step": [{"horizon": 0, "epochs": 1}]},
            "multi_step.0.horizon: must be greater than 0",
        ),
        ({"multi_step": [{"epochs": 1}]}, "multi_step.0.horizon: missing"),
        ({"beginnings": {}, "one_step": {"batch": 1}}, "batches of at least 2 windows"),
        ({"beginnings": {"share": 1.0}}, "beginnings.share: must be less than 1"),
        ({"one_step": {"rate": 1e-3}}, "one_step.rate: unknown key"),
    ],
)
def test_wrong_configs(content: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        validate(content, TrainingConfig, "training")
    assert "\n" not in str(caught.value)


def test_reading_a_configuration_imports_no_lightning() -> None:
    code = (
        "import sys, residnet.training.config; print('lightning' in sys.modules or 'torch' in"
        " sys.modules)"
    )
    assert (
        subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, check=True
        ).stdout
        == "False\n"
    )
