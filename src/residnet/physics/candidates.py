"""Candidate terms of an equation, put together from motions and inputs.

Motions multiply motions, inputs multiply inputs, and only what is named couples the two.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import combinations, combinations_with_replacement, product
from typing import NamedTuple

from pydantic import Field

from residnet.core.config import Config
from residnet.core.errors import ConfigError
from residnet.core.names import VELOCITY, nearest
from residnet.physics.terms import parse_term


class Candidate(NamedTuple):
    """A candidate term with its degree and how complicated it is among those of its degree.

    A function counts as one degree.
    """

    term: str
    degree: int
    effort: float


class CandidatesConfig(Config):
    """Which terms an equation may have.

    The candidates are all products of motions (with any factor as its magnitude), and all products
    of inputs times products of coupled motions times the sine or cosine of an angle or neither.
    Document 000 eqs. (6.21)-(6.23): inputs rpm up to degree 2, coupled with u up to degree 2, angle
    nozzle.

    Attributes:
        motions: channels of the motion that the model has; those that it lacks are left out.
        motion_degree: highest degree of their products.
        magnitudes: whether factors also stand as magnitudes, as in `u|u|`.
        inputs: channels whose products enter; None: all that are neither motions nor angles.
        input_degree: highest degree of their products, all factors plain; None: 1 where `coupling`
            is given, otherwise what propellers and rudders need: the first and second degree with
            magnitudes as in `n|n|`, times u and |u|, those of one input also times u^2 and `u|u|`
            as in `u^2 delta`, and squares of one times another as in `n|n| delta`.
        angles: inputs that enter as sine and cosine.
        coupling: motions that products of inputs are multiplied by.
        coupling_degree: highest degree of these factors.
        extra: further terms by name.
    """

    motions: tuple[str, ...] = VELOCITY
    motion_degree: int = Field(default=2, ge=0, le=4)
    magnitudes: bool = True
    inputs: tuple[str, ...] | None = None
    input_degree: int | None = Field(default=None, ge=0, le=4)
    angles: tuple[str, ...] = ()
    coupling: tuple[str, ...] = ()
    coupling_degree: int = Field(default=1, ge=1, le=4)
    extra: tuple[str, ...] = ()

    def candidates(self, names: Sequence[str]) -> tuple[Candidate, ...]:
        """Return the candidates for a model with channels `names`, simplest first in each degree.

        Raises:
            ConfigError: where a channel is named that the model lacks.
        """
        motions = [name for name in self.motions if name in names]
        angles = list(self.angles)
        inputs = (
            [n for n in names if n not in motions and n not in angles]
            if self.inputs is None
            else list(self.inputs)
        )
        for name in (*angles, *inputs, *self.coupling):
            if name not in names:
                raise ConfigError(
                    f"candidates: '{name}' is not a channel of the model{nearest(name, names)}"
                )
        flows = _products(motions, self.motion_degree, magnitudes=self.magnitudes)
        turns = ["", *(f"{function}({angle})" for angle in angles for function in ("sin", "cos"))]
        texts = [*flows, *_joined(self._driven(motions, inputs), turns), *self.extra]
        return rated(dict.fromkeys(text or "1" for text in texts), names)

    def _driven(self, motions: Sequence[str], inputs: Sequence[str]) -> list[str]:
        """Return the products of inputs and coupled motions."""
        if self.input_degree is None and not self.coupling:
            return _of_ships("u" if "u" in motions else "", inputs, magnitudes=self.magnitudes)
        degree = 1 if self.input_degree is None else self.input_degree
        coupled = _products(self.coupling, self.coupling_degree if self.coupling else 0)
        return _joined(coupled, _products(inputs, degree))


def _of_ships(speed: str, inputs: Sequence[str], *, magnitudes: bool) -> list[str]:
    """Return what propellers and rudders add to an equation: thrust, and lift in their flow."""
    first, second = (
        _products([speed] if speed else [], degree, magnitudes=magnitudes) for degree in (1, 2)
    )
    one = [t for name in inputs for t in _products([name], 2, magnitudes=magnitudes)[1:]]
    pairs = [
        t
        for a, b in combinations(inputs, 2)
        for t in _joined(
            _products([a], 1, magnitudes=magnitudes)[1:],
            _products([b], 1, magnitudes=magnitudes)[1:],
        )
    ]
    squares = [
        f"{square} {other}"
        for name in inputs
        for square in ([f"{name}^2", f"{name} |{name}|"] if magnitudes else [f"{name}^2"])
        for other in inputs
        if other != name
    ]
    return ["", *_joined(second, one), *_joined(first, pairs), *squares]


def _joined(*choices: Sequence[str]) -> list[str]:
    """Return the products of one text out of each list."""
    return [" ".join(part for part in parts if part) for parts in product(*choices)]


def rated(terms: Iterable[str], names: Sequence[str]) -> tuple[Candidate, ...]:
    """Return the terms with degree and effort, by degree and then by effort.

    Raises:
        ConfigError: where a term cannot be read.
    """
    out = []
    for term in terms:
        factors = parse_term(term, names)
        degree = sum(abs(factor.power) for factor in factors)
        effort = len({factor.name for factor in factors}) + sum(
            0.5 * f.magnitude + 0.75 * bool(f.function) + (f.power < 0) for f in factors
        )
        out.append(Candidate(term, degree, effort))
    return tuple(sorted(out, key=lambda candidate: candidate[1:]))


def _products(names: Sequence[str], degree: int, *, magnitudes: bool = False) -> list[str]:
    """Return the products up to a degree, the empty one first.

    Of one channel's factors at most one stands as a magnitude, since |x|^2 is x^2.
    """
    symbols = [(name, False) for name in names] + (
        [(name, True) for name in names] if magnitudes else []
    )
    out = []
    for d in range(degree + 1):
        for chosen in combinations_with_replacement(symbols, d):
            if all(chosen.count((name, True)) <= 1 for name in names):
                out.append(
                    " ".join(
                        _power(name, bars, chosen.count((name, bars)))
                        for name, bars in dict.fromkeys(chosen)
                    )
                )
    return out


def _power(name: str, bars: bool, power: int) -> str:
    symbol = f"|{name}|" if bars else name
    return symbol if power == 1 else f"{symbol}^{power}"
