"""Kernels on standardised features, and how each is fitted and evaluated: radial basis functions
and polynomials.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations_with_replacement
from math import factorial
from typing import Annotated, Any, Literal, final

import torch
from pydantic import Field
from torch import Tensor, nn

from residnet.core.config import Config
from residnet.regression.kernel.path import Path, dual_path, primal_path

_RANK = 1e-12
"""Eigenvalues of the landmarks' kernel below this share of the largest are rounding."""


class Kernel(nn.Module, ABC):
    """f(x) [..., 3] from standardised features [..., F]: raw features of the kernel times
    coefficients.
    """

    @abstractmethod
    def forward(self, x: Tensor) -> Tensor:
        """[..., 3] at features [..., F]."""

    @abstractmethod
    def paths(
        self, x: Tensor, y: Tensor, fold: Tensor, folds: int, penalties: Sequence[float]
    ) -> list[Path]:
        """Fits of targets [N, 3] at features [N, F] with absolute penalties, one path for each
        setting of the kernel.
        """

    @abstractmethod
    def along(self, path: Path, x: Tensor) -> Tensor:
        """Raw features [..., P] that the coefficients of a path belong to, at features [..., F]."""

    @abstractmethod
    def chosen(
        self, paths: Sequence[Path], coefficients: Tensor
    ) -> tuple[dict[str, Any], dict[str, Tensor]]:
        """What there is to say of the path that each axis takes, and the state with coefficients
        [P, 3].
        """

    @abstractmethod
    def nothing(self) -> dict[str, Tensor]:
        """The state of the function that is zero."""


@final
class RbfKernel(Kernel):
    """f_k(x) = sum_i c_ik exp(-gamma_k |x - x_i|^2), gamma = 1 / (2 sigma) (document 001 section
    3.2, ERRATA M5: sigma is a squared length).
    """

    def __init__(self, config: Rbf, count: int) -> None:
        super().__init__()
        self.sigmas = config.sigma
        self.exact = config.exact
        self.landmarks = config.landmarks
        self.seed = config.seed
        self.register_buffer("points", torch.zeros(0, count, dtype=torch.float64))
        self.register_buffer("gamma", torch.ones(3, dtype=torch.float64))
        self.register_buffer("coefficients", torch.zeros(0, 3, dtype=torch.float64))
        self.points: Tensor
        self.gamma: Tensor
        self.coefficients: Tensor

    def forward(self, x: Tensor) -> Tensor:
        """[..., 3] at features [..., F]."""
        apart = squared_distances(x, self.points.to(x.dtype))
        out: list[Tensor] = []
        for axis in range(3):
            out.append(
                torch.exp(-self.gamma[axis].to(x.dtype) * apart)
                @ self.coefficients[:, axis].to(x.dtype)
            )
        return torch.stack(out, dim=-1)

    def paths(
        self, x: Tensor, y: Tensor, fold: Tensor, folds: int, penalties: Sequence[float]
    ) -> list[Path]:
        """One path for each sigma: exact where there are no more than `exact` samples, else by
        Nystroem's method on landmarks.
        """
        if len(x) <= self.exact:
            apart = squared_distances(x, x)
            exact = [
                (sigma, dual_path(torch.exp(-apart / (2 * sigma)), y, fold, folds, penalties))
                for sigma in self.sigmas
            ]
            return [replace(path, sigma=sigma, points=x) for sigma, path in exact]
        points = x[spread_out(x, self.landmarks, self.seed)]
        out = []
        for sigma in self.sigmas:
            values, vectors = torch.linalg.eigh(
                torch.exp(-squared_distances(points, points) / (2 * sigma))
            )
            kept = values > _RANK * values[-1]
            whiten = vectors[:, kept] / values[kept].sqrt()

            def features(part: Tensor, sigma: float = sigma) -> Tensor:
                return torch.exp(-squared_distances(part, points) / (2 * sigma))

            out.append(
                replace(
                    primal_path(features, whiten, x, y, fold, folds, penalties),
                    sigma=sigma,
                    points=points,
                )
            )
        return out

    def along(self, path: Path, x: Tensor) -> Tensor:
        """The kernel between x and the points that carry the function."""
        return torch.exp(-squared_distances(x, path.points) / (2 * path.sigma))

    def chosen(
        self, paths: Sequence[Path], coefficients: Tensor
    ) -> tuple[dict[str, Any], dict[str, Tensor]]:
        """Sigma of each axis, and the points, gamma and coefficients."""
        sigma = [path.sigma for path in paths]
        gamma = torch.tensor([0.5 / value for value in sigma], dtype=torch.float64)
        return {"sigma": sigma}, {
            "points": paths[0].points,
            "gamma": gamma,
            "coefficients": coefficients,
        }

    def nothing(self) -> dict[str, Tensor]:
        """No landmarks."""
        count = self.points.shape[1]
        return {
            "points": torch.zeros(0, count, dtype=torch.float64),
            "gamma": torch.ones(3, dtype=torch.float64),
            "coefficients": torch.zeros(0, 3, dtype=torch.float64),
        }

    def _load_from_state_dict(self, state_dict: dict[str, Tensor], prefix: str, *rest: Any) -> None:
        # how many samples carry the function is known only from the data
        for name in ("points", "coefficients"):
            stored = state_dict.get(prefix + name)
            if stored is not None:
                own = getattr(self, name)
                setattr(self, name, torch.zeros(stored.shape, dtype=own.dtype, device=own.device))
        super()._load_from_state_dict(state_dict, prefix, *rest)


@final
class PolynomialKernel(Kernel):
    """Kernel (slope x'x' + constant)^degree (document 001 section 3.2), as the ridge regression on
    weighted products that it equals.

    The products are finitely many, so that any number of samples is fitted exactly.
    """

    def __init__(self, config: Polynomial, count: int) -> None:
        super().__init__()
        self.degree = config.degree
        chosen = list(combinations_with_replacement(range(count + 1), config.degree))
        self.register_buffer(
            "index", torch.tensor(chosen, dtype=torch.long).T.contiguous(), persistent=False
        )
        self.register_buffer(
            "weight",
            torch.tensor([_weight(c) for c in chosen], dtype=torch.float64).sqrt(),
            persistent=False,
        )
        self.register_buffer("coefficients", torch.zeros(len(chosen), 3, dtype=torch.float64))
        self.slope, self.constant = config.slope**0.5, config.constant**0.5
        self.index: Tensor
        self.weight: Tensor
        self.coefficients: Tensor

    def products(self, x: Tensor) -> Tensor:
        """Weighted products [..., P] of features [..., F], whose inner product is the kernel."""
        joined = torch.cat((torch.full_like(x[..., :1], self.constant), x * self.slope), dim=-1)
        out = self.weight.to(x.dtype) * joined.index_select(-1, self.index[0])
        for i in range(1, self.degree):
            out = out * joined.index_select(-1, self.index[i])
        return out

    def forward(self, x: Tensor) -> Tensor:
        """[..., 3] at features [..., F]."""
        return self.products(x) @ self.coefficients.to(x.dtype)

    def paths(
        self, x: Tensor, y: Tensor, fold: Tensor, folds: int, penalties: Sequence[float]
    ) -> list[Path]:
        """A single path, exact for any number of samples."""
        return [
            primal_path(
                self.products,
                torch.eye(len(self.coefficients), dtype=torch.float64),
                x,
                y,
                fold,
                folds,
                penalties,
            )
        ]

    def along(self, path: Path, x: Tensor) -> Tensor:
        """The products."""
        return self.products(x)

    def chosen(
        self, paths: Sequence[Path], coefficients: Tensor
    ) -> tuple[dict[str, Any], dict[str, Tensor]]:
        """Nothing to say; the coefficients."""
        return {}, {"coefficients": coefficients}

    def nothing(self) -> dict[str, Tensor]:
        """Coefficients of zero."""
        return {"coefficients": torch.zeros_like(self.coefficients)}


class Rbf(Config):
    """Radial basis functions exp(-|x - x'|^2 / (2 sigma)) of standardised features.

    Attributes:
        sigma: candidates, in squared units of a feature's spread (ERRATA M5).
        exact: with no more samples than these all of them carry the function, as in kernel ridge
            regression; with more, landmarks do.
        landmarks: samples that carry the function where there are more than `exact` (Nystroem's
            method), spread out by k-means++ seeding.
        seed: of the choice of landmarks.
    """

    kind: Literal["rbf"] = "rbf"
    sigma: tuple[Annotated[float, Field(gt=0)], ...] = Field(
        default=(3.0, 10.0, 30.0, 100.0, 300.0), min_length=1
    )
    exact: int = Field(default=2000, ge=1, le=10_000)
    landmarks: int = Field(default=300, ge=2, le=5000)
    seed: int = Field(default=0, ge=0)

    def build(self, count: int) -> RbfKernel:
        """The module for `count` features."""
        return RbfKernel(self, count)


class Polynomial(Config):
    """The polynomial kernel (slope x'x' + constant)^degree of standardised features; degree 1 is
    ridge regression.

    Attributes:
        degree: p.
        slope: theta.
        constant: c; with 0 only products of exactly `degree` features are left.
    """

    kind: Literal["polynomial"] = "polynomial"
    degree: int = Field(default=2, ge=1, le=4)
    slope: float = Field(default=1.0, gt=0)
    constant: float = Field(default=1.0, ge=0)

    def build(self, count: int) -> PolynomialKernel:
        """The module for `count` features."""
        return PolynomialKernel(self, count)


def squared_distances(x: Tensor, points: Tensor) -> Tensor:
    """|x - x_i|^2 [..., M] between features [..., F] and points [M, F]."""
    square = (x * x).sum(-1, keepdim=True) + (points * points).sum(-1)
    return (square - 2.0 * (x @ points.T)).clamp(min=0.0)


def spread_out(x: Tensor, count: int, seed: int) -> Tensor:
    """Indices [count] of samples that lie apart: each is drawn with a chance that grows with its
    squared distance to those before (k-means++).

    Fewer than `count` where the samples have no more different values.
    """
    random = torch.Generator().manual_seed(seed)
    first = int(torch.randint(len(x), (1,), generator=random))
    nearest = (x - x[first]).square().sum(-1)
    found = [first]
    while len(found) < count and float(nearest.max()) > 0:
        # by its cumulated sum: multinomial takes no more than 2^24 samples
        total = nearest.cumsum(0)
        draw = torch.rand(1, generator=random, dtype=x.dtype) * total[-1]
        found.append(min(int(torch.searchsorted(total, draw, right=True)), len(x) - 1))
        nearest = torch.minimum(nearest, (x - x[found[-1]]).square().sum(-1))
    return torch.tensor(found)


def _weight(chosen: tuple[int, ...]) -> float:
    """Multinomial coefficient of a product of factors given by number."""
    out = factorial(len(chosen))
    for number in set(chosen):
        out //= factorial(chosen.count(number))
    return float(out)
