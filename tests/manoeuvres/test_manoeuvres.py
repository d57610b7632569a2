"""The contract of every manoeuvre and family, found from the unions themselves, and the shape of
each kind.
"""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
import pytest
import torch
from flown_manoeuvres import (
    DIVING,
    DURATION,
    EXAMPLES,
    FAMILIES,
    FLOWN,
    MANOEUVRES,
    drawn,
    fly,
    times,
    traced,
)
from kinds import of_kind

from residnet.core.config import validate
from residnet.core.errors import ConfigError, UsageError
from residnet.core.log import Log
from residnet.data.simulated import SimulatedTrials, simulate
from residnet.dynamics.rollout import Rollout
from residnet.manoeuvres import ManoeuvreConfig
from residnet.manoeuvres.base import Helm, ScheduleSource, StackedSource
from residnet.manoeuvres.closed_loop import Zigzag
from residnet.manoeuvres.indices import UNITS
from residnet.manoeuvres.open_loop import (
    AccelerationDeceleration,
    ConstantInput,
    MultiSine,
    ThreeTwoOneOne,
)
from residnet.physics.actuators import Thrusters
from residnet.physics.plant import Plant
from residnet.physics.vessel import load_vessel

# the other kinds are open-loop excitation, which no index is defined for
WITH_INDICES = {"zigzag", "turning_circle", "spiral", "stopping", "waypoints", "replay"}


@pytest.fixture(params=FLOWN)
def kind(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.fixture(params=FAMILIES)
def random_kind(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.fixture(scope="module")
def plant() -> Plant:
    return load_vessel("wam_v_cal").build()


def test_every_family_draws_a_manoeuvre_of_its_kind() -> None:
    assert set(FAMILIES) | set(EXAMPLES) | {"replay"} == {*FLOWN, *DIVING}, (
        "a kind without a family needs an example here"
    )
    for kind in FAMILIES:
        assert {type(m) for m in drawn(kind)} == {MANOEUVRES[kind]}


def test_draws_are_repeatable_by_seed(random_kind: str) -> None:
    kind = random_kind
    assert drawn(kind) == drawn(kind)
    if "count" in FAMILIES[kind].model_fields:
        assert drawn(kind) != drawn(kind, seed=1)
        assert len(drawn(kind)) == 5
        assert len({m.model_dump_json() for m in drawn(kind)}) == 5


def test_a_batch_is_single_flights_with_commands_in_bounds_and_indices(
    kind: str, plant: Plant
) -> None:
    """Every kind reads its indices off its own flight: finite numbers with a unit."""
    manoeuvres = drawn(kind)
    for manoeuvre in manoeuvres:
        assert validate(manoeuvre.model_dump(mode="json"), ManoeuvreConfig, "log") == manoeuvre
    states, commands = fly(plant, manoeuvres)
    n_max = float(of_kind(plant.actuators, Thrusters).n_max.max())
    assert bool(torch.isfinite(states).all())
    assert 0 < float(commands.abs().max()) <= n_max
    # the propellers follow
    assert float(states[..., 6:].abs().max()) <= n_max
    for i, manoeuvre in enumerate(manoeuvres[:2]):
        alone, command = fly(plant, [manoeuvre])
        torch.testing.assert_close(alone[0], states[i], rtol=1e-10, atol=1e-12)
        assert torch.equal(command[0], commands[i])
    channels = dict(zip(plant.state, states[0, :-1].T.numpy(), strict=True))
    channels |= dict(zip(("cmd_port", "cmd_stbd"), commands[0].T.numpy(), strict=True))
    indices = manoeuvres[0].indices(Log(kind, times().numpy(), channels), length=5.0)
    assert {name.removesuffix("_lengths") for name in indices} <= set(UNITS)
    assert all(np.isfinite(value).all() for value in indices.values())
    assert bool(indices) == (kind in WITH_INDICES)


def test_all_kinds_side_by_side_equal_each_alone(plant: Plant) -> None:
    groups = [drawn(kind)[:2] for kind in FLOWN]
    t = times()
    source = StackedSource(
        [type(g[0]).source(g, Helm.from_plant(plant), t) for g in groups], [2] * len(groups)
    )
    x0 = torch.zeros(2 * len(groups), 8, dtype=torch.float64)
    w = torch.zeros(len(x0), len(t), len(plant.inputs), dtype=torch.float64)
    w[:, :, 2] = 5.0
    with torch.no_grad():
        states, inputs, _ = Rollout(traced(plant), source)(x0, w, x0[:, :0])
        assert bool((inputs[:, :, 2] == 5.0).all()), "disturbances pass through a manoeuvre"
        for i, group in enumerate(groups):
            own = type(group[0]).source(group, Helm.from_plant(plant), t)
            alone, _, _ = Rollout(traced(plant), own)(x0[:2], w[:2], x0[:2, :0])
            torch.testing.assert_close(alone, states[2 * i : 2 * i + 2], rtol=1e-10, atol=1e-12)


def test_zigzag_switches_at_its_bound(plant: Plant) -> None:
    bound = float(np.radians(15))
    sides: list[Literal["starboard", "port"]] = ["starboard", "port"]
    cases = [(first, psi) for first in sides for psi in (0.0, 2.5, -7.0)]
    zigzags = [
        Zigzag(drive=0.5, steer=0.4, start=4.0, heading=bound, first=first) for first, _ in cases
    ]
    begun = torch.tensor([psi for _, psi in cases], dtype=torch.float64)
    states, commands = fly(plant, [*zigzags], seconds=40.0, psi=begun)
    t = times(40.0).numpy()
    for row, (first, psi) in enumerate(cases):
        heading = states[row, :-1, 2].numpy() - psi
        side = np.sign((commands[row, :, 0] - commands[row, :, 1]).numpy())
        assert (side[t < 4.0 - 1e-9] == 0).all()
        expected, current = [], 1.0 if first == "starboard" else -1.0
        for k in range(len(t)):
            if current * heading[k] >= bound:
                current = -current
            expected.append(current if t[k] >= 4.0 else 0.0)
        np.testing.assert_array_equal(side, expected)
        assert (np.diff(side[t >= 4.0]) != 0).sum() >= 4
        # positive steer turns to starboard: the heading first grows for `starboard`
        later = heading[(t > 5.0)][:20]
        assert (np.sign(later) == (1.0 if first == "starboard" else -1.0)).all()
        # and overshoots the bound
        assert np.abs(heading).max() > bound


def test_three_two_one_one_pattern() -> None:
    m = ThreeTwoOneOne(drive=0.4, steer=0.7, start=5.0, unit=2.0)
    t = torch.arange(0.0, 40.0, 1.0, dtype=torch.float64)
    drive, steer = m.demands(t)
    once = [0.7] * 6 + [-0.7] * 4 + [0.7] * 2 + [-0.7] * 2
    assert drive.tolist() == [0.4] * 40
    assert steer.tolist() == ([0.0] * 5 + once * 3)[:40]
    _, single = m.model_copy(update={"repeat": False}).demands(t)
    assert single.tolist() == [0.0] * 5 + once + [0.0] * 21


@pytest.mark.parametrize(
    ("dt", "unit", "start"),
    [(0.01, 3.0, 10.0), (0.05, 0.35, 1.15), (0.1, 0.3, 0.7), (0.02, 1.1, 2.3)],
)
def test_edges_fall_on_the_grid_point_they_name(dt: float, unit: float, start: float) -> None:
    """Rounding must not move an edge by a step, wherever it lies."""
    t = times(30.0, dt)
    _, steer = ThreeTwoOneOne(drive=0.0, steer=1.0, start=start, unit=unit).demands(t)
    edges = np.flatnonzero(np.diff(steer.numpy()) != 0) + 1
    units = np.cumsum([0, 3, 2, 1] + [1, 3, 2, 1] * 200)
    expected = np.rint((start + unit * units) / dt).astype(int)
    np.testing.assert_array_equal(edges, expected[expected < len(t)])
    levels = AccelerationDeceleration(
        times=tuple(start + unit * k for k in range(5)), levels=(1.0, 0.5, 0.2, 0.8, 0.1)
    )
    drive, _ = levels.demands(t)
    edges = np.flatnonzero(np.diff(drive.numpy()) != 0) + 1
    np.testing.assert_array_equal(edges, np.rint((start + unit * np.arange(5)) / dt).astype(int))


@pytest.mark.parametrize(("dt", "start"), [(0.01, 2.3), (0.05, 1.15), (0.1, 0.7), (0.02, 1.14)])
def test_zigzag_starts_on_the_grid_point_it_names(dt: float, start: float, plant: Plant) -> None:
    _, commands = fly(
        plant, [Zigzag(drive=0.5, steer=0.4, start=start, heading=0.3)], dt=dt, seconds=3.0
    )
    turning = np.flatnonzero((commands[0, :, 0] != commands[0, :, 1]).numpy())
    assert turning[0] == round(start / dt)


def test_acceleration_deceleration_levels() -> None:
    m = AccelerationDeceleration(times=(1.0, 3.0, 4.0), levels=(0.8, 0.2, 0.5))
    drive, steer = m.demands(torch.arange(0.0, 6.0, 0.5, dtype=torch.float64))
    assert drive.tolist() == [0, 0, 0.8, 0.8, 0.8, 0.8, 0.2, 0.2, 0.5, 0.5, 0.5, 0.5]
    assert steer.abs().max() == 0
    for draw in drawn("acceleration_deceleration"):
        assert isinstance(draw, AccelerationDeceleration)
        assert draw.times[0] == 0.0
        assert draw.times[-1] < DURATION
        assert all(
            6.0 <= b - a <= 12.0 for a, b in zip(draw.times[:-1], draw.times[1:], strict=True)
        )
        assert all(0.0 <= level <= 1.0 for level in draw.levels)
        assert min(draw.levels[::2]) > max(draw.levels[1::2], default=0.0) - 0.1


def test_constant_family_is_every_combination() -> None:
    got = FAMILIES["constant"](drive=(0.2, 0.6), steer=(-0.1, 0.0, 0.1)).draw(
        np.random.default_rng(0), 10.0
    )
    assert got == [ConstantInput(drive=d, steer=s) for d in (0.2, 0.6) for s in (-0.1, 0.0, 0.1)]


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ({"kind": "zigzag", "drive": 0.5, "steer": 0.4, "heading": "-10 deg"}, "greater than 0"),
        (
            {"kind": "zigzag", "drive": 1.5, "steer": 0.4, "heading": "10 deg"},
            "less than or equal to 1",
        ),
        ({"kind": "constant", "drive": 0.5, "steer": -1.1}, "greater than or equal to -1"),
        ({"kind": "three_two_one_one", "drive": 0.5, "steer": 0.4, "unit": 0}, "greater than 0"),
        ({"kind": "acceleration_deceleration", "times": [0, 5], "levels": [0.3]}, "same number"),
        ({"kind": "acceleration_deceleration", "times": [5, 0], "levels": [0.3, 0.4]}, "ascending"),
        ({"kind": "zigzog", "drive": 0.5, "steer": 0.4}, "zigzag"),
    ],
)
def test_wrong_manoeuvres(config: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        validate(config, ManoeuvreConfig, "here")
    assert "\n" not in str(caught.value)


def trials(**changes: Any) -> SimulatedTrials:
    return SimulatedTrials.model_validate(
        {
            "vessel": "wam_v_cal",
            "trials": [
                {"kind": "zigzag", "count": 4, "heading": [0.2]},
                {"kind": "constant", "drive": [0.5], "steer": [0.2]},
            ],
            "duration": 10.0,
            "substeps": 1,
            "identification": {"zigzag": 3},
            "validation": {"zigzag": 1},
            "noise": {"u": 0.0, "v": 0.0, "r": 0.0},
            **changes,
        }
    )


def test_simulated_trials_are_repeatable_and_split_whole() -> None:
    config = trials()
    manoeuvres = config.draw()
    assert sorted(config.splits(manoeuvres)) == ["test", "train", "train", "train", "validation"]
    assert config.splits(manoeuvres)[-1] == "train", (
        "kinds that are not named are for identification"
    )
    one, two = simulate(manoeuvres, config), simulate(config.draw(), config)
    for a, b in zip(one, two, strict=True):
        assert a.name == b.name
        for name in a.channels:
            np.testing.assert_array_equal(a[name], b[name])
    with pytest.raises(ValueError, match="leaves a split empty"):
        trials(identification={"zigzag": 4}).splits(manoeuvres)


def test_sensor_noise_is_on_the_velocities_alone() -> None:
    config = trials(noise={"u": 0.03, "v": 0.02, "r": 0.01}, duration=20.0)
    manoeuvres = config.draw()
    noisy, clean = simulate(manoeuvres, config), simulate(manoeuvres, trials(duration=20.0))
    for name, spread in {"u": 0.03, "v": 0.02, "r": 0.01}.items():
        error = np.concatenate([a[name] - b[name] for a, b in zip(noisy, clean, strict=True)])
        assert error.std() == pytest.approx(spread, rel=0.07)
        assert abs(error.mean()) < 5 * spread / np.sqrt(error.size)
    for name in ("x", "y", "psi", "n_port", "cmd_stbd"):
        for a, b in zip(noisy, clean, strict=True):
            np.testing.assert_array_equal(a[name], b[name])


def test_multi_sines_excite_the_sway_force_where_commands_are_forces() -> None:
    """Document 000 section 6.3: every force moves by itself; other vessels refuse it in words."""
    t = torch.arange(0.0, 100.0, 0.1, dtype=torch.float64)
    wave = MultiSine(
        drive=0.2, steer_amplitude=0.1, sway_amplitude=0.3, band=(0.02, 0.1), start=5.0
    )
    plant = load_vessel("odin_forces").build()
    source = MultiSine.source([wave], Helm.from_plant(plant), t)
    assert isinstance(source, ScheduleSource)
    sway, moment = source.commands[0, :, 1], source.commands[0, :, 2]
    assert float(sway[:50].abs().max()) == 0.0
    assert 0.15 * 25e3 < float(sway.abs().max()) <= 0.3 * 25e3
    assert abs(float(torch.corrcoef(torch.stack((sway, moment)))[0, 1])) < 0.2
    with pytest.raises(UsageError, match="no forces; leave it out"):
        MultiSine.source([wave], Helm.from_plant(load_vessel("wam_v_cal").build()), t)
