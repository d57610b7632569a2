"""Every estimator on data that determine little, and on random draws beside scikit-learn.

What an estimator is given it either answers rightly or refuses in one line.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from sklearn.cross_decomposition import PLSRegression
from sklearn.linear_model import ElasticNet as ReferenceElasticNet
from sklearn.linear_model import LinearRegression
from sklearn.linear_model import Ridge as ReferenceRidge

from residnet.core.errors import FitError
from residnet.regression.estimator import Estimator, Solution, assign_group_folds
from residnet.regression.genetic import GeneticEquations
from residnet.regression.genetic_config import EquationSearchConfig, EvolutionConfig
from residnet.regression.kernel import KernelRidge
from residnet.regression.kernel_config import PolynomialConfig, RbfConfig
from residnet.regression.least_squares import CentredLeastSquares, ElasticNet, LeastSquares
from residnet.regression.shrinkage import PLSR, Ridge
from residnet.regression.sparse import SparseRegression
from residnet.regression.surface import SurfacePLSR

Make = Callable[[int, int], Estimator]
LINEAR: dict[str, Make] = {
    "least squares": lambda j, n: LeastSquares(),
    "ridge penalties": lambda j, n: LeastSquares((1e-8, 1e-2)),
    "centred": lambda j, n: CentredLeastSquares(),
    "plsr": lambda j, n: PLSR(folds=2),
    "ridge": lambda j, n: Ridge((1e-10, 1e-3), folds=2, has_alternatives=True),
    "elastic net": lambda j, n: ElasticNet(0.5, folds=2),
    "surface": lambda j, n: SurfacePLSR("least"),
    "sparse": lambda j, n: SparseRegression(gammas=(0.0, 1.0)),
}
OTHERS: dict[str, Make] = {
    "rbf": lambda j, n: KernelRidge(RbfConfig(sigma=(3.0,)).build(j, n), (1e-6, 1e-2), folds=2),
    "polynomial": lambda j, n: KernelRidge(PolynomialConfig().build(j, n), (1e-6, 1e-2), folds=2),
    "genetic": lambda j, n: GeneticEquations(
        EquationSearchConfig(evolution=EvolutionConfig(population=10, generations=1))
    ),
}
ALL = LINEAR | OTHERS


def drawn(samples: int, j: int, n: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Inputs and outputs that are linear in them, but for noise."""
    random = np.random.default_rng(seed)
    x = random.normal(size=(samples, j)) * 10.0 ** random.uniform(-2, 2, j)
    return x, x / (x.std(0) + 1e-3) @ random.normal(size=(j, n)) + 0.1 * random.normal(
        size=(samples, n)
    )


def put(values: np.ndarray, where: Any, value: Any) -> np.ndarray:
    changed = values.copy()
    changed[where] = value
    return changed


# data that ask for trouble, from 60 samples of 4 columns and 2 outputs
CASES: dict[str, Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]] = {
    "plain": lambda x, y: (x, y),
    "rank deficient": lambda x, y: (put(x, np.s_[:, 3], 2.0 * x[:, 0] - x[:, 1]), y),
    "one sample": lambda x, y: (x[:1], y[:1]),
    "no sample": lambda x, y: (x[:0], y[:0]),
    "no column": lambda x, y: (x[:, :0], y),
    "constant column": lambda x, y: (put(x, np.s_[:, 2], 7.3), y),
    "zero column": lambda x, y: (put(x, np.s_[:, 2], 0.0), y),
    "fewer samples than columns": lambda x, y: drawn(8, 12, 2),
    "one output": lambda x, y: (x, y[:, :1]),
    "one column": lambda x, y: (x[:, :1], y),
    "constant output": lambda x, y: (x, put(y, np.s_[:, 1], 5.1)),
    "zero output": lambda x, y: (x, put(y, np.s_[:, 1], 0.0)),
    "not finite": lambda x, y: (put(x, (7, 2), np.nan), y),
    "not finite output": lambda x, y: (x, put(y, (7, 1), np.inf)),
    "repeated sample": lambda x, y: (np.repeat(x[:1], 60, 0), np.repeat(y[:1], 60, 0)),
    "far from zero": lambda x, y: (x + 1e6 * x.std(0), y),
    "huge": lambda x, y: (1e150 * x, 1e150 * y),
}
ANSWERED_BY_ALL = {"plain", "one output"}
REFUSED_BY_ALL = {"no sample", "no column", "not finite", "not finite output"}


@pytest.mark.parametrize("trouble", CASES)
@pytest.mark.parametrize("kind", ALL)
def test_the_answer_is_right_or_refused_in_one_line(kind: str, trouble: str) -> None:
    """Right: coefficients are finite, and no prediction is far beyond the outputs."""
    x, y = (torch.from_numpy(part) for part in CASES[trouble](*drawn(60, 4, 2)))
    groups = torch.arange(len(x)) * 4 // max(len(x), 1)
    refused = ""
    solutions: list[Solution] = []
    try:
        solutions = ALL[kind](x.shape[1], y.shape[1]).fit(x, y, groups)
    except FitError as error:
        refused = str(error)
    assert "\n" not in refused
    assert bool(refused) != bool(solutions)
    assert trouble not in ANSWERED_BY_ALL or not refused, refused
    assert trouble not in REFUSED_BY_ALL or refused
    for solution in solutions:
        assert all(bool(torch.isfinite(value).all()) for value in solution.state.values())
        if kind in LINEAR and bool(solution.coefficients.any()):
            assert solution.coefficients.shape == (x.shape[1], y.shape[1])
            reach = y - y.mean(0) if "intercept" in solution.state else y
            left = y - solution.predict(x)
            limit = 1.01 * reach.square().sum(0) + 1e-9 * y.square().sum(0)
            assert bool((left.square().sum(0) <= limit).all())


def reference(kind: str, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Predictions of scikit-learn with the same settings."""
    model, seen = {
        "least squares": (LinearRegression(fit_intercept=False), x),
        "centred": (LinearRegression(), x),
        "plsr": (PLSRegression(2, scale=False, tol=1e-28, max_iter=20_000), x / x.std(0, ddof=1)),
        "ridge": (ReferenceRidge(alpha=1e-2 * len(x), solver="svd"), x / x.std(0)),
    }[kind]
    return np.asarray(model.fit(seen, y).predict(seen)).reshape(len(x), -1)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("kind", ["least squares", "centred", "plsr", "ridge"])
def test_random_draws_are_as_scikit_learn_has_them(kind: str, seed: int) -> None:
    random = np.random.default_rng(seed)
    j, n = int(random.integers(2, 9)), int(random.integers(1, 5))
    x, y = drawn(int(random.integers(j + 5, 80)), j, n, seed)
    estimators: dict[str, Estimator] = {
        "least squares": LeastSquares(),
        "centred": CentredLeastSquares(),
        "plsr": PLSR(2),
        "ridge": Ridge((1e-2,)),
    }
    found = estimators[kind].fit(torch.from_numpy(x), torch.from_numpy(y))[0]
    mine = found.predict(torch.from_numpy(x)).numpy()
    np.testing.assert_allclose(mine, reference(kind, x, y), atol=1e-7 * y.std())


@pytest.mark.parametrize("seed", range(2))
def test_the_chosen_elastic_net_is_scikit_learns_at_its_penalty(seed: int) -> None:
    x, y = drawn(80, 5, 2, seed)
    x = (x - x.mean(0)) / x.std(0)
    groups = torch.arange(80) // 20
    found = ElasticNet(0.5).fit(torch.from_numpy(x), torch.from_numpy(y), groups)[0]
    for output, alpha in enumerate(found.hyperparameters["alpha"]):
        model = ReferenceElasticNet(alpha=alpha, l1_ratio=0.5, tol=1e-4, max_iter=3000)
        model.fit(x, y[:, output])
        np.testing.assert_allclose(found.coefficients[:, output], model.coef_, atol=1e-3)


@pytest.mark.parametrize("kind", ["plsr", "ridge", "elastic net", "surface", "rbf"])
def test_without_groups_nothing_is_chosen(kind: str) -> None:
    x, y = (torch.from_numpy(part) for part in drawn(60, 4, 2))
    with pytest.raises(FitError, match=r"groups|at least two runs|at least 2 manoeuvres"):
        ALL[kind](4, 2).fit(x, y)


def test_the_numbers_of_samples_must_agree() -> None:
    x, y = (torch.from_numpy(part) for part in drawn(60, 4, 2))
    for make in ALL.values():
        with pytest.raises(FitError, match="60 samples of the inputs, but 59 of the outputs"):
            make(4, 2).fit(x, y[:59], torch.arange(60) // 15)


def test_settings_stay_as_they_were() -> None:
    """`fit` learns nothing into the estimator: a second fit of other data is as a first one."""
    x, y = (torch.from_numpy(part) for part in drawn(60, 4, 2))
    groups = torch.arange(60) // 15
    for make in LINEAR.values():
        estimator = make(4, 2)
        estimator.fit(x.flip(0) ** 2, y.exp(), groups)
        again = estimator.fit(x, y, groups)[0]
        fresh = make(4, 2).fit(x, y, groups)[0]
        torch.testing.assert_close(again.coefficients, fresh.coefficients, rtol=1e-9, atol=1e-12)


def test_a_group_is_never_split_between_folds() -> None:
    groups = torch.tensor([3, 3, 5, 5, 5, 7, 8, 8, 11])
    assert assign_group_folds(groups, 2).tolist() == [0, 0, 1, 1, 1, 0, 1, 1, 0]
    assert assign_group_folds(groups, None).tolist() == [0, 0, 1, 1, 1, 2, 3, 3, 4]
    with pytest.raises(FitError, match=r"3 folds.* have 2; lower `folds`"):
        assign_group_folds(torch.tensor([0, 0, 1]), 3)


def least_squares(x: np.ndarray, y: np.ndarray, groups: int = 1, ridge: float = 0.0) -> Solution:
    group = torch.arange(len(x)) * groups // len(x)
    given = (torch.from_numpy(x), torch.from_numpy(y), group)
    (found,) = LeastSquares((ridge,)).fit(*given, names=("a", "b", "c"))
    return found


def problem(count: int) -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(count)
    x = random.normal(size=(count, 3)) * [1.0, 30.0, 0.02] + [0.5, 0.0, 0.0]
    return x, random.normal(size=(count, 2))


def test_ridge_is_a_share_of_each_column_s_energy() -> None:
    x, y = problem(200)
    fit = least_squares(x, y, 5, ridge=0.3)
    size = np.sqrt((x**2).mean(0))
    truth = (
        ReferenceRidge(alpha=0.3 * 200, fit_intercept=False, tol=1e-14).fit(x / size, y).coef_
        / size
    )
    np.testing.assert_allclose(fit.coefficients, truth.T, rtol=1e-10)


@pytest.mark.parametrize("groups", [1, 7])
def test_coefficients_and_errors_in_closed_form(groups: int) -> None:
    """The textbook's with one manoeuvre; of clusters (X'X)^-1 sum_g X_g'e_g e_g'X_g (X'X)^-1 G / (G
    - 1), in the columns' own units.
    """
    x, y = problem(210)
    fit = least_squares(x, y, groups)
    wanted = np.linalg.lstsq(x, y, rcond=None)[0]
    np.testing.assert_allclose(fit.coefficients, wanted, rtol=1e-10)
    scaled = x / np.sqrt((x**2).mean(0))
    assert fit.notes["condition"] == pytest.approx(np.linalg.cond(scaled), rel=1e-9)
    bread = np.linalg.inv(x.T @ x)
    for k, e in enumerate((y - x @ wanted).T):
        scores = (x * e[:, None]).reshape(groups, -1, 3).sum(1)
        meat = scores.T @ scores * groups / max(groups - 1, 1)
        covariance = bread @ meat @ bread if groups > 1 else e @ e / 207 * bread
        np.testing.assert_allclose(
            fit.standard_errors[:, k], np.sqrt(np.diag(covariance)), rtol=1e-9
        )


NOISE = np.random.default_rng(5).normal(size=(60, 3))


@pytest.mark.parametrize(
    ("x", "message"),
    [
        (np.ones((3, 3)), "3 samples do not determine 3 coefficients"),
        (NOISE * [1, 0, 1], "regressor 'b' is zero in all 60 samples"),
        (NOISE[:, [0, 1, 1]] * [1, 1, 3], r"'(b' and 'c|c' and 'b)'"),
    ],
)
def test_what_the_data_do_not_determine_is_refused(x: np.ndarray, message: str) -> None:
    with pytest.raises(FitError, match=message) as caught:
        least_squares(x, NOISE[: len(x), :1])
    assert "\n" not in str(caught.value)
