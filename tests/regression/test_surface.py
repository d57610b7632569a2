"""The surface analysis against scikit-learn's PLSRegression, model by model."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from sklearn.cross_decomposition import PLSRegression

from residnet.core.errors import FitError
from residnet.regression.shrinkage import FoldMoments
from residnet.regression.surface import compute_error_surface


def data(seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Correlated columns of different size, three outputs, fold of each row."""
    random = np.random.default_rng(seed)
    columns = 7
    rows = 240
    x = random.normal(size=(rows, columns)) @ random.normal(size=(columns, columns))
    x = x * 10.0 ** random.uniform(-2, 2, columns) + 3.0
    noise = random.normal(size=(rows, 3)) * [0.5, 2.0, 8.0]
    y = (x / x.std(0)) @ random.normal(size=(columns, 3)) + noise
    return x, y, np.arange(rows) * 4 // rows


def by_hand(
    x: np.ndarray, y: np.ndarray, fit: list[np.ndarray], judge: list[np.ndarray], whole: np.ndarray
) -> dict[tuple[int, int], float]:
    """Error by (order, count) of one output: one scikit-learn fit for every model and fold."""

    def fitted(rows: np.ndarray) -> PLSRegression:
        model = PLSRegression(order, scale=True, tol=1e-14, max_iter=5000)
        return model.fit(x[rows][:, kept], y[rows])

    out: dict[tuple[int, int], float] = {}
    for order in range(1, x.shape[1] + 1):
        kept = list(range(x.shape[1]))
        while len(kept) >= max(order, 2):
            off = [
                fitted(train).predict(x[test][:, kept]).ravel() - y[test]
                for train, test in zip(fit, judge, strict=True)
            ]
            out[order, len(kept)] = float(np.square(np.concatenate(off)).mean())
            size = np.abs(fitted(whole).coef_.ravel() * x[whole][:, kept].std(0))
            del kept[int(size.argmin())]
    return out


def moments(x: np.ndarray, y: np.ndarray, fold: np.ndarray) -> FoldMoments:
    return FoldMoments.from_samples(
        torch.from_numpy(x), torch.from_numpy(y), torch.from_numpy(fold), int(fold.max()) + 1
    )


@pytest.mark.parametrize("judged", ["folds", "test half"])
def test_equals_scikit_learn(judged: str) -> None:
    x, y, fold = data()
    rows = np.arange(len(x))
    if judged == "folds":
        found = compute_error_surface(moments(x, y, fold))
        fit, judge = ([rows[(fold == f) == own] for f in range(4)] for own in (False, True))
        whole = rows
    else:
        found = compute_error_surface(moments(x, y, fold), test_folds=(2, 3))
        fit = [rows[fold < 2]]
        judge = [rows[fold >= 2]]
        whole = rows[fold < 2]
    for k in range(3):
        expected = by_hand(x, y[:, k], fit, judge, whole)
        places = torch.isfinite(found.error[k]).nonzero().tolist()
        own = {(a + 1, j): float(found.error[k, a, j]) for a, j in places}
        assert own.keys() == expected.keys()
        assert own == pytest.approx(expected, rel=1e-8)
        order, count = found.minimum_error_model(k)
        assert found.error[k, order - 1, count] == min(own.values())


def test_what_explains_nothing_goes_first() -> None:
    random = np.random.default_rng(1)
    x = random.normal(size=(400, 5))
    y = np.stack((x[:, 0] + 2 * x[:, 3], x[:, 1], x[:, 3] - x[:, 4]), axis=1)
    y += 0.01 * random.normal(size=(400, 3))
    found = compute_error_surface(moments(x, y, np.arange(400) % 4))
    assert found.retained_columns(0, 2, 2) == [0, 3]
    assert found.retained_columns(2, 2, 2) == [3, 4]


def test_simplest_is_no_worse_than_one_standard_error_and_no_more_complex() -> None:
    x, y, fold = data(seed=3)
    found = compute_error_surface(moments(x, y, fold))
    for k in range(3):
        (a, j), (low, many) = found.minimum_error_model(k), found.one_standard_error_model(k)
        assert low <= a
        limit = found.error[k, a - 1, j] + found.standard_error[k, a - 1, j]
        assert found.error[k, low - 1, many] <= limit


def test_constant_and_single_columns_are_refused() -> None:
    x, y, fold = data()
    x[:, 4] = 2.5
    with pytest.raises(FitError, match="number 4 is constant"):
        compute_error_surface(moments(x, y, fold))
    with pytest.raises(FitError, match="at least two"):
        compute_error_surface(moments(x[:, :1], y, fold))
