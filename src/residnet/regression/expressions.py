"""Expressions in normal form: sums of products of channels and of functions of such sums.

Genetic programming creates trees. The normal form of a tree is a sum of products whose terms get a
coefficient each (Halvorsen 2019, sections 5.1.1 and 5.1.3). A product is a tuple of indices of
atoms, so that trees of equal meaning compare equal and share their columns and their fit.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, cast

import numpy as np
import torch
from torch import Tensor, nn

if TYPE_CHECKING:
    import sympy


_MIN_ROOT_ARGUMENT = 1e-24
"""Lower bound of the argument of a square root, which bounds the derivative of the root."""

Function = Literal["sum", "abs", "sin", "cos", "sqrt", "inv"]
"""Functions of a sum: brackets, magnitude, sine, cosine, protected square root and inverse.

Source of the protected functions: Moreno-Salinas et al. 2019, section 2.4.
"""
FUNCTIONS: tuple[Function, ...] = ("sum", "abs", "sin", "cos", "sqrt", "inv")

Product = tuple[int, ...]
"""Ascending indices of atoms, repeated according to their power; () is the constant 1."""
Sum = dict[Product, float]
"""Sum of products: weight of each product."""
CONSTANT_PRODUCT: Product = ()


class ExpressionLimits(NamedTuple):
    """Limits of an expression.

    Attributes:
        terms: maximum number of terms of a sum.
        degree: maximum number of factors of a product.
        nesting: maximum depth of nested functions.
        expand: whether products of sums are expanded.
    """

    terms: int = 50
    degree: int = 8
    nesting: int = 2
    expand: bool = True


class TooLargeError(Exception):
    """An expression exceeds the limits; the search discards the individual."""


class Atom(NamedTuple):
    """A channel, or a function of a sum of products.

    Attributes:
        channel: name of the channel; empty for a function.
        function: name of the function; unused for a channel.
        inner: products and weights of the argument of a function; empty for a channel.
        nesting: depth of nested functions; 0 for a channel.
    """

    channel: str
    function: Function = "sum"
    inner: tuple[tuple[Product, float], ...] = ()
    nesting: int = 0


class Algebra:
    """Algebra of sums of products of named channels in normal form.

    Simplifications: |a|^2 = a^2, |a b| = |a| |b|, cos(-a) = cos a, sin(-a) = -sin a.
    """

    def __init__(self, channels: Sequence[str], limits: ExpressionLimits | None = None) -> None:
        self.channels = tuple(channels)
        self.limits = limits or ExpressionLimits()
        self.atoms: list[Atom] = [Atom(name) for name in channels]
        self._atom_numbers: dict[Atom, int] = {atom: i for i, atom in enumerate(self.atoms)}
        self._product_cache: dict[tuple[Product, Product], Product] = {}

    def make_channel(self, name: str) -> Sum:
        """Return a channel as a sum of one product with one factor."""
        return {(self.channels.index(name),): 1.0}

    def add(self, a: Sum, b: Sum, sign: float = 1.0) -> Sum:
        """Return a + sign b.

        Raises:
            TooLargeError: if the result exceeds the limits.
        """
        result = dict(a)
        for product, weight in b.items():
            new_weight = result.get(product, 0.0) + sign * weight
            if new_weight == 0.0:
                result.pop(product, None)
            else:
                result[product] = new_weight
        return self._require_within_limits(result)

    def multiply(self, a: Sum, b: Sum) -> Sum:
        """Return a b, expanded or as a product of brackets.

        Raises:
            TooLargeError: if the result exceeds the limits.
        """
        # without expansion a sum is one factor, such as (u + v) in (u + v) r
        if not self.limits.expand:
            a = self.bracket_sum(a)
            b = self.bracket_sum(b)
        # terms may cancel or merge, so that the limit before multiplication is looser
        if len(a) * len(b) > 4 * self.limits.terms:
            raise TooLargeError
        result: Sum = {}
        for p, weight in a.items():
            for q, other_weight in b.items():
                key = (p, q)
                if key not in self._product_cache:
                    self._product_cache[key] = self._normalise_product([*p, *q])
                product = self._product_cache[key]
                result[product] = result.get(product, 0.0) + weight * other_weight
        return self._require_within_limits(
            {product: weight for product, weight in result.items() if weight != 0.0}
        )

    def apply_function(self, function: Function, a: Sum) -> Sum:
        """Return a function of a sum.

        Raises:
            TooLargeError: if the result exceeds the limits.
        """
        # a function of a constant is a constant
        if all(product == CONSTANT_PRODUCT for product in a):
            value = float(apply_function(function, np.array([a.get(CONSTANT_PRODUCT, 0.0)]))[0])
            return {CONSTANT_PRODUCT: value} if value else {}
        # multiplicative functions of a product are products of functions
        if len(a) == 1 and function in ("abs", "sqrt", "inv"):
            ((product, weight),) = a.items()
            factor = float(apply_function(function, np.array([weight]))[0])
            factor_products = [
                self._normalise_function(function, {(atom,): 1.0}) for atom in product
            ]
            return {
                self._normalise_product(
                    [atom for factor_product in factor_products for atom in factor_product]
                ): factor
            }
        # normalise the sign of the argument, so that f(a) and f(-a) share an atom
        if a[min(a)] > 0:
            return {self._normalise_function(function, a): 1.0}
        negated = {product: -weight for product, weight in a.items()}
        is_odd = function in ("sin", "inv")
        return {self._normalise_function(function, negated): -1.0 if is_odd else 1.0}

    def bracket_sum(self, a: Sum) -> Sum:
        """Return a sum of several terms as one bracketed factor times its leading weight."""
        if len(a) <= 1:
            return a
        # brackets that differ by a factor share one atom
        leading_weight = a[min(a)]
        return {
            self._normalise_function(
                "sum", {product: weight / leading_weight for product, weight in a.items()}
            ): leading_weight
        }

    def make_product(self, factors: Iterable[tuple[str, str, int]]) -> Product:
        """Build a product of factors (function, channel, power); the function may be empty.

        Raises:
            TooLargeError: if the result exceeds the limits.
        """
        result: Sum = {CONSTANT_PRODUCT: 1.0}
        for function, name, power in factors:
            factor = self.make_channel(name)
            for function_name in (function, "inv" if power < 0 else ""):
                factor = (
                    self.apply_function(cast("Function", function_name), factor)
                    if function_name
                    else factor
                )
            for _ in range(abs(power)):
                result = self.multiply(result, factor)
        return next(iter(result))

    def register_atom(self, function: Function, a: Sum) -> int:
        """Return the index of the atom of a function of a sum; add it if it is new."""
        nesting = 1 + max([self.atoms[i].nesting for product in a for i in product], default=0)
        atom = Atom("", function, tuple(sorted(a.items())), nesting)
        if atom not in self._atom_numbers:
            self._atom_numbers[atom] = len(self.atoms)
            self.atoms.append(atom)
        return self._atom_numbers[atom]

    def count_factors(self, product: Product) -> int:
        """Return the number of factors of a product, including those inside functions."""
        return sum(
            max([self.count_factors(p) for p, _ in self.atoms[i].inner], default=1)
            + bool(self.atoms[i].nesting)
            for i in product
        )

    def complexity(self, product: Product) -> float:
        """Return a score by which products of equal degree are sorted, simplest first."""
        return len(set(product)) + sum(
            0.5 + 0.1 * len(self.atoms[atom_number].inner)
            for atom_number in product
            if self.atoms[atom_number].inner
        )

    def _normalise_function(self, function: Function, a: Sum) -> Product:
        """Return the product of a function of a sum, simplified for a single atom."""
        ((first_product, weight),) = list(a.items())[:1]
        if (
            len(a) == 1
            and len(first_product) == 1
            and weight == 1.0
            and (inner_atom := self.atoms[first_product[0]]).inner
        ):
            if function == "abs" and inner_atom.function in ("abs", "sqrt"):
                return first_product
            if function == "sqrt" and inner_atom.function == "abs":
                return self._normalise_function("sqrt", dict(inner_atom.inner))
            if function == "inv" and inner_atom.function == "inv":
                return (
                    self._normalise_function("sum", dict(inner_atom.inner))
                    if len(inner_atom.inner) > 1
                    else inner_atom.inner[0][0]
                )
        nesting = 1 + max([self.atoms[i].nesting for product in a for i in product], default=0)
        if nesting > self.limits.nesting:
            raise TooLargeError
        return (self.register_atom(function, a),)

    def _normalise_product(self, factors: list[int]) -> Product:
        """Return the sorted product, with squared magnitudes replaced by squares."""
        atoms = sorted(factors)
        for i in {i for i in atoms if self.atoms[i].function == "abs" and atoms.count(i) > 1}:
            inner_terms = self.atoms[i].inner
            squared_argument = (
                inner_terms[0][0]
                if len(inner_terms) == 1 and inner_terms[0][1] == 1.0
                else self._normalise_function("sum", dict(inner_terms))
            )
            n_pairs = atoms.count(i) // 2
            atoms = (
                [k for k in atoms if k != i]
                + [i] * (atoms.count(i) % 2)
                + list(squared_argument) * (2 * n_pairs)
            )
        if len(atoms) > self.limits.degree:
            raise TooLargeError
        return tuple(sorted(atoms))

    def _require_within_limits(self, a: Sum) -> Sum:
        """Return a sum unchanged.

        Raises:
            TooLargeError: if it has too many terms.
        """
        if len(a) > self.limits.terms:
            raise TooLargeError
        return a

    def evaluate_products(
        self, products: Sequence[Product], data: Mapping[str, np.ndarray]
    ) -> np.ndarray:
        """Evaluate products at channels of N samples, [P, N].

        Values are infinite or NaN on overflow.
        """
        columns = ProductEvaluator(self, data)
        return columns.evaluate(products)


class ProductEvaluator:
    """Evaluates products on data; every atom is evaluated once."""

    def __init__(self, algebra: Algebra, data: Mapping[str, np.ndarray]) -> None:
        self.algebra = algebra
        # row 0 is the constant 1, which pads products of fewer factors
        rows = [np.asarray(data[name], dtype=np.float64) for name in algebra.channels]
        self._atom_values = np.concatenate((np.ones((1, len(rows[0]))), np.stack(rows)))
        self._row_of_atom = {i: i + 1 for i in range(len(rows))}

    def evaluate(self, products: Sequence[Product]) -> np.ndarray:
        """Evaluate products, [P, N]."""
        self._evaluate_atoms({i for product in products for i in product})
        max_factors = max([len(product) for product in products], default=0)
        index = np.array(
            [
                [self._row_of_atom[i] for i in product] + [0] * (max_factors - len(product))
                for product in products
            ],
            dtype=np.intp,
        )
        values = np.ones((len(products), self._atom_values.shape[1]))
        with np.errstate(over="ignore", invalid="ignore"):
            for d in range(max_factors):
                values *= self._atom_values[index[:, d]]
        return values

    def _evaluate_atoms(self, required: set[int]) -> None:
        """Evaluate the functions among some atoms that were not evaluated before."""
        missing = sorted(i for i in required if i not in self._row_of_atom)
        if not missing:
            return
        rows = []
        for i in missing:
            atom = self.algebra.atoms[i]
            with np.errstate(over="ignore", invalid="ignore"):
                inner_values = np.array([weight for _, weight in atom.inner]) @ self.evaluate(
                    [product for product, _ in atom.inner]
                )
                rows.append(apply_function(atom.function, inner_values))
        for i, row in zip(missing, rows, strict=True):
            self._row_of_atom[i] = len(self._atom_values)
            self._atom_values = np.concatenate((self._atom_values, row[None]))


def apply_function(function: Function, x: np.ndarray) -> np.ndarray:
    """Return the values of a function of one variable, such as `sin`, at x, elementwise."""
    return np.asarray(_NUMPY_FUNCTIONS[function](x))


_NUMPY_FUNCTIONS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "sum": lambda x: x,
    "abs": np.abs,
    "sin": np.sin,
    "cos": np.cos,
    "sqrt": lambda x: np.sqrt(np.abs(x)),
    "inv": lambda x: np.where(x == 0.0, 0.0, 1.0 / np.where(x == 0.0, 1.0, x)),
}


class ResizableModule(nn.Module):
    """Module whose buffers are resized to the shapes of a loaded state_dict.

    The number of terms of an equation, or of centres of a kernel, depends on the data.
    """

    def _load_from_state_dict(
        self, state_dict: dict[str, Tensor], prefix: str, *other_arguments: Any
    ) -> None:
        for name, buffer in list(self.named_buffers(recurse=False)):
            stored = state_dict.get(prefix + name)
            if stored is not None:
                setattr(
                    self, name, torch.zeros(stored.shape, dtype=buffer.dtype, device=buffer.device)
                )
        super()._load_from_state_dict(state_dict, prefix, *other_arguments)


class ProductLayer(ResizableModule):
    """Products of columns, [..., C] -> [..., P].

    The buffer `index` [D, P] has the columns of the D factors of each product. Column 0 is the
    constant 1, which pads products of fewer factors.
    """

    def __init__(self) -> None:
        super().__init__()
        self.index = nn.Buffer(torch.zeros(1, 0, dtype=torch.long))

    @torch.jit.unused
    def decode_products(self, atom_of_column: Mapping[int, int]) -> list[Product]:
        """Return the products in terms of atoms, given the atom of each column."""
        return [
            tuple(sorted(atom_of_column[i] for i in column if i))
            for column in self.index.T.tolist()
        ]

    def forward(self, columns: Tensor) -> Tensor:
        """Return the P products of the selected columns [..., C] as [..., P]."""
        values = columns.index_select(-1, self.index[0])
        for d in range(1, self.index.shape[0]):
            values = values * columns.index_select(-1, self.index[d])
        return values


class FunctionLayer(ResizableModule):
    """Appends K functions of sums, f_k(sum_m weight_km product_km), to the columns.

    Attributes:
        products: products of all sums, M for each function.
        weight: weights of the products [K, M]; zero for padding.
        pick: one-hot selection of each function among `FUNCTIONS` [K, 6].
    """

    def __init__(self) -> None:
        super().__init__()
        self.products = ProductLayer()
        self.weight = nn.Buffer(torch.zeros(0, 1, dtype=torch.float64))
        self.pick = nn.Buffer(torch.zeros(0, len(FUNCTIONS), dtype=torch.float64))
        self.root_floor = _MIN_ROOT_ARGUMENT

    def forward(self, columns: Tensor) -> Tensor:
        """Append the functions: [..., C] -> [..., C + K]."""
        if self.weight.shape[0] == 0:
            return columns
        inner_sums = (
            self.products(columns).unflatten(-1, self.weight.shape) * self.weight.to(columns.dtype)
        ).sum(-1)
        # the protected inverse is 0 at 0; the inner `where` avoids NaN in the gradient
        is_zero = inner_sums == 0
        inverse = torch.where(
            is_zero,
            inner_sums,
            torch.where(is_zero, torch.ones_like(inner_sums), inner_sums).reciprocal(),
        )
        # the order is that of FUNCTIONS
        values = torch.stack(
            (
                inner_sums,
                inner_sums.abs(),
                inner_sums.sin(),
                inner_sums.cos(),
                inner_sums.abs().clamp(min=self.root_floor).sqrt(),
                inverse,
            ),
            dim=-1,
        )
        return torch.cat(
            # all functions are evaluated and one is selected, because a traced graph has no
            # branches
            (columns, torch.where(self.pick > 0, values, torch.zeros_like(values)).sum(-1)),
            dim=-1,
        )


class ExpressionLibrary(nn.Module):
    """Values of J terms from channels, [..., F] -> [..., J].

    Each level evaluates the functions of one nesting depth.
    """

    def __init__(self, nesting: int) -> None:
        super().__init__()
        self.levels = nn.ModuleList([FunctionLayer() for _ in range(nesting)])
        self.terms = ProductLayer()

    @torch.jit.unused
    def decode_terms(self, channels: Sequence[str]) -> tuple[Algebra, list[Product]]:
        """Return the algebra and terms of the state, the inverse of `build_library_state`."""
        algebra = Algebra(channels, ExpressionLimits(nesting=len(self.levels)))
        atom_of_column: dict[int, int] = {i + 1: i for i in range(len(channels))}
        for level in self.levels:
            assert isinstance(level, FunctionLayer)
            inner_products = level.products.decode_products(atom_of_column)
            terms_per_function = level.weight.shape[1]
            level_atoms = []
            for k, (weights, function_selector) in enumerate(
                zip(level.weight.tolist(), level.pick.tolist(), strict=True)
            ):
                inner_sum = {
                    product: weight
                    for product, weight in zip(
                        inner_products[k * terms_per_function : (k + 1) * terms_per_function],
                        weights,
                        strict=True,
                    )
                    if weight != 0.0
                }
                level_atoms.append(
                    algebra.register_atom(FUNCTIONS[function_selector.index(1.0)], inner_sum)
                )
            atom_of_column |= {len(atom_of_column) + 1 + k: i for k, i in enumerate(level_atoms)}
        return algebra, self.terms.decode_products(atom_of_column)

    def forward(self, z: Tensor) -> Tensor:
        """Return the terms [..., J] at channels [..., F]."""
        columns = torch.cat((torch.ones_like(z[..., :1]), z), dim=-1)
        for level in self.levels:
            columns = level(columns)
        values: Tensor = self.terms(columns)
        return values


class CoefficientTable(ResizableModule):
    """Coefficients [J, n] of the terms on each axis."""

    def __init__(self, outputs: int) -> None:
        super().__init__()
        self.values = nn.Buffer(torch.zeros(0, outputs, dtype=torch.float64))


def build_library_state(
    algebra: Algebra, terms: Sequence[Product], nesting: int
) -> dict[str, Tensor]:
    """Build the state of an `ExpressionLibrary`, with all nested functions of its terms.

    Args:
        algebra: algebra of the terms.
        terms: the J terms.
        nesting: number of levels of the library.
    """
    # collect the atoms inside functions, from the terms inwards
    required_atoms: set[int] = set()
    new_atoms = {i for product in terms for i in product}
    while new_atoms:
        required_atoms |= new_atoms
        new_atoms = {
            i for k in new_atoms for product, _ in algebra.atoms[k].inner for i in product
        } - required_atoms
    # the columns of a level are those of the previous level and its functions
    function_atoms = sorted(i for i in required_atoms if algebra.atoms[i].nesting)
    column_of_atom = {i: i + 1 for i in range(len(algebra.channels))}
    state: dict[str, Tensor] = {}
    for level in range(nesting):
        level_atoms = [i for i in function_atoms if algebra.atoms[i].nesting == level + 1]
        atoms = [algebra.atoms[i] for i in level_atoms]
        max_terms = max([len(atom.inner) for atom in atoms], default=1)
        inner_products = [
            product
            for atom in atoms
            for product in [*(p for p, _ in atom.inner), *[()] * (max_terms - len(atom.inner))]
        ]
        state[f"levels.{level}.products.index"] = _product_index(inner_products, column_of_atom)
        state[f"levels.{level}.weight"] = torch.tensor(
            [
                [weight for _, weight in atom.inner] + [0.0] * (max_terms - len(atom.inner))
                for atom in atoms
            ],
            dtype=torch.float64,
        ).reshape(len(atoms), max_terms)
        function_selectors = [
            [float(atom.function == function) for function in FUNCTIONS] for atom in atoms
        ]
        state[f"levels.{level}.pick"] = torch.tensor(
            function_selectors, dtype=torch.float64
        ).reshape(len(atoms), len(FUNCTIONS))
        column_of_atom |= {i: len(column_of_atom) + 1 + k for k, i in enumerate(level_atoms)}
    return state | {"terms.index": _product_index(terms, column_of_atom)}


def _product_index(products: Sequence[Product], column_of_atom: dict[int, int]) -> Tensor:
    """Return the buffer `index` [D, P] of a `ProductLayer` for products of atoms."""
    max_factors = max([1, *(len(product) for product in products)])
    rows = [
        [column_of_atom[i] for i in product] + [0] * (max_factors - len(product))
        for product in products
    ]
    return torch.tensor(rows, dtype=torch.long).reshape(len(products), max_factors).T.contiguous()


TEXT_FORMATS = {
    "sum": "({})",
    "abs": "|{}|",
    **{name: name + "({})" for name in ("sin", "cos", "sqrt", "ssqrt", "inv")},
}
"""Format of a function of an argument in the term language."""
Factors = Sequence[tuple[str, str, int]]
"""Product of factors (function, channel, power); the function is empty for a plain channel."""


def format_product(algebra: Algebra, product: Product) -> str:
    """Format a product as plain text, channels before functions; `1` for the empty product.

    The text does not depend on the order in which the atoms were registered.
    """
    formatted_atoms = [
        (_format_atom(algebra, i), algebra.atoms[i].nesting, i) for i in set(product)
    ]
    # channels in the order of the algebra, functions alphabetically
    formatted_atoms.sort(key=lambda entry: (entry[1], entry[2] if not entry[1] else 0, entry[0]))
    atom_powers = [(text, product.count(i)) for text, _, i in formatted_atoms]
    return " ".join(text if power == 1 else f"{text}^{power}" for text, power in atom_powers) or "1"


def format_sum(terms: Sequence[str], weights: Sequence[float]) -> str:
    """Format a weighted sum of terms with six digits; weights of 1 are omitted."""
    text_sum = ""
    for text, weight in zip(terms, weights, strict=True):
        number = f"{abs(weight):.6g}"
        term_text = number if text == "1" else text if number == "1" else f"{number} {text}"
        text_sum += (" - " if weight < 0 else " + ") + term_text
    return ("-" if text_sum.startswith(" - ") else "") + text_sum[3:] or "0"


def _format_atom(algebra: Algebra, i: int) -> str:
    """Format a channel, or a function of a sum sorted by degree, as plain text."""
    atom = algebra.atoms[i]
    if not atom.inner:
        return atom.channel
    inner_terms = sorted((len(p), format_product(algebra, p), weight) for p, weight in atom.inner)
    return TEXT_FORMATS[atom.function].format(
        format_sum(
            [term_text for _, term_text, _ in inner_terms],
            [term_weight for *_, term_weight in inner_terms],
        )
    )


def terms_to_sympy(terms: Sequence[Factors], weights: Sequence[float]) -> sympy.Expr:
    """Convert a weighted sum of products of functions of channels to a SymPy expression."""
    import sympy

    summands = []
    for factors, weight in zip(terms, weights, strict=True):
        sympy_factors = [
            _apply_sympy_function(function, sympy.Symbol(name)) ** power
            for function, name, power in factors
        ]
        summands.append(sympy.Mul(sympy.Float(weight, 17), *sympy_factors))
    return sympy.Add(*summands)


def products_to_sympy(algebra: Algebra, products: Sequence[tuple[Product, float]]) -> sympy.Expr:
    """Convert a weighted sum of products of an algebra to a SymPy expression."""
    import sympy

    def atom(i: int) -> Any:
        atom_definition = algebra.atoms[i]
        if not atom_definition.inner:
            return sympy.Symbol(atom_definition.channel)
        return _apply_sympy_function(
            atom_definition.function, products_to_sympy(algebra, atom_definition.inner)
        )

    return sympy.Add(
        *(sympy.Mul(sympy.Float(weight, 17), *map(atom, product)) for product, weight in products)
    )


def _apply_sympy_function(function: str, x: Any) -> Any:
    """Return a function of the term language of a SymPy expression."""
    import sympy

    if function == "inv":
        return sympy.Piecewise((0, sympy.Eq(x, 0)), (1 / x, True))
    if function in ("sqrt", "ssqrt"):
        root = sympy.sqrt(sympy.Abs(x))
        return root if function == "sqrt" else sympy.sign(x) * root
    return {"abs": sympy.Abs, "sin": sympy.sin, "cos": sympy.cos}.get(function, lambda y: y)(x)


def format_equation(
    name: str,
    right_hand_side: str,
    expression: sympy.Expr,
    channels: Sequence[str],
    comment: str = "",
) -> dict[str, str]:
    """Format an equation as plain text, LaTeX, SymPy and C.

    Args:
        name: left side, for example `u_dot`.
        right_hand_side: right side as plain text.
        expression: right side as a SymPy expression.
        channels: all channels, in the order of the arguments of the C function.
        comment: comment above the C function; none if empty.

    Returns:
        `text` with six digits; `latex` with six digits; `sympy`, the right side with all digits for
        `sympy.sympify`; and `c`, a C99 function `double <name>(double <channel>, ...)` with all
        digits, which needs <math.h>.
    """
    import sympy

    rounded_expression = expression.xreplace(
        {x: sympy.Float(x, 6) for x in expression.atoms(sympy.Float)}
    )
    # SymPy renders the suffix `dot` as a dot above the letter
    lhs_symbol = sympy.Symbol(name.replace("_dot", "dot"))
    used_channels = {symbol.name for symbol in expression.free_symbols}
    unused_arguments = "".join(
        f"    (void){channel};\n" for channel in channels if channel not in used_channels
    )
    arguments = ", ".join(f"double {channel}" for channel in channels)
    comment_line = f"/* {comment} */\n" if comment else ""
    body = f"{unused_arguments}    return {sympy.ccode(expression)};"
    return {
        "text": f"{name} = {right_hand_side}",
        "latex": f"{sympy.latex(lhs_symbol)} = {sympy.latex(rounded_expression, full_prec=False)}",
        "sympy": sympy.sstr(expression, full_prec=True),
        "c": f"{comment_line}double {name}({arguments})\n{{\n{body}\n}}\n",
    }
