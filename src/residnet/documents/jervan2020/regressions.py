"""Linear regressions of forces on basis functions, side by side (document 002 chapters 3 and 4).

One config class per kind says which estimator of `residnet.regression` finds the coefficients.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, Literal, final

import torch
from pydantic import Field
from torch import Tensor

from residnet.core.config import Config
from residnet.core.errors import FitError
from residnet.regression.elastic_net import ElasticNet
from residnet.regression.estimator import Estimator, require_data
from residnet.regression.least_squares import CentredLeastSquares
from residnet.regression.pls_path import pls_path
from residnet.regression.plsr import PLSR
from residnet.regression.ridge import Ridge
from residnet.regression.surface import Surface
from residnet.regression.surface_plsr import SurfacePLSR

_FORCES = ("surge force", "sway force", "yaw moment")
_PENALTIES = tuple(10.0**k for k in range(-10, 1))
"""Ridge penalties tried where none is given, in units of a standardised column's energy."""


@dataclass(frozen=True)
class Regression:
    """The data of a regression.

    Attributes:
        terms: names of the basis functions.
        x: basis functions [N, J], float64.
        y: residual forces [N, 3] in N, N, N m.
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
        require_data(self.x, self.y, self.terms, _FORCES)
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


@dataclass(frozen=True)
class OrderErrors:
    """Mean square errors of a PLSR over its order: forces [A, 3] in N^2, N^2, (N m)^2.

    Attributes:
        left_out: over samples whose fold was left out; NaN without folds.
        test: over the test half; NaN without one.
    """

    left_out: Tensor
    test: Tensor


@dataclass(frozen=True)
class Fit:
    """Coefficients of y = intercept + x coefficients.

    Attributes:
        coefficients: Theta_post [J, 3], zero for basis functions that were removed.
        intercept: of each axis [3].
        pre: Theta_pre [J, 3], coefficients of the scaled variables (3.11).
        notes: what was chosen.
        surface: errors of all models that the choice was made from, where a surface analysis made
            it.
        orders: errors over the order of a PLSR.
    """

    coefficients: Tensor
    intercept: Tensor
    pre: Tensor
    notes: dict[str, Any] = field(default_factory=dict)
    surface: Surface | None = None
    orders: OrderErrors | None = None

    @classmethod
    def from_pre(cls, data: Regression, pre: Tensor, notes: dict[str, Any]) -> Fit:
        """Return the fit with coefficients of scaled variables.

        Theta_post = diag(scale)^-1 Theta_pre diag(std y) (3.12), correction J15.
        """
        _, _, mean_x, mean_y, std_y = data.standardised
        post = pre / data.scale[:, None] * std_y
        return cls(post, mean_y - mean_x @ post, pre, notes)

    def predict(self, x: Tensor) -> Tensor:
        """Return the outputs [N, 3] at basis functions [N, J]."""
        return x @ self.coefficients + self.intercept


class RegressionKind(Config, ABC):
    """A way to find coefficients."""

    @abstractmethod
    def fit(self, data: Regression) -> Fit:
        """Return the coefficients that fit the regression's samples.

        Raises:
            FitError: where the data do not determine them.
        """


class _ScaledRegression(RegressionKind):
    """An estimator that runs on scaled columns and outputs."""

    @abstractmethod
    def estimator(self) -> Estimator:
        """Return the estimator; columns are scaled already."""

    @abstractmethod
    def chosen(self, choice: dict[str, Any], notes: dict[str, Any]) -> dict[str, Any]:
        """Return what to report of a solution's choice and notes."""

    def fixed(self) -> bool:
        """Return whether nothing is left to choose, so that folds do not matter."""
        return False

    @final
    def fit(self, data: Regression) -> Fit:
        """Return the coefficients; see `RegressionKind.fit`."""
        e, f, *_ = data.standardised
        groups = None if self.fixed() else data.fold
        first = self.estimator().fit(e, f, groups, names=data.terms, outputs=_FORCES)[0]
        out = Fit.from_pre(data, first.coefficients, self.chosen(first.choice, first.notes))
        return replace(out, orders=self.over_orders(data))

    def over_orders(self, data: Regression) -> OrderErrors | None:
        """Return the errors over all orders; None for an estimator without an order."""
        return None


@final
class PlsrRegression(_ScaledRegression):
    """PLSR of the three axes together.

    Attributes:
        order: number of latent variables; null takes the least error over left-out folds.
        algorithm: `kernel`, from moments alone, or `nipals`, as the document prints it.
    """

    kind: Literal["plsr"]
    order: int | None = Field(default=None, ge=1)
    algorithm: Literal["kernel", "nipals"] = "kernel"

    def estimator(self) -> Estimator:
        """Return PLSR on scaled columns, every segment a fold."""
        return PLSR(self.order, max_order=None, folds=None, scale=False, algorithm=self.algorithm)

    def fixed(self) -> bool:
        """Return whether the order is given."""
        return self.order is not None

    def chosen(self, choice: dict[str, Any], notes: dict[str, Any]) -> dict[str, Any]:
        """Return the order, the number of latent variables.

        Raises:
            FitError: where it is 0.
        """
        if choice["order"] == 0:
            raise FitError("PLSR: nothing in the residual varies with the basis functions")
        return choice

    def over_orders(self, data: Regression) -> OrderErrors:
        """Return the errors over all orders (document 002 Figures 4.4, 4.22, 4.42, 5.7)."""
        e, f, mean_x, mean_y, std_y = data.standardised
        folds = data.fold.unique()
        orders, left_out = e.shape[1], torch.full_like(f, torch.nan).repeat(e.shape[1], 1, 1)
        if len(folds) > 1:
            for fold in folds:
                out = data.fold == fold
                left_out[:, out] = _error_by_order(e[~out], f[~out], e[out], f[out], orders)
        test = torch.full((orders, 3), torch.nan, dtype=f.dtype)
        if data.test is not None and len(data.test[0]):
            x, y = data.test
            scaled = (x - mean_x) / data.scale, (y - mean_y) / std_y
            test = _error_by_order(e, f, *scaled, orders).square().mean(1)
        square = std_y.square()
        return OrderErrors(left_out.square().mean(1) * square, test * square)


def _error_by_order(e: Tensor, f: Tensor, x: Tensor, y: Tensor, orders: int) -> Tensor:
    """Return the errors [A, N, 3] at x of a PLSR of f on e, for each order up to `orders`."""
    mean_e, mean_f = e.mean(0), f.mean(0)
    centred = e - mean_e
    path = pls_path(centred.T @ centred, centred.T @ (f - mean_f), orders)
    if len(path) < orders:
        # what is left explains nothing: higher orders change no more
        last = path[-1:] if len(path) else torch.zeros(1, e.shape[1], f.shape[1], dtype=e.dtype)
        path = torch.cat((path, last.expand(orders - len(path), -1, -1)))
    return y - mean_f - (x - mean_e) @ path


@final
class SurfaceRegression(RegressionKind):
    """PLSR of each axis by itself, chosen by surface analysis (document 002 section 4.5.1).

    Attributes:
        choose: `test`, the document's own: the least error on the test half, which then also judges
            it; `simplest`: cross-validation over the folds of the first half and the
            one-standard-error rule; `least`: cross-validation and its bare minimum.
    """

    kind: Literal["surface"]
    choose: Literal["test", "simplest", "least"] = "simplest"

    def fit(self, data: Regression) -> Fit:
        """Return the chosen model of each axis; see `RegressionKind.fit`."""
        x, y, groups = data.x, data.y, data.fold
        estimator = SurfacePLSR("simplest" if self.choose == "simplest" else "least")
        if self.choose == "test":
            if data.test is None:
                raise FitError("surface: choose 'test' needs the test half")
            x, y = torch.cat((x, data.test[0])), torch.cat((y, data.test[1]))
            groups = (torch.arange(len(x)) >= len(data.x)).long()
            estimator = SurfacePLSR("least", test=[1])
        found = estimator.surface(x, y, groups, names=data.terms, outputs=_FORCES)
        best = estimator.chosen(found, x, y, groups)
        pre = best.coefficients * data.x.std(0)[:, None] / data.y.std(0)
        return Fit(best.coefficients, best.intercept, pre, best.choice, found)


@final
class LeastSquaresRegression(_ScaledRegression):
    """Ordinary least squares of the residual force on the basis functions."""

    kind: Literal["ols"]

    def estimator(self) -> Estimator:
        """Return least squares with an intercept."""
        return CentredLeastSquares()

    def chosen(self, choice: dict[str, Any], notes: dict[str, Any]) -> dict[str, Any]:
        """Return the condition number of the scaled columns."""
        return notes


@final
class RidgeRegression(_ScaledRegression):
    """Ridge regression of the residual force on the basis functions.

    Attributes:
        penalty: in units of a scaled column's energy: alpha = penalty * samples in scikit-learn's
            terms; null takes that of the least error over left-out folds.
    """

    kind: Literal["ridge"]
    penalty: float | None = Field(default=None, gt=0)

    def estimator(self) -> Estimator:
        """Return ridge regression with one penalty for all axes."""
        penalties = _PENALTIES if self.penalty is None else (self.penalty,)
        return Ridge(penalties, folds=None, scale=False, shared=True)

    def fixed(self) -> bool:
        """Return whether the penalty is given."""
        return self.penalty is not None

    def chosen(self, choice: dict[str, Any], notes: dict[str, Any]) -> dict[str, Any]:
        """Return the penalty of all axes."""
        return {"penalty": choice["penalty"][0]}


@final
class ShrinkRegression(_ScaledRegression):
    """LASSO or elastic net, cross-validated over the folds; each axis by itself.

    Attributes:
        kind: `lasso`, or `elastic_net`, whose penalty is partly quadratic.
        l1_ratio: share of the absolute penalty in that of the elastic net.
    """

    kind: Literal["lasso", "elastic_net"]
    l1_ratio: float = Field(default=0.5, gt=0, lt=1)

    def estimator(self) -> Estimator:
        """Return scikit-learn's elastic net."""
        return ElasticNet(1.0 if self.kind == "lasso" else self.l1_ratio)

    def chosen(self, choice: dict[str, Any], notes: dict[str, Any]) -> dict[str, Any]:
        """Return the penalty of each axis."""
        return choice


RegressionConfig = Annotated[
    PlsrRegression
    | SurfaceRegression
    | LeastSquaresRegression
    | RidgeRegression
    | ShrinkRegression,
    Field(discriminator="kind"),
]
