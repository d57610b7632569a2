"""Vessel files: a wrong one stops with one line that says what and where, and one may build on
another.
"""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from residnet.core.config import load_config
from residnet.core.errors import ConfigError
from residnet.core.registry import find_vessel_files
from residnet.physics.hull import FossenConfig, RollingHullConfig
from residnet.physics.parameters import Parameter
from residnet.physics.vessel import VesselConfig, load_vessel

# vessel, override, what is said of it
WRONG = [
    ("wam_v_cal", "rigid_body.m.unit=m", "unit 'm' does not measure \\[kg\\]"),
    ("wam_v_cal", "rigid_body.m.unit=kilo", "unknown unit 'kilo'"),
    ("wam_v_cal", "rigid_body.m.value=-1", "must be positive"),
    ("wam_v_cal", "rigid_body.m.value=.nan", "finite"),
    ("wam_v_cal", "rigid_body.m.source=' '", "needs its source"),
    ("wam_v_cal", "rigid_body.mass.value=3", "rigid_body.m"),
    ("wam_v_cal", "actuators.kind=sail", "sail"),
    ("wam_v_cal", "damping.X.w={value: 1, unit: kg/s, source: made}", "no channel 'w'"),
    ("wam_v_cal", "damping.X.u.unit=kg", "kg/s"),
    (
        "wam_v_cal",
        "damping.X.u^-1={value: 1, unit: kg, source: made}",
        "divides by a channel that may be zero",
    ),
    ("wam_v_cal", "damping.N.r.unit=kg/s", "kg m\\^2/s"),
    ("wam_v_cal", "damping.N.|u|v|v|={value: 1, unit: kg, source: made}", "kg s/m"),
    ("wam_v_cal", "actuators.curve_range=[-1500 rpm, 2400 rpm]", "does not reach n_max"),
    ("wam_v_cal", "added_mass.X_udot.value=400", "wam_v_cal.*mass matrix is not positive definite"),
    ("odin_forces", "terms.u.u.unit=1/m", "expected the unit 1/s"),
    ("odin_forces", "gains.n.unit=1/kg", "expected the unit 1/kg/m\\^2"),
    ("milliampere_azimuth", "actuators.shaft.n_max=5400 rpm", "curve_range"),
    ("milliampere_azimuth", "actuators.shaft.n_max=5300 rpm", "thrust decreases"),
    (
        "milliampere_azimuth",
        "actuators.places=[{name: bow, x: 1.8}, {name: bow, x: -1.8}]",
        "two thrusters are named 'bow'",
    ),
    ("milliampere_azimuth", "actuators.places=[{name: bow, x: 1.8}]", "give two positions"),
    ("patrol_p06", "hydrostatics.GM.value=-0.2", "hydrostatics.*must be positive"),
    ("patrol_p06", "forces.K.p.unit=kg m^2", "K.p: expected the unit kg m\\^2/s"),
    ("patrol_p06", "forces.K.phi^2={value: 1, unit: N, source: made}", "kg m\\^2/s\\^2"),
    ("patrol_p06", "forces.N.sin(phi)={value: 1, unit: N m, source: made}", "no function 'sin'"),
    ("patrol_p06", "base=wam_v_clean", "no vessel 'wam_v_clean'"),
    ("mariner", "coefficients.Y.v^-1=1", "divides"),
    ("mariner", "coefficients.X.dn=1", "given together"),
    ("mariner", "delta_sign=1", "check delta_sign"),
    ("example_rudder_boat", "actuators.rudder.area=0.1 m", "m\\^2"),
    (
        "example_rudder_boat",
        "actuators.propeller.n_max=1600 rpm",
        "curve_range -1500 to 1500 rpm does not reach n_max \\(\\+-1600 rpm\\)",
    ),
    ("example_rudder_boat", "actuators.kind=rudder", "rudder_propeller"),
    ("example_rudder_boat", "kind=fosen", "did you mean 'fossen'"),
    ("nomoto_oceanos", "T.value=0", "T must not be zero"),
    ("nomoto_oceanos", "K.value=-1", "to starboard"),
    ("nomoto_mariner", "T_v.value=18.530161", "T_v must differ from T3"),
    ("nomoto_mariner_yaw", "T2.value=-7", "to starboard"),
]


@pytest.mark.parametrize(("name", "override", "message"), WRONG)
def test_a_wrong_value_is_one_line(name: str, override: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        load_config(find_vessel_files()[name], [override], VesselConfig).build()
    text = str(caught.value)
    assert "\n" not in text
    # where it is: the override, unless only the whole vessel is impossible
    assert override in text or "mass matrix" in text


def test_a_mass_matrix_may_not_be_singular() -> None:
    overrides = ["mass.x_G=0.0", "mass.Y_rdot=-358.21502e-5", "mass.N_vdot=-358.21502e-5"]
    with pytest.raises(ConfigError, match=r"mass matrix is (singular|not positive definite)"):
        load_config(find_vessel_files()["mariner"], overrides, VesselConfig).build()


def test_units_are_converted_at_the_door() -> None:
    overrides = [
        "rigid_body.m.value=0.315",
        "rigid_body.m.unit=t",
        "length.value=488",
        "length.unit=cm",
        "damping.X.u.unit=N s/m",
        "damping.N.r.unit=N m s/rad",
    ]
    vessel = load_config(find_vessel_files()["wam_v_cal"], overrides, FossenConfig)
    source = vessel.rigid_body.m.source
    assert vessel.rigid_body.m == Parameter(value=315.0, unit="kg", source=source)
    assert vessel.length.value == pytest.approx(4.88)
    # what is converted once is not converted again; equal units of a term are taken as they stand
    assert FossenConfig.model_validate(vessel.model_dump()) == vessel
    nu = torch.tensor([[1.5, -0.4, 0.3]], dtype=torch.float64)
    known = load_vessel("wam_v_cal")
    torch.testing.assert_close(
        vessel.build_hull().hydrodynamic_force(nu), known.build_hull().hydrodynamic_force(nu)
    )


def test_a_set_has_its_base_but_for_what_it_says() -> None:
    hybrid = load_vessel("patrol_hyb")
    base = load_vessel("patrol_p06")
    changed = {
        "name": "patrol_hyb",
        "description": hybrid.description,
        "added_mass": base.added_mass.model_copy(update={"Y_vdot": hybrid.added_mass.Y_vdot}),
    }
    assert hybrid == base.model_copy(update=changed)
    assert hybrid.added_mass.Y_vdot.value == -393e3
    # a section of another kind takes the place of the base's as a whole
    assert load_vessel("patrol_p06_linear").actuators.kind == "linear_rudders"
    assert load_vessel("milliampere_azimuth").damping == load_vessel("milliampere").damping
    # what a run writes down names no base
    assert RollingHullConfig.model_validate(hybrid.model_dump()) == hybrid


def test_a_base_by_path(tmp_path: Path) -> None:
    heavy = (
        "kind: patrol\nname: {name}\ndescription: made\nbase: {base}\nrigid_body:\n  m: {{value:"
        " {m}, unit: t, source: made}}\n"
    )
    (tmp_path / "first.yaml").write_text(heavy.format(name="first", base="patrol_hyb", m=400))
    (tmp_path / "second.yaml").write_text(heavy.format(name="second", base="first.yaml", m=410))
    vessel = load_vessel(str(tmp_path / "second.yaml"))
    assert (vessel.name, vessel.rigid_body.m.value, vessel.added_mass.Y_vdot.value) == (
        "second",
        410e3,
        -393e3,
    )
    (tmp_path / "first.yaml").write_text(heavy.format(name="first", base="second.yaml", m=400))
    with pytest.raises(ConfigError, match="refer to each other in a cycle") as caught:
        load_vessel(str(tmp_path / "second.yaml"))
    assert "\n" not in str(caught.value)
    (tmp_path / "first.yaml").write_text("kind: [patrol\n")
    with pytest.raises(ConfigError, match=r"base: .*first.yaml"):
        load_vessel(str(tmp_path / "second.yaml"))


def test_a_vessel_by_path_and_a_vessel_that_is_not_there(tmp_path: Path) -> None:
    copy = tmp_path / "mine.yaml"
    copy.write_text(find_vessel_files()["wam_v_cal"].read_text())
    assert load_vessel(str(copy)) == load_vessel("wam_v_cal")
    with pytest.raises(ConfigError, match="did you mean 'wam_v_cal'"):
        load_vessel("wam_v_cla")
    with pytest.raises(ConfigError, match="no such file"):
        load_vessel(str(tmp_path / "other.yaml"))
