"""The linear speed and steering models of document 003 (sections 4.2.1, 4.2.2).

They are identified through steady-state constraints.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import torch
from torch import Tensor

from residnet.baselines.base import Baseline, IdentifiedConfig, require
from residnet.baselines.regressors import RegressorBaseline
from residnet.core.config import Seconds
from residnet.core.errors import FitError
from residnet.core.samples import Samples
from residnet.regression.least_squares import LeastSquares
from residnet.regression.solutions import Coefficient, Solution


class LinearSteadyConfig(IdentifiedConfig):
    """The models u_dot = a u + k tau + c and (v, r)_dot = A (v, r) + B tau + C (eqs. (12), (16)).

    First the steady states of constant-input manoeuvres give x_ss = Phi tau + Phi_bias by least
    squares (eqs. (24), (32)); then x_dot = A (x - Phi tau - Phi_bias) gives A by least squares on
    derivatives (eq. (29)), and B = -A Phi (eq. (28)).

    Attributes:
        drive: channel that drives surge.
        steer: channel that turns the vessel.
        steady: kinds of manoeuvre with constant input.
        settled: time after the start of a constant manoeuvre from which its samples count as
            steady, s.
        speed: kinds of manoeuvre that identify a.
        steering: kinds of manoeuvre that identify A.
    """

    kind: Literal["linear_steady"] = "linear_steady"
    drive: str = "tau_x"
    steer: str = "tau_n"
    steady: tuple[str, ...] = ("constant",)
    settled: Seconds = 40.0
    speed: tuple[str, ...] = ("acceleration_deceleration",)
    steering: tuple[str, ...] = ("zigzag", "three_two_one_one")

    def build(self, names: Sequence[str]) -> RegressorBaseline:
        """Return the module, coefficients zero, for channels `names`."""
        require(names, ("u", "v", "r", self.drive, self.steer), "baseline 'linear_steady'")
        steering = ("v", "r", self.steer, "1")
        return RegressorBaseline([("u", self.drive, "1"), steering, steering], names)

    def solutions(self, baseline: Baseline, samples: Samples) -> list[Solution]:
        """Return the one solution.

        Raises:
            FitError: where a kind of manoeuvre that a step needs is absent.
        """
        assert isinstance(baseline, RegressorBaseline)
        speed = self._block(samples, ("u",), self.drive, self.speed)
        steering = self._block(samples, ("v", "r"), self.steer, self.steering)
        table: list[Coefficient] = []
        terms = baseline.library.terms
        theta = torch.zeros_like(baseline.theta)
        for axis, row in enumerate((*speed, *steering)):
            for term, value, error in row:
                theta[axis, terms.index(term)] = value
                table.append(Coefficient(f"{'uvr'[axis]}_dot", term, value, error))
        return [Solution({}, {"theta": theta}, tuple(table))]

    def require_samples(self, samples: Samples) -> None:
        """Check that there are constant manoeuvres, and those that identify speed and steering.

        Raises:
            FitError: where there are not.
        """
        self._settled(samples)
        for kinds in (self.speed, self.steering):
            self._dynamic(samples, kinds)

    def _settled(self, samples: Samples) -> Samples:
        """Return the samples of constant manoeuvres once their transients have passed."""
        settled = samples.of_kinds(self.steady)
        settled = settled.where(settled.t >= self.settled)
        count = torch.unique(settled.group).numel()
        if count < 3:
            raise FitError(
                "baseline 'linear_steady' needs at least 3 constant-input manoeuvres of kinds"
                f" {list(self.steady)} longer than {self.settled:g} s, the data have {count}; kinds"
                f" in the data: {sorted(set(samples.kinds))}"
            )
        return settled

    def _dynamic(self, samples: Samples, kinds: tuple[str, ...]) -> Samples:
        """Return the samples of some kinds of manoeuvre."""
        dynamic = samples.of_kinds(kinds)
        if len(dynamic) == 0:
            raise FitError(
                f"baseline 'linear_steady' needs manoeuvres of kinds {list(kinds)}; kinds in the"
                f" data: {sorted(set(samples.kinds))}"
            )
        return dynamic

    def _steady_states(self, samples: Samples, states: tuple[str, ...], drive: str) -> Solution:
        """Return Phi and Phi_bias [2, n] as the rows of a fit.

        It is made of the means of the settled part of every constant manoeuvre.
        """
        settled = self._settled(samples)
        present, index = torch.unique(settled.group, return_inverse=True)
        columns = torch.stack([settled.column(name) for name in (*states, drive)], dim=1)
        count = torch.bincount(index).to(columns.dtype)[:, None]
        means = (
            torch.zeros(int(present.numel()), columns.shape[1], dtype=columns.dtype).index_add_(
                0, index, columns
            )
            / count
        )
        slope = torch.stack((means[:, -1], torch.ones_like(means[:, -1])), dim=1)
        (steady,) = LeastSquares().fit(
            slope,
            means[:, :-1],
            torch.arange(int(present.numel())),
            names=(drive, "1"),
            outputs=states,
        )
        return steady

    def _block(
        self, samples: Samples, states: tuple[str, ...], drive: str, kinds: tuple[str, ...]
    ) -> list[list[tuple[str, float, float]]]:
        """Return rows of (term, value, standard error) for each state.

        First stands A, then B = -A Phi and -A Phi_bias with propagated errors.
        """
        steady = self._steady_states(samples, states, drive)
        dynamic = self._dynamic(samples, kinds)
        x = torch.stack([dynamic.column(name) for name in states], dim=1)
        deviation = (
            x - dynamic.column(drive)[:, None] * steady.coefficients[0] - steady.coefficients[1]
        )
        axes = ["uvr".index(name) for name in states]
        (dynamic_fit,) = LeastSquares().fit(
            deviation, dynamic.target[:, axes], dynamic.group, names=states
        )
        a, a_error = dynamic_fit.coefficients.T, dynamic_fit.errors.T
        rows: list[list[tuple[str, float, float]]] = []
        for i in range(len(states)):
            row = [(name, float(a[i, k]), float(a_error[i, k])) for k, name in enumerate(states)]
            for term, phi, phi_error in (
                (drive, steady.coefficients[0], steady.errors[0]),
                ("1", steady.coefficients[1], steady.errors[1]),
            ):
                row.append(
                    (term, float(-(a[i] @ phi)), _product_error(a[i], a_error[i], phi, phi_error))
                )
            rows.append(row)
        return rows


def _product_error(a: Tensor, a_error: Tensor, b: Tensor, b_error: Tensor) -> float:
    """Return the standard error of a.b to first order, errors of a and b being independent."""
    return float(((a * b_error).square() + (b * a_error).square()).sum().sqrt())
