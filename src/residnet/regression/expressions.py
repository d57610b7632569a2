"""Expressions in normal form: sums of products of channels and of functions of such sums.

Equal expressions are equal objects.

Genetic programming breeds trees; what a tree means is the sum of products that it comes to, whose
terms get a coefficient each (document 000 sections 5.1.1 and 5.1.3). Here every product is a tuple
of numbers of atoms, so that trees that mean the same share their columns and their fit.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, cast

import numpy as np
import torch
from torch import Tensor, nn

if TYPE_CHECKING:
    import sympy


_ROOT_FLOOR = 1e-24
"""What a root is taken of where its argument is less: its slope stays finite."""

Function = Literal["sum", "abs", "sin", "cos", "sqrt", "inv"]
"""Functions of a sum: itself in brackets, magnitude, sine, cosine, and the protected square root
and inverse (document 001 section 2.4).
"""
FUNCTIONS: tuple[Function, ...] = ("sum", "abs", "sin", "cos", "sqrt", "inv")

Product = tuple[int, ...]
"""Numbers of atoms, ascending, as often as their power; () is 1."""
Sum = dict[Product, float]
"""Products and what they are multiplied by."""
ONE: Product = ()


class Limits(NamedTuple):
    """The limits of an expression.

    Terms of a sum, factors of a product, functions inside functions, and whether sums are
    multiplied out.
    """

    terms: int = 50
    degree: int = 8
    nesting: int = 2
    expand: bool = True


class TooLargeError(Exception):
    """An expression beyond the limits; an individual that means it takes no part."""


class Atom(NamedTuple):
    """A channel, or a function of a sum of products: their factors and weights."""

    channel: str
    function: Function = "sum"
    inner: tuple[tuple[Product, float], ...] = ()
    nesting: int = 0


class Algebra:
    """The sums of products over named channels, kept in normal form.

    |a|^2 = a^2, |a b| = |a| |b|, cos(-a) = cos a, sin(-a) = -sin a.
    """

    def __init__(self, channels: Sequence[str], limits: Limits | None = None) -> None:
        self.channels = tuple(channels)
        self.limits = limits or Limits()
        self.atoms: list[Atom] = [Atom(name) for name in channels]
        self._number: dict[Atom, int] = {atom: i for i, atom in enumerate(self.atoms)}
        self._products: dict[tuple[Product, Product], Product] = {}

    def channel(self, name: str) -> Sum:
        """Return a channel alone."""
        return {(self.channels.index(name),): 1.0}

    def add(self, a: Sum, b: Sum, sign: float = 1.0) -> Sum:
        """Return a + sign b.

        Raises:
            TooLargeError: beyond the limits.
        """
        out = dict(a)
        for product, weight in b.items():
            total = out.get(product, 0.0) + sign * weight
            if total == 0.0:
                out.pop(product, None)
            else:
                out[product] = total
        return self._bounded(out)

    def multiply(self, a: Sum, b: Sum) -> Sum:
        """Return a b, multiplied out or as a product of brackets.

        Raises:
            TooLargeError: beyond the limits.
        """
        if not self.limits.expand:
            a, b = self.bracket(a), self.bracket(b)
        if len(a) * len(b) > 4 * self.limits.terms:
            raise TooLargeError
        out: Sum = {}
        for p, weight in a.items():
            for q, other in b.items():
                key = (p, q)
                if key not in self._products:
                    self._products[key] = self._normal([*p, *q])
                product = self._products[key]
                out[product] = out.get(product, 0.0) + weight * other
        return self._bounded({product: weight for product, weight in out.items() if weight != 0.0})

    def apply(self, function: Function, a: Sum) -> Sum:
        """Return a function of a sum.

        Raises:
            TooLargeError: beyond the limits.
        """
        if all(product == ONE for product in a):
            value = float(values_of(function, np.array([a.get(ONE, 0.0)]))[0])
            return {ONE: value} if value else {}
        if len(a) == 1 and function in ("abs", "sqrt", "inv"):
            ((product, weight),) = a.items()
            factor = float(values_of(function, np.array([weight]))[0])
            parts = [self._function(function, {(atom,): 1.0}) for atom in product]
            return {self._normal([atom for part in parts for atom in part]): factor}
        if a[min(a)] > 0:
            return {self._function(function, a): 1.0}
        turned = {product: -weight for product, weight in a.items()}
        odd = function in ("sin", "inv")
        return {self._function(function, turned): -1.0 if odd else 1.0}

    def bracket(self, a: Sum) -> Sum:
        """Return a sum of several terms as one factor."""
        if len(a) <= 1:
            return a
        lead = a[min(a)]
        return {
            self._function("sum", {product: weight / lead for product, weight in a.items()}): lead
        }

    def product(self, factors: Iterable[tuple[str, str, int]]) -> Product:
        """Return a product of (function, channel, power); a function may be empty.

        Raises:
            TooLargeError: beyond the limits.
        """
        out: Sum = {ONE: 1.0}
        for function, name, power in factors:
            part = self.channel(name)
            for one in (function, "inv" if power < 0 else ""):
                part = self.apply(cast("Function", one), part) if one else part
            for _ in range(abs(power)):
                out = self.multiply(out, part)
        return next(iter(out))

    def atom(self, function: Function, a: Sum) -> int:
        """Return the number of a function of a sum in normal form."""
        nesting = 1 + max([self.atoms[i].nesting for product in a for i in product], default=0)
        atom = Atom("", function, tuple(sorted(a.items())), nesting)
        if atom not in self._number:
            self._number[atom] = len(self.atoms)
            self.atoms.append(atom)
        return self._number[atom]

    def degree(self, product: Product) -> int:
        """Return the number of factors of a product, with those inside its functions."""
        return sum(
            max([self.degree(p) for p, _ in self.atoms[i].inner], default=1)
            + bool(self.atoms[i].nesting)
            for i in product
        )

    def effort(self, product: Product) -> float:
        """Return how complicated a product is among those of its degree."""
        return len(set(product)) + sum(
            0.5 + 0.1 * len(self.atoms[i].inner) for i in product if self.atoms[i].inner
        )

    def _function(self, function: Function, a: Sum) -> Product:
        """Return the product that a function of a sum is, a simpler one for a single atom."""
        ((first, weight),) = list(a.items())[:1]
        if (
            len(a) == 1
            and len(first) == 1
            and weight == 1.0
            and (inner := self.atoms[first[0]]).inner
        ):
            if function == "abs" and inner.function in ("abs", "sqrt"):
                return first
            if function == "sqrt" and inner.function == "abs":
                return self._function("sqrt", dict(inner.inner))
            if function == "inv" and inner.function == "inv":
                return (
                    self._function("sum", dict(inner.inner))
                    if len(inner.inner) > 1
                    else inner.inner[0][0]
                )
        nesting = 1 + max([self.atoms[i].nesting for product in a for i in product], default=0)
        if nesting > self.limits.nesting:
            raise TooLargeError
        return (self.atom(function, a),)

    def _normal(self, factors: list[int]) -> Product:
        """Return the product in ascending order, with squares of magnitudes as squares."""
        out = sorted(factors)
        for i in {i for i in out if self.atoms[i].function == "abs" and out.count(i) > 1}:
            inner = self.atoms[i].inner
            plain = (
                inner[0][0]
                if len(inner) == 1 and inner[0][1] == 1.0
                else self._function("sum", dict(inner))
            )
            pairs = out.count(i) // 2
            out = [k for k in out if k != i] + [i] * (out.count(i) % 2) + list(plain) * (2 * pairs)
        if len(out) > self.limits.degree:
            raise TooLargeError
        return tuple(sorted(out))

    def _bounded(self, a: Sum) -> Sum:
        if len(a) > self.limits.terms:
            raise TooLargeError
        return a

    def values(self, products: Sequence[Product], data: Mapping[str, np.ndarray]) -> np.ndarray:
        """Return the values [P, N] of products at channels [N] each.

        They are infinite or not a number where they cannot be had.
        """
        columns = Columns(self, data)
        return columns.of(products)


class Columns:
    """Atoms along data, each worked out once."""

    def __init__(self, algebra: Algebra, data: Mapping[str, np.ndarray]) -> None:
        self.algebra = algebra
        rows = [np.asarray(data[name], dtype=np.float64) for name in algebra.channels]
        self._table = np.concatenate((np.ones((1, len(rows[0]))), np.stack(rows)))
        self._row = {i: i + 1 for i in range(len(rows))}

    def of(self, products: Sequence[Product]) -> np.ndarray:
        """Return the values [P, N] of products."""
        self._prepare({i for product in products for i in product})
        depth = max([len(product) for product in products], default=0)
        index = np.array(
            [
                [self._row[i] for i in product] + [0] * (depth - len(product))
                for product in products
            ],
            dtype=np.intp,
        )
        out = np.ones((len(products), self._table.shape[1]))
        with np.errstate(over="ignore", invalid="ignore"):
            for d in range(depth):
                out *= self._table[index[:, d]]
        return out

    def _prepare(self, wanted: set[int]) -> None:
        missing = sorted(i for i in wanted if i not in self._row)
        if not missing:
            return
        rows = []
        for i in missing:
            atom = self.algebra.atoms[i]
            with np.errstate(over="ignore", invalid="ignore"):
                inner = np.array([weight for _, weight in atom.inner]) @ self.of(
                    [product for product, _ in atom.inner]
                )
                rows.append(values_of(atom.function, inner))
        for i, row in zip(missing, rows, strict=True):
            self._row[i] = len(self._table)
            self._table = np.concatenate((self._table, row[None]))


def values_of(function: Function, x: np.ndarray) -> np.ndarray:
    """Return a function of values."""
    return np.asarray(_VALUES[function](x))


_VALUES: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "sum": lambda x: x,
    "abs": np.abs,
    "sin": np.sin,
    "cos": np.cos,
    "sqrt": lambda x: np.sqrt(np.abs(x)),
    "inv": lambda x: np.where(x == 0.0, 0.0, 1.0 / np.where(x == 0.0, 1.0, x)),
}


class Table(nn.Module):
    """A module whose buffers take the shapes of what is loaded.

    How many terms an equation has, or samples a kernel, is known only from the data.
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
        self.index = nn.Buffer(torch.zeros(1, 0, dtype=torch.long))

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
        self.weight = nn.Buffer(torch.zeros(0, 1, dtype=torch.float64))
        self.pick = nn.Buffer(torch.zeros(0, len(FUNCTIONS), dtype=torch.float64))
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
    """The coefficients [J, n] of the terms on each axis."""

    def __init__(self, outputs: int) -> None:
        super().__init__()
        self.values = nn.Buffer(torch.zeros(0, outputs, dtype=torch.float64))


def tables(algebra: Algebra, terms: Sequence[Product], nesting: int) -> dict[str, Tensor]:
    """Return the state of an `ExpressionLibrary` of these terms.

    It has all functions that they need, innermost first.
    """
    found: set[int] = set()
    left = {i for product in terms for i in product}
    while left:
        found |= left
        left = {i for k in left for product, _ in algebra.atoms[k].inner for i in product} - found
    used = sorted(i for i in found if algebra.atoms[i].nesting)
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
            [
                [weight for _, weight in atom.inner] + [0.0] * (width - len(atom.inner))
                for atom in atoms
            ],
            dtype=torch.float64,
        ).reshape(len(atoms), width)
        pick = [[float(atom.function == function) for function in FUNCTIONS] for atom in atoms]
        state[f"levels.{level}.pick"] = torch.tensor(pick, dtype=torch.float64).reshape(
            len(atoms), len(FUNCTIONS)
        )
        place |= {i: len(place) + 1 + k for k, i in enumerate(level_atoms)}
    return state | {"terms.index": _index(terms, place)}


def _index(products: Sequence[Product], place: dict[int, int]) -> Tensor:
    depth = max([1, *(len(product) for product in products)])
    rows = [[place[i] for i in product] + [0] * (depth - len(product)) for product in products]
    return torch.tensor(rows, dtype=torch.long).reshape(len(products), depth).T.contiguous()


PLAIN = {
    "sum": "({})",
    "abs": "|{}|",
    **{name: name + "({})" for name in ("sin", "cos", "sqrt", "ssqrt", "inv")},
}
"""How functions are written in the term language."""
Term = Sequence[tuple[str, str, int]]
"""A product of (function, channel, power); no function stands for the channel itself."""


def term(algebra: Algebra, product: Product) -> str:
    """Return a product in plain text, channels before functions; `1` where it is empty.

    It does not depend on the order in which atoms were found.
    """
    written = [(_atom(algebra, i), algebra.atoms[i].nesting, i) for i in set(product)]
    # channels in their own order, functions by what is written
    written.sort(key=lambda one: (one[1], one[2] if not one[1] else 0, one[0]))
    powers = [(text, product.count(i)) for text, _, i in written]
    return " ".join(text if power == 1 else f"{text}^{power}" for text, power in powers) or "1"


def total(terms: Sequence[str], weights: Sequence[float]) -> str:
    """Return a weighted sum of terms in plain text, six digits; weights of 1 are not written."""
    out = ""
    for text, weight in zip(terms, weights, strict=True):
        number = f"{abs(weight):.6g}"
        part = number if text == "1" else text if number == "1" else f"{number} {text}"
        out += (" - " if weight < 0 else " + ") + part
    return ("-" if out.startswith(" - ") else "") + out[3:] or "0"


def _atom(algebra: Algebra, i: int) -> str:
    atom = algebra.atoms[i]
    if not atom.inner:
        return atom.channel
    inner = sorted((len(p), term(algebra, p), weight) for p, weight in atom.inner)
    return PLAIN[atom.function].format(total([t for _, t, _ in inner], [w for *_, w in inner]))


def symbolic(terms: Sequence[Term], weights: Sequence[float]) -> sympy.Expr:
    """Return a weighted sum of products of functions of channels as a SymPy expression."""
    import sympy

    out = []
    for factors, weight in zip(terms, weights, strict=True):
        parts = [_of(function, sympy.Symbol(name)) ** power for function, name, power in factors]
        out.append(sympy.Mul(sympy.Float(weight, 17), *parts))
    return sympy.Add(*out)


def symbolic_sum(algebra: Algebra, products: Sequence[tuple[Product, float]]) -> sympy.Expr:
    """Return a weighted sum of products of an algebra as a SymPy expression."""
    import sympy

    def atom(i: int) -> Any:
        found = algebra.atoms[i]
        if not found.inner:
            return sympy.Symbol(found.channel)
        return _of(found.function, symbolic_sum(algebra, found.inner))

    return sympy.Add(*(sympy.Mul(sympy.Float(w, 17), *map(atom, p)) for p, w in products))


def _of(function: str, x: Any) -> Any:
    import sympy

    if function == "inv":
        return sympy.Piecewise((0, sympy.Eq(x, 0)), (1 / x, True))
    if function in ("sqrt", "ssqrt"):
        root = sympy.sqrt(sympy.Abs(x))
        return root if function == "sqrt" else sympy.sign(x) * root
    return {"abs": sympy.Abs, "sin": sympy.sin, "cos": sympy.cos}.get(function, lambda y: y)(x)


def equation(
    name: str, text: str, value: sympy.Expr, channels: Sequence[str], comment: str = ""
) -> dict[str, str]:
    """Return one equation in writing.

    Args:
        name: left side, for example `u_dot`.
        channels: channels that may appear, in the order of a function's arguments.
        comment: what stands above the function in C.

    Returns:
        `text`, plain with six digits; `latex`, with six digits; `sympy`, the right side with all
        digits, for `sympy.sympify`; and `c`, a C99 function `double <name>(double <channel>, ...)`
        with all digits, which has all channels as arguments and needs <math.h>.
    """
    import sympy

    short = value.xreplace({x: sympy.Float(x, 6) for x in value.atoms(sympy.Float)})
    left = sympy.Symbol(name.replace("_dot", "dot"))
    used = {symbol.name for symbol in value.free_symbols}
    unused = "".join(f"    (void){channel};\n" for channel in channels if channel not in used)
    arguments = ", ".join(f"double {channel}" for channel in channels)
    note = f"/* {comment} */\n" if comment else ""
    body = f"{unused}    return {sympy.ccode(value)};"
    return {
        "text": f"{name} = {text}",
        "latex": f"{sympy.latex(left)} = {sympy.latex(short, full_prec=False)}",
        "sympy": sympy.sstr(value, full_prec=True),
        "c": f"{note}double {name}({arguments})\n{{\n{body}\n}}\n",
    }
