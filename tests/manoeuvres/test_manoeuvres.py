"""Every manoeuvre and family, found from the unions themselves, and the shape of each kind; what
all of them keep is in the contracts.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
import torch
from torch import Tensor

from residnet.core.config import validate_config
from residnet.core.errors import ConfigError, UsageError
from residnet.core.log import Log
from residnet.core.registry import load_kinds
from residnet.engine.recorded_plant import RecordedPlantDynamics
from residnet.engine.rollout import Rollout, Source
from residnet.manoeuvres import FamilyConfig, ManoeuvreConfig
from residnet.manoeuvres.base import Helm, Manoeuvre
from residnet.manoeuvres.closed_loop import Zigzag
from residnet.manoeuvres.indices import INDEX_UNITS
from residnet.manoeuvres.open_loop import (
    AccelerationDeceleration,
    ConstantInput,
    MultiSine,
    ThreeTwoOneOne,
)
from residnet.manoeuvres.sources import ScheduleSource, StackedSource
from residnet.manoeuvres.trials_config import SimulatedTrials
from residnet.physics.plant import Plant
from residnet.physics.vessel import load_vessel

FAMILIES = load_kinds(FamilyConfig)
MANOEUVRES = load_kinds(ManoeuvreConfig)
DURATION = 15.0
DT = 0.1
# what a family cannot do without; one whose fields have defaults beyond these needs no line here
NEEDS: dict[str, Any] = {
    "count": 5,
    "heading": (0.2, 0.4),
    "depth": (1.0, 2.0),
    "drive": (0.3, 0.8),
    "steer": (-0.5, 0.4),
}
# of kinds that nothing draws at random
EXAMPLES: dict[str, list[dict[str, Any]]] = {
    "spiral": [
        {"drive": 0.5, "start": 2, "steady": {"window": 1.5, "tolerance": 0.05}},
        {"drive": 0.6, "steers": [0.4, -0.4], "start": 1},
    ],
    "stopping": [{"drive": 0.6, "start": 8}, {"drive": 0.9, "astern": -0.5, "start": 11}],
    "waypoints": [
        {"drive": 0.7, "points": [[8, 0], [8, 10]], "acceptance": 2, "lookahead": 4},
        {"drive": 0.5, "points": [[10, -5]], "acceptance": 2, "lookahead": 4},
    ],
}
# these need a vessel that dives, or one with all three forces; the contracts fly them
ELSEWHERE = ("helix", "vertical_zigzag", "depth_step", "four_corner")
FLOWN = [kind for kind in MANOEUVRES if kind not in ELSEWHERE]
# the other kinds are open-loop excitation, which no index is defined for
WITH_INDICES = {"zigzag", "turning_circle", "spiral", "stopping", "waypoints", "replay"}


def drawn(kind: str, seed: int = 0) -> list[Manoeuvre]:
    fields = FAMILIES[kind].model_fields.items()
    required = {name: NEEDS[name] for name, info in fields if info.is_required()}
    family: Any = FAMILIES[kind](**required)
    return family.sample_all(np.random.default_rng(seed), DURATION)  # type: ignore[no-any-return]


def pair(kind: str, folder: Path) -> list[Manoeuvre]:
    """Two manoeuvres of a kind; replays of two recorded logs, flown from where they begin."""
    if kind in FAMILIES:
        return drawn(kind)[:2]
    examples = EXAMPLES.get(kind, [])
    for i in range(2) if kind == "replay" else ():
        t = np.arange(0.0, DURATION, 0.25)
        pose = ("x", "y", "psi", "u", "v", "r")
        channels = {name: np.full(t.size, 0.1 * (i + j)) for j, name in enumerate(pose)}
        channels |= {"cmd_port": 20.0 + 5.0 * np.sin(t + i), "cmd_stbd": 15.0 * np.cos(t)}
        Log(f"log{i}", t, channels).save(folder / f"log{i}.parquet")
        examples = [*examples, {"log": folder / f"log{i}.parquet"}]
    return [MANOEUVRES[kind](**example) for example in examples]  # type: ignore[misc]


def times(seconds: float = DURATION, dt: float = DT) -> Tensor:
    return torch.arange(round(seconds / dt), dtype=torch.float64) * dt


@pytest.fixture(scope="module")
def plant() -> Plant:
    return load_vessel("wam_v_cal").build()


def fly(
    model: RecordedPlantDynamics, source: Source, steps: int, psi: Tensor
) -> tuple[Tensor, Tensor]:
    """States [B, T+1, 8] and inputs [B, T, m], whose third is a disturbance."""
    x0 = torch.zeros(len(psi), 8, dtype=torch.float64)
    x0[:, 2] = psi
    w = torch.zeros(len(psi), steps, len(model.plant.input_names), dtype=torch.float64)
    w[:, :, 2] = 5.0
    with torch.no_grad():
        states, inputs, _ = Rollout(model, source)(x0, w, x0[:, :0])
    return states, inputs


@pytest.mark.parametrize("kind", FAMILIES)
def test_a_family_draws_manoeuvres_of_its_kind_by_seed(kind: str) -> None:
    known = {*FAMILIES, *EXAMPLES, "replay", "four_corner"}
    assert known == {*MANOEUVRES}, "a kind without a family needs an example here"
    assert {type(m) for m in drawn(kind)} == {MANOEUVRES[kind]}
    assert drawn(kind) == drawn(kind)
    if "count" in FAMILIES[kind].model_fields:
        assert drawn(kind) != drawn(kind, seed=1)
        assert len({m.model_dump_json() for m in drawn(kind)}) == len(drawn(kind)) == 5


def test_kinds_side_by_side_equal_each_alone_within_bounds_and_with_indices(
    plant: Plant, tmp_path: Path
) -> None:
    """Every kind reads its indices off its own flight: finite numbers with a unit."""
    groups = [pair(kind, tmp_path) for kind in FLOWN]
    t = times()
    helm = Helm.from_plant(plant)
    model = RecordedPlantDynamics(plant, DT)
    source = StackedSource([type(g[0]).build_source(g, helm, t) for g in groups], [2] * len(groups))
    zero = torch.zeros(2 * len(groups), dtype=torch.float64)
    states, inputs = fly(model, source, len(t), zero)
    assert bool((inputs[:, :, 2] == 5.0).all()), "disturbances pass through a manoeuvre"
    n_max = float(plant.actuators.n_max.max())  # type: ignore[operator, union-attr]
    for i, (kind, group) in enumerate(zip(FLOWN, groups, strict=True)):
        rows = slice(2 * i, 2 * i + 2)
        assert 0 < float(inputs[rows, :, :2].abs().max()) <= n_max
        # the propellers follow
        assert float(states[rows, :, 6:].abs().max()) <= n_max
        before = t < getattr(group[0], "start", 0.0)
        assert torch.equal(inputs[2 * i, before, 0], inputs[2 * i, before, 1]), "the helm waits"
        alone, own = fly(model, type(group[1]).build_source(group[1:], helm, t), len(t), zero[:1])
        torch.testing.assert_close(alone[0], states[2 * i + 1], rtol=1e-10, atol=1e-12)
        torch.testing.assert_close(own[0], inputs[2 * i + 1], rtol=1e-10, atol=1e-12)
        channels = dict(zip(plant.state_names, states[2 * i, :-1].T.numpy(), strict=True))
        channels |= dict(zip(("cmd_port", "cmd_stbd"), inputs[2 * i].T.numpy(), strict=False))
        indices = group[0].compute_indices(Log(kind, t.numpy(), channels), length=5.0)
        assert {name.removesuffix("_lengths") for name in indices} <= set(INDEX_UNITS)
        assert all(np.isfinite(value).all() for value in indices.values())
        assert bool(indices) == (kind in WITH_INDICES)


def test_zigzag_switches_at_its_bound(plant: Plant) -> None:
    bound = float(np.radians(15))
    sides: list[Literal["starboard", "port"]] = ["starboard", "port"]
    cases = [(first, psi) for first in sides for psi in (0.0, 2.5, -7.0)]
    zigzags = [
        Zigzag(drive=0.5, steer=0.4, start=4.0, heading=bound, first=first) for first, _ in cases
    ]
    time = times(40.0)
    begun = torch.tensor([psi for _, psi in cases], dtype=torch.float64)
    source = Zigzag.build_source(zigzags, Helm.from_plant(plant), time)
    states, commands = fly(RecordedPlantDynamics(plant, DT), source, len(time), begun)
    t = time.numpy()
    for row, (first, psi) in enumerate(cases):
        heading = states[row, :-1, 2].numpy() - psi
        side = np.sign((commands[row, :, 0] - commands[row, :, 1]).numpy())
        expected = []
        current = 1.0 if first == "starboard" else -1.0
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


@pytest.mark.parametrize(
    ("dt", "unit", "start"),
    [(0.01, 3.0, 10.0), (0.05, 0.35, 1.15), (0.1, 0.3, 0.7), (0.02, 1.1, 2.3)],
)
def test_edges_fall_on_the_grid_point_they_name(
    dt: float, unit: float, start: float, plant: Plant
) -> None:
    """Rounding must not move an edge by a step, wherever it lies."""
    t = times(30.0, dt)
    _, steer = ThreeTwoOneOne(drive=0.0, steer=1.0, start=start, unit=unit).demands_at(t)
    edges = np.flatnonzero(np.diff(steer.numpy()) != 0) + 1
    units = np.cumsum([0, 3, 2, 1] + [1, 3, 2, 1] * 200)
    expected = np.rint((start + unit * units) / dt).astype(int)
    np.testing.assert_array_equal(edges, expected[expected < len(t)])
    moments = tuple(start + unit * k for k in range(5))
    levels = AccelerationDeceleration(times=moments, levels=(1.0, 0.5, 0.2, 0.8, 0.1))
    drive, _ = levels.demands_at(t)
    edges = np.flatnonzero(np.diff(drive.numpy()) != 0) + 1
    np.testing.assert_array_equal(edges, np.rint(np.array(moments) / dt).astype(int))
    zigzag = Zigzag(drive=0.5, steer=0.4, start=start, heading=0.3)
    source = Zigzag.build_source([zigzag], Helm.from_plant(plant), t)
    x = plant.make_initial_state(1)
    memory = source.initial(x)
    first = round(start / dt)
    w = torch.zeros(1, len(plant.input_names))
    for k in range(first + 1):
        command, memory = source(x, w.double(), k, memory)
        assert bool(command[0, 0] != command[0, 1]) == (k == first)


def test_open_loop_patterns() -> None:
    m = ThreeTwoOneOne(drive=0.4, steer=0.7, start=5.0, unit=2.0)
    drive, steer = m.demands_at(times(40.0, 1.0))
    once = [0.7] * 6 + [-0.7] * 4 + [0.7] * 2 + [-0.7] * 2
    assert drive.tolist() == [0.4] * 40
    assert steer.tolist() == ([0.0] * 5 + once * 3)[:40]
    _, single = m.model_copy(update={"repeat": False}).demands_at(times(40.0, 1.0))
    assert single.tolist() == [0.0] * 5 + once + [0.0] * 21
    levels = AccelerationDeceleration(times=(1.0, 3.0, 4.0), levels=(0.8, 0.2, 0.5))
    drive, steer = levels.demands_at(times(6.0, 0.5))
    assert drive.tolist() == [0, 0, 0.8, 0.8, 0.8, 0.8, 0.2, 0.2, 0.5, 0.5, 0.5, 0.5]
    assert steer.abs().max() == 0
    for draw in drawn("acceleration_deceleration"):
        assert isinstance(draw, AccelerationDeceleration)
        assert 0.0 == draw.times[0] < draw.times[-1] < DURATION
        assert all(6.0 <= gap <= 12.0 for gap in np.diff(draw.times))
        assert all(0.0 <= level <= 1.0 for level in draw.levels)
        assert min(draw.levels[::2]) > max(draw.levels[1::2], default=0.0) - 0.1
    family: Any = FAMILIES["constant"](drive=(0.2, 0.6), steer=(-0.1, 0.0, 0.1))
    every = [ConstantInput(drive=d, steer=s) for d in (0.2, 0.6) for s in (-0.1, 0.0, 0.1)]
    assert family.sample_all(np.random.default_rng(0), 10.0) == every


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ({"kind": "zigzag", "drive": 0.5, "steer": 0.4, "heading": "-10 deg"}, "greater than 0"),
        ({"kind": "constant", "drive": 1.5, "steer": 0.4}, "less than or equal to 1"),
        ({"kind": "constant", "drive": 0.5, "steer": -1.1}, "greater than or equal to -1"),
        ({"kind": "three_two_one_one", "drive": 0.5, "steer": 0.4, "unit": 0}, "greater than 0"),
        ({"kind": "acceleration_deceleration", "times": [0, 5], "levels": [0.3]}, "same number"),
        ({"kind": "acceleration_deceleration", "times": [5, 0], "levels": [0.3, 0.4]}, "ascending"),
        ({"kind": "zigzog", "drive": 0.5, "steer": 0.4}, "zigzag"),
    ],
)
def test_wrong_manoeuvres(config: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        validate_config(config, ManoeuvreConfig, "here")
    assert "\n" not in str(caught.value)


def test_simulated_trials_are_split_whole() -> None:
    content: dict[str, Any] = {
        "vessel": "wam_v_cal",
        "trials": [
            {"kind": "zigzag", "count": 4, "heading": [0.2]},
            {"kind": "constant", "drive": [0.5], "steer": [0.2]},
        ],
        "duration": 10.0,
        "identification": {"zigzag": 3},
        "validation": {"zigzag": 1},
    }
    config = SimulatedTrials.model_validate(content)
    splits = config.assign_splits(config.draw_manoeuvres())
    assert sorted(splits) == ["test", "train", "train", "train", "validation"]
    assert splits[-1] == "train", "kinds that are not named are for identification"
    assert splits == config.assign_splits(config.draw_manoeuvres())
    config = SimulatedTrials.model_validate(content | {"identification": {"zigzag": 4}})
    with pytest.raises(ValueError, match="a split is empty"):
        config.assign_splits(config.draw_manoeuvres())


def test_multi_sines_excite_the_sway_force_where_commands_are_forces() -> None:
    """Document 000 section 6.3: every force moves by itself; other vessels refuse it in words."""
    t = torch.arange(0.0, 100.0, 0.1, dtype=torch.float64)
    wave = MultiSine(
        drive=0.2, steer_amplitude=0.1, sway_amplitude=0.3, band=(0.02, 0.1), start=5.0
    )
    source = MultiSine.build_source([wave], Helm.from_plant(load_vessel("odin_forces").build()), t)
    assert isinstance(source, ScheduleSource)
    sway = source.commands[0, :, 1]
    moment = source.commands[0, :, 2]
    assert float(sway[:50].abs().max()) == 0.0
    assert 0.15 * 25e3 < float(sway.abs().max()) <= 0.3 * 25e3
    assert abs(float(torch.corrcoef(torch.stack((sway, moment)))[0, 1])) < 0.2
    with pytest.raises(UsageError, match="not forces; remove it"):
        MultiSine.build_source([wave], Helm.from_plant(load_vessel("wam_v_cal").build()), t)
