"""The operations that a step may consist of, by the names that torch gives them.

What is in none of these tables is refused by name.
"""

from __future__ import annotations

MOVES: dict[str, tuple[int, ...]] = {
    **dict.fromkeys(
        (
            "alias", "clone", "detach", "lift_fresh_copy", "view", "_unsafe_view", "reshape",
            "permute", "t", "transpose", "expand", "select", "slice", "unsqueeze", "squeeze",
            "index_select", "index", "gather", "flip", "roll", "repeat", "unbind", "split",
            "split_with_sizes", "chunk", "diagonal", "unfold", "contiguous", "cat", "stack",
        ),
        (0,),
    ),
    "slice_scatter": (0, 1),
    "select_scatter": (0, 1),
    "index_copy": (0, 3),
}  # fmt: skip
"""Operations that only move numbers, with the places of the arguments whose numbers are moved."""

LIKE = frozenset(
    (
        "full_like", "zeros_like", "ones_like", "empty_like", "new_zeros", "new_ones", "new_full",
        "new_empty",
    )
)  # fmt: skip
"""Operations whose result depends on the shape of their argument alone."""

MAPS: dict[str, str] = {
    **{
        name: name
        for name in (
            "neg", "abs", "sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh",
            "asinh", "acosh", "atanh", "sigmoid", "exp", "exp2", "expm1", "log", "log1p", "log2",
            "log10", "sqrt", "rsqrt", "reciprocal", "relu", "sign", "floor", "ceil", "round",
            "trunc", "square", "erf", "erfc", "mul", "atan2", "hypot", "copysign", "maximum",
            "minimum", "fmod", "remainder", "where", "eq", "ne", "lt", "le", "gt", "ge", "isnan",
            "isinf",
        )
    },
    "logical_not": "not", "bitwise_not": "not",
    "logical_and": "and", "bitwise_and": "and",
    "logical_or": "or", "bitwise_or": "or",
    "logical_xor": "ne", "bitwise_xor": "ne",
}  # fmt: skip
"""Operations on each element, with the names that programs give them."""

FOLDS: dict[str, str] = {
    "sum": "add", "mean": "mean", "amax": "maximum", "amin": "minimum", "prod": "mul",
    "any": "or", "all": "and", "argmax": "argmax", "argmin": "argmin",
}  # fmt: skip
"""Reductions, with the names that programs give them."""
