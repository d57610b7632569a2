"""The surface analysis against scikit-learn's PLSRegression, model by model."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from sklearn.cross_decomposition import PLSRegression

from residnet.core.errors import FitError
from residnet.regression.shrinkage import FoldMoments
from residnet.regression.surface import surface


def data(
    columns: int = 7, rows: int = 240, seed: int = 0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Correlated columns of different size, three outputs, fold of each row."""
    random = np.random.default_rng(seed)
    x = (
        random.normal(size=(rows, columns))
        @ random.normal(size=(columns, columns))
        * 10.0 ** random.uniform(-2, 2, columns)
        + 3.0
    )
    y = (x / x.std(0)) @ random.normal(size=(columns, 3)) + random.normal(size=(rows, 3)) * [
        0.5,
        2.0,
        8.0,
    ]
    return x, y, np.arange(rows) * 4 // rows


def by_hand(
    x: np.ndarray, y: np.ndarray, fit: list[np.ndarray], judge: list[np.ndarray], whole: np.ndarray
) -> dict[tuple[int, int], float]:
    """Error by (order, count) of one output: one scikit-learn fit for every model and fold."""
    out: dict[tuple[int, int], float] = {}
    for order in range(1, x.shape[1] + 1):
        kept = list(range(x.shape[1]))
        while len(kept) >= max(order, 2):
            squares = count = 0.0
            for train, test in zip(fit, judge, strict=True):
                model = PLSRegression(order, scale=True, tol=1e-14, max_iter=5000).fit(
                    x[train][:, kept], y[train]
                )
                squares += float(((model.predict(x[test][:, kept]).ravel() - y[test]) ** 2).sum())
                count += len(test)
            out[order, len(kept)] = squares / count
            model = PLSRegression(order, scale=True, tol=1e-14, max_iter=5000).fit(
                x[whole][:, kept], y[whole]
            )
            size = np.abs(model.coef_.ravel() * x[whole][:, kept].std(0))
            del kept[int(size.argmin())]
    return out


def moments(x: np.ndarray, y: np.ndarray, fold: np.ndarray) -> FoldMoments:
    return FoldMoments.gather(
        torch.from_numpy(x), torch.from_numpy(y), torch.from_numpy(fold), int(fold.max()) + 1
    )


@pytest.mark.parametrize("judged", ["folds", "test half"])
def test_equals_scikit_learn(judged: str) -> None:
    x, y, fold = data()
    rows = np.arange(len(x))
    if judged == "folds":
        found = surface(moments(x, y, fold))
        fit, judge, whole = (
            [rows[fold != f] for f in range(4)],
            [rows[fold == f] for f in range(4)],
            rows,
        )
    else:
        found = surface(moments(x, y, fold), test=(2, 3))
        fit, judge, whole = [rows[fold < 2]], [rows[fold >= 2]], rows[fold < 2]
    for k in range(3):
        expected = by_hand(x, y[:, k], fit, judge, whole)
        own = {
            (a + 1, j): float(found.error[k, a, j])
            for a, j in torch.isfinite(found.error[k]).nonzero().tolist()
        }
        assert own.keys() == expected.keys()
        for key, value in expected.items():
            assert own[key] == pytest.approx(value, rel=1e-8), key
        order, count = found.least(k)
        assert found.error[k, order - 1, count] == min(own.values())


def test_removal_names_each_basis_function_once() -> None:
    x, y, fold = data()
    found = surface(moments(x, y, fold))
    for order in (1, 3, 7):
        gone = [j for j in found.removal[0, order - 1].tolist() if j >= 0]
        assert len(set(gone)) == len(gone) == 7 - max(order, 2)
        assert found.kept(0, order, 7) == list(range(7))
        assert set(found.kept(0, order, max(order, 2))) == set(range(7)) - set(gone)


def test_what_explains_nothing_goes_first() -> None:
    random = np.random.default_rng(1)
    x = random.normal(size=(400, 5))
    y = np.stack(
        (x[:, 0] + 2 * x[:, 3], x[:, 1], x[:, 3] - x[:, 4]), axis=1
    ) + 0.01 * random.normal(size=(400, 3))
    found = surface(moments(x, y, np.arange(400) % 4))
    assert found.kept(0, 2, 2) == [0, 3]
    assert found.kept(2, 2, 2) == [3, 4]


def test_simplest_is_no_worse_than_one_standard_error_and_no_more_complex() -> None:
    x, y, fold = data(seed=3)
    found = surface(moments(x, y, fold))
    for k in range(3):
        (a, j), (low, many) = found.least(k), found.simplest(k)
        assert low <= a
        assert (
            found.error[k, low - 1, many]
            <= found.error[k, a - 1, j] + found.standard_error[k, a - 1, j]
        )


def test_constant_and_single_columns_are_refused() -> None:
    x, y, fold = data()
    x[:, 4] = 2.5
    with pytest.raises(FitError, match="number 4 is constant"):
        surface(moments(x, y, fold))
    with pytest.raises(FitError, match="at least two"):
        surface(moments(x[:, :1], y, fold))
