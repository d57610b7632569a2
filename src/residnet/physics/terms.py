"""Regressors by name: products of channels such as `u|u|`, `v |r|`, `n^2 delta` or `1`.

One library serves the baselines (hydrodynamic derivatives) and the closed-form heads (basis functions), so that a
name means the same number everywhere.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from residnet.core.errors import ConfigError
from residnet.core.names import nearest

_FACTOR = re.compile(r"\s*(?:\|(?P<magnitude>\w+)\||(?P<name>[A-Za-z_]\w*)|(?P<one>1))(?:\^(?P<power>-?[1-9]))?\s*\*?")


class Factor(NamedTuple):
    """One factor of a term: a channel or its magnitude, to a whole power."""

    name: str
    magnitude: bool
    power: int


def parse_term(term: str, names: Sequence[str]) -> tuple[Factor, ...]:
    """Factors of a term.

    Args:
        term: product of channels; factors stand apart by spaces, `*` or the bars of a magnitude; `^2` is a power; `1` the constant;
            `^-1` divides, for channels that stay away from zero, such as `wind_mag`.
        names: channels that may appear.

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
            raise ConfigError(f"term '{term}': cannot read it from '{term[position:]}'; write a product such as 'u|u|', 'v r' or 'n^2 delta'")
        position = match.end()
        if match["one"]:
            continue
        name = match["magnitude"] or match["name"]
        if name not in names:
            raise ConfigError(f"term '{term}': no channel '{name}'{nearest(name, names)}")
        factors.append(Factor(name, match["magnitude"] is not None, int(match["power"] or 1)))
    return tuple(factors)


def polynomial_terms(names: Sequence[str], degree: int, *, magnitudes: Sequence[str] = ()) -> tuple[str, ...]:
    """All products of `names` up to `degree` (without the constant), then x|x| of every name in `magnitudes`."""
    from itertools import combinations_with_replacement

    out = [" ".join(c) for d in range(1, degree + 1) for c in combinations_with_replacement(names, d)]
    return tuple(out + [f"{name}|{name}|" for name in magnitudes])


class TermLibrary(nn.Module):
    """Values of J terms from channels: [..., nz] -> [..., J].

    Every term is a product of columns of [1, z, |z|, 1/z], gathered by index, so that the number of tensor operations is
    the largest number of factors and not the number of terms; 1/z is there for the channels that a term divides by.
    """

    def __init__(self, terms: Sequence[str], names: Sequence[str]) -> None:
        super().__init__()
        self.terms = tuple(terms)
        parsed = [parse_term(term, names) for term in terms]
        places = {name: i for i, name in enumerate(names)}
        divisors = sorted({factor.name for factors in parsed for factor in factors if factor.power < 0}, key=places.__getitem__)
        self.register_buffer("divisors", torch.tensor([places[name] for name in divisors], dtype=torch.long), persistent=False)
        self.divisors: Tensor
        self.divides = len(divisors) > 0
        columns: list[list[int]] = []
        for factors in parsed:
            column: list[int] = []
            for factor in factors:
                index = 1 + places[factor.name] + (len(names) if factor.magnitude else 0)
                if factor.power < 0:
                    inverse = 1 + 2 * len(names) + divisors.index(factor.name)
                    # 1/|z| = |z| / z^2
                    column.extend(([index, inverse, inverse] if factor.magnitude else [inverse]) * -factor.power)
                else:
                    column.extend([index] * factor.power)
            columns.append(column)
        self.depth = max([len(column) for column in columns], default=0)
        padded = [column + [0] * (self.depth - len(column)) for column in columns]
        gather = torch.tensor(padded, dtype=torch.long).reshape(len(columns), self.depth).T.contiguous()
        self.register_buffer("index", gather, persistent=False)
        self.index: Tensor
        self.count = len(columns)

    def forward(self, z: Tensor) -> Tensor:
        """Channels z [..., nz] -> terms [..., J]."""
        one = torch.ones_like(z[..., :1])
        base = torch.cat((one, z, z.abs()), dim=-1)
        if self.divides:
            base = torch.cat((base, z.index_select(-1, self.divisors).reciprocal()), dim=-1)
        if self.depth == 0:
            return one.expand(z.shape[:-1] + (self.count,))  # noqa: RUF005 (TorchScript)
        out = base.index_select(-1, self.index[0])
        for d in range(1, self.depth):
            out = out * base.index_select(-1, self.index[d])
        return out
