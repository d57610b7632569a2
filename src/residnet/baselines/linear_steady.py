"""The simplified speed and steering models of document 003 (sections 2.2, 4.2.1, 4.2.2).

They are identified through steady-state constraints.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor

from residnet.baselines.base import Baseline, IdentifiedConfig, require
from residnet.baselines.regressors import RegressorBaseline
from residnet.core.config import Seconds
from residnet.core.errors import FitError
from residnet.core.samples import Samples
from residnet.regression.least_squares import LeastSquares
from residnet.regression.solutions import Coefficient, Solution


class _Block(NamedTuple):
    """States that one input drives, and the manoeuvres that identify how they settle."""

    states: tuple[str, ...]
    drive: str
    kinds: tuple[str, ...]


class LinearSteadyConfig(IdentifiedConfig):
    """The models u_dot = a u + k tau + c and (v, r)_dot = A (v, r) + B tau + C (eqs. (12), (16)).

    First the steady states of constant-input manoeuvres give x_ss = Phi tau + Phi_bias by least
    squares (eqs. (24), (32)); then x_dot = A (x - Phi tau - Phi_bias) gives A by least squares on
    derivatives (eq. (29)), and B = -A Phi (eq. (28)). Nomoto's models are identified alike.

    Attributes:
        drive: channel that drives surge.
        steer: channel that turns the vessel.
        steering_model: `linear` is (16). `nomoto` is (13), in which sway velocity decays with
            yaw's time constant. `nomoto_sideslip` is (15) with side slip written as sway velocity:
            the yaw rate alone drives sway.
        steady: kinds of manoeuvre with constant input.
        settled: time after the start of a constant manoeuvre from which its samples count as
            steady, s.
        speed: kinds of manoeuvre that identify a.
        steering: kinds of manoeuvre that identify A.
    """

    kind: Literal["linear_steady"] = "linear_steady"
    drive: str = "tau_x"
    steer: str = "tau_n"
    steering_model: Literal["linear", "nomoto", "nomoto_sideslip"] = "linear"
    steady: tuple[str, ...] = ("constant",)
    settled: Seconds = 40.0
    speed: tuple[str, ...] = ("acceleration_deceleration",)
    steering: tuple[str, ...] = ("zigzag", "three_two_one_one")

    def build(self, names: Sequence[str]) -> RegressorBaseline:
        """Return the module, coefficients zero, for channels `names`."""
        require(names, ("u", "v", "r", self.drive, self.steer), "baseline 'linear_steady'")
        rows: dict[str, tuple[str, ...]] = {"v": ("v",)}
        for block in self._blocks():
            rows |= dict.fromkeys(block.states, (*block.states, block.drive, "1"))
        held = () if self._driven("v") else ((1, "v"),)
        return RegressorBaseline([rows[axis] for axis in "uvr"], names, held)

    def solutions(self, baseline: Baseline, samples: Samples) -> list[Solution]:
        """Return the one solution; its notes hold the steady states and Phi.

        Raises:
            FitError: where a kind of manoeuvre that a step needs is absent.
        """
        assert isinstance(baseline, RegressorBaseline)
        rows: dict[str, list[tuple[str, float, float]]] = {}
        phi: dict[str, dict[str, Any]] = {}
        for block in self._blocks():
            steady = self._steady_states(samples, block)
            rows |= dict(zip(block.states, self._rows(samples, block, steady), strict=True))
            phi |= _constraints(block, steady)
        if not self._driven("v"):
            _, slope, error = rows["r"][0]
            rows["v"] = [("v", slope, error)]
        table: list[Coefficient] = []
        terms = baseline.library.terms
        theta = torch.zeros_like(baseline.theta)
        for axis, state in enumerate("uvr"):
            for term, value, error in rows[state]:
                theta[axis, terms.index(term)] = value
                table.append(Coefficient(f"{state}_dot", term, value, error))
        names = ("u", "v", "r", self.drive, self.steer)
        means = self._means(samples, names)
        states = {name: means[:, i].tolist() for i, name in enumerate(names)}
        notes = {"steady_states": states, "steady_constraints": phi}
        return [Solution({}, {"theta": theta}, tuple(table), notes)]

    def _blocks(self) -> list[_Block]:
        """Return the blocks of states that one input drives."""
        speed = _Block(("u",), self.drive, self.speed)
        yaw = _Block(("r",), self.steer, self.steering)
        steering = {
            "linear": [_Block(("v", "r"), self.steer, self.steering)],
            "nomoto": [yaw],
            "nomoto_sideslip": [_Block(("v",), "r", self.steering), yaw],
        }
        return [speed, *steering[self.steering_model]]

    def _driven(self, state: str) -> bool:
        return any(state in block.states for block in self._blocks())

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

    def _means(self, samples: Samples, names: Sequence[str]) -> Tensor:
        """Return the means [n, len(names)] of the settled part of every constant manoeuvre."""
        settled = self._settled(samples)
        present, index = torch.unique(settled.group, return_inverse=True)
        columns = torch.stack([settled.column(name) for name in names], dim=1)
        count = torch.bincount(index).to(columns.dtype)[:, None]
        sums = torch.zeros(present.numel(), columns.shape[1], dtype=columns.dtype)
        return sums.index_add_(0, index, columns) / count

    def _steady_states(self, samples: Samples, block: _Block) -> Solution:
        """Return Phi and Phi_bias [2, n] as the rows of a fit of the steady states."""
        means = self._means(samples, (*block.states, block.drive))
        slope = torch.stack((means[:, -1], torch.ones_like(means[:, -1])), dim=1)
        (steady,) = LeastSquares().fit(
            slope,
            means[:, :-1],
            torch.arange(len(means)),
            names=(block.drive, "1"),
            outputs=block.states,
        )
        return steady

    def _rows(
        self, samples: Samples, block: _Block, steady: Solution
    ) -> list[list[tuple[str, float, float]]]:
        """Return rows of (term, value, standard error) for each state of a block.

        First stands A, then B = -A Phi and -A Phi_bias with propagated errors.
        """
        states, drive = block.states, block.drive
        dynamic = self._dynamic(samples, block.kinds)
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


def _constraints(block: _Block, steady: Solution) -> dict[str, dict[str, Any]]:
    """Return Phi and Phi_bias of each state with their standard errors (Table 1)."""
    return {
        state: {
            "of": block.drive,
            "phi": float(steady.coefficients[0, i]),
            "phi_error": float(steady.errors[0, i]),
            "bias": float(steady.coefficients[1, i]),
            "bias_error": float(steady.errors[1, i]),
        }
        for i, state in enumerate(block.states)
    }


def _product_error(a: Tensor, a_error: Tensor, b: Tensor, b_error: Tensor) -> float:
    """Return the standard error of a.b to first order, errors of a and b being independent."""
    return float(((a * b_error).square() + (b * a_error).square()).sum().sqrt())
