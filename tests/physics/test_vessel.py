"""Vessel files: every one loads, and a wrong one stops with a line that says where."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from residnet.core.config import load_config
from residnet.core.errors import ConfigError
from residnet.core.names import CHANNEL_UNITS
from residnet.dynamics.rollout import Rollout
from residnet.dynamics.simulated import PlantDynamics
from residnet.physics.hull import FossenConfig
from residnet.physics.parameters import Parameter
from residnet.physics.vessel import load_vessel, vessel_files

CAL = vessel_files()["wam_v_cal"]


@pytest.mark.parametrize("name", vessel_files())
def test_every_vessel_file(name: str) -> None:
    vessel = load_vessel(name)
    assert vessel.name == name, "a vessel is called as its file"
    plant = vessel.build()
    x = plant.approach(2)
    assert x.shape == (2, len(plant.state))
    zero = torch.zeros(2, dtype=torch.float64)
    w = torch.zeros(2, len(plant.inputs), dtype=torch.float64)
    w[:, : plant.commands] = plant.demand(zero + 0.5, zero + 0.2)
    rate = plant.rate(x, w)
    assert rate.shape == x.shape
    assert bool(torch.isfinite(rate).all())
    assert plant.end_step(x, w, 0.01).shape == x.shape
    # what a log may hold has a unit; thrusters are named by the vessel file, so that no table can
    # hold their channels
    named_by_file = ("_", "n_", "alpha_", "cmd_n_", "cmd_alpha_")
    logged = [
        name
        for name in (*plant.state, *plant.inputs[: plant.commands])
        if not name.startswith(named_by_file)
    ]
    assert [name for name in logged if name not in CHANNEL_UNITS] == []
    assert {"x", "y", "psi", "u", "v", "r"} <= set(plant.state)


@pytest.mark.parametrize("name", vessel_files())
def test_every_vessel_in_a_batch_with_gradients(name: str) -> None:
    plant = load_vessel(name).build()
    random = torch.Generator().manual_seed(0)
    x = plant.approach(4)
    x = x + 0.05 * torch.rand(x.shape, generator=random, dtype=torch.float64)
    w = 0.1 * torch.rand(4, len(plant.inputs), generator=random, dtype=torch.float64)
    w[:, : plant.commands] = plant.demand(
        torch.full((4,), 0.6, dtype=torch.float64),
        torch.linspace(-0.5, 0.4, 4, dtype=torch.float64),
    )
    # at rest, too, slopes stay finite
    x[3] = 0.0
    x.requires_grad_()
    w.requires_grad_()
    rate = plant.rate(x, w)
    for slope in torch.autograd.grad(rate.sum(), (x, w), allow_unused=True):
        assert slope is None or bool(torch.isfinite(slope).all())
    for row in range(4):
        torch.testing.assert_close(
            plant.rate(x[row : row + 1], w[row : row + 1])[0], rate[row], rtol=1e-9, atol=1e-12
        )
        torch.testing.assert_close(
            plant.end_step(x[row : row + 1], w[row : row + 1], 0.01)[0],
            plant.end_step(x, w, 0.01)[row],
        )


@pytest.mark.parametrize("name", vessel_files())
def test_every_vessel_turns_to_starboard_where_it_is_steered(name: str) -> None:
    """From where trials start, at full drive, to one side and the other."""
    vessel = load_vessel(name)
    plant = vessel.build()
    x = plant.approach(2)
    drive, steer = (
        torch.ones(2, dtype=torch.float64),
        torch.tensor([0.3, -0.3], dtype=torch.float64),
    )
    w = torch.zeros(2, 400, len(plant.inputs), dtype=torch.float64)
    w[:, :, : plant.commands] = plant.demand(drive, steer)[:, None]
    with torch.no_grad():
        states, _, _ = Rollout(PlantDynamics(plant, 0.05))(x, w, x[:, :0])
    turned = states[:, -1, plant.state.index("psi")]
    assert float(turned[0]) > 0 > float(turned[1])
    assert bool((states[:, -1, plant.state.index("u")] > 0).all())


def test_calibrated_numbers_are_those_of_errata() -> None:
    vessel = load_vessel("wam_v_cal")
    body, added, damping = vessel.rigid_body, vessel.added_mass, vessel.damping
    assert (body.m.value, body.I_z.value, body.x_G.value) == (315, 760, 0)
    assert (added.X_udot.value, added.Y_vdot.value, added.N_rdot.value) == (-42, -250, -500)
    assert {term: p.value for term, p in damping.X.items()} == {"u": 180, "u|u|": 83}
    assert {term: p.value for term, p in damping.Y.items()} == {"v": 250, "|u|v": 150, "v|v|": 600}
    assert {term: p.value for term, p in damping.N.items()} == {
        "r": 900,
        "r|r|": 1700,
        "|u|v": -320,
    }
    assert (
        vessel.actuators.spacing,
        vessel.actuators.n_max * 60,
        vessel.actuators.n_rate * 60,
    ) == pytest.approx((2.44, 2380, 1500))


def test_units_are_converted_at_the_door() -> None:
    vessel = load_config(
        CAL,
        ["rigid_body.m.value=0.315", "rigid_body.m.unit=t", "length.value=488", "length.unit=cm"],
        FossenConfig,
    )
    assert vessel.rigid_body.m == Parameter(
        value=315.0, unit="kg", source=vessel.rigid_body.m.source
    )
    assert vessel.length.value == pytest.approx(4.88)
    # what is converted once is not converted again
    again = FossenConfig.model_validate(vessel.model_dump())
    assert again == vessel


@pytest.mark.parametrize(
    ("override", "place", "message"),
    [
        ("rigid_body.m.unit=m", "rigid_body.m", r"unit 'm' does not measure \[kg\]"),
        ("rigid_body.m.unit=kilo", "rigid_body.m", "unknown unit 'kilo'"),
        ("rigid_body.m.value=-1", "rigid_body.m", "must be positive"),
        ("rigid_body.I_z.value=0", "rigid_body.I_z", "must be positive"),
        ("rigid_body.m.value=.nan", "rigid_body.m.value", "finite"),
        ("rigid_body.m.value=heavy", "rigid_body.m.value", "number"),
        ("rigid_body.m.source=' '", "rigid_body.m.source", "needs its source"),
        ("rigid_body.mass.value=3", "rigid_body.mass", "rigid_body.m"),
        ("added_mass.N_rdot.unit=kg m", "added_mass.N_rdot", r"does not measure \[kg m\^2\]"),
        ("length.value=-3", "length", "must be positive"),
        ("actuators.kind=sail", "actuators", "sail"),
        ("actuators.n_max=2380 rpm/s", "actuators.n_max", "rpm/s"),
    ],
)
def test_a_wrong_value_is_one_line_with_its_place(override: str, place: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        load_config(CAL, [override], FossenConfig)
    text = str(caught.value)
    assert "\n" not in text
    assert place in text
    assert override in text


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("damping.X.w={value: 1, unit: kg/s, source: made}", "no channel 'w'"),
        ("damping.X.u+v={value: 1, unit: kg/s, source: made}", "cannot read"),
        ("damping.X.u.unit=kg", "kg/s"),
        ("damping.X.u^-1={value: 1, unit: kg, source: made}", "divides by what may be zero"),
        ("damping.N.r.unit=kg/s", r"kg m\^2/s"),
        ("damping.Y.v.unit=t/s", "kg/s"),
        ("damping.Y.v.unit=kg2/s", "kg/s"),
        ("damping.N.|u|v|v|={value: 1, unit: kg, source: made}", "kg s/m"),
    ],
)
def test_a_wrong_damping_term_is_found_when_the_file_is_read(override: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        load_config(CAL, [override], FossenConfig)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "override",
    [
        "damping.X.u.unit=N s/m",
        "damping.N.r.unit=N m s/rad",
        "damping.N.r.unit=N m s",
        "damping.N.|u|v|v|={value: 1, unit: kg s/m, source: made}",
    ],
)
def test_equal_units_of_damping_are_taken(override: str) -> None:
    vessel, known = load_config(CAL, [override], FossenConfig), load_vessel("wam_v_cal")
    axis, term = (
        override.split(".")[1],
        override.removeprefix("damping.").split(".")[1].split("=")[0],
    )
    assert isinstance(known, FossenConfig)
    row = getattr(vessel.damping, axis)
    assert row[term].value == (
        1.0 if term == "|u|v|v|" else getattr(known.damping, axis)[term].value
    )
    assert row[term].unit in override
    # the plant brakes with the number as it stands, whichever of its equal units was named
    nu = torch.tensor([[1.5, -0.4, 0.3]], dtype=torch.float64)
    extra = torch.tensor(
        [[0.0, 0.0, 1.5 * -0.4 * 0.4 if term == "|u|v|v|" else 0.0]], dtype=torch.float64
    )
    torch.testing.assert_close(vessel.hull().load(nu), known.hull().load(nu) - extra)


def test_a_vessel_by_path_and_a_vessel_that_is_not_there(tmp_path: Path) -> None:
    copy = tmp_path / "mine.yaml"
    copy.write_text(CAL.read_text())
    assert load_vessel(str(copy)) == load_vessel("wam_v_cal")
    with pytest.raises(ConfigError, match="did you mean 'wam_v_cal'"):
        load_vessel("wam_v_cla")
    with pytest.raises(ConfigError, match="no such file"):
        load_vessel(str(tmp_path / "other.yaml"))
