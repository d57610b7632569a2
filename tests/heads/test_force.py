"""Residuals in force space: recovered from a vessel whose mass, Coriolis and damping are known, and
run forward as its equations of motion.
"""

from __future__ import annotations

from typing import Any

import pytest
import torch
from made_samples import sampled

from residnet.baselines.given_config import BelievedConfig
from residnet.baselines.regressors_config import RegressorsConfig
from residnet.core.errors import ConfigError, FitError
from residnet.core.samples import Samples
from residnet.dynamics.ensemble import mean_of
from residnet.dynamics.store import ModelSpec
from residnet.engine.rollout import Rollout
from residnet.export.feed_forward import BelievedForce, RequiredForce, ResidualForce
from residnet.heads.force import ForceHead
from residnet.heads.linear import PlsrConfig, RidgeConfig
from residnet.heads.mlp_config import MlpConfig
from residnet.heads.symbolic_config import SymbolicConfig
from residnet.physics.plant import HullPlant
from residnet.physics.signals_config import SignalsConfig
from residnet.physics.vessel import load_vessel

SIGNALS = SignalsConfig(inputs=("tau_x", "tau_y", "tau_n"))
NAMES = SIGNALS.build().names
BELIEVED = BelievedConfig(vessel="milliampere")
OTHER = RegressorsConfig(terms=("u", "tau_x"))
TERMS = (
    "u_dot", "v_dot", "r_dot", "u", "v", "r", "u|u|", "v|v|", "u^3", "v^3", "r|r|", "u v", "u r",
    "v r", "r^2", "|r|v", "|v|r",
)  # fmt: skip


def hull(name: str) -> Any:
    vessel = load_vessel(name).build()
    assert isinstance(vessel, HullPlant)
    return vessel.hull


def samples(mass_sign: float = 1.0, count: int = 3000, groups: int = 10) -> Samples:
    """Motion and the forces that the true ferry (half the believed one) needs for it; the sign
    turns its inertia around.
    """
    random = torch.Generator().manual_seed(0)
    nu, nu_dot = (
        torch.randn(count, 3, generator=random, dtype=torch.float64) * torch.tensor(spread)
        for spread in ([0.6, 0.4, 0.2], [0.2, 0.2, 0.05])
    )
    with torch.no_grad():
        tau = hull("milliampere_half").required_force(mass_sign * nu_dot, nu)
    return sampled(torch.cat((nu, tau), dim=-1), nu_dot, NAMES, groups=groups)


def built(head: Any) -> Any:
    content = {
        "schema": "residnet.model/1", "name": "force", "role": "head", "dt": 0.1,
        "integrator": "rk4", "signals": SIGNALS.model_dump(), "head": head.model_dump(),
        "baseline": BELIEVED.without_file_references().model_dump(),
        "low": [-2.0, -1.0, -0.5, -500.0, -500.0, -500.0],
        "high": [2.0, 1.0, 0.5, 500.0, 500.0, 500.0],
    }  # fmt: skip
    return ModelSpec.model_validate(content).build()


def fitted(head: Any, of: Samples) -> Any:
    model = built(head)
    with torch.no_grad():
        residual = model.head.residual_samples(of, model.baseline(of.z))
    assert isinstance(model.head, ForceHead)
    model.head.calibrate(residual)
    model.head.fit_preferred(residual)
    return model.eval()


@pytest.fixture(scope="module")
def model() -> Any:
    return fitted(RidgeConfig(space="force", terms=TERMS, choose="one_step"), samples())


def test_the_mass_and_the_accelerations_are_the_true_ferrys(model: Any) -> None:
    of = samples()
    with torch.no_grad():
        torch.testing.assert_close(
            model.one_step_accelerations(of.z[None])[0], of.target, rtol=0, atol=1e-5
        )
    torch.testing.assert_close(
        torch.linalg.inv(model.head.inverse), hull("milliampere_half").mass, rtol=1e-4, atol=1e-2
    )


@pytest.mark.parametrize(
    "config",
    [PlsrConfig(space="force", choose="one_step"), RidgeConfig(space="force", choose="one_step")],
)
def test_the_thirty_basis_functions_hold_it_too(config: Any) -> None:
    model = fitted(config, samples())
    assert model.head.inner.library.n_terms == 30
    of = samples()
    with torch.no_grad():
        torch.testing.assert_close(
            model.one_step_accelerations(of.z[None])[0], of.target, rtol=0, atol=1e-3
        )


def test_a_free_run_is_the_true_ferrys(model: Any) -> None:
    """Against the hull's own equations of motion under the same forces."""
    true = hull("milliampere_half")
    x = torch.tensor([[0.0, 0.0, 0.0, 0.5, 0.1, 0.05]], dtype=torch.float64)
    w = torch.tensor([[100.0, -20.0, 30.0]], dtype=torch.float64)
    s, nu, h = x[:, :0], x[:, 3:].clone(), 0.01
    inverse = torch.linalg.inv(true.mass)
    none = torch.zeros_like(nu)
    with torch.no_grad():
        for k in range(500):
            if k % 10 == 0:
                x, s = model.step(x, w, s)
            a = (w - true.required_force(none, nu)) @ inverse.T
            nu = nu + h * (w - true.required_force(none, nu + 0.5 * h * a)) @ inverse.T
    # the residual is held over steps of 0.1 s
    torch.testing.assert_close(x[:, 3:], nu, rtol=0, atol=2e-3)


def test_the_feed_forward_undoes_the_motion(model: Any) -> None:
    of = samples(count=50)
    believed = BelievedForce(model.baseline, model.head.mass)
    force = RequiredForce(believed, ResidualForce(model.head), is_mirrored=False).eval()
    with torch.no_grad():
        torch.testing.assert_close(force(of.target, of.z[:, :3]), of.z[:, 3:], rtol=0, atol=1e-2)
        # and exactly the model's own inverse
        nu_dot = model.one_step_accelerations(of.z[None])[0]
        torch.testing.assert_close(force(nu_dot, of.z[:, :3]), of.z[:, 3:], rtol=0, atol=1e-8)


def test_a_mean_is_that_of_its_members(model: Any) -> None:
    of = samples(count=60)
    x, w = torch.zeros(60, 6, dtype=torch.float64), of.z[:, 3:]
    x[:, 3:] = of.z[:, :3]
    with torch.no_grad():
        other = fitted(PlsrConfig(space="force", order=2, choose="one_step"), samples())
        mean = mean_of([model, other])
        expected = (
            model.one_step_accelerations(of.z[None]) + other.one_step_accelerations(of.z[None])
        ) / 2
        torch.testing.assert_close(mean.one_step_accelerations(of.z[None]), expected)
        stepped = mean.step(x, w, x[:, :0])[0]
        torch.testing.assert_close(Rollout(mean)(x, w[:, None], x[:, :0])[0][:, 1], stepped)


@pytest.mark.parametrize(
    "config",
    [
        PlsrConfig(space="force", order=17, terms=TERMS),
        RidgeConfig(space="force", terms=TERMS, penalties=(1e-8, 1e-6)),
    ],
)
def test_a_mass_that_cannot_be_inverted_safely_fails_the_fit(config: Any) -> None:
    with pytest.raises(FitError, match=r"eigenvalues .* cannot be solved"):
        fitted(config, samples(mass_sign=-1.0))


def test_only_the_solutions_that_run_forward_are_offered() -> None:
    """The least penalties find the negative mass; strong ones stay with the believed one."""
    model = built(RidgeConfig(space="force", terms=TERMS, penalties=(1e-8, 100.0)))
    of = samples(mass_sign=-1.0)
    with torch.no_grad():
        residual = model.head.residual_samples(of, model.baseline(of.z))
    model.head.calibrate(residual)
    offered = [
        solution.hyperparameters["penalty"] for solution in model.head.fit_solutions(residual)
    ]
    assert offered == [[100.0] * 3, []]


def force(**settings: Any) -> Any:
    return RidgeConfig(space="force", **settings).build(NAMES)


ALONE = "only be a term by itself"
ONLY = "only heads in force space"


@pytest.mark.parametrize(
    ("build", "said"),
    [
        (lambda: RidgeConfig(terms=("u", "u_dot")), "space: force"),
        (lambda: force(terms=("u", "u_dot u")), ALONE),
        (lambda: force(terms=("|u_dot|",)), ALONE),
        (lambda: force(terms=("u_ddot",)), "u_ddot"),
        (lambda: MlpConfig(features=("u_dot", "v")).build(NAMES), ONLY),
        (lambda: SymbolicConfig(features=("u_dot",)).build(NAMES), ONLY),
        (lambda: force().set_inertia(OTHER.build(NAMES).inertia_matrix()), "kind to 'believed'"),
    ],
)
def test_refused(build: Any, said: str) -> None:
    with pytest.raises((ConfigError, ValueError), match=said):
        build()


def test_believed_mass_is_the_hulls_times_its_factor() -> None:
    mass = BelievedConfig(vessel="milliampere", scale=0.5).build(NAMES).inertia_matrix()
    assert mass is not None
    torch.testing.assert_close(mass, 0.5 * hull("milliampere").mass, rtol=1e-10, atol=1e-8)
