"""Configuration of kernels."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import Field

from residnet.core.config import Config

if TYPE_CHECKING:
    from residnet.regression.kernel import PolynomialKernel, RbfKernel


class RbfConfig(Config):
    """Radial basis functions exp(-|x - x'|^2 / (2 sigma)) of standardised features.

    Attributes:
        kind: name of the kernel.
        sigma: candidate values, in squared standard deviations of a feature (see M5 in
            docs/documents/corrections.md).
        exact: number of samples up to which every sample is a centre (kernel ridge regression).
        landmarks: number of centres for more than `exact` samples (Nystroem method), drawn by
            k-means++ seeding.
        seed: random seed of the landmarks.
    """

    kind: Literal["rbf"] = "rbf"
    sigma: tuple[Annotated[float, Field(gt=0)], ...] = Field(
        default=(3.0, 10.0, 30.0, 100.0, 300.0), min_length=1
    )
    exact: int = Field(default=2000, ge=1, le=10_000)
    landmarks: int = Field(default=300, ge=2, le=5000)
    seed: int = Field(default=0, ge=0)

    def build(self, n_features: int, n_outputs: int = 3) -> RbfKernel:
        """Build the kernel module for a number of features and outputs."""
        from residnet.regression.kernel import RbfKernel

        return RbfKernel(self, n_features, n_outputs)


class PolynomialConfig(Config):
    """Polynomial kernel (slope x'x' + constant)^degree of standardised features.

    Degree 1 is ridge regression.

    Attributes:
        kind: name of the kernel.
        degree: degree p of the polynomial.
        slope: factor theta of the inner product.
        constant: constant c; with 0 the monomials have exactly `degree` factors.
    """

    kind: Literal["polynomial"] = "polynomial"
    degree: int = Field(default=2, ge=1, le=4)
    slope: float = Field(default=1.0, gt=0)
    constant: float = Field(default=1.0, ge=0)

    def build(self, n_features: int, n_outputs: int = 3) -> PolynomialKernel:
        """Build the kernel module for a number of features and outputs."""
        from residnet.regression.kernel import PolynomialKernel

        return PolynomialKernel(self, n_features, n_outputs)
