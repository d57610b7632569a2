"""Wave-frequency heading motion from yaw rates: found where it is, and nowhere else."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from residnet.autopilot.heading.conditions import sample_gauss_markov, sample_wave_motion
from residnet.autopilot.heading.wave_motion import estimate_wave_motion

DT = 0.1
COUNT = 6000


def draw_disturbances(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return white noise and a slow disturbance of yaw rates [COUNT] in rad/s."""
    generator = torch.Generator().manual_seed(seed)
    white_noise = torch.randn(COUNT, generator=generator).numpy() * math.radians(0.1)
    slow = sample_gauss_markov(1, COUNT, DT / 5.0, generator)[0].numpy() * math.radians(0.2)
    return white_noise, slow


@pytest.mark.parametrize(("period", "std_deg"), [(4.0, 0.5), (6.5, 1.0), (9.0, 1.5)])
def test_amplitude_and_period_of_a_seaway(period: float, std_deg: float) -> None:
    generator = torch.Generator().manual_seed(1)
    motion = sample_wave_motion(torch.tensor([period]), COUNT, DT, generator)[0, :, 1].numpy()
    white_noise, slow = draw_disturbances(2)
    waves = estimate_wave_motion([white_noise + slow + math.radians(std_deg) * motion], DT)
    assert waves is not None
    assert math.degrees(waves.heading_std) == pytest.approx(std_deg, rel=0.2)
    assert waves.period == pytest.approx(period, rel=0.2)


@pytest.mark.parametrize("seed", range(6))
def test_noise_and_slow_disturbances_are_no_waves(seed: int) -> None:
    white_noise, slow = draw_disturbances(seed)
    assert estimate_wave_motion([white_noise + slow, white_noise, slow], DT) is None


def test_records_shorter_than_the_periods_are_not_used() -> None:
    assert estimate_wave_motion([np.zeros(100)], DT) is None
