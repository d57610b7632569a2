"""Regressors by name: products of channels and of functions of one channel.

Names are such as `u|u|`, `v |r|`, `n^2 sin(delta)` or `1`. One library serves hulls, baselines
(hydrodynamic derivatives) and closed-form heads (basis functions), so that a name means the same
number everywhere.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from itertools import combinations, combinations_with_replacement, product
from typing import Any, NamedTuple

import torch
from pydantic import Field
from torch import Tensor, nn

from residnet.core.config import Config
from residnet.core.errors import ConfigError
from residnet.core.names import VELOCITY, nearest

FUNCTIONS = ("sin", "cos", "sqrt", "ssqrt", "inv")
"""Functions of one channel: sine, cosine, the protected square root sqrt|x|, the sign-preserving
one sign(x) sqrt|x|, and the protected inverse, 1/x and 0 at x = 0 (document 001, section 2.4:
protected division and square root).
"""
EVEN_FUNCTIONS = ("cos", "sqrt")
"""Functions that keep their value when their channel changes sign; the others change sign with it.
"""

_FACTOR = re.compile(
    r"\s*(?:\|(?P<magnitude>\w+)\||(?P<function>[a-z]+)\((?P<inner>\w+)\)"
    r"|(?P<name>[A-Za-z_]\w*)|(?P<one>1))(?:\^(?P<power>-?[1-9]))?\s*\*?"
)


class Factor(NamedTuple):
    """One factor of a term: a channel, its magnitude or a function of it, to a whole power."""

    name: str
    magnitude: bool
    power: int
    function: str = ""

    @property
    def symbol(self) -> str:
        """The channel, or the function of it, without magnitude and power."""
        return f"{self.function}({self.name})" if self.function else self.name

    @property
    def text(self) -> str:
        """The factor as a term has it."""
        base = f"|{self.name}|" if self.magnitude else self.symbol
        return base if self.power == 1 else f"{base}^{self.power}"


def parse_term(term: str, names: Sequence[str], *, functions: bool = True) -> tuple[Factor, ...]:
    """Return the factors of a term.

    Args:
        term: product of channels; factors stand apart by spaces, `*` or the bars of a magnitude;
            `^2` is a power; `1` the constant; `^-1` divides, for channels that stay away from zero,
            such as `wind_mag`; `sin(delta)` is one of `FUNCTIONS`.
        functions: whether functions may appear.

    Raises:
        ConfigError: where the text cannot be read or names an unknown channel.
    """
    if not term.strip():
        raise ConfigError("a term is empty; write '1' for the constant")
    factors: list[Factor] = []
    position = 0
    while position < len(term):
        match = _FACTOR.match(term, position)
        if match is None or match.end() == position:
            raise ConfigError(
                f"term '{term}': cannot read it from '{term[position:]}'; write a product such as"
                " 'u|u|', 'v r' or 'n^2 delta'"
            )
        position = match.end()
        if match["one"]:
            continue
        name = match["magnitude"] or match["inner"] or match["name"]
        function, power = match["function"] or "", int(match["power"] or 1)
        if function and (not functions or function not in FUNCTIONS):
            hint = (
                nearest(function, FUNCTIONS)
                if functions
                else "; only products of channels have a place here"
            )
            raise ConfigError(f"term '{term}': no function '{function}'{hint}")
        if name not in names:
            raise ConfigError(f"term '{term}': no channel '{name}'{nearest(name, names)}")
        if function and power < 0:
            raise ConfigError(
                f"term '{term}': cannot divide by {function}({name}), which may be zero"
            )
        factors.append(Factor(name, match["magnitude"] is not None, power, function))
    return tuple(factors)


def read_rows(
    rows: Mapping[Any, Iterable[str]], names: Sequence[str], *, functions: bool = True
) -> list[tuple[str, str, tuple[Factor, ...]]]:
    """Return (axis, term, its factors) of all terms of all axes, as a config gives them.

    Raises:
        ValueError: where a term cannot be read, names an unknown channel or divides.
    """
    out = []
    for axis, row in rows.items():
        for term in row:
            try:
                factors = parse_term(term, names, functions=functions)
            except ConfigError as error:
                raise ValueError(f"{axis}: {error}") from None
            if any(factor.power < 0 for factor in factors):
                raise ValueError(f"{axis}: term '{term}' divides by what may be zero")
            out.append((axis, term, factors))
    return out


def polynomial_terms(
    names: Sequence[str], degree: int, *, magnitudes: Sequence[str] = ()
) -> tuple[str, ...]:
    """Return all products of `names` up to `degree`, without the constant.

    Behind them stands x|x| of every name in `magnitudes`.
    """
    out = [
        " ".join(c) for d in range(1, degree + 1) for c in combinations_with_replacement(names, d)
    ]
    return tuple(out + [f"{name}|{name}|" for name in magnitudes])


class TermLibrary(nn.Module):
    """The values [..., J] of J terms from channels [..., nz].

    Every term is a product of columns of [1, z, |z|, 1/z, functions of z], gathered by index, so
    that the number of tensor operations is the largest number of factors and not the number of
    terms; 1/z and each function are there for the channels that need them.
    """

    def __init__(self, terms: Sequence[str], names: Sequence[str]) -> None:
        super().__init__()
        self.terms = tuple(terms)
        parsed = [parse_term(term, names) for term in terms]
        plain = [(name, bars, "") for bars in (False, True) for name in names]
        further = {
            (f.name, f.function or "1/")
            for factors in parsed
            for f in factors
            if f.function or f.power < 0
        }
        base = {key: i + 1 for i, key in enumerate(plain)}
        # the first one stands for nothing: TorchScript takes no empty list
        self.further = [("", 0)]
        for name, function in sorted(further):
            base[name, False, function] = len(base) + 1
            self.further.append((function, names.index(name)))
        columns = [
            [index for factor in factors for index in _columns(factor, base)] for factors in parsed
        ]
        self.count, self.depth = len(columns), max([len(column) for column in columns], default=0)
        padded = [column + [0] * (self.depth - len(column)) for column in columns]
        gather = torch.tensor(padded, dtype=torch.long).reshape(self.count, self.depth).T
        self.index = nn.Buffer(gather.contiguous(), persistent=False)
        # a linear model has the channels alone for terms
        self.linear = self.count > 0 and all(
            len(column) == 1 and 0 < column[0] <= len(names) for column in columns
        )
        channel = gather[0] - 1 if self.linear else gather.new_zeros(0)
        self.channel = nn.Buffer(channel, persistent=False)
        self.same = self.linear and channel.tolist() == list(range(len(names)))

    def forward(self, z: Tensor) -> Tensor:
        """Return the terms [..., J] of channels z [..., nz]."""
        if self.linear:
            return z if self.same else z.index_select(-1, self.channel)
        if self.depth == 0:
            # constants need no channel
            return z.new_ones(z.shape[:-1] + (self.count,))  # noqa: RUF005 (TorchScript)
        parts = [torch.ones_like(z[..., :1]), z, z.abs()]
        for function, channel in self.further:
            if function != "":
                parts.append(_function(function, z.narrow(-1, channel, 1)))
        base = torch.cat(parts, dim=-1)
        out = base.index_select(-1, self.index[0])
        for d in range(1, self.depth):
            out = out * base.index_select(-1, self.index[d])
        return out


def _function(name: str, x: Tensor) -> Tensor:
    """Return one of `FUNCTIONS` of x, or 1/x, any shape."""
    if name == "sin":
        return torch.sin(x)
    if name == "cos":
        return torch.cos(x)
    # where |x| is below the clamp, the slope of the root stays finite
    if name == "sqrt":
        return torch.sqrt(x.abs().clamp(min=1e-24))
    if name == "ssqrt":
        return x.sign() * torch.sqrt(x.abs().clamp(min=1e-24))
    if name == "inv":
        # zero stays zero, and its gradient finite
        return torch.where(x == 0, x, torch.where(x == 0, torch.ones_like(x), x).reciprocal())
    return x.reciprocal()


def _columns(factor: Factor, base: Mapping[tuple[str, bool, str], int]) -> list[int]:
    """Return the columns whose product is the factor."""
    if factor.power > 0:
        return [base[factor.name, factor.magnitude, factor.function]] * factor.power
    inverse = base[factor.name, False, "1/"]
    # 1/|z| = |z| / z^2
    bars = [base[factor.name, True, ""], inverse] if factor.magnitude else []
    return [*bars, inverse] * -factor.power


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
            as in `u^2 delta`, and squares of one times another as in `n|n| delta`. There are ratios
            too, products of motions over an input and one input over another; a head takes those
            whose divisor stays `clear` of zero in its data.
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
            return _of_ships(motions, inputs, magnitudes=self.magnitudes)
        degree = 1 if self.input_degree is None else self.input_degree
        coupled = _products(self.coupling, self.coupling_degree if self.coupling else 0)
        return _joined(coupled, _products(inputs, degree))

    def clear(self, terms: Sequence[str], names: Sequence[str], z: Tensor) -> Tensor:
        """Return which terms [J] divide by nothing near zero, or are named under `extra`.

        Args:
            z: channels in the data [N, nz].
        """
        far = z.amin(0) * z.amax(0) > 0
        far &= z.abs().amin(0) >= _CLEAR * z.abs().amax(0)
        near = {name for name, good in zip(names, far.tolist(), strict=True) if not good}
        return torch.tensor(
            [
                term in self.extra
                or not any(f.function == "inv" and f.name in near for f in parse_term(term, names))
                for term in terms
            ]
        )


_CLEAR = 0.1
"""Least share of a channel's largest value that a divisor keeps: noise of a hundredth of that value
then changes the quotient by a tenth at most.
"""


def _of_ships(motions: Sequence[str], inputs: Sequence[str], *, magnitudes: bool) -> list[str]:
    """Return what propellers and rudders add to an equation: thrust, lift in their flow, ratios."""
    speed = [name for name in motions if name == "u"]
    first, second = (_products(speed, degree, magnitudes=magnitudes) for degree in (1, 2))
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
    ratios = [
        f"{above} inv({name})".strip()
        for name in inputs
        for above in (*_products(motions, 2), *(other for other in inputs if other != name))
    ]
    return ["", *_joined(second, one), *_joined(first, pairs), *squares, *ratios]


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
                        Factor(name, bars, chosen.count((name, bars))).text
                        for name, bars in dict.fromkeys(chosen)
                    )
                )
    return out
