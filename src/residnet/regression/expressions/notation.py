"""How formulas are written: plain text, LaTeX, SymPy and C.

One table of functions serves equations of terms and bred expressions.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class Style:
    """A way to write formulas.

    Numbers, channels, powers (positive, or negative for a divisor), what stands between factors,
    and functions of what is within.
    """

    number: Callable[[float], str]
    channel: Callable[[str], str]
    power: Callable[[str, int], str]
    times: str
    functions: Mapping[str, Callable[[str], str]]


def signed_sum(parts: Sequence[str], values: Sequence[float]) -> str:
    """Return parts written without sign, joined by the signs of their values; `0` for none."""
    out = "".join(
        (" - " if value < 0 else " + ") + part for part, value in zip(parts, values, strict=True)
    )
    return ("-" if out.startswith(" - ") else "") + out[3:] or "0"


def c_body(
    name: str, channels: Sequence[str], used: Sequence[str], value: str, comment: str = ""
) -> str:
    """Return a C99 function `double <name>(double <channel>, ...)` that returns `value`.

    It has all channels as arguments and needs <math.h>.
    """
    unused = "".join(f"    (void){channel};\n" for channel in channels if channel not in used)
    note = f"/* {comment} */\n" if comment else ""
    return (
        f"{note}double"
        f" {name}({', '.join(f'double {channel}' for channel in channels)})\n{{\n{unused}    return"
        f" {value};\n}}\n"
    )


def latex_name(name: str) -> str:
    """Return a channel in LaTeX, names with more than one letter upright."""
    head, _, foot = name.partition("_")
    greek = head in ("tau", "delta", "psi", "phi", "eta", "nu")
    symbol = f"\\{head}" if greek else head if len(head) == 1 else rf"\mathrm{{{head}}}"
    return symbol + (rf"_{{\mathrm{{{foot.replace('_', ',')}}}}}" if foot else "")


def latex_left(name: str) -> str:
    """Return the left side of an equation; `u_dot` gets its dot."""
    base, dot, _ = name.rpartition("_dot")
    return rf"\dot{{{latex_name(base)}}}" if dot else latex_name(name)


def _digits(value: float) -> str:
    return f"{value:.6g}"


def _latex_number(value: float) -> str:
    digits, _, exponent = _digits(value).partition("e")
    return rf"{digits} \cdot 10^{{{int(exponent)}}}" if exponent else digits


def _latex_power(base: str, n: int) -> str:
    bare = "(" not in base and "sqrt" not in base
    return rf"{{{base}}}^{{{n}}}" if bare else rf"\left({base}\right)^{{{n}}}"


def _c_power(base: str, n: int) -> str:
    product = "*".join([base] * abs(n))
    return f"(1.0/({product}))" if n < 0 else product


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
        "ssqrt": lambda x: f"ssqrt({x})",
        "inv": lambda x: f"inv({x})",
    },
)
LATEX = Style(
    _latex_number,
    latex_name,
    _latex_power,
    r" \, ",
    {
        "sum": lambda x: rf"\left({x}\right)",
        "abs": lambda x: rf"\left|{x}\right|",
        "sin": lambda x: rf"\sin\left({x}\right)",
        "cos": lambda x: rf"\cos\left({x}\right)",
        "sqrt": lambda x: rf"\sqrt{{\left|{x}\right|}}",
        "ssqrt": lambda x: rf"\operatorname{{sgn}}\left({x}\right)\sqrt{{\left|{x}\right|}}",
        "inv": lambda x: rf"\left({x}\right)^{{-1}}",
    },
)
SYMPY = Style(
    lambda value: repr(float(value)),
    lambda name: name,
    lambda base, n: f"({base})**({n})",
    "*",
    {
        "sum": lambda x: f"({x})",
        "abs": lambda x: f"Abs({x})",
        "sin": lambda x: f"sin({x})",
        "cos": lambda x: f"cos({x})",
        "sqrt": lambda x: f"sqrt(Abs({x}))",
        "ssqrt": lambda x: f"sign({x})*sqrt(Abs({x}))",
        "inv": lambda x: f"Piecewise((0, Eq({x}, 0)), (1/({x}), True))",
    },
)
C = Style(
    lambda value: repr(float(value)),
    lambda name: name,
    _c_power,
    "*",
    {
        "sum": lambda x: f"({x})",
        "abs": lambda x: f"fabs({x})",
        "sin": lambda x: f"sin({x})",
        "cos": lambda x: f"cos({x})",
        "sqrt": lambda x: f"sqrt(fabs({x}))",
        "ssqrt": lambda x: f"copysign(sqrt(fabs({x})), {x})",
        "inv": lambda x: f"(({x}) == 0.0 ? 0.0 : 1.0/({x}))",
    },
)
