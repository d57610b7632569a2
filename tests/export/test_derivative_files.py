"""Files of derivatives are read back, and give the accelerations of the model."""

from __future__ import annotations

import csv
import io
import json
import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal, cast
from xml.etree import ElementTree

import numpy as np
import pytest
import torch

from residnet.baselines.regressors_config import RegressorsConfig
from residnet.core.errors import UsageError
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.store import ModelSpec
from residnet.evaluation.derivatives import DerivativesFile, compute_derivatives
from residnet.export.derivative_files import render_derivatives
from residnet.physics.plant import HullPlant
from residnet.physics.signals_config import SignalsConfig
from residnet.physics.similarity import Particulars
from residnet.physics.vessel import load_vessel

SHIP = Particulars(
    length=7.0, speed=1.2, beam=1.27, draught=0.46, mass=3270.0, centre_of_gravity=0.24
)
# third order in all variables, so that the Taylor series is exact
TERMS: dict[Literal["u", "v", "r", "w", "p", "q"], tuple[str, ...]] = {
    "u": ("1", "u", "u^2", "v r", "r^2", "n", "n^2", "delta^2"),
    "v": ("1", "v", "r", "u v", "v^3", "v^2 r", "delta", "u^2 delta", "v|v|", "v|r|"),
    "r": ("1", "v", "r", "u r", "v^3", "v r^2", "delta", "u^2 delta", "r|r|", "r|v|"),
}


def make_model() -> tuple[ModelSpec, HybridDynamics]:
    config = RegressorsConfig(terms=TERMS)
    spec = ModelSpec(
        name="hull",
        role="baseline",
        signals=SignalsConfig(inputs=("n", "delta")),
        baseline=config,
        dt=0.1,
        integrator="rk4",
        low=(0.8, -0.2, -0.1, 5.0, -0.5),
        high=(1.5, 0.2, 0.1, 12.0, 0.5),
    )
    model = spec.build()
    theta: Any = model.baseline.theta
    terms = list(cast(Any, model.baseline).library.terms)
    generator = np.random.default_rng(4)
    table = generator.normal(size=(3, len(terms))) * np.array([[0.01], [0.05], [0.02]])
    # resistance, thrust and a rudder that turns to starboard
    table[0, terms.index("u")] = -0.2
    table[0, terms.index("n")] = 0.03
    table[2, terms.index("delta")] = 0.05
    table[2, terms.index("u^2 delta")] = 0.02
    with torch.no_grad():
        theta.copy_(torch.from_numpy(table))
    assert isinstance(model, HybridDynamics)
    return spec, model


def make_table(particulars: Particulars = SHIP, order: int = 3) -> DerivativesFile:
    spec, model = make_model()
    return compute_derivatives(spec, model, particulars, order=order)


def draw_channels(n_rows: int = 40) -> np.ndarray:
    """Draw u, v, r, n, delta within the training ranges."""
    spec, _ = make_model()
    return np.random.default_rng(1).uniform(spec.low, spec.high, (n_rows, 5))


def accelerations(z: np.ndarray) -> np.ndarray:
    _, model = make_model()
    with torch.no_grad():
        result: np.ndarray = model.baseline(torch.from_numpy(z)).numpy()
    return result


@pytest.mark.parametrize(
    "particulars", [SHIP, Particulars(length=7.0, speed=1.2)], ids=["forces", "accelerations"]
)
def test_vessel_file_has_the_accelerations_of_the_model(
    particulars: Particulars, tmp_path: Path
) -> None:
    file = tmp_path / "ship.yaml"
    file.write_text(render_derivatives(make_table(particulars), file, None))
    plant = load_vessel(str(file)).build()
    assert isinstance(plant, HullPlant)
    z = draw_channels()
    x = plant.make_initial_state(len(z))
    names = list(plant.state_names)
    for name, column in zip(("u", "v", "r"), z.T[:3], strict=True):
        x[:, names.index(name)] = torch.from_numpy(column)
    # inputs without dynamics are commands
    commands = torch.from_numpy(z[:, [4, 3]])
    commands = torch.cat((commands, torch.zeros(len(z), len(plant.input_names) - 2)), dim=1)
    rate = plant.derivative(x, commands)
    result = rate[:, [names.index(name) for name in ("u", "v", "r")]].numpy()
    np.testing.assert_allclose(result, accelerations(z), rtol=1e-8, atol=1e-10)


def translate_matlab(text: str) -> Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, float]]:
    """Return a MATLAB function of scalars and matrices as a Python function."""
    lines = [line for line in text.splitlines() if line and not line.startswith("%")]
    assert re.fullmatch(r"function \[xdot,U\] = ship\(x,ui\)", lines[0])
    assert lines[-1] == "end"
    body = []
    for line in lines[1:-1]:
        if line.startswith("if "):
            continue
        name, _, expression = line.rstrip(";").partition(" = ")
        expression = expression.replace("^", "**")
        expression = re.sub(r"\b(x|ui)\((\d)\)", lambda m: f"{m[1]}[{int(m[2]) - 1}]", expression)
        if name == "M":
            rows = expression.strip("[]").split("; ")
            expression = f"np.array([{','.join('[' + ','.join(r.split()) + ']' for r in rows)}])"
        elif name == "nudot":
            assert expression == "M \\ [X; Y; N]"
            expression = "np.linalg.solve(M, np.array([X, Y, N]))"
        elif name == "xdot":
            values = expression.strip("[]").split("; ")
            expression = f"np.array([*nudot, {', '.join(values[1:])}])"
        body.append(f"{name} = {expression}")

    def run(x: np.ndarray, ui: np.ndarray) -> tuple[np.ndarray, float]:
        scope = {"np": np, "x": x, "ui": ui, "sqrt": math.sqrt, "cos": math.cos, "sin": math.sin}
        exec("\n".join(body), scope)
        return scope["xdot"], scope["U"]  # type: ignore[return-value]

    return run


@pytest.mark.parametrize(
    "particulars", [SHIP, Particulars(length=7.0, speed=1.2)], ids=["forces", "accelerations"]
)
def test_mss_function_has_the_accelerations_of_the_model(particulars: Particulars) -> None:
    text = render_derivatives(make_table(particulars), Path("ship.m"), "mss")
    vessel = translate_matlab(text)
    z = draw_channels()
    for channels, expected in zip(z, accelerations(z), strict=True):
        u, v, r = channels[:3]
        psi = 0.7
        xdot, speed = vessel(np.array([u, v, r, 10.0, 20.0, psi]), channels[3:])
        np.testing.assert_allclose(xdot[:3], expected, rtol=1e-8, atol=1e-10)
        track = [math.cos(psi) * u - math.sin(psi) * v, math.sin(psi) * u + math.cos(psi) * v, r]
        np.testing.assert_allclose(xdot[3:], track)
        assert speed == pytest.approx(math.hypot(u, v))


def read_plugins(text: str) -> list[dict[str, float]]:
    plugins = ElementTree.fromstring(f"<sdf>{text}</sdf>").findall("plugin")
    assert [plugin.get("name") for plugin in plugins] == [
        "gz::sim::systems::Hydrodynamics",
        "vrx::SimpleHydrodynamics",
    ]
    return [
        {child.tag: float(child.text or "") for child in plugin if child.tag != "link_name"}
        for plugin in plugins
    ]


def test_gazebo_plugin_has_the_accelerations_near_service_speed() -> None:
    """gz-sim: M_RB nu_dot + C_RB nu + M_A nu_dot + C_A nu = linear and modulus damping."""
    table = make_table()
    gazebo, _ = read_plugins(render_derivatives(table, Path("ship.sdf"), None))
    mass = SHIP.mass or 0.0
    centre = SHIP.centre_of_gravity
    inertia = mass * ((SHIP.gyradius * SHIP.length) ** 2 + centre**2)
    rigid = np.array([[mass, 0, 0], [0, mass, mass * centre], [0, mass * centre, inertia]])
    added = -np.array(
        [
            [gazebo["xDotU"], 0.0, 0.0],
            [0.0, gazebo["yDotV"], gazebo["yDotR"]],
            [0.0, gazebo["nDotV"], gazebo["nDotR"]],
        ]
    )

    def coriolis(matrix: np.ndarray, nu: np.ndarray) -> np.ndarray:
        u, v, r = nu
        sway = matrix[1, 1] * v + matrix[1, 2] * r
        surge = matrix[0, 0] * u
        return np.array([-sway * r, surge * r, sway * u - surge * v])

    def force(nu: np.ndarray) -> np.ndarray:
        damping = np.zeros(3)
        for i, axis in enumerate("xyn"):
            for j, first in enumerate("UVR"):
                damping[i] += gazebo.get(f"{axis}{first}", 0.0) * nu[j]
                for k, second in enumerate("UVR"):
                    coefficient = gazebo.get(f"{axis}{first}abs{second}", 0.0)
                    damping[i] += coefficient * nu[j] * abs(nu[k])
        return damping - coriolis(rigid + added, nu)

    # the difference of two motions about straight-ahead motion removes constants and thrust
    speed = SHIP.speed
    step = 1e-6
    equilibrium = np.array([table.operating_point["n"], 0.0])
    matrix = np.array(table.mass_matrix)
    for j, direction in enumerate(np.eye(3)):
        ahead = np.array([speed, 0.0, 0.0])
        difference = force(ahead + step * direction) - force(ahead - step * direction)
        z = np.array([[*(ahead + s * step * direction), *equilibrium] for s in (1.0, -1.0)])
        model_force = accelerations(z) @ matrix.T
        expected = model_force[0] - model_force[1]
        # the simulator's mass matrix is symmetric, that of the regressions is nearly so
        np.testing.assert_allclose(difference[j], expected[j], rtol=0.02)
        if j > 0:
            np.testing.assert_allclose(difference[1:], expected[1:], rtol=0.03, atol=2e-5)


def test_vrx_plugin_has_resistances_of_either_sign_convention() -> None:
    table = make_table()
    gazebo, vrx = read_plugins(render_derivatives(table, Path("ship.sdf"), None))
    values = {row.name: row.value for row in table.rows}
    assert vrx["xDotU"] == pytest.approx(-gazebo["xDotU"])
    assert vrx["yV"] == pytest.approx(-values["Y_v"])
    assert vrx["yVV"] == pytest.approx(-values["Y_v|v|"])
    assert vrx["nR"] == pytest.approx(-values["N_r"])
    assert vrx["nRR"] == pytest.approx(-values["N_r|r|"])
    # the slope of the resistance at the service speed
    assert vrx["xU"] + 2.0 * vrx["xUU"] * SHIP.speed == pytest.approx(-values["X_u"])
    assert vrx["max_effort"] > 1e4


def test_tables_hold_every_row() -> None:
    table = make_table()
    names = [row.name for row in table.rows]
    content = json.loads(render_derivatives(table, Path("a.json"), None))
    assert [row["name"] for row in content["rows"]] == names
    rows = list(csv.DictReader(io.StringIO(render_derivatives(table, Path("a.csv"), None))))
    assert [row["name"] for row in rows] == names
    assert [float(row["value"]) for row in rows] == [row.value for row in table.rows]
    matlab = render_derivatives(table, Path("a.m"), None)
    values = dict(re.findall(r"^si\.(\w+) = (\S+);", matlab, flags=re.MULTILINE))
    assert float(values["N_delta"]) == next(r.value for r in table.rows if r.name == "N_delta")
    assert len(values) == len(names)
    assert len(re.findall(r"^prime\.", matlab, flags=re.MULTILINE)) == len(names)


def test_formats_say_what_they_cannot_represent() -> None:
    table = make_table(Particulars(length=7.0, speed=1.2))
    with pytest.raises(UsageError, match="give --mass, --beam and --draught"):
        render_derivatives(table, Path("ship.sdf"), None)
    with pytest.raises(UsageError, match=r"\.xls.*--format"):
        render_derivatives(table, Path("ship.xls"), None)
    with pytest.raises(UsageError, match="no format 'simulink'"):
        render_derivatives(table, Path("ship.m"), "simulink")
    with pytest.raises(UsageError, match=r"1ship\.m: MATLAB"):
        render_derivatives(table, Path("1ship.m"), "mss")
