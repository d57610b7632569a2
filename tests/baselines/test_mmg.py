"""The MMG baseline: the published tanker turns as published, and beliefs move to a known ship."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from made_samples import sampled
from scipy.integrate import solve_ivp
from torch import Tensor

from residnet.baselines.mmg import MMGBaseline, soeding_normal_coefficient
from residnet.baselines.mmg_config import MMGConfig, SemiEmpiricalConfig
from residnet.baselines.mmg_parameters import (
    PARAMETER_NAMES,
    MMGRudder,
    clarke_priors,
    default_priors,
)
from residnet.core.errors import ConfigError

NAMES = ("u", "v", "r", "n", "delta")
TANKER: dict[str, Any] = {
    "kind": "mmg",
    "hull": {"length": 7, "beam": 1.27, "draught": 0.46, "mass": "3270 kg", "x_G": 0.244},
    "propeller": {"diameter": "0.216 m", "thrust": [0.2931, -0.2753, -0.1385]},
    "rudder": {"area": 0.0539, "aspect": 1.827, "race": 0.626},
}
# KVLCC2 as Yasukawa and Yoshimura (2015) print it, tables 3 and 4; their flow straightening is the
# other way round in sign of the drift
PUBLISHED = {
    "m_x": 0.022, "m_y": 0.223, "J_z": 0.011, "R_0": 0.022, "X_vv": -0.040, "X_vr": 0.002,
    "X_rr": 0.011, "X_vvvv": 0.771,
    "Y_v": -0.315, "Y_r": 0.083, "Y_vvv": -1.607, "Y_vvr": 0.379, "Y_vrr": -0.391, "Y_rrr": 0.008,
    "N_v": -0.137, "N_r": -0.049, "N_vvv": -0.030, "N_vvr": -0.294, "N_vrr": 0.055, "N_rrr": -0.013,
    "t_P": 0.220, "w_P0": 0.35, "C_2p": 1.6, "C_2n": 1.1, "t_R": 0.387, "a_H": 0.312, "x_H": -0.464,
    "gamma_p": 0.640, "gamma_n": 0.395, "l_R": -0.710, "epsilon": 1.09, "kappa": 0.50, "Y_0": 0.0,
    "N_0": 0.0,
}  # fmt: skip


def built(**beliefs: tuple[float, float]) -> MMGBaseline:
    return MMGConfig.model_validate({**TANKER, "beliefs": beliefs}).build(NAMES)


def published() -> MMGBaseline:
    return built(**{name: (value, 0.0) for name, value in PUBLISHED.items()})


def channels(rows: int, seed: int = 0) -> Tensor:
    random = np.random.default_rng(seed)
    low = [0.5, -0.2, -0.06, 9.0, -0.6]
    high = [1.2, 0.2, 0.06, 11.0, 0.6]
    return torch.from_numpy(random.uniform(low, high, size=(rows, 5)))


def test_the_published_tanker_turns_as_published() -> None:
    """35 degrees of rudder: simulated advance, tactical diameter and steady speed of Yasukawa and
    Yoshimura (2015), within their figures' reading.
    """
    baseline = published()

    @torch.no_grad()
    def rate(t: float, y: np.ndarray) -> list[float]:
        psi, u, v, r = y[2:].tolist()
        z = [u, v, r, 10.4, math.radians(min(15.8 * t, 35.0))]
        change = baseline(torch.tensor(z, dtype=torch.float64)).tolist()
        cos, sin = math.cos(psi), math.sin(psi)
        return [u * cos - v * sin, u * sin + v * cos, r, *change]

    path = solve_ivp(rate, (0, 220), [0, 0, 0, 1.179, 0, 0], max_step=1.0, rtol=1e-6)
    heading = path.y[2]
    advance = path.y[0][np.argmax(heading >= math.pi / 2)] / 7.0
    diameter = path.y[1][np.argmax(heading >= math.pi)] / 7.0
    assert advance == pytest.approx(3.2, abs=0.15)
    assert diameter == pytest.approx(3.2, abs=0.2)
    assert math.hypot(path.y[3][-1], path.y[4][-1]) / 1.179 == pytest.approx(0.34, abs=0.06)


def test_a_symmetric_ship_mirrors_and_signs() -> None:
    baseline = built(C_2p=(1.3, 0.1), C_2n=(1.3, 0.1))
    turned = torch.tensor([1.0, -1.0, -1.0])
    mirror = torch.tensor([1.0, -1.0, -1.0, 1.0, -1.0], dtype=torch.float64)
    z = channels(50)
    asked = [[0.5, 0, 0, 10, 0], [1, 0, 0, 10, 0.3], [1, 0, 0, 0, 0], [0] * 5]
    with torch.no_grad():
        torch.testing.assert_close(baseline(z * mirror), baseline(z) * turned)
        ahead, starboard, coasting, still = published()(torch.tensor(asked).double())
    assert ahead[0] > 0 > coasting[0]
    # a rudder to starboard turns to starboard and pushes the stern to port
    assert starboard[2] > 0 > starboard[1]
    assert float(still.abs().max()) < 1e-6


def test_sensitivities_are_those_of_forward_differentiation() -> None:
    baseline = built()
    z = channels(7)
    theta = baseline.theta.detach()
    exact = torch.func.jacfwd(lambda t: baseline.force_model(z, t))(theta)
    torch.testing.assert_close(baseline.parameter_jacobian(z), exact, rtol=1e-6, atol=1e-7)
    # every parameter matters
    slopes = baseline.parameter_jacobian(channels(200))
    assert bool((slopes.abs().amax((0, 1)) > 0).all())


def test_accelerations_of_a_known_ship_move_the_beliefs_to_it() -> None:
    truth = published()
    config = MMGConfig.model_validate({**TANKER, "correlation": 1})
    z = channels(4000, 3)
    with torch.no_grad():
        target = truth(z) + 1e-5 * torch.from_numpy(np.random.default_rng(4).normal(size=(4000, 3)))
    samples = sampled(z, target, NAMES)
    baseline = config.build(NAMES)
    table = {c.term: c for c in config.fit_preferred(baseline, samples)}
    fresh = channels(200, 5)
    with torch.no_grad():
        worst = (baseline(fresh) - truth(fresh)).abs().amax(0) / truth(fresh).std(0)
    assert float(worst.max()) < 2e-3
    for name in ("N_v", "N_r", "Y_v", "w_P0", "C_2p"):
        assert abs(table[name].value - PUBLISHED[name]) < 5 * table[name].standard_error + 1e-3, (
            name
        )
        assert table[name].standard_error < 0.5 * default_priors(config.hull)[name].sd


def test_a_fixed_parameter_stays() -> None:
    baseline = built(t_P=(0.2, 0.0))
    assert baseline.free_indices().numel() == len(PARAMETER_NAMES) - 1
    assert baseline.parameter_jacobian(channels(3)).shape == (3, 3, len(PARAMETER_NAMES) - 1)
    assert baseline.prior()[0].shape == (len(PARAMETER_NAMES) - 1,)


def test_config_names_what_is_wrong() -> None:
    with pytest.raises(ValueError, match="Y_w"):
        built(Y_w=(0.0, 1.0))
    with pytest.raises(ConfigError, match="'delta'"):
        MMGConfig.model_validate(TANKER).build(("u", "v", "r", "n"))


def test_the_regressions_of_clarke_are_near_the_published_tanker() -> None:
    """Table 3 of Yasukawa and Yoshimura (2015), measured by captive tests of the same hull."""
    hull = MMGConfig.model_validate({**TANKER, "formulas": "clarke"}).hull
    priors = clarke_priors(hull)
    for name, tolerance in (("Y_v", 0.1), ("Y_r", 0.04), ("N_v", 0.01), ("N_r", 0.01)):
        assert priors[name].mean == pytest.approx(PUBLISHED[name], abs=tolerance), name
    assert priors["m_y"].mean == pytest.approx(PUBLISHED["m_y"], abs=0.06)
    # what Clarke does not give is that of the default
    assert priors["R_0"] == default_priors(hull)["R_0"]


@pytest.mark.parametrize("formulas", ["kijima", "inoue"])
def test_the_regressions_of_the_aspect_ratio_are_near_the_published_tanker(formulas: str) -> None:
    config = MMGConfig.model_validate({**TANKER, "formulas": formulas})
    priors = dict(zip(PARAMETER_NAMES, config.priors(), strict=True))
    for name, tolerance in (("Y_v", 0.15), ("Y_r", 0.06), ("N_v", 0.01), ("N_r", 0.01)):
        assert priors[name].mean == pytest.approx(PUBLISHED[name], abs=tolerance), name


def test_the_formulas_of_the_rudder_change_their_own_means_only() -> None:
    usual, kijima, brix = (
        dict(
            zip(
                PARAMETER_NAMES,
                MMGConfig.model_validate({**TANKER, "rudder_formulas": formulas}).priors(),
                strict=True,
            )
        )
        for formulas in ("usual", "kijima", "brix")
    )
    assert {name for name in usual if kijima[name] != usual[name]} == {"a_H", "t_R", "epsilon"}
    assert {name for name in usual if brix[name] != usual[name]} == {"gamma_p", "gamma_n", "l_R"}
    for name, tolerance in (("a_H", 0.08), ("t_R", 0.2), ("epsilon", 0.3)):
        assert kijima[name].mean == pytest.approx(PUBLISHED[name], abs=tolerance), name
    assert brix["l_R"].mean == pytest.approx(PUBLISHED["l_R"], abs=0.25)
    assert brix["gamma_p"].sd == usual["gamma_p"].sd


def test_a_semi_empirical_model_is_not_fitted() -> None:
    config = SemiEmpiricalConfig.model_validate(
        {**TANKER, "kind": "semi_empirical", "formulas": "clarke"}
    )
    baseline = config.build(NAMES)
    samples = sampled(channels(300), published()(channels(300)).detach(), NAMES)
    (solution,) = config.fit_solutions(baseline, samples)
    assert solution.state == {}
    values = {entry.term: entry.value for entry in solution.table}
    assert values["N_v"] == pytest.approx(clarke_priors(config.hull)["N_v"].mean)
    assert not config.is_parametric(NAMES)
    assert baseline.parameter_counts() == [0.0, 0.0, 0.0]
    prior_means = MMGConfig.model_validate({**TANKER, "formulas": "clarke"}).build(NAMES)
    assert torch.equal(baseline(channels(20)), prior_means(channels(20)))


def test_the_evidence_widens_priors_that_the_logs_contradict_and_keeps_right_ones() -> None:
    z = channels(4000)
    generator = torch.Generator().manual_seed(1)
    truth = published()(z).detach()
    target = truth + 0.002 * torch.randn(truth.shape, generator=generator, dtype=torch.float64)
    samples = sampled(z, target, NAMES)
    factors = {}
    for name, shift in (("right", 0.0), ("wrong", 8.0)):
        priors = default_priors(MMGConfig.model_validate(TANKER).hull)
        beliefs = {
            key: (PUBLISHED[key] + shift * 0.1 * priors[key].sd, 0.1 * priors[key].sd)
            for key in ("Y_v", "Y_r", "N_v", "N_r", "Y_vvv", "N_vvr")
        }
        fixed = {key: (PUBLISHED[key], 0.0) for key in PUBLISHED if key not in beliefs}
        config = MMGConfig.model_validate(
            {**TANKER, "beliefs": beliefs | fixed, "prior_weight": "evidence", "correlation": 1}
        )
        (solution,) = config.fit_solutions(config.build(NAMES), samples)
        factors[name] = solution.notes["prior_factor"]
    assert factors["right"] == 1.0
    assert factors["wrong"] > 1.0


def _soeding(angles_deg: list[float], aspect: float, reynolds_number: float) -> Tensor:
    rudder = MMGRudder(area=1.0, aspect=aspect, race=1.0, curve="soeding")
    angles = torch.deg2rad(torch.tensor(angles_deg, dtype=torch.float64))
    return soeding_normal_coefficient(
        angles,
        torch.full_like(angles, reynolds_number),
        lift_slope=rudder.lift_slope,
        aspect=aspect,
    )


def test_the_rudder_curve_of_soeding_has_the_limits_of_theory() -> None:
    # thin aerofoil (2 pi) for a large aspect ratio, about Jones' slender wing (pi/2 Lambda) below
    slopes = {
        aspect: MMGRudder(area=1.0, aspect=aspect, race=1.0, curve="soeding").lift_slope
        for aspect in (1e-4, 1.0, 2.0, 1e6)
    }
    assert slopes[1e6] == pytest.approx(2 * math.pi, rel=1e-5)
    assert slopes[1e-4] / 1e-4 == pytest.approx(2 * math.pi * 0.7 / 1.7**2, rel=1e-3)
    assert slopes[1e-4] / 1e-4 == pytest.approx(math.pi / 2, rel=0.05)
    # near Fujii's slope for rudders of ships
    for aspect in (1.0, 2.0):
        fujii = MMGRudder(area=1.0, aspect=aspect, race=1.0).lift_slope
        assert slopes[aspect] == pytest.approx(fujii, rel=0.25)


def test_the_rudder_curve_of_soeding_is_odd_and_adds_the_friction_of_the_plate() -> None:
    forward = _soeding([0.0, 5.0, 20.0, 35.0], 1.8, 1e7)
    torch.testing.assert_close(_soeding([0.0, -5.0, -20.0, -35.0], 1.8, 1e7), -forward)
    assert float(forward[0]) == 0.0
    assert bool((forward.diff() > 0).all())
    # at 90 degrees the lift of the cross flow vanishes: C_N = C_D
    slope = MMGRudder(area=1.0, aspect=1.8, race=1.0, curve="soeding").lift_slope
    across = float(_soeding([90.0], 1.8, 1e7))
    assert across == pytest.approx(slope**2 / (math.pi * 1.8) + 1.0 + 2.5 * 0.075 / 25, rel=1e-9)
    # 0.075 / (log10(R_n) - 2)^2 is 0.003 at 1e7 and 0.0046875 at 1e6
    angle = math.radians(20.0)
    friction = float(_soeding([20.0], 1.8, 1e6) - _soeding([20.0], 1.8, 1e7))
    assert friction == pytest.approx(2.5 * (0.0046875 - 0.003) * math.sin(angle), rel=1e-9)
    # the friction line is bounded at rest
    assert bool(_soeding([20.0], 1.8, 0.0).isfinite().all())


def test_the_rudder_curve_of_soeding_turns_the_semi_empirical_ship() -> None:
    content = {**TANKER, "kind": "semi_empirical"}
    fujii = SemiEmpiricalConfig.model_validate(content).build(NAMES)
    content["rudder"] = {**TANKER["rudder"], "curve": "soeding"}
    soeding = SemiEmpiricalConfig.model_validate(content).build(NAMES)
    z = torch.tensor([[1.0, 0, 0, 10, 0.0], [1.0, 0, 0, 10, 0.02], [1.0, 0, 0, 10, 0.5]]).double()
    ratio = soeding(z)[1:, 2] - soeding(z)[0, 2]
    ratio = ratio / (fujii(z)[1:, 2] - fujii(z)[0, 2])
    slopes = [
        MMGRudder.model_validate({**TANKER["rudder"], "curve": curve}).lift_slope
        for curve in ("soeding", "fujii")
    ]
    # small angles: the ratio of the slopes; large ones: the cross flow adds to the force
    assert float(ratio[0]) == pytest.approx(slopes[0] / slopes[1], rel=0.03)
    assert float(ratio[1]) > 1.03 * float(ratio[0])
