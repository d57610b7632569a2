"""Exported coefficients, read back and used as PythonVehicleSimulator and MSS do."""

from __future__ import annotations

import json
import runpy
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
import torch
from exported_models import built

from residnet.core.errors import UsageError
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.store import ModelSpec
from residnet.export import get_exporter
from residnet.export.vessel import ExportedVessel

FORCES = ("tau_x", "tau_y", "tau_n")


def put(folder: Path, spec: ModelSpec, model: HybridDynamics) -> Any:
    file = folder / "hull.parameters.json"
    return get_exporter("parameters").export(ExportedVessel(spec, model), file)


def believed() -> tuple[ModelSpec, HybridDynamics]:
    """The WAM-V's hull as it is believed, driven by forces."""
    spec = ModelSpec.model_validate(
        {
            "schema": "residnet.model/1",
            "name": "hull",
            "role": "baseline",
            "signals": {"inputs": FORCES},
            "baseline": {"kind": "believed", "vessel": "wam_v_cal"},
            "dt": 0.05,
            "integrator": "rk4",
            "low": (-0.5, -0.5, -0.5, -200.0, -50.0, -300.0),
            "high": (3.0, 0.5, 0.5, 400.0, 50.0, 300.0),
        }
    )
    return spec, spec.build().double()


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("parameters")
    (folder / "hull.masses.yaml").write_text("mass: 180\ninertia: 446\n")
    put(folder, *believed())
    return folder


def compare(folder: Path, model: HybridDynamics, axes: slice = slice(3)) -> Any:
    """Compare the rates of PythonVehicleSimulator's vehicle and of MSS' equations with the
    baseline's, at random velocities and forces; return the card.
    """
    boat = runpy.run_path(str(folder / "hull_vehicle.py"))["Hull"]()
    card = json.loads((folder / "hull.parameters.json").read_text())
    mass, linear, quadratic = (np.array(card[name]) for name in ("M", "D", "D_n"))
    # m2c of MSS in three degrees of freedom takes the symmetric part
    whole = 0.5 * (mass + mass.T)
    dt = 0.02
    random = np.random.default_rng(0)
    for nu, tau in zip(*random.uniform(-1, 1, size=(2, 20, 3)), strict=True):
        tau = tau * np.diag(mass)
        with torch.no_grad():
            own = model.baseline(torch.from_numpy(np.concatenate((nu, tau)))[None])[0].numpy()
        six = np.zeros(6)
        six[[0, 1, 5]] = nu
        after = boat.dynamics(np.zeros(6), six, np.zeros(3), tau, dt)[0][[0, 1, 5]]
        c = np.zeros((3, 3))
        c[0, 2] = -whole[1, 1] * nu[1] - whole[1, 2] * nu[2]
        c[1, 2] = whole[0, 0] * nu[0]
        c[2, :2] = -c[:2, 2]
        rest = tau - c @ nu - linear @ nu - quadratic @ (np.abs(nu) * nu)
        for found in (np.linalg.solve(mass, rest), (after - nu) / dt):
            np.testing.assert_allclose(found[axes], own[axes], rtol=1e-6, atol=1e-9)
    return card


def test_the_believed_hull_is_told_but_for_what_the_form_has_no_place_for(written: Path) -> None:
    card = compare(written, believed()[1], slice(1))
    assert card["share_left_out"]["u"] < 1e-9
    assert 0.1 < card["share_left_out"]["v"] < 0.3
    assert card["terms_left_out"] == {"u_dot": [], "v_dot": ["|u|v"], "r_dot": ["|u|v"]}


HULL_TERMS = (
    "u", "v", "r", "u|u|", "v|v|", "r|r|", "v r", "r^2", "u r", "u v", "|u|v", *FORCES,
)  # fmt: skip


def drawn(seed: int, lift: float) -> tuple[ModelSpec, HybridDynamics]:
    """A hull drawn at random as a sum of regressors; `lift` is a damping that forms do not have."""
    random = np.random.default_rng(seed)
    mass = 10.0 ** random.uniform(1.5, 3.5) * np.array([1.0, 1.5, 1.0])
    length = (mass[0] / 40.0) ** (1 / 3) * 2.0
    mass[2] *= (0.3 * length) ** 2
    m = np.diag(mass)
    m[1, 2] = m[2, 1] = 0.05 * length * mass[0]
    slow = random.uniform(0.1, 0.5, 3) * mass
    fast = random.uniform(0.05, 0.5, 3) * mass
    rows = np.zeros((3, len(HULL_TERMS)))
    at = {term: place for place, term in enumerate(HULL_TERMS)}
    for i, name in enumerate("uvr"):
        rows[i, at[name]], rows[i, at[f"{name}|{name}|"]] = -slow[i], -fast[i]
        rows[i, at[FORCES[i]]] = 1.0
    rows[1, at["|u|v"]] = -lift * mass[1]
    rows[0, [at["v r"], at["r^2"]]] = m[1, 1], m[1, 2]
    rows[1, at["u r"]] = -m[0, 0]
    rows[2, [at["u v"], at["u r"]]] = m[0, 0] - m[1, 1], -m[1, 2]
    content = believed()[0].model_dump(by_alias=True)
    content["baseline"] = {"kind": "regressors", "terms": HULL_TERMS}
    spec = ModelSpec.model_validate(content)
    model = spec.build().double()
    theta: Any = model.baseline.theta
    with torch.no_grad():
        theta.copy_(torch.from_numpy(np.linalg.solve(m, rows)))
    return spec, model


@pytest.mark.parametrize("lift", [0.0, 0.3])
def test_hulls_drawn_at_random_are_written_exactly(lift: float, tmp_path: Path) -> None:
    """What a hull has besides is listed with its share."""
    spec, model = drawn(1, lift)
    (tmp_path / "hull.masses.yaml").write_text("mass: 20\ninertia: 10\n")
    card = put(tmp_path, spec, model)
    assert card["share_left_out"]["u"] < 1e-9
    if lift:
        assert card["terms_left_out"]["v_dot"] == ["|u|v"]
        assert card["share_left_out"]["v"] > 0.01
    else:
        assert max(card["share_left_out"].values()) < 1e-9
        compare(tmp_path, model)


def test_gazebo_gets_added_masses_and_resistances(written: Path) -> None:
    card = json.loads((written / "hull.parameters.json").read_text())
    text = (written / "hull.sdf").read_text()
    gz, vrx = ElementTree.fromstring(f"<sdf>{text}</sdf>").findall("plugin")
    for plugin, sign in ((gz, -1.0), (vrx, 1.0)):
        found = {child.tag: child.text for child in plugin}
        assert float(found["xDotU"] or "") == pytest.approx(sign * (card["M"][0][0] - 180))
        assert float(found["nDotR"] or "") == pytest.approx(sign * (card["M"][2][2] - 446))
        assert float(found["xU"] or "") == pytest.approx(sign * card["D"][0][0])


def test_what_cannot_be_told_is_asked_for(tmp_path: Path) -> None:
    spec, model = believed()
    with pytest.raises(UsageError, match=r"hull.masses.yaml: write there mass \(kg\), inertia"):
        put(tmp_path, spec, model)
    assert not list(tmp_path.iterdir())


def test_models_of_commands_have_coefficients_of_accelerations(tmp_path: Path) -> None:
    spec, model = built("mlp")
    card = put(tmp_path, spec, model)
    assert [path.name for path in tmp_path.iterdir()] == ["hull.parameters.json"]
    assert "tau_" in card["not_identifiable"][0]
    assert card["head_left_out"] == "mlp"
    baseline: Any = model.baseline
    z = torch.from_numpy(np.random.default_rng(0).uniform(spec.low, spec.high, (5, len(spec.low))))
    values = dict(zip(baseline.library.terms, baseline.library(z).T.numpy(), strict=True))
    for axis, expected in zip(card["accelerations"], baseline.double()(z).T, strict=True):
        coefficients = card["accelerations"][axis].items()
        acceleration = sum(coefficient * values[term] for term, coefficient in coefficients)
        np.testing.assert_allclose(acceleration, expected.detach().numpy(), rtol=1e-9)


def test_a_model_without_terms_is_refused(tmp_path: Path) -> None:
    content = believed()[0].model_dump(by_alias=True)
    content["baseline"] = {"kind": "still"}
    spec = ModelSpec.model_validate(content)
    assert not get_exporter("parameters").supports(spec)
    with pytest.raises(UsageError, match=r"'still' is no sum of terms.*--model"):
        put(tmp_path, spec, spec.build().double())
