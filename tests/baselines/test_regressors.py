"""Baselines linear in their coefficients: exact on noise-free samples of a known model; what the
named sets of regressors hold, that nothing stands twice, what they refuse.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from made_samples import sampled
from sklearn.linear_model import Ridge
from sklearn.preprocessing import PolynomialFeatures

from residnet.baselines.given_config import ZeroBaselineConfig
from residnet.baselines.regressors import _find_undamped_term
from residnet.baselines.regressors_config import RegressorsConfig
from residnet.baselines.sets import drop_equivalent_terms
from residnet.core.config import validate_config
from residnet.core.errors import ConfigError, FitError
from residnet.core.samples import Samples
from residnet.physics.term_library import TermLibrary

NAMES = ("u", "v", "r", "tau_x", "tau_n")
TRUTH = {
    "u": {"u": -0.5, "u|u|": -0.23, "v r": 1.58, "tau_x": 0.0028},
    "v": {"v": -0.44, "|u|v": -0.27, "u r": -0.63},
    "r": {"v": 0.1, "r": -0.71, "r|r|": -1.35, "tau_n": 7.9e-4, "1": 0.02},
}
OWN = RegressorsConfig.model_validate({"terms": {axis: [*row] for axis, row in TRUTH.items()}})


def accelerations(z: np.ndarray) -> np.ndarray:
    u, v, r, tau_x, tau_n = z.T
    surge = -0.5 * u - 0.23 * u * abs(u) + 1.58 * v * r + 0.0028 * tau_x
    sway = -0.44 * v - 0.27 * abs(u) * v - 0.63 * u * r
    yaw = 0.1 * v - 0.71 * r - 1.35 * r * abs(r) + 7.9e-4 * tau_n + 0.02
    return np.stack((surge, sway, yaw), axis=1)


def made(noise: float = 0.0, count: int = 400, groups: int = 8) -> Samples:
    rng = np.random.default_rng(0)
    z = rng.normal(size=(count, 5)) * [1, 0.3, 0.3, 300, 200]
    target = accelerations(z) + noise * rng.normal(size=(count, 3))
    kinds = ["zigzag" if g % 2 else "constant" for g in range(groups)]
    return sampled(z, target, NAMES, groups=groups, kinds=kinds)


def test_exact_coefficients_from_noise_free_samples() -> None:
    baseline = OWN.build(NAMES)
    table = OWN.fit_preferred(baseline, made())
    rows = [(f"{axis}_dot", term) for axis, row in TRUTH.items() for term in row]
    assert [(entry.axis, entry.term) for entry in table] == rows
    for entry in table:
        assert entry.value == pytest.approx(TRUTH[entry.axis[0]][entry.term], rel=1e-10)
        assert entry.standard_error < 1e-10 * max(abs(entry.value), 1.0)
    z = np.random.default_rng(1).normal(size=(2, 30, 5)) * [1, 0.3, 0.3, 300, 200]
    found = baseline(torch.from_numpy(z))
    wanted = accelerations(z.reshape(-1, 5))
    np.testing.assert_allclose(found.reshape(-1, 3), wanted, rtol=1e-9, atol=1e-12)
    # terms of all axes, and the linear ones where none are named
    assert RegressorsConfig().build(NAMES).library.terms == ("1", *NAMES)
    shared = RegressorsConfig(terms=tuple({term: 0 for row in TRUTH.values() for term in row}))
    for entry in shared.fit_preferred(shared.build(NAMES), made()):
        assert entry.value == pytest.approx(TRUTH[entry.axis[0]].get(entry.term, 0.0), abs=1e-10)


def test_standard_errors_cover_the_truth() -> None:
    table = OWN.fit_preferred(OWN.build(NAMES), made(noise=0.05, count=4000, groups=40))
    score = [
        (entry.value - TRUTH[entry.axis[0]][entry.term]) / entry.standard_error for entry in table
    ]
    assert max(map(abs, score)) < 4
    assert 0.5 < np.sqrt(np.mean(np.square(score))) < 1.6


def test_only_the_chosen_manoeuvres() -> None:
    samples = made()
    spoiled = samples.target.clone()
    spoiled[(samples.group % 2) == 0] = 99.0
    config = OWN.model_copy(update={"manoeuvres": ("zigzag",)})
    for entry in config.fit_preferred(config.build(NAMES), samples.with_target(spoiled)):
        assert entry.value == pytest.approx(TRUTH[entry.axis[0]][entry.term], rel=1e-9)
    other = RegressorsConfig(manoeuvres=("turning",))
    with pytest.raises(FitError, match=r"turning.*kinds in the data: \['constant', 'zigzag'\]"):
        other.fit_preferred(other.build(NAMES), samples)


def test_still_knows_nothing() -> None:
    baseline = ZeroBaselineConfig().build(NAMES)
    assert ZeroBaselineConfig().fit_preferred(baseline, made()) == []
    assert torch.equal(baseline(torch.randn(4, 7, 5)), torch.zeros(4, 7, 3))


SHIP = ("u", "v", "r", "n", "delta")
TANKER = (*SHIP, "wind_u", "wind_v", "wind_mag")
CATAMARAN = ("u", "v", "r", "n_port", "n_stbd", "tau_x", "tau_y", "tau_n")
LINEAR = ("1", "u", "v", "r", "n", "delta")


def terms(names: tuple[str, ...], **config: Any) -> tuple[str, ...]:
    rows = validate_config({"kind": "regressors", **config}, RegressorsConfig, "here").axis_terms(
        names
    )
    assert rows[0] == rows[1] == rows[2]
    return tuple(rows[0])


def test_sets_of_a_ship_on_propeller_and_rudder() -> None:
    assert terms(TANKER, sets=["linear"]) == LINEAR
    fossen = terms(TANKER, sets=["fossen"])
    hull = "1, u, v, r, u v, u r, v r, u|u|, v|v|, r|r|, v|r|, r|v|"
    assert set(fossen[:12]) == set(hull.split(", "))
    assert fossen[12:] == ("n", "n|n|", "|n| u", "u|u| delta", "n|n| delta", "u n delta")
    assert terms(TANKER, sets=["fossen", "astern"])[18:] == ("n^2", "n u", "n^2 delta")
    wind = terms(TANKER, sets=["linear", "wind"])
    assert {"wind_u", "wind_v wind_mag", "wind_u wind_v"} <= set(wind)
    abkowitz = terms(TANKER, sets=["abkowitz"])
    assert {"u^3", "v v v", "v v delta", "r delta delta", "v r", "u r"} <= set(abkowitz)
    # model tests at constant revolutions: the thrust is part of the constant
    without_drive = terms(("u", "v", "r", "delta"), sets=["abkowitz"])
    assert set(without_drive) == {term for term in abkowitz if "n" not in term.split()} - {
        "n|n|",
        "|n| u",
    }


def test_sets_of_a_vessel_on_forces_and_roles_that_are_given() -> None:
    on_forces = ("1", "u", "v", "r", "tau_x", "tau_n")
    assert terms(CATAMARAN, sets=["linear"]) == on_forces
    assert terms(CATAMARAN, sets=["fossen"])[12:] == ("tau_x", "tau_n")
    both = terms(CATAMARAN, sets=["linear"], steer=["tau_n", "tau_y"])
    assert both == (*on_forces, "tau_y")
    pod = ("u", "v", "r", "rpm", "azimuth")
    found = terms(pod, sets=["fossen"], drive=["rpm"], steer=["azimuth"])[12:]
    turned = ("u|u| azimuth", "rpm|rpm| azimuth", "u rpm azimuth")
    assert found == ("rpm", "rpm|rpm|", "|rpm| u", *turned)


def test_a_ridge_polynomial_is_scikit_learn_s() -> None:
    """Document 001 section 2.2: ridge on polynomial features, columns scaled to unit root mean
    square.
    """
    rng = np.random.default_rng(1)
    z, y = rng.normal(size=(300, 5)) + 0.5, rng.normal(size=(300, 3))
    samples = sampled(z, y, SHIP, groups=10)
    config = RegressorsConfig(sets=("polynomial_2",), ridge=0.05)
    baseline = config.build(SHIP)
    config.fit_preferred(baseline, samples)
    features = PolynomialFeatures(2).fit_transform(z)
    own = TermLibrary(terms(SHIP, sets=["polynomial_2"]), SHIP)(samples.z)
    np.testing.assert_allclose(own, features, rtol=1e-12)
    assert terms(SHIP, sets=["polynomial_1"]) == ("1", *SHIP)
    scale = np.sqrt((features**2).mean(0))
    truth = Ridge(alpha=0.05 * 300, fit_intercept=False, solver="svd").fit(features / scale, y)
    np.testing.assert_allclose(baseline(samples.z), truth.predict(features / scale), atol=1e-10)


def test_what_is_said_twice_stands_once() -> None:
    said = (
        "u v, v u, n^2, n n, |n||n|, n|n|, |n| n, u|u|, u^2, 1, wind_u wind_mag^-1, u v^2, v u v,"
        " v|v| u"
    )
    once = "u v, n^2, n|n|, u|u|, u^2, 1, wind_u wind_mag^-1, u v^2, v|v| u"
    assert drop_equivalent_terms(tuple(said.split(", ")), TANKER) == tuple(once.split(", "))
    both = terms(TANKER, sets=["fossen", "linear"], terms=["r u", "n v", "|v|r"])
    assert both == (*terms(TANKER, sets=["fossen"]), "delta", "n v")
    # terms of one axis join a set
    axes: dict[Any, tuple[str, ...]] = {"u": ("u|u|",), "v": (), "r": ("r|r|", "r")}
    rows = RegressorsConfig(sets=("linear",), terms=axes).axis_terms(TANKER)
    assert rows == [(*LINEAR, "u|u|"), LINEAR, (*LINEAR, "r|r|")]


@pytest.mark.parametrize(
    ("names", "config", "message"),
    [
        (TANKER, {"terms": {"u": ["u"], "v": ["v"]}}, "all of the axes u, v, r"),
        (TANKER, {"ridge": -1.0}, "greater than or equal to 0"),
        (TANKER, {"terms": ["u"], "order": 2}, "order"),
        (NAMES, {"terms": ["u", "tau_y"]}, "no channel 'tau_y'"),
        (CATAMARAN, {"sets": ["wind"]}, "add wind_speed and wind_dir to signals.exogenous"),
        (CATAMARAN[:5], {"sets": ["fossen"]}, "set 'fossen': .*'n_port'"),
        (SHIP[:4], {"sets": ["abkowitz"]}, "a channel for steering; add it to `steer`"),
        (("u", "v", "r", "delta"), {"sets": ["fossen"]}, "thrust and one for steering"),
        (CATAMARAN, {"sets": ["astern"]}, "needs a propeller"),
        (TANKER, {"sets": ["fossen"], "drive": ["rpm"]}, "no channel 'rpm'"),
        (TANKER, {"sets": ["fosen"]}, "fossen"),
        (TANKER, {"terms": ["u"], "steer": ["delta"]}, "give sets, or remove them"),
        (TANKER, {"sets": ["fossen"], "ridge": [0.1]}, "at least 2"),
        (TANKER, {"sets": ["fossen"], "ridge": [0.1, -1.0]}, "greater than or equal to 0"),
    ],
)
def test_what_cannot_be_is_a_config_error(
    names: tuple[str, ...], config: dict[str, Any], message: str
) -> None:
    with pytest.raises(ConfigError, match=message):
        validate_config({"kind": "regressors", **config}, RegressorsConfig, "here").build(names)


def test_each_of_several_penalties_is_the_fit_with_it() -> None:
    rng = np.random.default_rng(2)
    z, y = rng.normal(size=(200, 5)), rng.normal(size=(200, 3))
    samples = sampled(z, y, SHIP, groups=10)
    penalties = (0.0, 1e-2, 1.0)
    several = RegressorsConfig(sets=("linear",), ridge=penalties)
    baseline = several.build(SHIP)
    found = several.fit_solutions(baseline, samples)
    assert [solution.hyperparameters["ridge"] for solution in found] == [*penalties]
    for solution, ridge in zip(found, penalties, strict=True):
        (alone,) = RegressorsConfig(sets=("linear",), ridge=ridge).fit_solutions(baseline, samples)
        assert alone.hyperparameters == {}
        torch.testing.assert_close(solution.state["theta"], alone.state["theta"])
        assert solution.table == alone.table


def test_a_penalty_decides_between_regressors_that_the_data_cannot_tell_apart() -> None:
    """A propeller that never turns astern: n|n| is n^2."""
    z = np.random.default_rng(3).normal(size=(200, 5))
    z[:, 3] = 5 + abs(z[:, 3])
    samples = sampled(z, z[:, :3], SHIP, groups=10)
    plain, ridge = (RegressorsConfig(sets=("fossen", "astern"), ridge=r) for r in (0.0, 1e-6))
    with pytest.raises(FitError, match=r"'n\^2' and 'n\|n\|' are collinear"):
        plain.fit_preferred(plain.build(SHIP), samples)
    baseline = ridge.build(SHIP)
    ridge.fit_preferred(baseline, samples)
    np.testing.assert_allclose(baseline(samples.z), z[:, :3], atol=1e-2)


def test_what_feeds_an_axis_most_is_named_by_its_share_and_not_its_slope() -> None:
    theta = torch.tensor([2.0, 0.5, -0.1], dtype=torch.float64)
    slopes = torch.tensor([[1.0, 3.0, 1.0]], dtype=torch.float64)
    assert _find_undamped_term(theta, slopes) == 0
    assert _find_undamped_term(-theta, slopes) is None
