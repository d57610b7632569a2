"""Files of the patrol vessel: what is wrong in one is one line, and one may build on another."""

from __future__ import annotations

from pathlib import Path

import pytest

from residnet.core.config import load_config
from residnet.core.errors import ConfigError
from residnet.physics.hull import PatrolConfig
from residnet.physics.vessel import VesselConfig, load_vessel, vessel_files


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("rigid_body.z_G.unit=kg", r"rigid_body.z_G.*does not measure \[m\]"),
        ("rigid_body.I_x.value=-1", "must be positive"),
        ("hydrostatics.GM.value=-0.2", r"hydrostatics.*must be positive"),
        ("hydrostatics.volume.unit=m^2", r"does not measure \[m\^3\]"),
        ("forces.K.p.unit=kg m^2", r"K.p: its unit must be kg m\^2/s"),
        ("forces.K.phi^2={value: 1, unit: N, source: made}", r"kg m\^2/s\^2"),
        ("forces.N.w r={value: 1, unit: kg, source: made}", "no channel 'w'"),
        ("forces.N.sin(phi)={value: 1, unit: N m, source: made}", "no function 'sin'"),
        ("forces.Y.u^-1={value: 1, unit: kg m/s, source: made}", "divides by what may be zero"),
        ("actuators.kind=sails", "sails"),
        ("actuators.stall=100 deg", "less than 1.5707"),
        ("actuators.x=3 m", "less than 0"),
        ("actuators.thrust=0", "greater than 0"),
        ("base=wam_v_clean", "no vessel 'wam_v_clean'"),
    ],
)
def test_a_wrong_value_is_one_line(override: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        load_config(vessel_files()["patrol_p06"], [override], VesselConfig)
    assert "\n" not in str(caught.value)


def test_a_mass_matrix_that_is_not_positive_stops() -> None:
    vessel = load_config(
        vessel_files()["patrol_p06"], ["added_mass.K_pdot.value=5e6"], VesselConfig
    )
    with pytest.raises(ConfigError, match=r"patrol_p06.*mass matrix is not positive definite"):
        vessel.build()


def test_a_set_has_its_base_but_for_what_it_says() -> None:
    hybrid, base = load_vessel("patrol_hyb"), load_vessel("patrol_p06")
    changed = {
        "name": "patrol_hyb",
        "description": hybrid.description,
        "added_mass": base.added_mass.model_copy(update={"Y_vdot": hybrid.added_mass.Y_vdot}),
    }
    assert hybrid == base.model_copy(update=changed)
    assert hybrid.added_mass.Y_vdot.value == -393e3
    # a section of another kind takes the place of the base's as a whole
    assert load_vessel("patrol_p06_linear").actuators.kind == "linear_rudders"
    # what a run writes down names no base
    assert PatrolConfig.model_validate(hybrid.model_dump()) == hybrid


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
    with pytest.raises(ConfigError, match="name each other in a circle") as caught:
        load_vessel(str(tmp_path / "second.yaml"))
    assert "\n" not in str(caught.value)
    (tmp_path / "first.yaml").write_text("kind: [patrol\n")
    with pytest.raises(ConfigError, match=r"base: .*first.yaml"):
        load_vessel(str(tmp_path / "second.yaml"))
