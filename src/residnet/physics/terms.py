"""Regressors by name: products of channels and of functions of one channel.

Names are such as `u|u|`, `v |r|`, `n^2 sin(delta)` or `1`.

One library serves the baselines (hydrodynamic derivatives) and the closed-form heads (basis
functions), so that a name means the same number everywhere.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from residnet.core.derivatives import derivatives_along
from residnet.core.errors import ConfigError
from residnet.core.names import nearest

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


def parse_term(term: str, names: Sequence[str], *, functions: bool = True) -> tuple[Factor, ...]:
    """Return the factors of a term.

    Args:
        term: product of channels; factors stand apart by spaces, `*` or the bars of a magnitude;
            `^2` is a power; `1` the constant; `^-1` divides, for channels that stay away from zero,
            such as `wind_mag`; `sin(delta)` is one of `FUNCTIONS`.
        names: channels that may appear.
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
        name, function, power = (
            match["magnitude"] or match["inner"] or match["name"],
            match["function"] or "",
            int(match["power"] or 1),
        )
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


def polynomial_terms(
    names: Sequence[str], degree: int, *, magnitudes: Sequence[str] = ()
) -> tuple[str, ...]:
    """Return all products of `names` up to `degree`, without the constant.

    Behind them stands x|x| of every name in `magnitudes`.
    """
    from itertools import combinations_with_replacement

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
        base = {
            f: i + 1
            for i, f in enumerate(
                [*((name, False, "") for name in names), *((name, True, "") for name in names)]
            )
        }
        # 1/z first, then the functions in their order: forward() lays its columns out so
        for number, kind in enumerate(("^-1", *FUNCTIONS)):
            used = {
                f.name
                for factors in parsed
                for f in factors
                if (f.function == kind if number else f.power < 0)
            }
            chosen = [i for i, name in enumerate(names) if name in used]
            self.register_buffer(
                f"of_{kind if number else 'divisors'}",
                torch.tensor(chosen, dtype=torch.long),
                persistent=False,
            )
            for i in chosen:
                base[names[i], False, kind] = len(base) + 1
        self.of_divisors: Tensor
        self.of_sin: Tensor
        self.of_cos: Tensor
        self.of_sqrt: Tensor
        self.of_ssqrt: Tensor
        self.of_inv: Tensor
        # where |x| is below, the root is taken of this: its slope stays finite
        self.root_floor = 1e-24
        self.divides = self.of_divisors.numel() > 0
        self.turns = self.of_sin.numel() + self.of_cos.numel() > 0
        self.protects = self.of_sqrt.numel() + self.of_ssqrt.numel() + self.of_inv.numel() > 0
        columns = [
            [index for factor in factors for index in _columns(factor, base)] for factors in parsed
        ]
        self.depth = max([len(column) for column in columns], default=0)
        padded = [column + [0] * (self.depth - len(column)) for column in columns]
        gather = (
            torch.tensor(padded, dtype=torch.long).reshape(len(columns), self.depth).T.contiguous()
        )
        self.register_buffer("index", gather, persistent=False)
        self.index: Tensor
        self.count = len(columns)
        # a linear model has the channels alone for terms
        self.linear = len(columns) > 0 and all(
            len(column) == 1 and 0 < column[0] <= len(names) for column in columns
        )
        channel = gather[0] - 1 if self.linear else gather.new_zeros(0)
        self.register_buffer("channel", channel, persistent=False)
        self.channel: Tensor
        self.same = self.linear and channel.tolist() == list(range(len(names)))

    def forward(self, z: Tensor) -> Tensor:
        """Return the channels z [..., nz] -> terms [..., J]."""
        if self.linear:
            return z if self.same else z.index_select(-1, self.channel)
        ones = torch.ones_like(z[..., :1])
        parts = [ones, z, z.abs()]
        if self.divides:
            parts.append(z.index_select(-1, self.of_divisors).reciprocal())
        if self.turns:
            parts.append(z.index_select(-1, self.of_sin).sin())
            parts.append(z.index_select(-1, self.of_cos).cos())
        if self.protects:
            parts.append(z.index_select(-1, self.of_sqrt).abs().clamp(min=self.root_floor).sqrt())
            signed = z.index_select(-1, self.of_ssqrt)
            parts.append(signed.sign() * signed.abs().clamp(min=self.root_floor).sqrt())
            divisor = z.index_select(-1, self.of_inv)
            parts.append(
                torch.where(
                    divisor == 0,
                    divisor,
                    torch.where(divisor == 0, torch.ones_like(divisor), divisor).reciprocal(),
                )
            )
        base = torch.cat(parts, dim=-1)
        if self.depth == 0:
            return ones.expand(z.shape[:-1] + (self.count,))  # noqa: RUF005 (TorchScript)
        out = base.index_select(-1, self.index[0])
        for d in range(1, self.depth):
            out = out * base.index_select(-1, self.index[d])
        return out

    def along(self, z: Tensor, ahead: Tensor) -> Tensor:
        """Return the derivatives of the terms [D, B, J] along directions.

        Args:
            z: channels [B, nz].
            ahead: the directions [D, B, nz].
        """
        if self.divides or self.turns or self.protects:
            return derivatives_along(self, z, ahead)
        if self.depth == 0:
            return ahead.new_zeros(*ahead.shape[:2], self.count)
        # the same products as in `forward`: written out, each is computed once for all directions
        base = torch.cat((torch.ones_like(z[:, :1]), z, z.abs()), dim=-1)
        moved = torch.cat((torch.zeros_like(ahead[..., :1]), ahead, z.sign() * ahead), dim=-1)
        out, slope = (part.index_select(-1, self.index[0]) for part in (base, moved))
        for d in range(1, self.depth):
            factor = base.index_select(-1, self.index[d])
            slope.mul_(factor).addcmul_(out, moved.index_select(-1, self.index[d]))
            out = out * factor
        return slope


def _columns(factor: Factor, base: dict[tuple[str, bool, str], int]) -> list[int]:
    """Return the columns whose product is the factor."""
    if factor.power > 0:
        return [base[factor.name, factor.magnitude, factor.function]] * factor.power
    inverse = base[factor.name, False, "^-1"]
    # 1/|z| = |z| / z^2
    return (
        [base[factor.name, True, ""], inverse, inverse] if factor.magnitude else [inverse]
    ) * -factor.power
