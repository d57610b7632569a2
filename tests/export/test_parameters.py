"""Exported coefficients, read back and simulated as PythonVehicleSimulator and MSS do."""

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
from residnet.export import exporter
from residnet.export.vessel import ExportedVessel

FORCES = ("tau_x", "tau_y", "tau_n")


def put(folder: Path, spec: ModelSpec, model: HybridDynamics) -> Any:
    file = folder / "hull.parameters.json"
    return exporter("parameters").export(ExportedVessel(spec, model), file)


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


def zigzag(step: Any, dt: float, drive: float, push: float) -> list[float]:
    """Overshoots in degrees of a 20/20 zigzag driven by a force, steered by a moment."""
    psi, nu, side, farthest = 0.0, np.zeros(3), 1.0, 0.0
    overshoots: list[float] = []
    for _ in range(round(120.0 / dt)):
        nu = step(nu, np.array([drive, 0.0, push * side]))
        psi += dt * nu[2]
        # how far the heading goes on to the side that is being left
        farthest = max(farthest, -side * psi)
        if side * psi > np.radians(20.0):
            overshoots.append(float(np.degrees(farthest)) - 20.0)
            side, farthest = -side, 0.0
    return overshoots[1:]


def overshoots(folder: Path, model: HybridDynamics, drive: float, push: float) -> Any:
    """Compare those of PythonVehicleSimulator's vehicle and of MSS' equations with the baseline's;
    return the card.
    """
    dt = 0.02
    boat = runpy.run_path(str(folder / "hull_vehicle.py"))["Hull"]()
    card = json.loads((folder / "hull.parameters.json").read_text())
    mass, linear, quadratic = (np.array(card[name]) for name in ("M", "D", "D_n"))

    def simulator(nu: np.ndarray, tau: np.ndarray) -> np.ndarray:
        six = np.zeros(6)
        six[[0, 1, 5]] = nu
        after = boat.dynamics(np.zeros(6), six, np.zeros(3), tau, dt)[0]
        return np.asarray(after[[0, 1, 5]])

    def mss(nu: np.ndarray, tau: np.ndarray) -> np.ndarray:
        """m2c of MSS in three degrees of freedom, its symmetric part first."""
        whole = 0.5 * (mass + mass.T)
        c = np.zeros((3, 3))
        c[0, 2] = -whole[1, 1] * nu[1] - whole[1, 2] * nu[2]
        c[1, 2] = whole[0, 0] * nu[0]
        c[2, :2] = -c[:2, 2]
        rest = tau - c @ nu - linear @ nu - quadratic @ (np.abs(nu) * nu)
        return nu + dt * np.linalg.solve(mass, rest)

    scripted = torch.jit.trace(model.baseline, torch.zeros(1, 6, dtype=torch.float64))

    def own(nu: np.ndarray, tau: np.ndarray) -> np.ndarray:
        z = torch.from_numpy(np.concatenate((nu, tau)))[None]
        with torch.no_grad():
            return nu + dt * np.asarray(scripted(z)[0].numpy())

    wanted, *others = (zigzag(step, dt, drive, push) for step in (own, simulator, mss))
    assert len(wanted) >= 2
    for found in others:
        np.testing.assert_allclose(found, wanted, atol=0.5)
    return card


def test_a_zigzag_has_the_overshoots_of_the_baseline(written: Path) -> None:
    card = overshoots(written, believed()[1], 250.0, 150.0)
    assert card["share_left_out"]["u"] < 1e-9
    assert 0.1 < card["share_left_out"]["v"] < 0.3
    # the only terms of this hull that the form has no place for
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


@pytest.mark.parametrize("seed", range(2))
def test_hulls_drawn_at_random_keep_their_overshoots(seed: int, tmp_path: Path) -> None:
    spec, model = drawn(seed, 0.0)
    (tmp_path / "hull.masses.yaml").write_text("mass: 20\ninertia: 10\n")
    card = put(tmp_path, spec, model)
    assert max(card["share_left_out"].values()) < 1e-9
    drive, push = 0.4 * card["M"][0][0], 0.1 * card["M"][2][2]
    overshoots(tmp_path, model, drive, push)


def test_what_a_drawn_hull_has_besides_is_listed_with_its_share(tmp_path: Path) -> None:
    spec, model = drawn(3, 0.3)
    (tmp_path / "hull.masses.yaml").write_text("mass: 20\ninertia: 10\n")
    card = put(tmp_path, spec, model)
    assert card["terms_left_out"]["v_dot"] == ["|u|v"]
    assert card["share_left_out"]["v"] > 0.01
    assert card["share_left_out"]["u"] < 1e-9


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
    with pytest.raises(UsageError, match="accelerations do not tell all masses"):
        put(tmp_path, *built("mlp"))
    assert not list(tmp_path.iterdir())
