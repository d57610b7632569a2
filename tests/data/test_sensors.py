"""Sensors of simulated trials: what existing configs measure, and bias, noise, sampling and latency
per channel.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from residnet.core.config import validate
from residnet.core.errors import ConfigError
from residnet.data.sea import SensorNoise
from residnet.data.simulated import SimulatedTrials, simulate

TRIALS: dict[str, Any] = {
    "kind": "simulated",
    "vessel": "wam_v_cal",
    "duration": 60,
    "step": 0.1,
    "substeps": 1,
    "trials": [
        {"kind": "constant", "drive": [0.4], "steer": [0.3]},
        {"kind": "zigzag", "count": 3, "heading": ["20 deg"]},
    ],
    "identification": {"zigzag": 1},
    "validation": {},
}


def logs(noise: dict[str, Any], seed: int = 0) -> list[Any]:
    config = validate(TRIALS | {"noise": noise, "seed": seed}, SimulatedTrials, "here")
    return simulate(config.draw(), config)


CLEAN = {"u": 0.0, "v": 0.0, "r": 0.0}


def test_white_noise_is_drawn_as_it_always_was() -> None:
    """After the forces of the same generator, three values per sample; nothing else moves."""
    quiet, noisy = logs(CLEAN, 5), logs({"u": 0.1, "v": 0.2, "r": 0.05}, 5)
    random = np.random.default_rng([5, 3])
    random.standard_normal((len(quiet), 600, 3))
    noise = random.standard_normal((len(quiet), 600, 3)) * [0.1, 0.2, 0.05]
    for i, (a, b) in enumerate(zip(quiet, noisy, strict=True)):
        for j, name in enumerate(("u", "v", "r")):
            np.testing.assert_array_equal(b[name], a[name] + noise[i, :, j])
        for name in ("x", "y", "psi", "n_port", "cmd_port"):
            np.testing.assert_array_equal(a[name], b[name])


def test_noise_and_bias_of_one_channel_leave_the_others_alone() -> None:
    truth, seen = (
        logs({}),
        logs({"sensors": {"psi": {"noise": "2 deg", "bias": "-1 deg"}, "x": {"bias": 3}}}),
    )
    for a, b in zip(truth, seen, strict=True):
        error = np.degrees(b["psi"] - a["psi"])
        assert error.std() == pytest.approx(2.0, rel=0.1)
        assert error.mean() == pytest.approx(-1.0, abs=0.3)
        np.testing.assert_allclose(b["x"] - a["x"], 3.0, rtol=1e-12)
        for name in ("u", "v", "r", "y", "n_stbd"):
            np.testing.assert_array_equal(a[name], b[name])
    assert (
        np.corrcoef(seen[0]["psi"] - truth[0]["psi"], seen[1]["psi"] - truth[1]["psi"])[0, 1] < 0.2
    )


def test_a_slow_sensor_is_empty_between_its_samples() -> None:
    truth, seen = logs(CLEAN), logs(CLEAN | {"sensors": {"x": {"interval": "1 s"}}})
    for a, b in zip(truth, seen, strict=True):
        known = np.isfinite(b["x"])
        assert known.sum() == 60
        np.testing.assert_array_equal(np.flatnonzero(known), np.arange(0, 600, 10))
        np.testing.assert_array_equal(b["x"][known], a["x"][known])


def test_latency_shows_the_past() -> None:
    truth, seen = (
        logs(CLEAN),
        logs(CLEAN | {"sensors": {"r": {"latency": "300 ms"}, "psi": {"latency": "250 ms"}}}),
    )
    for a, b in zip(truth, seen, strict=True):
        np.testing.assert_allclose(b["r"][3:], a["r"][:-3], rtol=0, atol=1e-12)
        np.testing.assert_array_equal(b["r"][:3], np.full(3, a["r"][0]))
        np.testing.assert_allclose(
            b["psi"][3:], 0.5 * (a["psi"][:-3] + a["psi"][1:-2]), rtol=0, atol=1e-12
        )


def test_a_config_keeps_its_numbers_when_it_is_written_and_read_again() -> None:
    first = validate({"sensors": {"psi": {"noise": "2 deg"}}}, SensorNoise, "here")
    assert first.sensors["psi"].noise == pytest.approx(np.radians(2))
    assert validate(first.model_dump(mode="json"), SensorNoise, "again") == first


@pytest.mark.parametrize(
    ("sensors", "message"),
    [
        ({"psy": {"noise": 1}}, "no channel 'psy'; did you mean 'psi'"),
        ({"psi": {"noise": "2 m"}}, "does not measure"),
        ({"psi": {"noise": -0.1}}, "must not be negative"),
        ({"u": {"noise": 0.1}}, "given as noise.u"),
        ({"x": {"interval": 0.25}}, "not a multiple of the log's step, 0.1 s"),
        ({"x": {"interval": 0.01}}, "not a multiple"),
        ({"x": {"latency": -1}}, "latency"),
        ({"delta": {"bias": "1 deg"}}, "vessel 'wam_v_cal' has no channel 'delta'"),
    ],
)
def test_wrong_sensors_are_one_line(sensors: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        logs({"sensors": sensors})
    assert "\n" not in str(caught.value)
