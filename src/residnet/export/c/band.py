"""The half widths of a model's band as a C function."""

from __future__ import annotations

import math

from residnet.dynamics.band import BandTable
from residnet.export.c.arrays import literal

ABOUT = (
    "half widths of u, v, r, heading and position k steps after a measured state: between steps of"
    "\n * the table interpolated, beyond the last in proportion to time, infinite without a table"
)
"""Comment of the function in the header."""
_BODY = """    static const int steps[{count}] = {{{steps}}};
    static const REAL widths[{count}][5] = {{{widths}}};
    int i, after = 0;
    REAL from, share;
    while (after < {count} && steps[after] <= k) after++;
    for (i = 0; i < 5; i++) {{
        if (k <= 0) half[i] = ZERO;
        else if (after == {count})
            half[i] = widths[{last}][i] * ((REAL)k / (REAL)steps[{last}]);
        else {{
            from = after ? widths[after - 1][i] : ZERO;
            share = (REAL)(k - (after ? steps[after - 1] : 0));
            share /= (REAL)(steps[after] - (after ? steps[after - 1] : 0));
            half[i] = from + share * (widths[after][i] - from);
        }}
    }}
"""


def band_prototype(prefix: str) -> str:
    """Return the prototype of the function, whose names begin with a prefix."""
    return f"void {prefix}_band(int k, {prefix}_real *half)"


def band_body(table: BandTable | None) -> str:
    """Return the body of the function; half widths are infinite where there is no table."""
    steps: tuple[int, ...] = (1,)
    rows: list[tuple[float, ...]] = [(math.inf,) * 5]
    if table is not None:
        steps, rows = table.steps, list(zip(*table.columns, strict=True))
    shown = ["{" + ", ".join(map(literal, row)) + "}" for row in rows]
    return _BODY.format(
        count=len(steps),
        last=len(steps) - 1,
        steps=", ".join(map(str, steps)),
        widths=",\n        ".join(shown),
    )
