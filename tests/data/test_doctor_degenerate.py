"""The doctor on logs whose channels hold little or nothing."""

from __future__ import annotations

import numpy as np
import pytest
from known_logs import wavy

from residnet.core.log import Log
from residnet.data.doctor import inspect
from residnet.data.doctor.findings import with_channels
from residnet.data.doctor.kinematics import position_causes
from residnet.data.doctor.statistics import Record


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("way", ["zero", "constant", "half unknown"])
def test_channels_without_content_are_told_and_stop_nothing(way: str) -> None:
    log = wavy()
    for name, values in log.channels.items():
        sick = values.copy()
        if way == "zero":
            sick[:] = 0.0
        elif way == "constant":
            sick[:] = sick[20]
        else:
            sick[len(sick) // 2 :] = np.nan
        # reports may say what they like: to end with one is what counts
        assert inspect(with_channels(log, **{name: sick}), inputs=["delta"]).lines(), name


@pytest.mark.filterwarnings("error")
def test_a_moored_vessel_is_inspected() -> None:
    log = wavy()
    still = {name: np.full(len(log), 0.1) for name in ("x", "y", "psi")}
    rest = {name: np.zeros(len(log)) for name in "uvr"}
    report = inspect(with_channels(log, **still, **rest), inputs=["delta"])
    assert report.lines()


def turn_on_the_spot(seed: int) -> Log:
    """A vessel that turns steadily, at velocities no larger than their noise."""
    random = np.random.default_rng(seed)
    t = 0.05 * np.arange(1200)
    u, v, r = np.outer((0.03, 0.033, -0.19), 1.0 - np.exp(-t / 0.8))

    def integral(rate: np.ndarray) -> np.ndarray:
        return np.append(0.0, np.cumsum(0.025 * (rate[1:] + rate[:-1])))

    psi = integral(r)
    place = integral(np.exp(1j * psi) * (u + 1j * v))
    noise = random.standard_normal((3, t.size)) * np.array([[0.03], [0.03], [0.003]])
    channels = {"x": place.real, "y": place.imag, "psi": psi}
    return Log("spot", t, channels | dict(zip("uvr", np.stack((u, v, r)) + noise, strict=True)))


def test_noise_of_velocities_is_no_scale_of_theirs() -> None:
    # a lever arm can stand for the steady part, and then noise decides on the scale
    for seed in range(20):
        causes = position_causes(Record(turn_on_the_spot(seed)))
        gains = [causes[name].values for name in causes if name.startswith("gain")]
        assert np.abs(np.concatenate([[0.0], *gains])).max() < 0.3, seed
