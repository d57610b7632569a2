"""Disturbances of simulated trials: what existing configs draw, statistics of gusts, and what a
plant cannot feel.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from scipy.signal import lfilter

from residnet.core.config import validate
from residnet.core.errors import ConfigError
from residnet.data.sea import (
    Disturbance,
    WindField,
    gusty_wind,
    ornstein_uhlenbeck,
)
from residnet.data.simulated import SimulatedTrials, simulate
from residnet.physics.vessel import load_vessel, vessel_files

TRIALS: dict[str, Any] = {
    "kind": "simulated",
    "vessel": "wam_v_cal",
    "duration": 20,
    "step": 0.1,
    "substeps": 1,
    "seed": 3,
    "trials": [
        {"kind": "constant", "drive": [0.4, 0.9], "steer": [0.3]},
        {"kind": "zigzag", "count": 2, "heading": ["20 deg"], "start": 3},
    ],
    "identification": {"zigzag": 1},
    "validation": {},
}
WAVES = {
    "significant_height": 0.3,
    "peak_period": 3.0,
    "direction": "90 deg",
    "hull": {"length": 4.9, "breadth": 1.0, "draught": 0.2},
}
WIND = {
    "kind": "symmetric",
    "frontal_area": 2.0,
    "lateral_area": 4.0,
    "length": 4.9,
    "c_x": 0.7,
    "c_y": 0.8,
    "c_n": 0.1,
    "source": "made",
}


@pytest.fixture
def windy(tmp_path: Path) -> str:
    """A vessel file with wind coefficients."""
    content = yaml.safe_load(vessel_files()["wam_v_cal"].read_text())
    path = tmp_path / "windy.yaml"
    path.write_text(yaml.safe_dump(content | {"wind": WIND}, sort_keys=False))
    return str(path)


def trials(**changes: Any) -> SimulatedTrials:
    return validate(TRIALS | changes, SimulatedTrials, "here")


def test_random_forces_are_drawn_as_they_always_were() -> None:
    """Data of one seed stay the same for good: the process written out, three draws per step,
    sampled from its stationary state.
    """
    disturbance = Disturbance(
        force_x=20, force_y=10, force_n=15, correlation=4, current_north=0.2, current_east=-0.1
    )
    plant = load_vessel("wam_v_cal").build()
    found = disturbance.series(plant, 3, 50, 0.1, 7, np.random.default_rng([7, 3]))
    keep = np.exp(-0.1 / 4)
    drive = np.random.default_rng([7, 3]).standard_normal((3, 50, 3)) * np.sqrt(1 - keep**2)
    drive[:, 0] /= np.sqrt(1 - keep**2)
    expected = np.zeros((3, 50, 9))
    expected[:, :, 2:5] = lfilter([1.0], [1.0, -keep], drive, axis=1) * [20, 10, 15]
    expected[:, :, 5], expected[:, :, 6] = 0.2, -0.1
    np.testing.assert_array_equal(found, expected)


def test_new_disturbances_leave_old_draws_alone(windy: str) -> None:
    """Wind and waves have generators of their own: noise and random forces stay the same."""
    plant = load_vessel(windy).build()
    forces = {"force_x": 20.0, "force_n": 15.0}
    plain, full = (
        Disturbance.model_validate(forces),
        validate(
            forces | {"wind": {"speed": 5, "direction": 1.0, "gust": 1.0}, "waves": WAVES},
            Disturbance,
            "here",
        ),
    )
    series = [d.series(plant, 2, 30, 0.1, 0, np.random.default_rng(0)) for d in (plain, full)]
    np.testing.assert_array_equal(series[0][:, :, :-2], series[1][:, :, :-2])
    assert np.ptp(series[1][:, :, -2]) > 0.1


def test_current_by_speed_and_direction() -> None:
    assert Disturbance(current_speed=2.0, current_direction=np.pi / 2).current() == pytest.approx(
        (0.0, 2.0)
    )
    with pytest.raises(ConfigError, match="belong together"):
        validate({"current_speed": "1 kn"}, Disturbance, "here")
    with pytest.raises(ConfigError, match="given twice"):
        validate(
            {"current_speed": 1, "current_direction": 0, "current_east": 0.1}, Disturbance, "here"
        )


def test_each_trial_may_have_a_current_of_its_own() -> None:
    disturbance = validate(
        {"current_north": 1.0, "current_each": ["0.1 m/s", 0.4]}, Disturbance, "here"
    )
    drawn = disturbance.currents(400, 3)
    speed, direction = (
        np.hypot(drawn[:, 0] - 1.0, drawn[:, 1]),
        np.arctan2(drawn[:, 1], drawn[:, 0] - 1.0),
    )
    assert 0.1 <= speed.min() < 0.11 < 0.39 < speed.max() <= 0.4
    assert abs(np.exp(1j * direction).mean()) < 0.15
    np.testing.assert_array_equal(drawn, disturbance.currents(400, 3))
    plant = load_vessel("wam_v_cal").build()
    series = disturbance.series(plant, 400, 5, 0.1, 3, np.random.default_rng(0))
    np.testing.assert_array_equal(series[:, :, 5:7], np.repeat(drawn[:, None], 5, axis=1))
    with pytest.raises(ConfigError, match="is faster than the fastest"):
        validate({"current_each": [0.4, 0.1]}, Disturbance, "here")


def test_gusts_have_the_stated_spread_memory_and_spectrum() -> None:
    step, time = 0.5, 6.0
    process = ornstein_uhlenbeck(np.random.default_rng(0), (200, 2048, 1), step, time)[:, :, 0]
    assert process.var() == pytest.approx(1.0, rel=0.03)
    lag = 12
    assert np.mean(process[:, lag:] * process[:, :-lag]) == pytest.approx(
        np.exp(-lag * step / time), abs=0.03
    )
    power = (np.abs(np.fft.rfft(process, axis=1)) ** 2).mean(0) * step / process.shape[1] / np.pi
    omega = 2 * np.pi * np.fft.rfftfreq(process.shape[1], step)
    low = (omega > 0.02) & (omega < 0.8)
    np.testing.assert_allclose(
        power[low], (2 * time / np.pi) / (1 + (omega[low] * time) ** 2), rtol=0.35
    )
    np.testing.assert_allclose(
        power[low].mean(), ((2 * time / np.pi) / (1 + (omega[low] * time) ** 2)).mean(), rtol=0.05
    )


def test_wind_without_gusts_is_steady_and_gusts_are_isotropic() -> None:
    speed, direction = gusty_wind(WindField(speed=7.0, direction=2.0), 2, 10, 0.1, 0).values()
    np.testing.assert_allclose(speed, 7.0)
    np.testing.assert_allclose(direction, 2.0)
    speed, direction = gusty_wind(
        WindField(speed=7.0, direction=2.0, gust=1.0, correlation=1.0),
        20,
        3000,
        0.5,
        0,
    ).values()
    assert (speed >= 0).all()
    assert (speed * np.sin(direction - 2.0)).std() == pytest.approx(1.0, rel=0.03)
    assert (speed * np.cos(direction - 2.0)).std() == pytest.approx(1.0, rel=0.03)


def test_waves_move_a_vessel_and_one_seed_gives_one_log() -> None:
    config = trials(disturbance={"waves": WAVES}, noise={"u": 0, "v": 0, "r": 0})
    calm = simulate(config.draw(), trials(noise={"u": 0, "v": 0, "r": 0}))
    rough, again = simulate(config.draw(), config), simulate(config.draw(), config)
    for a, b, still in zip(rough, again, calm, strict=True):
        assert all(np.array_equal(a[name], b[name]) for name in a.channels)
        assert (a["v"] - still["v"]).std() > 0.02
    # the constant inputs did not change; a zigzag may
    np.testing.assert_array_equal(rough[0]["cmd_port"], calm[0]["cmd_port"])


def test_the_true_wind_stands_in_the_log(windy: str) -> None:
    config = trials(
        vessel=windy, disturbance={"wind": {"speed": "12 kn", "direction": "200 deg", "gust": 0.5}}
    )
    log = simulate(config.draw(), config)[0]
    assert log.units["wind_speed"] == "m/s"
    assert log["wind_speed"].mean() == pytest.approx(12 * 1852 / 3600, abs=1.0)
    assert np.degrees(log["wind_dir"].mean()) == pytest.approx(200, abs=10)
    assert (
        "wind_speed" not in simulate(trials(vessel=windy).draw(), trials(vessel=windy))[0].channels
    )


@pytest.mark.parametrize(
    ("disturbance", "message"),
    [
        (
            {"wind": {"speed": 5, "direction": 0}},
            r"disturbance.wind: vessel 'wam_v_cal' has no input 'wind_speed'; give its vessel file",
        ),
        ({"wind": {"speed": 5}}, "direction"),
        ({"waves": {"peak_period": 3}}, "significant_height"),
        ({"current": 3}, "did you mean 'current_east'"),
    ],
)
def test_what_a_vessel_cannot_feel_is_one_line(disturbance: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        trials(disturbance=disturbance)
    assert "\n" not in str(caught.value)


def test_dead_time_needs_the_plants_own_step(tmp_path: Path) -> None:
    """Found when the config is read, not after the first step of a long run; the delay line itself
    enters no log.
    """
    text = vessel_files()["example_rudder_boat"].read_text()
    late = text.replace("    # dead_time: 0.2 s ", "    dead_time: 0.2 s  # ").replace(
        "    # delay_step: 0.01 s ", "    delay_step: 0.02 s  # "
    )
    path = tmp_path / "late.yaml"
    path.write_text(late)
    with pytest.raises(
        ConfigError, match=r"delay_step is 0.02 s, but the plant steps by 0.1 s"
    ) as caught:
        trials(vessel=str(path))
    assert "\n" not in str(caught.value)
    config = trials(vessel=str(path), substeps=5)
    log = simulate(config.draw()[:1], config)[0]
    assert not [name for name in log.channels if name.startswith("_")]
    # the rudder answers two samples after its command
    assert log["delta"][:3].tolist() == [0.0, 0.0, 0.0]
    assert log["delta"][3] > 0.01
