"""Froude scaling of models, logs and prediction intervals, and its verification."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from residnet.baselines.base import ParametricBaseline
from residnet.baselines.given_config import EquationsConfig
from residnet.baselines.mmg_config import MMGConfig
from residnet.baselines.regressors import RegressorBaseline
from residnet.baselines.regressors_config import RegressorsConfig
from residnet.core.errors import ConfigError, UsageError
from residnet.core.log import Log
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.scaling import (
    ScaleEffects,
    apply_scale_effects,
    ittc_resistance_ratio,
    scale_model,
)
from residnet.dynamics.store import BandTable, ModelSpec
from residnet.heads.mlp_config import MlpConfig
from residnet.identification.fitter import FittedModel
from residnet.identification.scaling import scale_fitted_model, scale_log
from residnet.physics.signals_config import SignalsConfig
from residnet.physics.similarity import FroudeScaling
from residnet.tasks.scale_settings import make_scale_settings

SCALING = FroudeScaling(50.0, 1.025)
TERMS = ("1", "u", "v", "r", "v|v|", "v r", "n|n|", "u n", "u|u| delta", "delta")
LOW = (0.6, -0.2, -0.1, 5.0, -0.6)
HIGH = (1.4, 0.2, 0.1, 12.0, 0.6)


def make_model(**changes: object) -> tuple[ModelSpec, HybridDynamics]:
    spec = ModelSpec.model_validate(
        {
            "name": "hull",
            "role": "baseline",
            "signals": SignalsConfig(inputs=("n", "delta")),
            "baseline": RegressorsConfig(terms=TERMS, bounded=True),
            "dt": 0.1,
            "integrator": "semi_implicit_euler",
            "low": LOW,
            "high": HIGH,
            "band": BandTable(
                level=0.9,
                steps=(1, 10),
                u=(0.01, 0.1),
                v=(0.01, 0.1),
                r=(0.01, 0.1),
                heading=(0.01, 0.1),
                position=(0.1, 1.0),
                logs=3,
            ),
            **changes,
        }
    )
    model = spec.build()
    generator = torch.Generator().manual_seed(3)
    with torch.no_grad():
        for name, value in model.state_dict().items():
            value.copy_(0.01 * torch.randn(value.shape, generator=generator))
            if name.endswith(("low", "high")):
                value.copy_(torch.tensor((LOW if name.endswith("low") else HIGH)[: len(value)]))
            if name.endswith(("std", "rate")):
                value.abs_()
            if name.endswith("linear.coefficients"):
                # products of channels in small standard deviations are large
                value.mul_(1e-6)
    if isinstance(model.baseline, RegressorBaseline):
        for axis, term in enumerate(("u", "v", "r")):
            # rounding errors grow in an undamped free run
            model.baseline.theta[axis, TERMS.index(term)] = -0.4
    return spec, model.double()


def free_run(model: HybridDynamics, speed: float, inputs: torch.Tensor) -> torch.Tensor:
    x = torch.tensor([[0.0, 0.0, 0.0, speed, 0.0, 0.0]], dtype=torch.float64)
    s = torch.zeros(1, model.n_state, dtype=torch.float64)
    states = []
    for w in inputs:
        x, s = model.step(x, w[None], s)
        states.append(x[0])
    return torch.stack(states)


@pytest.mark.parametrize("head", [None, MlpConfig()])
def test_a_scaled_free_run_is_the_original_in_non_dimensional_form(head: MlpConfig | None) -> None:
    spec, model = make_model(head=head, role="baseline" if head is None else "head")
    scaled_spec, scaled_model = scale_model(spec, model, SCALING)
    steps = torch.arange(100, dtype=torch.float64)
    inputs = torch.stack((torch.full_like(steps, 8.0), 0.4 * torch.sin(0.1 * steps)), dim=1)
    original = free_run(model, 1.1, inputs).detach()
    ship = free_run(
        scaled_model,
        1.1 * math.sqrt(50),
        inputs * torch.tensor([50**-0.5, 1.0], dtype=torch.float64),
    )
    factors = torch.tensor([50, 50, 1, 50**0.5, 50**0.5, 50**-0.5], dtype=torch.float64)
    assert torch.allclose(ship / factors, original, rtol=1e-8, atol=1e-10)
    # the manoeuvre must not be trivial
    assert original[:, 5].abs().max() > 1e-3
    assert scaled_spec.dt == pytest.approx(0.1 * 50**0.5)
    assert scaled_spec.band is not None
    assert scaled_spec.band.position == pytest.approx((5.0, 50.0))
    assert scaled_spec.low[3] == pytest.approx(5.0 / 50**0.5)


def test_scaling_back_returns_the_model() -> None:
    spec, model = make_model()
    there = scale_model(spec, model, SCALING)
    back_spec, back = scale_model(*there, SCALING.inverse)
    for name, value in model.state_dict().items():
        assert torch.allclose(back.state_dict()[name], value, rtol=1e-12), name
    assert back_spec.low == pytest.approx(spec.low)
    assert back_spec.dt == pytest.approx(spec.dt)


def test_an_mmg_model_keeps_its_non_dimensional_parameters_and_scales_its_particulars() -> None:
    config = MMGConfig.model_validate(
        {
            "hull": {"length": 7.0, "beam": 1.27, "draught": 0.46, "mass": 3270.0},
            "propeller": {"diameter": 0.216, "thrust": (0.29, -0.27, -0.14)},
            "rudder": {"area": 0.0539, "aspect": 1.8, "race": 0.6},
        }
    )
    spec, model = make_model(baseline=config)
    model.load_state_dict(spec.build().state_dict())
    scaled_spec, scaled = scale_model(spec, model, SCALING)
    assert isinstance(scaled_spec.baseline, MMGConfig)
    assert scaled_spec.baseline.hull.length == pytest.approx(350.0)
    assert scaled_spec.baseline.hull.mass == pytest.approx(3270.0 * 50**3 * 1.025)
    assert scaled_spec.baseline.hull.density == pytest.approx(1025.0)
    assert isinstance(scaled.baseline, ParametricBaseline)
    assert isinstance(model.baseline, ParametricBaseline)
    assert torch.equal(scaled.baseline.theta, model.baseline.theta)


def test_a_model_with_dimensional_constants_is_refused() -> None:
    baseline = EquationsConfig(u={"u": -0.1}, r={"r": -0.5, "delta": 0.1}, source="test")
    spec, model = make_model(baseline=baseline)
    model.load_state_dict(spec.build().state_dict())
    with pytest.raises(UsageError, match=r"equations.*has constants with dimensions"):
        scale_model(spec, model, SCALING)


def test_scale_effects_change_the_terms_of_their_force_and_need_a_source() -> None:
    spec, model = make_model()
    effects = ScaleEffects(resistance=0.8, rudder=1.1, propeller=0.9, source="towing test")
    _, changed = apply_scale_effects(spec, model, effects)
    assert isinstance(changed.baseline, ParametricBaseline)
    assert isinstance(model.baseline, ParametricBaseline)
    ratio = changed.baseline.theta / model.baseline.theta
    factor_of = dict(zip(TERMS, ratio.T.tolist(), strict=True))
    assert factor_of["u"][0] == pytest.approx(0.8)
    assert factor_of["u"][1] == pytest.approx(1.0)
    assert factor_of["n|n|"] == pytest.approx([0.9] * 3)
    assert factor_of["u|u| delta"] == pytest.approx([1.1] * 3)
    assert factor_of["v r"] == pytest.approx([1.0] * 3)
    with pytest.raises(ConfigError, match="source"):
        make_scale_settings(50.0, 1.0, {"rudder": 1.1})


def test_the_resistance_of_the_ship_follows_the_itcc_line_of_1957() -> None:
    # KCS at 1:31.6, C_TM 3.56e-3 at 2.197 m/s and Re 1.4e7, k = 0.1: C_FM 2.83e-3, C_FS 1.38e-3
    ratio = ittc_resistance_ratio(7.2786, 2.197, 31.6, form_factor=0.1, total_coefficient=3.56e-3)
    model_friction = 0.075 / (math.log10(2.197 * 7.2786 / 1.1386e-6) - 2) ** 2
    assert model_friction == pytest.approx(2.83e-3, rel=0.01)
    assert ratio == pytest.approx((3.56e-3 - 1.1 * (2.83e-3 - 1.38e-3)) / 3.56e-3, rel=0.02)
    with pytest.raises(UsageError, match="smaller than the viscous share"):
        ittc_resistance_ratio(7.2786, 2.197, 31.6, form_factor=0.1, total_coefficient=1e-3)
    with pytest.raises(UsageError, match="--form-factor needs --total-resistance, --length"):
        make_scale_settings(50.0, 1.0, {}, form_factor=0.1, speed="2 m/s")
    with pytest.raises(UsageError, match="positive number"):
        make_scale_settings(-1.0, 1.0, {})


def test_coefficients_and_their_covariance_are_scaled_together() -> None:
    spec, model = make_model()
    n = len(model.baseline.free_indices())
    covariance = torch.diag(torch.linspace(1.0, 2.0, n, dtype=torch.float64))
    names = model.baseline.free_parameter_names()
    notes = {
        "covariance": covariance.tolist(),
        "refit": {},
        "coefficients": [
            {"axis": axis, "term": term, "value": value, "standard_error": math.sqrt(variance)}
            for (axis, term), value, variance in zip(
                names, model.baseline.get_free().tolist(), covariance.diagonal(), strict=True
            )
        ],
    }
    scaled = scale_fitted_model(FittedModel(spec, model, notes), SCALING)
    assert scaled.covariance is not None
    values = scaled.model.baseline.get_free()
    for row, value, variance in zip(
        scaled.notes["coefficients"], values, scaled.covariance.diagonal(), strict=True
    ):
        assert row["value"] == pytest.approx(float(value))
        assert row["standard_error"] == pytest.approx(math.sqrt(variance))
    # relative errors do not change
    old_errors = covariance.diagonal().sqrt() / model.baseline.get_free()
    assert torch.allclose(scaled.covariance.diagonal().sqrt() / values, old_errors)


def test_a_log_is_scaled_by_the_units_of_its_channels() -> None:
    t = np.linspace(0.0, 10.0, 11)
    log = Log("a", t, {name: np.ones(11) for name in ("x", "psi", "u", "r", "n", "delta")})
    ship = scale_log(log, FroudeScaling(25.0))
    assert ship.t[-1] == pytest.approx(50.0)
    values = {name: float(ship[name][0]) for name in log.channels}
    assert values == pytest.approx(
        {"x": 25.0, "psi": 1.0, "u": 5.0, "r": 0.2, "n": 0.2, "delta": 1.0}
    )
