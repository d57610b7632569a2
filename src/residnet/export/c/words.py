"""How each operation of a program is written in C99, with the small functions that some need."""

from __future__ import annotations

FUNCTIONS = (
    "sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh", "asinh", "acosh",
    "atanh", "exp", "exp2", "expm1", "log", "log1p", "log2", "log10", "sqrt", "floor", "ceil",
    "trunc", "erf", "erfc", "atan2", "hypot", "pow", "fmod", "copysign", "rint", "fabs",
)  # fmt: skip
"""Functions of C's own library, called `R(name)`, which adds an `f` in single precision."""

OPERATORS: dict[str, str] = {
    "add": "{0} + {1}", "sub": "{0} - {1}", "mul": "{0} * {1}", "div": "{0} / {1}",
    "neg": "-{0}", "square": "{0} * {0}", "reciprocal": "ONE / {0}",
    "rsqrt": "ONE / R(sqrt)({0})", "abs": "R(fabs)({0})", "round": "R(rint)({0})",
    "sigmoid": "ONE / (ONE + R(exp)(-{0}))",
    "eq": "{0} == {1}", "ne": "{0} != {1}", "lt": "{0} < {1}", "le": "{0} <= {1}",
    "gt": "{0} > {1}", "ge": "{0} >= {1}",
    "and": "{0} && {1}", "or": "{0} || {1}", "not": "!{0}",
    "isnan": "{0} != {0}", "isinf": "{0} - {0} != {0} - {0} && {0} == {0}",
    "where": "{0} ? {1} : {2}", "number": "(REAL){0}",
}  # fmt: skip
"""Operations that are expressions of their operands."""

HELPERS: dict[str, str] = {
    "maximum": "(REAL a, REAL b) { return (a > b || a != a) ? a : b; }",
    "minimum": "(REAL a, REAL b) { return (a < b || a != a) ? a : b; }",
    "relu": "(REAL a) { return (a > ZERO || a != a) ? a : ZERO; }",
    "sign": "(REAL a) { return (REAL)((a > ZERO) - (a < ZERO)); }",
    "remainder": (
        "(REAL a, REAL b) { const REAL c = R(fmod)(a, b);"
        " return (c != ZERO && ((c < ZERO) != (b < ZERO))) ? c + b : c; }"
    ),
}
"""Operations that are functions of their own: what follows the name."""


def expression(op: str, operands: list[str], prefix: str) -> str:
    """Return an operation in C; `prefix` stands before the names of helper functions.

    Raises:
        KeyError: where there is no such operation.
    """
    if op in OPERATORS:
        return OPERATORS[op].format(*operands)
    call = ", ".join(operands)
    if op in HELPERS:
        return f"{prefix}{op}({call})"
    if op in FUNCTIONS:
        return f"R({op})({call})"
    raise KeyError(op)
