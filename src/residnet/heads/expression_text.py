"""Found expressions in writing: plain text, LaTeX, SymPy and C, for terms with functions of sums as well."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from residnet.core.expressions import Algebra, Product
from residnet.heads.equation_text import latex_name


@dataclass(frozen=True)
class Style:
    """How to write: numbers, channels, powers, what stands between factors, and functions of what is within."""

    number: Callable[[float], str]
    channel: Callable[[str], str]
    power: Callable[[str, int], str]
    times: str
    functions: Mapping[str, Callable[[str], str]]


def _digits(value: float) -> str:
    return f"{value:.6g}"


def _latex_number(value: float) -> str:
    digits, _, exponent = _digits(value).partition("e")
    return rf"{digits} \cdot 10^{{{int(exponent)}}}" if exponent else digits


PLAIN = Style(
    _digits,
    lambda name: name,
    lambda base, n: f"{base}^{n}",
    " ",
    {
        "sum": lambda x: f"({x})",
        "abs": lambda x: f"|{x}|",
        "sin": lambda x: f"sin({x})",
        "cos": lambda x: f"cos({x})",
        "sqrt": lambda x: f"sqrt({x})",
        "inv": lambda x: f"inv({x})",
    },
)
LATEX = Style(
    _latex_number,
    latex_name,
    lambda base, n: rf"{{{base}}}^{{{n}}}",
    r" \, ",
    {
        "sum": lambda x: rf"\left({x}\right)",
        "abs": lambda x: rf"\left|{x}\right|",
        "sin": lambda x: rf"\sin\left({x}\right)",
        "cos": lambda x: rf"\cos\left({x}\right)",
        "sqrt": lambda x: rf"\sqrt{{\left|{x}\right|}}",
        "inv": lambda x: rf"\left({x}\right)^{{-1}}",
    },
)
SYMPY = Style(
    repr,
    lambda name: name,
    lambda base, n: f"({base})**{n}",
    "*",
    {
        "sum": lambda x: f"({x})",
        "abs": lambda x: f"Abs({x})",
        "sin": lambda x: f"sin({x})",
        "cos": lambda x: f"cos({x})",
        "sqrt": lambda x: f"sqrt(Abs({x}))",
        "inv": lambda x: f"Piecewise((0, Eq({x}, 0)), (1/({x}), True))",
    },
)
C = Style(
    repr,
    lambda name: name,
    lambda base, n: "*".join([base] * n),
    "*",
    {
        "sum": lambda x: f"({x})",
        "abs": lambda x: f"fabs({x})",
        "sin": lambda x: f"sin({x})",
        "cos": lambda x: f"cos({x})",
        "sqrt": lambda x: f"sqrt(fabs({x}))",
        "inv": lambda x: f"(({x}) == 0.0 ? 0.0 : 1.0/({x}))",
    },
)


def term(algebra: Algebra, product: Product, style: Style = PLAIN) -> str:
    """A product, channels before functions; `1` where it is empty. What it says does not depend on the order in which atoms were found."""
    numbers = sorted(set(product), key=lambda i: (algebra.atoms[i].nesting, i if not algebra.atoms[i].inner else 0, _atom(algebra, i, PLAIN)))
    written = [(_atom(algebra, i, style), product.count(i)) for i in numbers]
    return style.times.join(base if power == 1 else style.power(base, power) for base, power in written) or "1"


def total(algebra: Algebra, products: Sequence[Product], weights: Sequence[float], style: Style) -> str:
    """A sum of products; weights of 1 are not written."""
    out = ""
    for product, weight in zip(products, weights, strict=True):
        number, factors = style.number(abs(weight)), term(algebra, product, style)
        text = number if not product else factors if weight in (1.0, -1.0) else number + style.times + factors
        out += (" - " if weight < 0 else " + ") + text
    return ("-" if out.startswith(" - ") else "") + out[3:] or "0"


def c_function(algebra: Algebra, name: str, products: Sequence[Product], weights: Sequence[float]) -> str:
    """A C99 function `double <name>(double <channel>, ...)` with all channels as arguments; needs <math.h>."""
    unused = "".join(f"    (void){channel};\n" for channel in algebra.channels)
    arguments = ", ".join(f"double {channel}" for channel in algebra.channels)
    return f"double {name}({arguments})\n{{\n{unused}    return {total(algebra, products, weights, C)};\n}}\n"


def _atom(algebra: Algebra, i: int, style: Style) -> str:
    atom = algebra.atoms[i]
    if not atom.inner:
        return style.channel(atom.channel)
    inner = sorted(atom.inner, key=lambda pair: (len(pair[0]), term(algebra, pair[0])))
    return style.functions[atom.function](total(algebra, [p for p, _ in inner], [w for _, w in inner], style))
