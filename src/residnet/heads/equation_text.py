"""Equations in writing: plain text, LaTeX, SymPy and C."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

from residnet.physics.terms import Factor, parse_term


class Written(NamedTuple):
    """One equation: the name of its left side, its terms, their coefficients, and the channels that may appear."""

    name: str
    terms: Sequence[str]
    values: Sequence[float]
    channels: Sequence[str]


def plain(equation: Written) -> str:
    """`u_dot = 0.0002026 tau_x - 0.0101 u`, six digits; terms as in the term language."""
    return f"{equation.name} = " + _sum([f"{abs(v):.6g}" + ("" if t == "1" else f" {t}") for t, v in _pairs(equation)], equation.values)


def latex(equation: Written) -> str:
    """LaTeX with six digits, names with more than one letter upright."""
    parts = [r" \, ".join([_number(abs(value)), *(_latex_factor(factor) for factor in _factors(term, equation))]) for term, value in _pairs(equation)]
    base, dot, _ = equation.name.rpartition("_dot")
    left = rf"\dot{{{latex_name(base)}}}" if dot else latex_name(equation.name)
    return f"{left} = " + _sum(parts, equation.values)


def sympy_text(equation: Written) -> str:
    """The right side as text that `sympy.sympify` reads, all digits; SymPy itself is not needed to write it."""
    parts = ["*".join([repr(float(value)), *(_sympy_factor(factor) for factor in _factors(term, equation))]) for term, value in _pairs(equation)]
    return " + ".join(parts) or "0"


def c_function(equation: Written, comment: str = "") -> str:
    """A C99 function `double <name>(double <channel>, ...)` with all channels as arguments, all digits; needs <math.h>."""
    parts = ["*".join([repr(float(value)), *(_c_factor(factor) for factor in _factors(term, equation))]) for term, value in _pairs(equation)]
    used = {factor.name for term in equation.terms for factor in _factors(term, equation)}
    unused = "".join(f"    (void){name};\n" for name in equation.channels if name not in used)
    note = f"/* {comment} */\n" if comment else ""
    body = "\n        + ".join(parts) or "0.0"
    return f"{note}double {equation.name}({', '.join(f'double {name}' for name in equation.channels)})\n{{\n{unused}    return {body};\n}}\n"


def _pairs(equation: Written) -> list[tuple[str, float]]:
    return list(zip(equation.terms, equation.values, strict=True))


def _factors(term: str, equation: Written) -> tuple[Factor, ...]:
    return parse_term(term, equation.channels)


def _sum(parts: Sequence[str], values: Sequence[float]) -> str:
    if not parts:
        return "0"
    signs = ["- " if value < 0 else "+ " for value in values]
    return ("-" if signs[0] == "- " else "") + parts[0] + "".join(f" {sign}{part}" for sign, part in zip(signs[1:], parts[1:], strict=True))


def _number(value: float) -> str:
    digits, _, exponent = f"{value:.6g}".partition("e")
    return rf"{digits} \cdot 10^{{{int(exponent)}}}" if exponent else digits


def latex_name(name: str) -> str:
    """A channel in LaTeX, names with more than one letter upright."""
    head, _, foot = name.partition("_")
    greek = head in ("tau", "delta", "psi", "phi", "eta", "nu")
    symbol = f"\\{head}" if greek else head if len(head) == 1 else rf"\mathrm{{{head}}}"
    return symbol + (rf"_{{\mathrm{{{foot.replace('_', ',')}}}}}" if foot else "")


_LATEX: dict[str, Callable[[str], str]] = {
    "": lambda x: x,
    "sin": lambda x: rf"\sin {x}",
    "cos": lambda x: rf"\cos {x}",
    "sqrt": lambda x: rf"\sqrt{{|{x}|}}",
    "ssqrt": lambda x: rf"\operatorname{{sgn}}({x})\sqrt{{|{x}|}}",
    "inv": lambda x: rf"{x}^{{-1}}",
}
_SYMPY: dict[str, Callable[[str], str]] = {
    "": lambda x: x,
    "sin": lambda x: f"sin({x})",
    "cos": lambda x: f"cos({x})",
    "sqrt": lambda x: f"sqrt(Abs({x}))",
    "ssqrt": lambda x: f"sign({x})*sqrt(Abs({x}))",
    "inv": lambda x: f"Piecewise((0, Eq({x}, 0)), (1/{x}, True))",
}
_C: dict[str, Callable[[str], str]] = {
    "": lambda x: x,
    "sin": lambda x: f"sin({x})",
    "cos": lambda x: f"cos({x})",
    "sqrt": lambda x: f"sqrt(fabs({x}))",
    "ssqrt": lambda x: f"copysign(sqrt(fabs({x})), {x})",
    "inv": lambda x: f"({x} == 0.0 ? 0.0 : 1.0/{x})",
}


def _latex_factor(factor: Factor) -> str:
    name = latex_name(factor.name)
    symbol = f"|{name}|" if factor.magnitude else _LATEX[factor.function](name)
    if factor.power == 1:
        return symbol
    return (rf"\left({symbol}\right)" if factor.function else symbol) + f"^{{{factor.power}}}"


def _sympy_factor(factor: Factor) -> str:
    symbol = f"Abs({factor.name})" if factor.magnitude else _SYMPY[factor.function](factor.name)
    return symbol if factor.power == 1 else f"({symbol})**({factor.power})"


def _c_factor(factor: Factor) -> str:
    symbol = f"fabs({factor.name})" if factor.magnitude else _C[factor.function](factor.name)
    product = "*".join([symbol] * abs(factor.power))
    return f"(1.0/({product}))" if factor.power < 0 else product
