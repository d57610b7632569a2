"""Equations of terms in writing: plain text, LaTeX, SymPy and C."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from residnet.regression.expressions.notation import (
    LATEX,
    PLAIN,
    SYMPY,
    C,
    Style,
    c_body,
    latex_left,
    signed_sum,
)


class Factor(NamedTuple):
    """A function of a channel to a whole power; no function stands for the channel itself."""

    function: str
    channel: str
    power: int


class Written(NamedTuple):
    """An equation to be written: a sum of terms with coefficients.

    Attributes:
        name: left side, for example `u_dot`.
        terms: names of the terms.
        factors: factors of each term.
        values: coefficients of the terms.
        channels: channels that may appear, in the order of a function's arguments.
    """

    name: str
    terms: Sequence[str]
    factors: Sequence[Sequence[Factor]]
    values: Sequence[float]
    channels: Sequence[str]


def plain(equation: Written) -> str:
    """Return `u_dot = 0.0002026 tau_x - 0.0101 u`, six digits; terms as in the term language."""
    parts = [
        PLAIN.number(abs(v)) + ("" if t == "1" else f" {t}")
        for t, v in zip(equation.terms, equation.values, strict=True)
    ]
    return f"{equation.name} = " + signed_sum(parts, equation.values)


def latex(equation: Written) -> str:
    """Return LaTeX with six digits, names with more than one letter upright."""
    return f"{latex_left(equation.name)} = " + signed_sum(_parts(equation, LATEX), equation.values)


def sympy_text(equation: Written) -> str:
    """Return the right side as text that `sympy.sympify` reads, all digits.

    SymPy itself is not needed to write it.
    """
    return signed_sum(_parts(equation, SYMPY), equation.values)


def c_function(equation: Written, comment: str = "") -> str:
    """Return a C99 function `double <name>(double <channel>, ...)`, all digits.

    It has all channels as arguments and needs <math.h>.
    """
    used = {factor.channel for factors in equation.factors for factor in factors}
    value = signed_sum(_parts(equation, C), equation.values) if equation.terms else "0.0"
    return c_body(equation.name, equation.channels, sorted(used), value, comment)


def _parts(equation: Written, style: Style) -> list[str]:
    """Return magnitudes of the coefficients times factors."""
    return [
        style.times.join(
            [
                style.number(abs(value)),
                *(_factor(factor, style) for factor in factors),
            ]
        )
        for factors, value in zip(equation.factors, equation.values, strict=True)
    ]


def _factor(factor: Factor, style: Style) -> str:
    name = style.channel(factor.channel)
    symbol = style.functions[factor.function](name) if factor.function else name
    return symbol if factor.power == 1 else style.power(symbol, factor.power)
