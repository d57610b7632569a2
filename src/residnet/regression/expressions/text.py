"""Found expressions in writing: plain text, LaTeX, SymPy and C.

Terms may have functions of sums.
"""

from __future__ import annotations

from collections.abc import Sequence

from residnet.regression.expressions.algebra import Algebra, Product
from residnet.regression.expressions.notation import PLAIN, C, Style, c_body, signed_sum


def term(algebra: Algebra, product: Product, style: Style = PLAIN) -> str:
    """Return a product in writing, channels before functions; `1` where it is empty.

    It does not depend on the order in which atoms were found.
    """
    numbers = sorted(
        set(product),
        key=lambda i: (
            algebra.atoms[i].nesting,
            i if not algebra.atoms[i].inner else 0,
            _atom(algebra, i, PLAIN),
        ),
    )
    written = [(_atom(algebra, i, style), product.count(i)) for i in numbers]
    return (
        style.times.join(
            base if power == 1 else style.power(base, power) for base, power in written
        )
        or "1"
    )


def total(
    algebra: Algebra, products: Sequence[Product], weights: Sequence[float], style: Style
) -> str:
    """Return a sum of products; weights of 1 are not written."""
    parts = []
    for product, weight in zip(products, weights, strict=True):
        number, factors = style.number(abs(weight)), term(algebra, product, style)
        parts.append(
            number
            if not product
            else factors
            if weight in (1.0, -1.0)
            else number + style.times + factors
        )
    return signed_sum(parts, weights)


def c_function(
    algebra: Algebra, name: str, products: Sequence[Product], weights: Sequence[float]
) -> str:
    """Return a C99 function `double <name>(double <channel>, ...)`.

    It has all channels as arguments and needs <math.h>.
    """
    return c_body(name, algebra.channels, (), total(algebra, products, weights, C))


def _atom(algebra: Algebra, i: int, style: Style) -> str:
    atom = algebra.atoms[i]
    if not atom.inner:
        return style.channel(atom.channel)
    inner = sorted(atom.inner, key=lambda pair: (len(pair[0]), term(algebra, pair[0])))
    return style.functions[atom.function](
        total(algebra, [p for p, _ in inner], [w for _, w in inner], style)
    )
