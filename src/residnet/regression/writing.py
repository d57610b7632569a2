"""Equations in writing: plain text as in the term language, LaTeX, SymPy and C, by SymPy."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from residnet.regression.expressions import Algebra, Product

if TYPE_CHECKING:
    import sympy

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
        text: right side in plain text.
        value: right side.
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
