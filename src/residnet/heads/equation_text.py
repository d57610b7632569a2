"""Equations of terms in writing: plain text, LaTeX, SymPy and C."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from residnet.physics.terms import Factor, parse_term
from residnet.regression.notation import (
    LATEX,
    PLAIN,
    SYMPY,
    C,
    Style,
    c_body,
    latex_left,
    signed_sum,
)


class Written(NamedTuple):
    """One equation: the name of its left side, its terms, their coefficients, and the channels that
    may appear.
    """

    name: str
    terms: Sequence[str]
    values: Sequence[float]
    channels: Sequence[str]


def plain(equation: Written) -> str:
    """`u_dot = 0.0002026 tau_x - 0.0101 u`, six digits; terms as in the term language."""
    parts = [
        PLAIN.number(abs(v)) + ("" if t == "1" else f" {t}")
        for t, v in zip(equation.terms, equation.values, strict=True)
    ]
    return f"{equation.name} = " + signed_sum(parts, equation.values)


def latex(equation: Written) -> str:
    """LaTeX with six digits, names with more than one letter upright."""
    return f"{latex_left(equation.name)} = " + signed_sum(_parts(equation, LATEX), equation.values)


def sympy_text(equation: Written) -> str:
    """The right side as text that `sympy.sympify` reads, all digits; SymPy itself is not needed to
    write it.
    """
    return signed_sum(_parts(equation, SYMPY), equation.values)


def c_function(equation: Written, comment: str = "") -> str:
    """A C99 function `double <name>(double <channel>, ...)` with all channels as arguments, all
    digits; needs <math.h>.
    """
    used = {
        factor.name for term in equation.terms for factor in parse_term(term, equation.channels)
    }
    value = signed_sum(_parts(equation, C), equation.values) if equation.terms else "0.0"
    return c_body(equation.name, equation.channels, sorted(used), value, comment)


def _parts(equation: Written, style: Style) -> list[str]:
    """Magnitudes of the coefficients times factors."""
    return [
        style.times.join(
            [
                style.number(abs(value)),
                *(_factor(factor, style) for factor in parse_term(term, equation.channels)),
            ]
        )
        for term, value in zip(equation.terms, equation.values, strict=True)
    ]


def _factor(factor: Factor, style: Style) -> str:
    function = "abs" if factor.magnitude else factor.function
    name = style.channel(factor.name)
    symbol = style.functions[function](name) if function else name
    return symbol if factor.power == 1 else style.power(symbol, factor.power)
