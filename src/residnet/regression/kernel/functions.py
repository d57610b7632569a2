"""Kernels on standardised inputs, and how each is fitted and evaluated."""

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
    """A function f(x) [..., n] of inputs [..., F]: features of a kernel times coefficients."""

    @abstractmethod
    def forward(self, x: Tensor) -> Tensor:
        """Return f [..., n] at inputs x [..., F]."""

    @abstractmethod
    def paths(
        self, x: Tensor, y: Tensor, fold: Tensor, folds: int, penalties: Sequence[float]
    ) -> list[Path]:
        """Return fits with absolute penalties, one path for each setting of the kernel.

        Args:
            x: inputs [N, F].
            y: outputs [N, n].
            fold: number of each sample's fold [N].
            folds: how many there are.
            penalties: lambda, absolute, positive.
        """

    @abstractmethod
    def features(self, path: Path, x: Tensor) -> Tensor:
        """Return the features [..., P] that the coefficients of a path belong to."""

    @abstractmethod
    def selected(
        self, paths: Sequence[Path], coefficients: Tensor
    ) -> tuple[dict[str, Any], dict[str, Tensor]]:
        """Return the settings of each output's path, and the state with coefficients [P, n]."""

    @abstractmethod
    def zero_state(self) -> dict[str, Tensor]:
        """Return the state of the function that is zero."""


@final
class RbfKernel(Kernel):
    """A sum of radial basis functions, f_k(x) = sum_i c_ik exp(-gamma_k |x - x_i|^2).

    gamma = 1 / (2 sigma) (document 001 section 3.2, correction M5: sigma is a squared length).
    """

    def __init__(self, config: Rbf, count: int, outputs: int = 3) -> None:
        super().__init__()
        self.sigmas = config.sigma
        self.exact = config.exact
        self.landmarks = config.landmarks
        self.seed = config.seed
        self.outputs = outputs
        self.register_buffer("points", torch.zeros(0, count, dtype=torch.float64))
        self.register_buffer("gamma", torch.ones(outputs, dtype=torch.float64))
        self.register_buffer("coefficients", torch.zeros(0, outputs, dtype=torch.float64))
        self.points: Tensor
        self.gamma: Tensor
        self.coefficients: Tensor

    def forward(self, x: Tensor) -> Tensor:
        """Return f [..., n] at inputs x [..., F]."""
        apart = squared_distances(x, self.points.to(x.dtype))
        out: list[Tensor] = []
        for output in range(self.outputs):
            out.append(
                torch.exp(-self.gamma[output].to(x.dtype) * apart)
                @ self.coefficients[:, output].to(x.dtype)
            )
        return torch.stack(out, dim=-1)

    def paths(
        self, x: Tensor, y: Tensor, fold: Tensor, folds: int, penalties: Sequence[float]
    ) -> list[Path]:
        """Return one path for each sigma; see `Kernel.paths`.

        It is exact where there are no more than `exact` samples, else by Nystroem's method on
        landmarks.
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

            path = primal_path(features, whiten, x, y, fold, folds, penalties)
            out.append(replace(path, sigma=sigma, points=points))
        return out

    def features(self, path: Path, x: Tensor) -> Tensor:
        """Return the kernel between x and the points that carry the function."""
        return torch.exp(-squared_distances(x, path.points) / (2 * path.sigma))

    def selected(
        self, paths: Sequence[Path], coefficients: Tensor
    ) -> tuple[dict[str, Any], dict[str, Tensor]]:
        """Return sigma of each output, and the points, gamma and coefficients."""
        sigma = [path.sigma for path in paths]
        gamma = torch.tensor([0.5 / value for value in sigma], dtype=torch.float64)
        state = {"points": paths[0].points, "gamma": gamma, "coefficients": coefficients}
        return {"sigma": sigma}, state

    def zero_state(self) -> dict[str, Tensor]:
        """Return a state without landmarks."""
        count = self.points.shape[1]
        return {
            "points": torch.zeros(0, count, dtype=torch.float64),
            "gamma": torch.ones(self.outputs, dtype=torch.float64),
            "coefficients": torch.zeros(0, self.outputs, dtype=torch.float64),
        }

    def _load_from_state_dict(self, state_dict: dict[str, Tensor], prefix: str, *rest: Any) -> None:
        # how many samples carry the function is known only from the data
        for name in ("points", "coefficients"):
            stored = state_dict.get(prefix + name)
            if stored is not None:
                present = getattr(self, name)
                empty = torch.zeros(stored.shape, dtype=present.dtype, device=present.device)
                setattr(self, name, empty)
        super()._load_from_state_dict(state_dict, prefix, *rest)


@final
class PolynomialKernel(Kernel):
    """The kernel (slope x'x' + constant)^degree (document 001 section 3.2).

    It is fitted as the ridge regression on weighted products that it equals. The products are
    finitely many, so that any number of samples is fitted exactly.
    """

    def __init__(self, config: Polynomial, count: int, outputs: int = 3) -> None:
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
        self.register_buffer("coefficients", torch.zeros(len(chosen), outputs, dtype=torch.float64))
        self.slope, self.constant = config.slope**0.5, config.constant**0.5
        self.index: Tensor
        self.weight: Tensor
        self.coefficients: Tensor

    def products(self, x: Tensor) -> Tensor:
        """Return the weighted products [..., P] of inputs [..., F], whose inner product it is."""
        joined = torch.cat((torch.full_like(x[..., :1], self.constant), x * self.slope), dim=-1)
        out = self.weight.to(x.dtype) * joined.index_select(-1, self.index[0])
        for i in range(1, self.degree):
            out = out * joined.index_select(-1, self.index[i])
        return out

    def forward(self, x: Tensor) -> Tensor:
        """Return f [..., n] at inputs x [..., F]."""
        return self.products(x) @ self.coefficients.to(x.dtype)

    def paths(
        self, x: Tensor, y: Tensor, fold: Tensor, folds: int, penalties: Sequence[float]
    ) -> list[Path]:
        """Return a single path, exact for any number of samples; see `Kernel.paths`."""
        identity = torch.eye(len(self.coefficients), dtype=torch.float64)
        return [primal_path(self.products, identity, x, y, fold, folds, penalties)]

    def features(self, path: Path, x: Tensor) -> Tensor:
        """Return the products [N, J] of inputs x [N, F]; they are the same for every path."""
        return self.products(x)

    def selected(
        self, paths: Sequence[Path], coefficients: Tensor
    ) -> tuple[dict[str, Any], dict[str, Tensor]]:
        """Return no settings, and the coefficients."""
        return {}, {"coefficients": coefficients}

    def zero_state(self) -> dict[str, Tensor]:
        """Return coefficients of zero."""
        return {"coefficients": torch.zeros_like(self.coefficients)}


class Rbf(Config):
    """The radial basis functions exp(-|x - x'|^2 / (2 sigma)) of standardised features.

    Attributes:
        kind: name of the kernel.
        sigma: candidates, in squared standard deviations of a feature (correction M5).
        exact: number of samples up to which all of them carry the function, as in kernel ridge
            regression; with more, landmarks do.
        landmarks: number of samples that carry the function where there are more than `exact`
            (Nystroem's method), spread out by k-means++ seeding.
        seed: seed of the choice of landmarks.
    """

    kind: Literal["rbf"] = "rbf"
    sigma: tuple[Annotated[float, Field(gt=0)], ...] = Field(
        default=(3.0, 10.0, 30.0, 100.0, 300.0), min_length=1
    )
    exact: int = Field(default=2000, ge=1, le=10_000)
    landmarks: int = Field(default=300, ge=2, le=5000)
    seed: int = Field(default=0, ge=0)

    def build(self, count: int, outputs: int = 3) -> RbfKernel:
        """Return the module for `count` features and a number of outputs."""
        return RbfKernel(self, count, outputs)


class Polynomial(Config):
    """The polynomial kernel (slope x'x' + constant)^degree of standardised features.

    Degree 1 is ridge regression.

    Attributes:
        kind: name of the kernel.
        degree: degree p of the polynomial.
        slope: factor theta of the inner product.
        constant: constant c; with 0 only products of exactly `degree` features are left.
    """

    kind: Literal["polynomial"] = "polynomial"
    degree: int = Field(default=2, ge=1, le=4)
    slope: float = Field(default=1.0, gt=0)
    constant: float = Field(default=1.0, ge=0)

    def build(self, count: int, outputs: int = 3) -> PolynomialKernel:
        """Return the module for `count` features and a number of outputs."""
        return PolynomialKernel(self, count, outputs)


def squared_distances(x: Tensor, points: Tensor) -> Tensor:
    """Return |x - x_i|^2 [..., M] between inputs [..., F] and points [M, F]."""
    square = (x * x).sum(-1, keepdim=True) + (points * points).sum(-1)
    return (square - 2.0 * (x @ points.T)).clamp(min=0.0)


def spread_out(x: Tensor, count: int, seed: int) -> Tensor:
    """Return the indices [count] of samples that lie apart (k-means++).

    Each is drawn with a chance that grows with its squared distance to those before. There are
    fewer than `count` where the samples have no more different values.
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
    """Return the multinomial coefficient of a product of factors given by number."""
    out = factorial(len(chosen))
    for number in set(chosen):
        out //= factorial(chosen.count(number))
    return float(out)
