"""Residuals in force space: recovered from a vessel whose mass, Coriolis and damping are known, and
run forward as its equations of motion.
"""

from __future__ import annotations

from typing import Any

import pytest
import torch
from made_samples import sampled

from residnet.baselines.given import BelievedConfig
from residnet.baselines.regressors import RegressorsConfig
from residnet.core.errors import ConfigError, FitError
from residnet.core.samples import Samples
from residnet.dynamics.ensemble import mean_of
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.rollout import Rollout
from residnet.dynamics.store import ModelSpec, load_model, save_model
from residnet.export.feed_forward import BelievedForce, RequiredForce, ResidualForce
from residnet.heads.force import ForceHead
from residnet.heads.linear import PlsrConfig, RidgeConfig
from residnet.heads.mlp import MlpConfig
from residnet.heads.symbolic import SymbolicConfig
from residnet.physics.plant import HullPlant
from residnet.physics.signals import SignalsConfig
from residnet.physics.vessel import load_vessel

SIGNALS = SignalsConfig(inputs=("tau_x", "tau_y", "tau_n"))
NAMES = SIGNALS.build().names
BELIEVED = BelievedConfig(vessel="milliampere")
TERMS = (
    "u_dot",
    "v_dot",
    "r_dot",
    "u",
    "v",
    "r",
    "u|u|",
    "v|v|",
    "u^3",
    "v^3",
    "r|r|",
    "u v",
    "u r",
    "v r",
    "r^2",
    "|r|v",
    "|v|r",
)


def hull(name: str) -> Any:
    vessel = load_vessel(name).build()
    assert isinstance(vessel, HullPlant)
    return vessel.hull


def samples(mass_sign: float = 1.0, count: int = 3000, groups: int = 10) -> Samples:
    """Motion and the forces that the true ferry (half the believed one) needs for it; the sign
    turns its inertia around.
    """
    random = torch.Generator().manual_seed(0)
    nu = torch.randn(count, 3, generator=random, dtype=torch.float64) * torch.tensor(
        [0.6, 0.4, 0.2]
    )
    nu_dot = torch.randn(count, 3, generator=random, dtype=torch.float64) * torch.tensor(
        [0.2, 0.2, 0.05]
    )
    with torch.no_grad():
        tau = hull("milliampere_half").required(mass_sign * nu_dot, nu)
    return sampled(torch.cat((nu, tau), dim=-1), nu_dot, NAMES, groups=groups)


def spec(head: Any, name: str = "force") -> ModelSpec:
    return ModelSpec.model_validate(
        {
            "schema": "residnet.model/1",
            "name": name,
            "role": "head",
            "signals": SIGNALS.model_dump(),
            "baseline": BELIEVED.resolved().model_dump(),
            "head": head.model_dump(),
            "dt": 0.1,
            "integrator": "rk4",
            "low": [-2.0, -1.0, -0.5, -500.0, -500.0, -500.0],
            "high": [2.0, 1.0, 0.5, 500.0, 500.0, 500.0],
        }
    )


def fitted(head: Any, of: Samples) -> HybridDynamics:
    model = spec(head).build()
    with torch.no_grad():
        residual = model.head.residual_target(of, model.baseline(of.z))
    assert isinstance(model.head, ForceHead)
    model.head.calibrate(residual)
    model.head.solve(residual)
    return model.eval()


@pytest.fixture(scope="module")
def model() -> HybridDynamics:
    return fitted(RidgeConfig(space="force", terms=TERMS, choose="one_step"), samples())


def test_the_mass_and_the_accelerations_are_the_true_ferrys(model: HybridDynamics) -> None:
    of = samples()
    with torch.no_grad():
        torch.testing.assert_close(model.one_step(of.z[None])[0], of.target, rtol=0, atol=1e-5)
    torch.testing.assert_close(
        torch.linalg.inv(model.head.inverse), hull("milliampere_half").mass, rtol=1e-4, atol=1e-2
    )


@pytest.mark.parametrize(
    "config",
    [PlsrConfig(space="force", choose="one_step"), RidgeConfig(space="force", choose="one_step")],
)
def test_the_thirty_basis_functions_hold_it_too(config: Any) -> None:
    model = fitted(config, samples())
    assert isinstance(model.head, ForceHead)
    assert model.head.inner.library.count == 30
    of = samples()
    with torch.no_grad():
        torch.testing.assert_close(model.one_step(of.z[None])[0], of.target, rtol=0, atol=1e-3)


def test_a_free_run_is_the_true_ferrys(model: HybridDynamics) -> None:
    """Against the hull's own equations of motion under the same forces."""
    true = hull("milliampere_half")
    x = torch.tensor([[0.0, 0.0, 0.0, 0.5, 0.1, 0.05]], dtype=torch.float64)
    w = torch.tensor([[100.0, -20.0, 30.0]], dtype=torch.float64)
    s, nu, h = x[:, :0], x[:, 3:].clone(), 0.001
    inverse = torch.linalg.inv(true.mass)
    for k in range(5000):
        if k % 100 == 0:
            x, s = model.step(x, w, s)
        for _ in range(1):
            a = (w - true.required(torch.zeros_like(nu), nu)) @ inverse.T
            b = (w - true.required(torch.zeros_like(nu), nu + 0.5 * h * a)) @ inverse.T
            nu = nu + h * b
    # the residual is held over steps of 0.1 s
    torch.testing.assert_close(x[:, 3:], nu, rtol=0, atol=2e-3)


def test_the_feed_forward_undoes_the_motion(model: HybridDynamics) -> None:
    of = samples(count=50)
    assert isinstance(model.head, ForceHead)
    believed = BelievedForce(model.baseline, model.head.mass)
    force = RequiredForce(believed, ResidualForce(model.head), mirrored=False).eval()
    with torch.no_grad():
        torch.testing.assert_close(force(of.target, of.z[:, :3]), of.z[:, 3:], rtol=0, atol=1e-2)
        # and exactly the model's own inverse
        nu_dot = model.one_step(of.z[None])[0]
        torch.testing.assert_close(force(nu_dot, of.z[:, :3]), of.z[:, 3:], rtol=0, atol=1e-8)
        scripted = torch.jit.script(force)
        torch.testing.assert_close(scripted(of.target, of.z[:, :3]), force(of.target, of.z[:, :3]))


def test_saved_scripted_and_averaged(model: HybridDynamics, tmp_path: Any) -> None:
    config = RidgeConfig(space="force", terms=TERMS, choose="one_step")
    save_model(tmp_path / "force", spec(config), model)
    _, loaded = load_model(tmp_path / "force")
    of = samples(count=60)
    x, w = torch.zeros(60, 6, dtype=torch.float64), of.z[:, 3:]
    x[:, 3:] = of.z[:, :3]
    with torch.no_grad():
        after, _ = model.step(x, w, x[:, :0])
        torch.testing.assert_close(loaded.step(x, w, x[:, :0])[0], after)
        scripted = torch.jit.script(Rollout(model))
        torch.testing.assert_close(scripted(x, w[:, None], x[:, :0])[0][:, 1], after)
        other = fitted(PlsrConfig(space="force", order=2, choose="one_step"), samples())
        mean = mean_of([model, other])
        expected = (model.one_step(of.z[None]) + other.one_step(of.z[None])) / 2
        torch.testing.assert_close(mean.one_step(of.z[None]), expected)
        scripted, stepped = torch.jit.script(Rollout(mean)), mean.step(x, w, x[:, :0])[0]
        torch.testing.assert_close(scripted(x, w[:, None], x[:, :0])[0][:, 1], stepped)


@pytest.mark.parametrize(
    "config",
    [
        PlsrConfig(space="force", order=17, terms=TERMS),
        RidgeConfig(space="force", terms=TERMS, penalties=(1e-8, 1e-6)),
    ],
)
def test_a_mass_that_cannot_be_inverted_safely_fails_the_fit(config: Any) -> None:
    with pytest.raises(FitError, match=r"eigenvalues .* cannot run forward"):
        fitted(config, samples(mass_sign=-1.0))


def test_only_the_solutions_that_run_forward_are_offered() -> None:
    """The least penalties find the negative mass; strong ones stay with the believed one."""
    head = spec(RidgeConfig(space="force", terms=TERMS, penalties=(1e-8, 100.0))).build()
    of = samples(mass_sign=-1.0)
    with torch.no_grad():
        residual = head.head.residual_target(of, head.baseline(of.z))
    assert isinstance(head.head, ForceHead)
    head.head.calibrate(residual)
    offered = [solution.choice["penalty"] for solution in head.head.solutions(residual)]
    assert offered == [[100.0] * 3, []]


@pytest.mark.parametrize(
    ("build", "said"),
    [
        (lambda: RidgeConfig(terms=("u", "u_dot")), "space: force"),
        (
            lambda: RidgeConfig(space="force", terms=("u", "u_dot u")).build(NAMES),
            "names accelerations only by themselves",
        ),
        (
            lambda: RidgeConfig(space="force", terms=("|u_dot|",)).build(NAMES),
            "names accelerations only by themselves",
        ),
        (lambda: RidgeConfig(space="force", terms=("u_ddot",)).build(NAMES), "u_ddot"),
        (lambda: MlpConfig(features=("u_dot", "v")).build(NAMES), "only a residual in force space"),
        (
            lambda: SymbolicConfig(features=("u_dot",)).build(NAMES),
            "only a residual in force space",
        ),
        (lambda: _on(RegressorsConfig(terms=("u", "tau_x"))), "kind to 'believed'"),
    ],
)
def test_refused(build: Any, said: str) -> None:
    with pytest.raises((ConfigError, ValueError), match=said):
        build()


def _on(baseline: Any) -> None:
    head = RidgeConfig(space="force").build(NAMES)
    assert isinstance(head, ForceHead)
    head.set_mass(baseline.build(NAMES).mass())


def test_believed_mass_is_the_hulls_times_its_factor() -> None:
    mass = BelievedConfig(vessel="milliampere", scale=0.5).build(NAMES).mass()
    assert mass is not None
    torch.testing.assert_close(mass, 0.5 * hull("milliampere").mass, rtol=1e-10, atol=1e-8)
