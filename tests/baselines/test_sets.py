"""Named sets of regressors: what they hold, that nothing stands twice, what they refuse."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from made_samples import sampled
from sklearn.linear_model import Ridge
from sklearn.preprocessing import PolynomialFeatures

from residnet.baselines.regressors import RegressorsConfig
from residnet.baselines.sets import merged
from residnet.core.config import validate
from residnet.core.errors import ConfigError, FitError
from residnet.physics.terms import TermLibrary

TANKER = ("u", "v", "r", "n", "delta", "wind_u", "wind_v", "wind_mag")
CATAMARAN = ("u", "v", "r", "n_port", "n_stbd", "tau_x", "tau_y", "tau_n")


def terms(names: tuple[str, ...], **config: Any) -> tuple[str, ...]:
    rows = validate({"kind": "regressors", **config}, RegressorsConfig, "here").rows(names)
    assert rows[0] == rows[1] == rows[2]
    return tuple(rows[0])


def test_sets_of_a_ship_on_propeller_and_rudder() -> None:
    assert terms(TANKER, sets=["linear"]) == ("1", "u", "v", "r", "n", "delta")
    fossen = terms(TANKER, sets=["fossen"])
    assert set(fossen[:12]) == {
        "1",
        "u",
        "v",
        "r",
        "u v",
        "u r",
        "v r",
        "u|u|",
        "v|v|",
        "r|r|",
        "v|r|",
        "r|v|",
    }
    assert fossen[12:] == ("n", "n|n|", "|n| u", "u|u| delta", "n|n| delta", "u n delta")
    assert terms(TANKER, sets=["fossen", "astern"])[18:] == ("n^2", "n u", "n^2 delta")
    assert {"wind_u", "wind_v wind_mag", "wind_u wind_v"} <= set(
        terms(TANKER, sets=["linear", "wind"])
    )
    abkowitz = terms(TANKER, sets=["abkowitz"])
    assert {"u^3", "v v v", "v v delta", "r delta delta", "v r", "u r"} <= set(abkowitz)


def test_sets_of_a_vessel_on_forces() -> None:
    assert terms(CATAMARAN, sets=["linear"]) == ("1", "u", "v", "r", "tau_x", "tau_n")
    assert terms(CATAMARAN, sets=["fossen"])[12:] == ("tau_x", "tau_n")
    assert terms(CATAMARAN, sets=["linear"], steer=["tau_n", "tau_y"]) == (
        "1",
        "u",
        "v",
        "r",
        "tau_x",
        "tau_n",
        "tau_y",
    )


@pytest.mark.parametrize("degree", [1, 2])
def test_polynomials_are_scikit_learn_s(degree: int) -> None:
    names = ("u", "v", "r", "n", "delta")
    z = np.random.default_rng(0).normal(size=(50, 5))
    own = TermLibrary(terms(names, sets=[f"polynomial_{degree}"]), names)(
        torch.from_numpy(z)
    ).numpy()
    np.testing.assert_allclose(own, PolynomialFeatures(degree).fit_transform(z), rtol=1e-12)


def test_a_ridge_polynomial_is_scikit_learn_s() -> None:
    """Document 001 section 2.2: ridge on polynomial features, columns scaled to unit root mean
    square.
    """
    names = ("u", "v", "r", "n", "delta")
    rng = np.random.default_rng(1)
    z, y = rng.normal(size=(300, 5)) + 0.5, rng.normal(size=(300, 3))
    samples = sampled(z, y, names, groups=10)
    config = RegressorsConfig(sets=("polynomial_2",), ridge=0.05)
    baseline = config.build(names)
    config.fit(baseline, samples)
    features = PolynomialFeatures(2).fit_transform(z)
    scale = np.sqrt((features**2).mean(0))
    truth = Ridge(alpha=0.05 * 300, fit_intercept=False, solver="svd").fit(features / scale, y)
    np.testing.assert_allclose(baseline(samples.z), truth.predict(features / scale), atol=1e-10)


def test_what_is_said_twice_stands_once() -> None:
    row = (
        "u v",
        "v u",
        "n^2",
        "n n",
        "|n||n|",
        "n|n|",
        "|n| n",
        "u|u|",
        "u^2",
        "1",
        "wind_u wind_mag^-1",
        "u v^2",
        "v u v",
        "v|v| u",
    )
    assert merged(row, TANKER) == (
        "u v",
        "n^2",
        "n|n|",
        "u|u|",
        "u^2",
        "1",
        "wind_u wind_mag^-1",
        "u v^2",
        "v|v| u",
    )
    both = terms(TANKER, sets=["fossen", "linear"], terms=["r u", "n v", "|v|r"])
    assert both == (*terms(TANKER, sets=["fossen"]), "delta", "n v")


def test_terms_of_one_axis_join_a_set() -> None:
    rows = RegressorsConfig(
        sets=("linear",), terms={"u": ("u|u|",), "v": (), "r": ("r|r|", "r")}
    ).rows(TANKER)
    linear = ("1", "u", "v", "r", "n", "delta")
    assert rows == [(*linear, "u|u|"), linear, (*linear, "r|r|")]


@pytest.mark.parametrize(
    ("names", "config", "message"),
    [
        (
            CATAMARAN,
            {"sets": ["linear", "wind"]},
            "add wind_speed and wind_dir to signals.exogenous",
        ),
        (
            ("u", "v", "r", "n_port", "n_stbd"),
            {"sets": ["fossen"]},
            "whether 'n_port' pushes or turns",
        ),
        (("u", "v", "r", "n"), {"sets": ["abkowitz"]}, "one that turns"),
        (CATAMARAN, {"sets": ["astern"]}, "needs a propeller"),
        (TANKER, {"sets": ["fossen"], "drive": ["rpm"]}, "no channel 'rpm'"),
        (TANKER, {"sets": ["fosen"]}, "fossen"),
        (TANKER, {"terms": ["u"], "steer": ["delta"]}, "give sets, or leave them out"),
        (TANKER, {"sets": ["fossen"], "ridge": [0.1]}, "at least 2"),
        (TANKER, {"sets": ["fossen"], "ridge": [0.1, -1.0]}, "greater than or equal to 0"),
    ],
)
def test_what_cannot_be_is_a_config_error(
    names: tuple[str, ...], config: dict[str, Any], message: str
) -> None:
    with pytest.raises(ConfigError, match=message):
        terms(names, **config)


def test_roles_may_be_given() -> None:
    names = ("u", "v", "r", "rpm", "azimuth")
    found = terms(names, sets=["fossen"], drive=["rpm"], steer=["azimuth"])
    assert found[12:] == (
        "rpm",
        "rpm|rpm|",
        "|rpm| u",
        "u|u| azimuth",
        "rpm|rpm| azimuth",
        "u rpm azimuth",
    )


def test_each_of_several_penalties_is_the_fit_with_it() -> None:
    names = ("u", "v", "r", "n", "delta")
    rng = np.random.default_rng(2)
    z, y = rng.normal(size=(200, 5)), rng.normal(size=(200, 3))
    samples = sampled(z, y, names, groups=10)
    several = RegressorsConfig(sets=("linear",), ridge=(0.0, 1e-2, 1.0))
    baseline = several.build(names)
    found = several.solutions(baseline, samples)
    assert [solution.choice for solution in found] == [
        {"ridge": 0.0},
        {"ridge": 1e-2},
        {"ridge": 1.0},
    ]
    for solution, ridge in zip(found, (0.0, 1e-2, 1.0), strict=True):
        alone = RegressorsConfig(sets=("linear",), ridge=ridge).solutions(baseline, samples)
        assert alone[0].choice == {}
        torch.testing.assert_close(solution.state["theta"], alone[0].state["theta"])
        assert solution.table == alone[0].table


def test_a_penalty_decides_between_regressors_that_the_data_cannot_tell_apart() -> None:
    """A propeller that never turns astern: n|n| is n^2."""
    names = ("u", "v", "r", "n", "delta")
    rng = np.random.default_rng(3)
    z = rng.normal(size=(200, 5))
    z[:, 3] = 5 + abs(z[:, 3])
    samples = sampled(z, z[:, :3], names, groups=10)
    plain, ridge = (
        RegressorsConfig(sets=("fossen", "astern")),
        RegressorsConfig(sets=("fossen", "astern"), ridge=1e-6),
    )
    with pytest.raises(FitError, match=r"cannot tell apart regressors.*or give a ridge penalty"):
        plain.fit(plain.build(names), samples)
    baseline = ridge.build(names)
    ridge.fit(baseline, samples)
    np.testing.assert_allclose(baseline(samples.z), z[:, :3], atol=1e-2)
