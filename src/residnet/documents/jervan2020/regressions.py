"""Linear regressions of forces on basis functions, side by side (document 002 chapters 3 and 4):
one config class per kind.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal, final

import torch
from pydantic import Field
from torch import Tensor

from residnet.core.config import Config
from residnet.core.errors import FitError
from residnet.regression.moments import FoldMoments
from residnet.regression.nipals import nipals
from residnet.regression.plsr import pls_path
from residnet.regression.surface import Surface, surface


@dataclass(frozen=True)
class Regression:
    """What a regression is made from.

    Attributes:
        terms: names of the basis functions.
        x: basis functions [N, J], float64.
        y: outputs [N, 3].
        scale: what the columns are divided by [J].
        fold: of each sample [N], from 0; samples that belong together (a segment, a run) share a
            fold.
        test: samples of the document's own choice of a model, which judges on them; None where a
            model must not see them.
    """

    terms: tuple[str, ...]
    x: Tensor
    y: Tensor
    scale: Tensor
    fold: Tensor
    test: tuple[Tensor, Tensor] | None = None

    def __post_init__(self) -> None:
        bad = ~torch.isfinite(self.x)
        if bool(bad.any()):
            row, column = (int(part[0]) for part in bad.nonzero(as_tuple=True))
            raise FitError(
                f"basis function '{self.terms[column]}' is not finite at sample {row}; mask or"
                " repair the log"
            )
        if not bool(torch.isfinite(self.y).all()):
            raise FitError(
                "the residual force is not finite at sample"
                f" {int((~torch.isfinite(self.y)).any(1).nonzero()[0, 0])}; mask the log"
            )
        if len(self.x) <= len(self.terms):
            raise FitError(
                f"{len(self.x)} samples do not determine {len(self.terms)} basis functions; give"
                " more data or fewer terms"
            )

    @property
    def standardised(self) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """E [N, J], F [N, 3], mean of x, mean of y, std of y (3.3), (3.4), (4.8)."""
        mean_x, mean_y, std_y = self.x.mean(0), self.y.mean(0), self.y.std(0)
        return (self.x - mean_x) / self.scale, (self.y - mean_y) / std_y, mean_x, mean_y, std_y

    def folds(self) -> int:
        """Number of folds.

        Raises:
            FitError: with fewer than two.
        """
        count = int(self.fold.max()) + 1
        if count < 2:
            raise FitError(
                "one run or segment only: nothing is left to cross-validate on; give more runs, or"
                " a fixed order or penalty"
            )
        return count


@dataclass(frozen=True)
class Fit:
    """y = intercept + x coefficients.

    Attributes:
        coefficients: Theta_post [J, 3], zero for basis functions that were removed.
        intercept: [3].
        pre: Theta_pre [J, 3], coefficients of the scaled variables (3.11).
        notes: what was chosen.
        surface: errors of all models that the choice was made from, where a surface analysis made
            it.
    """

    coefficients: Tensor
    intercept: Tensor
    pre: Tensor
    notes: dict[str, Any] = field(default_factory=dict)
    surface: Surface | None = None

    @classmethod
    def from_pre(cls, data: Regression, pre: Tensor, notes: dict[str, Any]) -> Fit:
        """From coefficients of scaled variables: Theta_post = diag(scale)^-1 Theta_pre diag(std y)
        (3.12), ERRATA J15.
        """
        _, _, mean_x, mean_y, std_y = data.standardised
        post = pre / data.scale[:, None] * std_y
        return cls(post, mean_y - mean_x @ post, pre, notes)

    def predict(self, x: Tensor) -> Tensor:
        """Outputs [N, 3] at basis functions [N, J]."""
        return x @ self.coefficients + self.intercept


class RegressionKind(Config, ABC):
    """How coefficients are found."""

    @abstractmethod
    def fit(self, data: Regression) -> Fit:
        """The coefficients.

        Raises:
            FitError: where the data do not determine them.
        """


@final
class PlsrRegression(RegressionKind):
    """PLSR of the three axes together; `order` null: the least error over left-out folds."""

    kind: Literal["plsr"]
    order: int | None = Field(default=None, ge=1)
    algorithm: Literal["kernel", "nipals"] = "kernel"

    def path(self, e: Tensor, f: Tensor, orders: int) -> Tensor:
        """Theta_pre [A, J, 3] of every order."""
        return (
            nipals(e, f, orders)
            if self.algorithm == "nipals"
            else pls_path(e.T @ e, e.T @ f, orders)
        )

    def fit(self, data: Regression) -> Fit:
        """Fit all orders, keep one."""
        e, f, *_ = data.standardised
        order = self.order or self._best(data, e, f)
        path = self.path(e, f, min(order, len(data.terms)))
        if len(path) == 0:
            raise FitError("PLSR: nothing in the residual varies with the basis functions")
        return Fit.from_pre(data, path[-1], {"order": len(path)})

    def _best(self, data: Regression, e: Tensor, f: Tensor) -> int:
        errors = []
        for k in range(data.folds()):
            out = data.fold == k
            inside, about = e[~out], f[~out]
            mx, my = inside.mean(0), about.mean(0)
            path = self.path(inside - mx, about - my, len(data.terms))
            errors.append((f[out] - my - (e[out] - mx) @ path).square().sum((1, 2)))
        shortest = min(len(error) for error in errors)
        return int(torch.stack([error[:shortest] for error in errors]).sum(0).argmin()) + 1


@final
class SurfaceRegression(RegressionKind):
    """PLSR of each axis by itself, order and basis functions by surface analysis (document 002
    section 4.5.1).

    Attributes:
        choose: `test`, the document's own: the least error on the test half, which then also judges
            it; `simplest`: cross-validation over the folds of the first half and the
            one-standard-error rule; `least`: cross-validation and its bare minimum.
    """

    kind: Literal["surface"]
    choose: Literal["test", "simplest", "least"] = "simplest"

    def surfaces(self, data: Regression) -> Surface:
        """Errors of all models.

        Raises:
            FitError: where the test half is needed and not there.
        """
        if self.choose != "test":
            return surface(FoldMoments.gather(data.x, data.y, data.fold, data.folds()))
        if data.test is None:
            raise FitError("surface: choose 'test' needs the test half")
        x, y = torch.cat((data.x, data.test[0])), torch.cat((data.y, data.test[1]))
        half = torch.cat(
            (
                torch.zeros(len(data.x), dtype=torch.long),
                torch.ones(len(data.test[0]), dtype=torch.long),
            )
        )
        return surface(FoldMoments.gather(x, y, half, 2), test=[1])

    def fit(self, data: Regression) -> Fit:
        """The chosen model of each axis."""
        found = self.surfaces(data)
        coefficients, pre = (
            torch.zeros(len(data.terms), 3, dtype=torch.float64),
            torch.zeros(len(data.terms), 3, dtype=torch.float64),
        )
        picks = [
            found.simplest(axis) if self.choose == "simplest" else found.least(axis)
            for axis in range(3)
        ]
        std = data.x.std(0)
        for axis, (order, count) in enumerate(picks):
            kept = found.kept(axis, order, count)
            e = (data.x[:, kept] - data.x[:, kept].mean(0)) / std[kept]
            spread = data.y[:, axis].std()
            f = (data.y[:, [axis]] - data.y[:, axis].mean()) / spread
            pre[kept, axis] = pls_path(e.T @ e, e.T @ f, order)[-1, :, 0]
            coefficients[kept, axis] = pre[kept, axis] / std[kept] * spread
        notes = {"order": [order for order, _ in picks], "terms": [count for _, count in picks]}
        return Fit(coefficients, data.y.mean(0) - data.x.mean(0) @ coefficients, pre, notes, found)


@final
class LeastSquaresRegression(RegressionKind):
    """Ordinary least squares."""

    kind: Literal["ols"]

    def fit(self, data: Regression) -> Fit:
        """Least squares on the scaled columns.

        Raises:
            FitError: where basis functions are collinear, naming them.
        """
        e, f, *_ = data.standardised
        _, singular, right = torch.linalg.svd(e, full_matrices=False)
        if float(singular[-1]) <= 1e-9 * float(singular[0]):
            loads = right[-1].abs()
            names = [data.terms[j] for j in (loads > 0.1 * loads.max()).nonzero()[:, 0].tolist()]
            raise FitError(
                f"basis functions {', '.join(names)} are collinear over these samples; leave one"
                " out, or use ridge or plsr"
            )
        return Fit.from_pre(
            data,
            torch.linalg.lstsq(e, f).solution,
            {"condition": float(singular[0] / singular[-1])},
        )


@final
class RidgeRegression(RegressionKind):
    """Ridge; `penalty` null: the least error over left-out folds (alpha = penalty * samples in
    scikit-learn's terms).
    """

    kind: Literal["ridge"]
    penalty: float | None = Field(default=None, gt=0)

    def fit(self, data: Regression) -> Fit:
        """Ridge on the scaled columns."""
        e, f, *_ = data.standardised
        penalty = self.penalty or self._best(data, e, f)
        return Fit.from_pre(data, self._solve(e, f, penalty), {"penalty": penalty})

    @staticmethod
    def _solve(e: Tensor, f: Tensor, penalty: float) -> Tensor:
        values, vectors = torch.linalg.eigh(e.T @ e / len(e))
        return vectors @ (vectors.T @ (e.T @ f) / len(e) / (values.clamp(min=0) + penalty)[:, None])

    def _best(self, data: Regression, e: Tensor, f: Tensor) -> float:
        penalties = [10.0**k for k in range(-10, 1)]
        error = torch.zeros(len(penalties), dtype=torch.float64)
        for k in range(data.folds()):
            out = data.fold == k
            mx, my = e[~out].mean(0), f[~out].mean(0)
            for i, penalty in enumerate(penalties):
                error[i] += (
                    (f[out] - my - (e[out] - mx) @ self._solve(e[~out] - mx, f[~out] - my, penalty))
                    .square()
                    .sum()
                )
        return penalties[int(error.argmin())]


@final
class ShrinkRegression(RegressionKind):
    """LASSO, or elastic net with `l1_ratio` below one, by scikit-learn with its cross-validation
    over the folds; each axis by itself.
    """

    kind: Literal["lasso", "elastic_net"]
    l1_ratio: float = Field(default=0.5, gt=0, lt=1)

    def fit(self, data: Regression) -> Fit:
        """Coordinate descent along scikit-learn's own path of penalties."""
        import warnings

        from sklearn.exceptions import ConvergenceWarning
        from sklearn.linear_model import ElasticNetCV, LassoCV

        e, f, *_ = data.standardised
        parts = [
            ((data.fold != k).nonzero()[:, 0].numpy(), (data.fold == k).nonzero()[:, 0].numpy())
            for k in range(data.folds())
        ]
        pre, alphas = [], []
        for axis in range(3):
            options = {"cv": parts, "alphas": 40, "max_iter": 3000, "tol": 1e-4}
            model = (
                LassoCV(**options)
                if self.kind == "lasso"
                else ElasticNetCV(l1_ratio=self.l1_ratio, **options)
            )
            with warnings.catch_warnings():
                # the smallest penalties of the path need not converge: cross-validation leaves them
                # behind
                warnings.simplefilter("ignore", ConvergenceWarning)
                model.fit(e.numpy(), f[:, axis].numpy())
            pre.append(torch.from_numpy(model.coef_))
            alphas.append(float(model.alpha_))
        return Fit.from_pre(data, torch.stack(pre, dim=1), {"alpha": alphas})


RegressionConfig = Annotated[
    PlsrRegression
    | SurfaceRegression
    | LeastSquaresRegression
    | RidgeRegression
    | ShrinkRegression,
    Field(discriminator="kind"),
]


def segments(t: Tensor, length: float) -> Tensor:
    """Fold of each sample [N] by stretches of `length` s, from 0 on."""
    number = torch.div(t - t.min(), length, rounding_mode="floor").long()
    return torch.unique(number, return_inverse=True)[1]


def table(terms: Sequence[str], fit: Fit) -> list[tuple[str, list[float]]]:
    """Rows of the model for reading: the constant, then each basis function that is kept, with its
    coefficients (surge, sway, yaw).
    """
    rows = [("1", fit.intercept.tolist())]
    return rows + [
        (term, row) for term, row in zip(terms, fit.coefficients.tolist(), strict=True) if any(row)
    ]
