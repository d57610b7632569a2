"""Simulated trials: what one seed draws for good, disturbances, sensors, where flights end."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from scipy.signal import lfilter
from torch import Tensor

from residnet.core.config import validate_config
from residnet.core.errors import ConfigError, DataError
from residnet.core.log import Log
from residnet.core.registry import find_vessel_files
from residnet.dynamics.base import Dynamics
from residnet.dynamics.simulated import PlantDynamics
from residnet.manoeuvres.base import Helm, Manoeuvre
from residnet.manoeuvres.closed_loop import TurningCircle, Zigzag
from residnet.manoeuvres.open_loop import ConstantInput
from residnet.manoeuvres.trials import (
    SimulatedVessel,
    TrialEnvironment,
    simulate_manoeuvres,
    simulate_trial_logs,
)
from residnet.manoeuvres.trials_config import (
    DisturbanceConfig,
    SensorsConfig,
    SimulatedTrials,
    WindConfig,
    sample_ornstein_uhlenbeck,
    simulate_wind,
)
from residnet.physics.vessel import load_vessel

STEP = 0.1
CLEAN = {"u": 0.0, "v": 0.0, "r": 0.0}
STILL = SensorsConfig(u=0, v=0, r=0)
TRIALS: dict[str, Any] = {
    **{"kind": "simulated", "vessel": "wam_v_cal", "duration": 20, "step": STEP, "substeps": 1},
    "trials": [
        {"kind": "constant", "drive": [0.4], "steer": [0.3]},
        {"kind": "zigzag", "count": 2, "heading": ["20 deg"], "start": 3},
    ],
    **{"identification": {"zigzag": 1}, "validation": {}},
}
HULL = {"length": 4.9, "breadth": 1.0, "draught": 0.2}
WAVES = {"significant_height": 0.3, "peak_period": 3.0, "direction": "90 deg", "hull": HULL}
WIND = {
    **{"kind": "symmetric", "frontal_area": 2.0, "lateral_area": 4.0, "length": 4.9},
    **{"c_x": 0.7, "c_y": 0.8, "c_n": 0.1, "source": "made"},
}


def trials(**changes: Any) -> SimulatedTrials:
    return validate_config(TRIALS | changes, SimulatedTrials, "here")


def logs(noise: dict[str, Any] | None = None, **changes: Any) -> list[Log]:
    config = trials(noise=CLEAN if noise is None else noise, **changes)
    return simulate_trial_logs(config.draw_manoeuvres(), config)


@pytest.fixture
def windy(tmp_path: Path) -> str:
    """A vessel file with wind coefficients."""
    content = yaml.safe_load(find_vessel_files()["wam_v_cal"].read_text())
    path = tmp_path / "windy.yaml"
    path.write_text(yaml.safe_dump(content | {"wind": WIND}, sort_keys=False))
    return str(path)


def test_random_forces_are_drawn_as_they_always_were(windy: str) -> None:
    """Data of one seed stay the same for good: the process written out, three draws per step,
    sampled from its stationary state. Wind and waves have generators of their own.
    """
    forces = {"force_x": 20.0, "force_y": 10.0, "force_n": 15.0, "correlation": 4.0}
    current = {"current_north": 0.2, "current_east": -0.1, "force_north": 3.0}
    wind = {"speed": 5, "direction": 1.0, "gust": 1.0}
    plant = load_vessel(windy).build()
    for more in ({}, {"wind": wind, "waves": WAVES}):
        disturbance = validate_config(forces | current | more, DisturbanceConfig, "here")
        found = disturbance.draw_plant_inputs(plant, 3, 50, STEP, 7, np.random.default_rng([7, 3]))
        keep = np.exp(-STEP / 4)
        drive = np.random.default_rng([7, 3]).standard_normal((3, 50, 3)) * np.sqrt(1 - keep**2)
        drive[:, 0] /= np.sqrt(1 - keep**2)
        expected = np.zeros((3, 50, len(plant.input_names) - 2))
        expected[:, :, 2:5] = lfilter([1.0], [1.0, -keep], drive, axis=1) * [20, 10, 15]
        for name, value in (*current.items(),):
            expected[:, :, plant.input_names.index(name)] = value
        np.testing.assert_array_equal(found[:, :, :-2], expected)
        assert (np.ptp(found[:, :, -2]) > 0.1) == bool(more)


def test_currents_by_speed_and_direction_and_of_each_trial() -> None:
    given = DisturbanceConfig(current_speed=2.0, current_direction=np.pi / 2)
    assert given.common_current() == pytest.approx((0.0, 2.0))
    each = {"current_north": 1.0, "current_each": ["0.1 m/s", 0.4]}
    disturbance = validate_config(each, DisturbanceConfig, "here")
    drawn = disturbance.draw_currents(400, 3)
    own = (drawn[:, 0] - 1.0) + 1j * drawn[:, 1]
    assert 0.1 <= abs(own).min() < 0.11 < 0.39 < abs(own).max() <= 0.4
    assert abs((own / abs(own)).mean()) < 0.15
    plant = load_vessel("wam_v_cal").build()
    series = disturbance.draw_plant_inputs(plant, 400, 5, STEP, 3, np.random.default_rng(0))
    np.testing.assert_array_equal(series[:, :, 5:7], np.repeat(drawn[:, None], 5, axis=1))


def test_gusts_have_the_stated_spread_memory_and_spectrum() -> None:
    step = 0.5
    time = 6.0
    lag = 12
    process = sample_ornstein_uhlenbeck(np.random.default_rng(0), (200, 2048, 1), step, time)[
        :, :, 0
    ]
    assert process.var() == pytest.approx(1.0, rel=0.03)
    memory = np.mean(process[:, lag:] * process[:, :-lag])
    assert memory == pytest.approx(np.exp(-lag * step / time), abs=0.03)
    power = (np.abs(np.fft.rfft(process, axis=1)) ** 2).mean(0) * step / process.shape[1] / np.pi
    omega = 2 * np.pi * np.fft.rfftfreq(process.shape[1], step)
    low = (omega > 0.02) & (omega < 0.8)
    stated = (2 * time / np.pi) / (1 + (omega[low] * time) ** 2)
    np.testing.assert_allclose(power[low], stated, rtol=0.35)
    assert power[low].mean() == pytest.approx(stated.mean(), rel=0.05)
    for gust in (0.0, 1.0):
        wind = WindConfig(speed=7.0, direction=2.0, gust=gust, correlation=1.0)
        speed, direction = simulate_wind(wind, 20, 3000, 0.5, 0).values()
        off = speed * np.exp(1j * (direction - 2.0)) - 7.0
        assert [off.real.std(), off.imag.std()] == pytest.approx([gust, gust], rel=0.03, abs=1e-9)


def test_waves_move_a_vessel_and_one_seed_gives_one_log() -> None:
    calm = logs()
    rough, again = (logs(disturbance={"waves": WAVES}) for _ in range(2))
    for a, b, still in zip(rough, again, calm, strict=True):
        assert all(np.array_equal(a[name], b[name]) for name in a.channels)
        assert (a["v"] - still["v"]).std() > 0.02
    # the constant inputs did not change; a zigzag may
    np.testing.assert_array_equal(rough[0]["cmd_port"], calm[0]["cmd_port"])


def test_the_true_wind_stands_in_the_log(windy: str) -> None:
    wind = {"speed": "12 kn", "direction": "200 deg", "gust": 0.5}
    log, calm = (logs(vessel=windy, disturbance=d)[0] for d in ({"wind": wind}, {}))
    assert log.units["wind_speed"] == "m/s"
    assert log["wind_speed"].mean() == pytest.approx(12 * 1852 / 3600, abs=1.0)
    assert np.degrees(log["wind_dir"].mean()) == pytest.approx(200, abs=10)
    assert "wind_speed" not in calm.channels


@pytest.mark.long
def test_dead_time_needs_the_plants_own_step(tmp_path: Path) -> None:
    """Found when the config is read; the delay line itself enters no log."""
    text = find_vessel_files()["example_rudder_boat"].read_text()
    text = text.replace("    # dead_time: 0.2 s ", "    dead_time: 0.2 s  # ")
    path = tmp_path / "late.yaml"
    path.write_text(text.replace("    # delay_step: 0.01 s ", "    delay_step: 0.02 s  # "))
    with pytest.raises(ConfigError, match=r"delay_step is 0.02 s, but the plant steps by 0.1 s"):
        trials(vessel=str(path))
    log = logs(vessel=str(path), substeps=5)[0]
    assert not [name for name in log.channels if name.startswith("_")]
    # the rudder answers two samples after its command
    assert log["delta"][:3].tolist() == [0.0, 0.0, 0.0]
    assert log["delta"][3] > 0.01


def test_white_noise_is_drawn_as_it_always_was() -> None:
    """After the forces of the same generator, three values per sample; nothing else moves."""
    quiet = logs(seed=5)
    noisy = logs({"u": 0.1, "v": 0.2, "r": 0.05}, seed=5)
    random = np.random.default_rng([5, 3])
    random.standard_normal((len(quiet), 200, 3))
    noise = random.standard_normal((len(quiet), 200, 3)) * [0.1, 0.2, 0.05]
    for i, (a, b) in enumerate(zip(quiet, noisy, strict=True)):
        for name in a.channels:
            white = noise[i, :, "uvr".index(name)] if name in "uvr" else 0.0
            np.testing.assert_array_equal(b[name], a[name] + white)


def test_bias_noise_sampling_and_latency_of_single_channels() -> None:
    sensors = {
        "psi": {"noise": "2 deg", "bias": "-1 deg"},
        "x": {"interval": "1 s", "bias": 3},
        "y": {"latency": "250 ms"},
        "r": {"latency": "300 ms"},
    }
    truth = logs()
    seen = logs(CLEAN | {"sensors": sensors})
    errors = [np.degrees(b["psi"] - a["psi"]) for a, b in zip(truth, seen, strict=True)]
    assert np.std(errors) == pytest.approx(2.0, rel=0.1)
    assert np.mean(errors) == pytest.approx(-1.0, abs=0.3)
    assert np.corrcoef(errors[0], errors[1])[0, 1] < 0.2
    for a, b in zip(truth, seen, strict=True):
        known = np.arange(0, 200, 10)
        np.testing.assert_array_equal(np.flatnonzero(np.isfinite(b["x"])), known)
        np.testing.assert_allclose(b["x"][known], a["x"][known] + 3.0)
        np.testing.assert_allclose(b["r"][3:], a["r"][:-3], rtol=0, atol=1e-12)
        np.testing.assert_array_equal(b["r"][:3], np.full(3, a["r"][0]))
        between = 0.5 * (a["y"][:-3] + a["y"][1:-2])
        np.testing.assert_allclose(b["y"][3:], between, rtol=0, atol=1e-12)
        for name in ("u", "v", "n_stbd"):
            np.testing.assert_array_equal(a[name], b[name])


@pytest.mark.parametrize(
    ("disturbance", "sensors", "message"),
    [
        ({"current_speed": "1 kn"}, {}, "belong together"),
        ({"current_speed": 1, "current_direction": 0, "current_east": 0.1}, {}, "specified twice"),
        ({"current_each": [0.4, 0.1]}, {}, "is faster than the fastest"),
        (
            {"wind": {"speed": 5, "direction": 0}},
            {},
            "disturbance.wind: vessel 'wam_v_cal' has no input 'wind_speed'; give its vessel file",
        ),
        ({"wind": {"speed": 5}}, {}, "direction"),
        ({"waves": {"peak_period": 3}}, {}, "significant_height"),
        ({"current": 3}, {}, "did you mean 'current_east'"),
        ({}, {"psy": {"noise": 1}}, "no channel 'psy'; did you mean 'psi'"),
        ({}, {"psi": {"noise": "2 m"}}, "does not measure"),
        ({}, {"psi": {"noise": -0.1}}, "must not be negative"),
        ({}, {"u": {"noise": 0.1}}, "as noise.u"),
        ({}, {"x": {"interval": 0.25}}, "not a multiple of the log's step, 0.1 s"),
        ({}, {"x": {"interval": 0.01}}, "not a multiple"),
        ({}, {"x": {"latency": -1}}, "latency"),
        ({}, {"delta": {"bias": "1 deg"}}, "vessel 'wam_v_cal' has no channel 'delta'"),
    ],
)
def test_what_cannot_be_is_one_line(
    disturbance: dict[str, Any], sensors: dict[str, Any], message: str
) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        trials(disturbance=disturbance, noise={"sensors": sensors})
    assert "\n" not in str(caught.value)


def ship(disturbance: DisturbanceConfig) -> tuple[SimulatedVessel, TrialEnvironment]:
    plant = load_vessel("wam_v_cal").build()
    dynamics = PlantDynamics(plant, STEP, 1)
    helm = Helm.from_plant(plant)
    craft = SimulatedVessel(
        "wam_v_cal", dynamics, helm, plant.n_commands, plant.make_initial_state(1)
    )
    return craft, TrialEnvironment(plant, disturbance, STILL, 0)


class Runaway(Dynamics):
    """u grows by its square: infinite in finite time; v is the wind's speed."""

    def __init__(self) -> None:
        super().__init__(STEP, "euler")

    def state_derivative(self, x: Tensor, p: Tensor, rho: Tensor) -> Tensor:
        return torch.zeros_like(x)

    def step(self, x: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        out = x.clone()
        out[:, 3], out[:, 4] = x[:, 3] ** 2 + w[:, 0], w[:, 1]
        return out, s


def runaway(start: float = 0.0) -> SimulatedVessel:
    names = ("x", "y", "psi", "u", "v", "r"), ("cmd_n", "wind_speed", "wind_dir")
    helm = Helm(lambda drive, steer: drive.unsqueeze(-1), *names)
    return SimulatedVessel(
        "runaway", Runaway(), helm, 1, torch.full((1, 6), start, dtype=torch.float64)
    )


def test_logs_end_where_the_manoeuvre_does() -> None:
    craft, sea = ship(DisturbanceConfig())
    turn: dict[str, Any] = {"drive": 0.6, "steer": 0.6, "start": 3, "until": math.pi / 2}
    manoeuvres: list[Manoeuvre] = [
        TurningCircle(**turn),
        ConstantInput(drive=0.5, steer=0.1, duration=7),
        TurningCircle(**turn, duration=4),
        ConstantInput(drive=0.5, steer=0.1, name="last"),
    ]
    flights = simulate_manoeuvres(craft, manoeuvres, sea, 20, STEP, {"vessel": "wam_v_cal"})
    names = ["turning_circle_01", "constant_01", "turning_circle_02", "last"]
    assert [f.measured_log.name for f in flights] == names
    psi = flights[0].true_log["psi"]
    assert psi[-1] >= math.pi / 2 > psi[-2]
    assert [len(f.measured_log) for f in flights[1:]] == [70, 40, 200]
    timed_out = "timed out after 3.9 s before a heading change of 90 deg"
    assert [f.fault_text for f in flights] == [None, None, timed_out, None]
    assert flights[2].measured_log.meta["timed_out"] is True
    assert flights[1].measured_log.meta["demand"]["steer"] == 0.1
    assert flights[1].measured_log.meta["vessel"] == "wam_v_cal"
    np.testing.assert_array_equal(flights[1].true_log["u"], flights[3].true_log["u"][:70])


def test_a_motion_that_is_not_finite_ends_there() -> None:
    # u: 0, 0.9, 1.71, 3.82, 15.5, ...: beyond the largest number after 13 steps or so
    manoeuvres = [ConstantInput(drive=drive, steer=0) for drive in (0.9, 0.1)]
    wind = DisturbanceConfig(wind=WindConfig(speed=4.0, direction=1.0))
    wild, tame = simulate_manoeuvres(
        runaway(), manoeuvres, TrialEnvironment(None, wind, STILL, 0), 5, STEP
    )
    assert wild.measured_log.meta["diverged"] is True
    assert np.isfinite(wild.true_log["u"]).all()
    assert 5 < len(wild.true_log) < 20
    assert "no longer finite" in str(wild.fault_text)
    assert (len(tame.true_log), tame.fault_text) == (50, None)
    # wind reaches a model without a vessel, and its log
    assert (tame.true_log["v"][1:] == 4.0).all()
    assert (tame.measured_log["wind_speed"] == 4.0).all()
    assert (tame.measured_log["wind_dir"] == 1.0).all()
    with pytest.raises(DataError, match="constant_01: the motion is not finite after the first"):
        simulate_manoeuvres(
            runaway(math.nan),
            manoeuvres,
            TrialEnvironment(None, DisturbanceConfig(), STILL, 0),
            5,
            STEP,
        )


def test_a_manoeuvre_stops_in_waves_too() -> None:
    craft, sea = ship(validate_config({"waves": WAVES}, DisturbanceConfig, "here"))
    zigzag = Zigzag(drive=0.6, steer=0.5, heading=0.3, start=5, reversals=2)
    (flight,) = simulate_manoeuvres(craft, [zigzag], sea, 40, STEP)
    assert flight.fault_text is None
    assert len(flight.true_log) < 350
    assert np.abs(flight.true_log["v"][:50]).max() > 0, "the waves push before the first order"
