"""Successive linear programming with penalties: least time, and what is asked is missed dearly.

Source: R. Fletcher and E. Sainz de la Maza, Nonlinear programming and nonsmooth optimization by
successive linear programming, Mathematical Programming 43, 1989.
"""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.optimize import linprog, minimize

from residnet.control.courses.turns import Array

_ROUNDS = 45
_LOOKED = 8
"""Steps after which the problem looks anew what it has to keep to."""
_SETTLED = 2e-2
"""Gain that a step promises below which none is made."""
_REACH = (5e-4, 0.3, 1.0)
"""Least, first and largest reach of a step."""
_HELD = (0.05, 0.3, 0.7)
"""Shares of the promised gain: from which a step is made, shortened below, lengthened above."""

_BENT = (0.5, 25)
"""Largest reach of all steps of quadratic programs, and how many there are at most."""


class Linear(NamedTuple):
    """A problem at z, and how it changes with it.

    Attributes:
        cost: to make small.
        slope: derivatives [nz] of it.
        values: what must not be negative [m].
        rows: derivatives [m, nz] of these.
        price: of one that they are negative by [m].
        even: what must vanish [e].
        level: derivatives [e, nz] of these.
        dear: price of one that they differ from zero by.
        fixed: which of z stay [nz].
    """

    cost: float
    slope: Array
    values: Array
    rows: Array
    price: Array
    even: Array
    level: Array
    dear: float
    fixed: NDArray[np.bool_]

    def merit(self) -> float:
        """Return the cost, and what is missed at its price."""
        missed = float((self.price * np.maximum(-self.values, 0.0)).sum())
        return self.cost + missed + self.dear * float(np.abs(self.even).sum())


class Problem(Protocol):
    """A smooth cost over z [nz] with bounds, equations, and values that must not be negative."""

    def least(self) -> Array:
        """Return the smallest z [nz]."""

    def most(self) -> Array:
        """Return the largest z [nz]."""

    def linear(self, z: Array) -> Linear:
        """Return the problem as it is linear at z."""

    def look(self, z: Array) -> None:
        """Look anew what must not be negative near z."""


def descend(problem: Problem, z: Array) -> Array:
    """Return the z of least merit near a start.

    A step solves the problem as it is linear there, within a reach that follows how well this
    holds. What is asked may be missed by a step, so that there always is one. Where the problem
    bends too much for a step, it is corrected once for what that step has missed.
    """
    reach, least, most = _REACH[1], problem.least(), problem.most()
    problem.look(z)
    here = problem.linear(z)
    for number in range(1, _ROUNDS + 1):
        if number % _LOOKED == 0:
            problem.look(z)
            here = problem.linear(z)
        low, high = np.maximum(least - z, -reach), np.minimum(most - z, reach)
        low[here.fixed] = high[here.fixed] = 0.0
        step, promised = _step(here, low, high)
        if promised < _SETTLED:
            break
        after, there, gained = _tried(problem, here, z, step)
        if gained < _HELD[0] * promised:
            bent = here._replace(
                values=there.values - here.rows @ (after - z),
                even=there.even - here.level @ (after - z),
            )
            corrected, _ = _step(bent, low, high)
            other, elsewhere, more = _tried(problem, here, z, corrected)
            if more > gained:
                after, there, gained = other, elsewhere, more
        size = float(np.abs(after - z).max())
        if gained > _HELD[0] * promised:
            z, here = after, there
        if gained < _HELD[1] * promised:
            reach = 0.4 * min(reach, size)
        elif gained > _HELD[2] * promised:
            reach = min(2.0 * reach, _REACH[2])
        if reach < _REACH[0]:
            break
    problem.look(z)
    return z


def polished(problem: Problem, z: Array) -> Array:
    """Return the z of least cost near an end of `descend`, or that end where none is found.

    Linear programs creep where less is asked than z has parts, because the cost bends there.
    Quadratic ones (SLSQP) see the bend. What is far from being missed is left out.
    """
    first = problem.linear(z)
    low = np.maximum(problem.least(), z - _BENT[0])
    high = np.minimum(problem.most(), z + _BENT[0])
    low[first.fixed] = high[first.fixed] = z[first.fixed]
    kept = first.values < np.abs(first.rows).max(axis=1, initial=0.0) * _BENT[0]
    conditions: list[Any] = [
        {
            "type": "ineq",
            "fun": lambda x: problem.linear(x).values[kept],
            "jac": lambda x: problem.linear(x).rows[kept],
        }
    ]
    if len(first.even):
        conditions.append(
            {
                "type": "eq",
                "fun": lambda x: problem.linear(x).even,
                "jac": lambda x: problem.linear(x).level,
            }
        )
    # its types know no conditions with derivatives
    solve: Any = minimize
    found = solve(
        lambda x: (problem.linear(x).cost, problem.linear(x).slope),
        z,
        jac=True,
        method="SLSQP",
        bounds=np.stack((low, high), axis=-1),
        constraints=conditions,
        options={"maxiter": _BENT[1], "ftol": 1e-4},
    )
    after = np.clip(found.x, low, high)
    better = problem.linear(after).merit() < first.merit()
    problem.look(after if better else z)
    return after if better else z


def _tried(problem: Problem, here: Linear, z: Array, step: Array) -> tuple[Array, Linear, float]:
    """Return where a step leads to, the problem there, and the merit gained."""
    after = np.clip(z + step, problem.least(), problem.most())
    there = problem.linear(after)
    return after, there, here.merit() - there.merit()


def _step(here: Linear, low: Array, high: Array) -> tuple[Array, float]:
    """Return the best step within bounds where all is linear, and the merit that it promises."""
    # what cannot become negative within the bounds is left out
    kept = here.values < np.abs(here.rows) @ np.maximum(-low, high)
    rows, values = here.rows[kept], here.values[kept]
    size, count, both = len(low), len(values), len(here.even)
    upper = sparse.hstack(
        (sparse.csr_array(-rows), -sparse.eye_array(count), sparse.csr_array((count, 2 * both)))
    )
    one = sparse.eye_array(both)
    equal = sparse.hstack(
        (sparse.csr_array(here.level), sparse.csr_array((both, count)), one, -one)
    )
    missed = np.tile([0.0, np.inf], (count + 2 * both, 1))
    # its types know no sparse arrays
    solve: Any = linprog
    found = solve(
        np.concatenate((here.slope, here.price[kept], np.full(2 * both, here.dear))),
        upper if count else None,
        values if count else None,
        equal if both else None,
        -here.even if both else None,
        np.concatenate((np.stack((low, high), axis=-1), missed)),
        method="highs",
    )
    if found.x is None:
        return np.zeros(size), 0.0
    return found.x[:size], here.merit() - here.cost - float(found.fun)
