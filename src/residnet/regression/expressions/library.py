"""Values of found expressions, as tables that a saved model carries and TorchScript runs.

Expressions are products of channels and of functions of sums.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from residnet.regression.expressions.algebra import FUNCTIONS, Algebra, Atom, Limits, Product

_ROOT_FLOOR = 1e-24


class Table(nn.Module):
    """A module whose buffers take the shapes of what is loaded.

    How many terms an equation has is known only from the data.
    """

    def _load_from_state_dict(self, state_dict: dict[str, Tensor], prefix: str, *rest: Any) -> None:
        for name, own in list(self.named_buffers(recurse=False)):
            stored = state_dict.get(prefix + name)
            if stored is not None:
                setattr(self, name, torch.zeros(stored.shape, dtype=own.dtype, device=own.device))
        super()._load_from_state_dict(state_dict, prefix, *rest)


class Products(Table):
    """The products of columns: [..., C] -> [..., P], gathered by index [D, P]; column 0 is one."""

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("index", torch.zeros(1, 0, dtype=torch.long))
        self.index: Tensor

    @torch.jit.unused
    def products(self, place: Mapping[int, int]) -> list[Product]:
        """Return the atoms of each product, from those of the columns."""
        return [tuple(sorted(place[i] for i in column if i)) for column in self.index.T.tolist()]

    def forward(self, columns: Tensor) -> Tensor:
        """Return the products [..., P]."""
        out = columns.index_select(-1, self.index[0])
        for d in range(1, self.index.shape[0]):
            out = out * columns.index_select(-1, self.index[d])
        return out


class Functions(Table):
    """The columns with K functions of sums beside them: f_k(sum_m weight_km product_km)."""

    def __init__(self) -> None:
        super().__init__()
        self.products = Products()
        self.register_buffer("weight", torch.zeros(0, 1, dtype=torch.float64))
        self.register_buffer("pick", torch.zeros(0, len(FUNCTIONS), dtype=torch.float64))
        self.weight: Tensor
        self.pick: Tensor
        self.root_floor = _ROOT_FLOOR

    def forward(self, columns: Tensor) -> Tensor:
        """Return [..., C + K] for columns [..., C]."""
        if self.weight.shape[0] == 0:
            return columns
        s = (
            self.products(columns).unflatten(-1, self.weight.shape) * self.weight.to(columns.dtype)
        ).sum(-1)
        zero = s == 0
        inverse = torch.where(zero, s, torch.where(zero, torch.ones_like(s), s).reciprocal())
        # in the order of FUNCTIONS
        values = torch.stack(
            (s, s.abs(), s.sin(), s.cos(), s.abs().clamp(min=self.root_floor).sqrt(), inverse),
            dim=-1,
        )
        return torch.cat(
            (columns, torch.where(self.pick > 0, values, torch.zeros_like(values)).sum(-1)), dim=-1
        )


class ExpressionLibrary(nn.Module):
    """The values of J terms from channels: [..., F] -> [..., J].

    Functions of functions follow one level after the other.
    """

    def __init__(self, nesting: int) -> None:
        super().__init__()
        self.levels = nn.ModuleList([Functions() for _ in range(nesting)])
        self.terms = Products()

    @torch.jit.unused
    def read(self, channels: Sequence[str]) -> tuple[Algebra, list[Product]]:
        """Return the terms again, for channels by name: `tables` backwards."""
        algebra = Algebra(channels, Limits(nesting=len(self.levels)))
        place: dict[int, int] = {i + 1: i for i in range(len(channels))}
        for level in self.levels:
            assert isinstance(level, Functions)
            inner = level.products.products(place)
            width = level.weight.shape[1]
            found = []
            for k, (weights, pick) in enumerate(
                zip(level.weight.tolist(), level.pick.tolist(), strict=True)
            ):
                a = {
                    p: w
                    for p, w in zip(inner[k * width : (k + 1) * width], weights, strict=True)
                    if w != 0.0
                }
                found.append(algebra.atom(FUNCTIONS[pick.index(1.0)], a))
            place |= {len(place) + 1 + k: i for k, i in enumerate(found)}
        return algebra, self.terms.products(place)

    def forward(self, z: Tensor) -> Tensor:
        """Return the terms [..., J] at channels [..., F]."""
        columns = torch.cat((torch.ones_like(z[..., :1]), z), dim=-1)
        for level in self.levels:
            columns = level(columns)
        values: Tensor = self.terms(columns)
        return values


class Weights(Table):
    """The coefficients [J, 3] of the terms on each axis."""

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("values", torch.zeros(0, 3, dtype=torch.float64))
        self.values: Tensor


def tables(algebra: Algebra, terms: Sequence[Product], nesting: int) -> dict[str, Tensor]:
    """Return the state of an `ExpressionLibrary` of these terms.

    It has all functions that they need, innermost first.
    """
    used = _used(algebra, terms)
    place = {i: i + 1 for i in range(len(algebra.channels))}
    state: dict[str, Tensor] = {}
    for level in range(nesting):
        level_atoms = [i for i in used if algebra.atoms[i].nesting == level + 1]
        atoms = [algebra.atoms[i] for i in level_atoms]
        width = max([len(atom.inner) for atom in atoms], default=1)
        inner = [
            product
            for atom in atoms
            for product in [*(p for p, _ in atom.inner), *[()] * (width - len(atom.inner))]
        ]
        state[f"levels.{level}.products.index"] = _index(inner, place)
        state[f"levels.{level}.weight"] = torch.tensor(
            [_padded(atom, width) for atom in atoms], dtype=torch.float64
        ).reshape(len(atoms), width)
        pick = [[float(atom.function == function) for function in FUNCTIONS] for atom in atoms]
        state[f"levels.{level}.pick"] = torch.tensor(pick, dtype=torch.float64).reshape(
            len(atoms), len(FUNCTIONS)
        )
        place |= {i: len(place) + 1 + k for k, i in enumerate(level_atoms)}
    return state | {"terms.index": _index(terms, place)}


def _used(algebra: Algebra, products: Sequence[Product]) -> list[int]:
    """Return the functions that products need, at any level."""
    found: set[int] = set()
    left = {i for product in products for i in product}
    while left:
        found |= left
        left = {i for k in left for product, _ in algebra.atoms[k].inner for i in product} - found
    return sorted(i for i in found if algebra.atoms[i].nesting)


def _padded(atom: Atom, width: int) -> list[float]:
    return [weight for _, weight in atom.inner] + [0.0] * (width - len(atom.inner))


def _index(products: Sequence[Product], place: dict[int, int]) -> Tensor:
    depth = max([1, *(len(product) for product in products)])
    rows = [[place[i] for i in product] + [0] * (depth - len(product)) for product in products]
    return torch.tensor(rows, dtype=torch.long).reshape(len(products), depth).T.contiguous()
