"""Named regressors: products of channels and of functions of a channel.

Examples of names are `u|u|`, `v |r|`, `n^2 sin(delta)` and `1`. Hulls, baselines (hydrodynamic
derivatives) and closed-form heads (residual models with basis functions) use the same library, so
that a name has one meaning.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from itertools import combinations, combinations_with_replacement, product
from typing import TYPE_CHECKING, Any, NamedTuple

from pydantic import Field

from residnet.core.config import Config
from residnet.core.errors import ConfigError
from residnet.core.names import VELOCITY_NAMES, suggest_name

if TYPE_CHECKING:
    from torch import Tensor

TERM_FUNCTIONS = ("sin", "cos", "sqrt", "ssqrt", "inv")
"""Functions of a channel.

`sqrt` is sqrt|x|, `ssqrt` is sign(x) sqrt|x|, and `inv` is 1/x with the value 0 at x = 0
(Moreno-Salinas et al. 2019, section 2.4: protected division and square root).
"""
EVEN_FUNCTIONS = ("cos", "sqrt")
"""Even functions; the others are odd."""
_FACTOR = re.compile(
    r"\s*(?:\|(?P<magnitude>\w+)\||(?P<function>[a-z]+)\((?P<inner>\w+)\)"
    r"|(?P<name>[A-Za-z_]\w*)|(?P<one>1))(?:\^(?P<power>-?[1-9]))?\s*\*?"
)


class Factor(NamedTuple):
    """Factor of a term: a channel, its magnitude or a function of it, with an integer power."""

    name: str
    magnitude: bool
    power: int
    function: str = ""

    @property
    def symbol(self) -> str:
        """Channel or function of a channel, without magnitude and power."""
        return f"{self.function}({self.name})" if self.function else self.name

    @property
    def term_text(self) -> str:
        """Channel or function with magnitude and power, such as `|v|^2`."""
        base = f"|{self.name}|" if self.magnitude else self.symbol
        return base if self.power == 1 else f"{base}^{self.power}"


def parse_term(term: str, names: Sequence[str], *, functions: bool = True) -> tuple[Factor, ...]:
    """Parse a term to its factors.

    Args:
        term: product of channels. Factors are separated by spaces, `*` or the bars of a magnitude;
            `^2` is a power; `1` is the constant; `^-1` is a division, for channels that are never
            near zero, such as `wind_mag`; `sin(delta)` is one of `TERM_FUNCTIONS`.
        names: channels of the model.
        functions: whether functions are allowed.

    Raises:
        ConfigError: if the text is invalid or contains an unknown channel.
    """
    if not term.strip():
        raise ConfigError("a term is empty; write '1' for the constant")
    factors: list[Factor] = []
    position = 0
    while position < len(term):
        match = _FACTOR.match(term, position)
        if match is None or match.end() == position:
            raise ConfigError(
                f"term '{term}': invalid from '{term[position:]}'; write a product such as"
                " 'u|u|', 'v r' or 'n^2 delta'"
            )
        # each match consumes one factor and an optional `*`
        position = match.end()
        if match["one"]:
            continue
        name = match["magnitude"] or match["inner"] or match["name"]
        function = match["function"] or ""
        power = int(match["power"] or 1)
        if function and (not functions or function not in TERM_FUNCTIONS):
            hint = (
                suggest_name(function, TERM_FUNCTIONS)
                if functions
                else "; functions are not allowed here, only products of channels"
            )
            raise ConfigError(f"term '{term}': no function '{function}'{hint}")
        if name not in names:
            raise ConfigError(f"term '{term}': no channel '{name}'{suggest_name(name, names)}")
        if function and power < 0:
            raise ConfigError(
                f"term '{term}': cannot divide by {function}({name}), which may be zero"
            )
        factors.append(Factor(name, match["magnitude"] is not None, power, function))
    return tuple(factors)


def parse_axis_terms(
    terms_by_axis: Mapping[Any, Iterable[str]], names: Sequence[str], *, functions: bool = True
) -> list[tuple[str, str, tuple[Factor, ...]]]:
    """Parse all terms of all axes of a config to (axis, term, factors).

    Raises:
        ValueError: if a term is invalid, contains an unknown channel or a division.
    """
    parsed_terms = []
    for axis, axis_terms in terms_by_axis.items():
        for term in axis_terms:
            try:
                factors = parse_term(term, names, functions=functions)
            except ConfigError as error:
                raise ValueError(f"{axis}: {error}") from None
            if any(factor.power < 0 for factor in factors):
                raise ValueError(f"{axis}: term '{term}' divides by a channel that may be zero")
            parsed_terms.append((axis, term, factors))
    return parsed_terms


def make_polynomial_terms(
    names: Sequence[str], degree: int, *, magnitudes: Sequence[str] = ()
) -> tuple[str, ...]:
    """Return all products of `names` up to `degree`, then x|x| of the names in `magnitudes`.

    The constant is not included.
    """
    products = [
        " ".join(factors)
        for product_degree in range(1, degree + 1)
        for factors in combinations_with_replacement(names, product_degree)
    ]
    return tuple(products + [f"{name}|{name}|" for name in magnitudes])


class CandidateTerm(NamedTuple):
    """Candidate term with its degree, and its complexity for the order of terms of equal degree.

    A function such as sin(delta) counts as degree one.
    """

    term: str
    degree: int
    complexity: float


class CandidatesConfig(Config):
    """Rules that generate the candidate terms of an equation.

    The candidates are of two types:

    - all products of motions, with magnitudes of any factors;
    - all products of inputs, multiplied by products of coupled motions and by 1 or the sine or
      cosine of an angle.

    Halvorsen 2019, eqs. (6.21)-(6.23), corresponds to `inputs: [rpm], input_degree: 2,
    coupling: [u], coupling_degree: 2, angles: [nozzle]`.

    With neither `input_degree` nor `coupling`, the products of inputs are those of propellers and
    rudders:

    - degrees one and two with magnitudes as in `n|n|`, times u and |u|;
    - one input times u^2 and `u|u|`, as in `u^2 delta`;
    - the square of one input times another or its square, as in `n|n| delta` and `n^2 delta^2`;
    - cubes, as in `delta^3`;
    - ratios of products of motions over an input, and of one input over another. A residual model
      uses the ratios whose divisor is not near zero in its data.

    Attributes:
        motions: channels of the motion; those that the model does not have are ignored.
        motion_degree: maximum degree of the products of motions. If null, it is 2; without
            `input_degree` and `coupling`, the products of degree 3 without magnitudes are included,
            as in the third-order expansion of Abkowitz (1964): `u^3`, `v^2 r`, `r^3`.
        magnitudes: whether magnitudes of factors are included, as in `u|u|`.
        inputs: inputs of the products; null for all that are neither motions nor angles.
        input_degree: maximum degree of the products of inputs without magnitudes. If null, it is 1
            with `coupling`; without `coupling` the products describe propellers and rudders.
        angles: inputs whose sine and cosine are used.
        coupling: motions by which products of inputs are multiplied.
        coupling_degree: maximum degree of these factors.
        extra: additional terms by name.
    """

    motions: tuple[str, ...] = VELOCITY_NAMES
    motion_degree: int | None = Field(default=None, ge=0, le=4)
    magnitudes: bool = True
    inputs: tuple[str, ...] | None = None
    input_degree: int | None = Field(default=None, ge=0, le=4)
    angles: tuple[str, ...] = ()
    coupling: tuple[str, ...] = ()
    coupling_degree: int = Field(default=1, ge=1, le=4)
    extra: tuple[str, ...] = ()

    def generate_candidates(self, names: Sequence[str]) -> tuple[CandidateTerm, ...]:
        """Return the candidates for channels `names`, sorted by degree and complexity.

        Raises:
            ConfigError: if a configured channel does not exist in the model.
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
                    f"candidates: '{name}' is not a channel of the model{suggest_name(name, names)}"
                )
        motion_degree = 2 if self.motion_degree is None else self.motion_degree
        motion_products = _products_up_to(motions, motion_degree, magnitudes=self.magnitudes)
        if self.motion_degree is None and self._has_ship_inputs:
            motion_products += _products_of_degree(motions, 3)
        angle_functions = [
            "",
            *(f"{function}({angle})" for angle in angles for function in ("sin", "cos")),
        ]
        term_texts = [
            *motion_products,
            *_combine_products(self._input_products(motions, inputs), angle_functions),
            *self.extra,
        ]
        return rank_candidates(dict.fromkeys(term_text or "1" for term_text in term_texts), names)

    @property
    def _has_ship_inputs(self) -> bool:
        """Whether the products of inputs are the products of propellers and rudders."""
        return self.input_degree is None and not self.coupling

    def _input_products(self, motions: Sequence[str], inputs: Sequence[str]) -> list[str]:
        """Return the terms with inputs, alone and times products of coupled motions."""
        if self._has_ship_inputs:
            return _ship_input_products(motions, inputs, magnitudes=self.magnitudes)
        degree = 1 if self.input_degree is None else self.input_degree
        coupling_products = _products_up_to(
            self.coupling, self.coupling_degree if self.coupling else 0
        )
        return _combine_products(coupling_products, _products_up_to(inputs, degree))

    def find_nonsingular_terms(
        self, terms: Sequence[str], names: Sequence[str], z: Tensor
    ) -> Tensor:
        """Return whether each term [J] has no divisor near zero in the data, or is in `extra`.

        Args:
            z: channels of the data [N, nz].
        """
        import torch

        # a divisor must have one sign and stay away from zero relative to its size
        is_nonzero = z.amin(0) * z.amax(0) > 0
        is_nonzero &= z.abs().amin(0) >= _MIN_DIVISOR_SHARE * z.abs().amax(0)
        near_zero_channels = {
            name for name, is_clear in zip(names, is_nonzero.tolist(), strict=True) if not is_clear
        }
        return torch.tensor(
            [
                term in self.extra
                or not any(
                    factor.function == "inv" and factor.name in near_zero_channels
                    for factor in parse_term(term, names)
                )
                for term in terms
            ]
        )


_MIN_DIVISOR_SHARE = 0.1
"""Minimum ratio of the magnitude of a divisor to its maximum.

Noise of 1 % of the maximum then changes the quotient by at most 10 %.
"""


def _ship_input_products(
    motions: Sequence[str], inputs: Sequence[str], *, magnitudes: bool
) -> list[str]:
    """Return the terms of propellers and rudders: thrust, lift and ratios."""
    surge = [name for name in motions if name == "u"]
    speed_products, speed_squares = (
        _products_up_to(surge, degree, magnitudes=magnitudes) for degree in (1, 2)
    )
    # propeller thrust and rudder lift: an input up to its square, times the inflow speed
    single_input_products = [
        product_text
        for name in inputs
        for product_text in _products_up_to([name], 2, magnitudes=magnitudes)[1:]
    ]
    # interaction of two actuators, such as propeller and rudder in its slipstream
    input_pairs = [
        product_text
        for first_input, second_input in combinations(inputs, 2)
        for product_text in _combine_products(
            _products_up_to([first_input], 1, magnitudes=magnitudes)[1:],
            _products_up_to([second_input], 1, magnitudes=magnitudes)[1:],
        )
    ]
    # rudder lift and drag in the slipstream: squared revolutions times an angle or its square
    squares = [
        f"{squared_input} {factor}"
        for name in inputs
        for squared_input in ([f"{name}^2", f"{name} |{name}|"] if magnitudes else [f"{name}^2"])
        for other_input in inputs
        if other_input != name
        for factor in (other_input, f"{other_input}^2")
    ]
    # stall of a rudder, saturation of a thruster
    cubes = [f"{name}^3" for name in inputs]
    # advance ratio and similar quotients, with the protected division `inv`
    ratios = [
        f"{numerator} inv({name})".strip()
        for name in inputs
        for numerator in (
            *_products_up_to(motions, 2),
            *(other_input for other_input in inputs if other_input != name),
        )
    ]
    return [
        "",
        *_combine_products(speed_squares, single_input_products),
        *_combine_products(speed_products, input_pairs),
        *squares,
        *cubes,
        *ratios,
    ]


def _combine_products(*choices: Sequence[str]) -> list[str]:
    """Return the names of all products with one factor from each list; an empty factor is one."""
    return [" ".join(factor for factor in factors if factor) for factors in product(*choices)]


def rank_candidates(terms: Iterable[str], names: Sequence[str]) -> tuple[CandidateTerm, ...]:
    """Sort terms by degree, then by complexity.

    Raises:
        ConfigError: if a term is invalid.
    """
    ranked = []
    for term in terms:
        factors = parse_term(term, names)
        degree = sum(abs(factor.power) for factor in factors)
        # among terms of one degree, terms with few different channels come first, then terms
        # without magnitudes (0.5), functions (0.75) and divisions (1)
        complexity = len({factor.name for factor in factors}) + sum(
            0.5 * parsed_factor.magnitude
            + 0.75 * bool(parsed_factor.function)
            + (parsed_factor.power < 0)
            for parsed_factor in factors
        )
        ranked.append(CandidateTerm(term, degree, complexity))
    return tuple(sorted(ranked, key=lambda candidate: candidate[1:]))


def _products_of_degree(names: Sequence[str], degree: int) -> list[str]:
    """Return the products of exactly one degree, without magnitudes."""
    lower_products = set(_products_up_to(names, degree - 1))
    return [text for text in _products_up_to(names, degree) if text not in lower_products]


def _products_up_to(names: Sequence[str], degree: int, *, magnitudes: bool = False) -> list[str]:
    """Return the products up to a degree, the empty product first.

    At most one factor of a channel is a magnitude, because |x|^2 is x^2.
    """
    symbols = [(name, False) for name in names] + (
        [(name, True) for name in names] if magnitudes else []
    )
    products = []
    for product_degree in range(degree + 1):
        for combination in combinations_with_replacement(symbols, product_degree):
            if all(combination.count((name, True)) <= 1 for name in names):
                products.append(
                    " ".join(
                        Factor(
                            name, is_magnitude, combination.count((name, is_magnitude))
                        ).term_text
                        for name, is_magnitude in dict.fromkeys(combination)
                    )
                )
    return products
