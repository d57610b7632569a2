"""Rollouts and their gradients as compiled C: many free runs at once, and training through them.

One step of a rollout becomes a CasADi function of single numbers, beside products with the matrices
that all rows share. It and the product of its Jacobian with a gradient are written for blocks of
rows by the vector types that gcc and clang know, compiled for this machine and called for all steps
of a run. Gradients of matrices follow from what the steps leave, in one product each.
"""

from __future__ import annotations

import copy
import ctypes
import math
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from importlib import resources
from itertools import accumulate, chain, groupby, pairwise
from typing import Any, final

import casadi as ca
import numpy as np
import torch
from torch import Tensor, nn

from residnet.core.errors import ExportError
from residnet.core.processes import available_cores
from residnet.engine.c_code import (
    FUNCTIONS,
    Body,
    Tables,
    compiled_library,
    literal,
)
from residnet.engine.rollout import Rollout
from residnet.engine.trace import Parts, in_numbers, in_parts

_VISITED, _ROWS, _STEPS = 40, 16, 3
"""The compiled rollout is checked over so many steps from every state that some runs visit in their
first steps: long enough that a step hands all on, too short for rounding to grow in a steep law.
"""
_SAME, _ROUNDED = 1e-6, 5e-3
"""How far it may be off: in double precision, and the median row in the precision of runs."""
_LONGEST = 20_000
"""Most operations on single numbers of a step: more take a compiler minutes."""
_HANDED_ON = ("x", "s", "q")
"""State, memory of the vessel and memory of the source, which a step hands on."""
_WHAT = "rollout"
_TWO = ("atan2", "hypot", "pow", "fmod", "copysign")


_PRELUDE, FLY, BACK = (
    resources.files("residnet.engine").joinpath(name).read_text()
    for name in ("lanes.h", "fly.c", "back.c")
)
_ONE_BY_ONE = {
    name: f"static __attribute__((noinline)) V v_{name}"
    + ("(V a, V b)" if name in _TWO else "(V a)")
    + f" {{ V o; EACH o[l] = R({name})(a[l]{', b[l]' if name in _TWO else ''}); return o; }}\n"
    for name in sorted(set(FUNCTIONS.values()))
}
"""Functions of C's library, which takes one number at a time."""


def _horner(x: str, *parts: float) -> str:
    """Return a polynomial in C, its coefficients from the constant on."""
    first, *rest = parts
    return f"(ALL({first!r}) + {x} * {_horner(x, *rest)})" if rest else f"ALL({first!r})"


def _at_once(terms: int, bits: int, bias: int, most: float, odd: int) -> dict[str, str]:
    """Return functions of many numbers at once, right but for the last digits, by name.

    They are those that networks call most. With C's library a step of a recurrent network takes six
    times as long.

    Args:
        terms: of the exponential's series for what is at most half of log 2, behind its one.
        bits: of a number behind its exponent.
        bias: of the exponent.
        most: beyond which the exponential is infinite; below about its opposite it is zero.
        odd: terms of the logarithm's series for what is at most 0.172, by odd powers.
    """
    log = [2.0 / (2 * k + 1) for k in range(odd)]
    head = '__attribute__((noinline, optimize("no-associative-math"))) static V '
    # the same for clang
    kept = "\n#pragma clang fp reassociate(off)\n"
    # a sum with so large a number ends in the nearest whole one
    whole = f"ALL({1.5 * 2.0**bits!r})"
    # e^a = 2^n e^r, whose rest r is at most half of log 2: `half` of 2^n, which is never beyond
    # what there is, and twice e^r - 1, `more`. The two parts of log 2 must stay apart: the first
    # has so few digits that its multiples are exact
    apart = (
        f"    V sum = a * ALL({1.0 / math.log(2.0)!r}) + {whole}, n = sum - {whole};\n"
        "    V r = a - n * ALL(0.693359375);\n"
        "    r = r - n * ALL(-2.12194440054690583e-4);\n"
        f"    V half = (V)(((I)sum << {bits}) + ((INT){bias - 1} << {bits}));\n"
        f"    V more = r * {_horner('r', *(2.0 / math.factorial(k + 1) for k in range(terms)))};\n"
    )
    return {
        "exp": (
            f"{head}v_exp(V a) {{{kept}{apart}"
            f"    V o = pick(a < ALL({-(bias - 1.5) * math.log(2.0)!r}), ALL(ZERO),"
            " half * (more + ALL(2)));\n"
            f"    return pick(a > ALL({most!r}), ALL(INFINITY), o);\n}}\n"
        ),
        # by e^2a - 1, all of whose digits are right where it is small
        "tanh": (
            f"{head}v_tanh(V x) {{{kept}"
            "    V a = ALL(2) * pick(x < ZERO, -x, x);\n"
            f"    a = pick(a > ALL(50), ALL(50), a);\n{apart}"
            "    V e = half * more + (ALL(2) * half - ONE), t = e / (e + ALL(2));\n"
            "    return pick(x < ZERO, -t, t);\n}\n"
        ),
        # the logarithm of u = 1 + a = 2^n m with m around one, by that of (1 + t) / (1 - t), and
        # what rounding took from u. A zero, less than that and infinity follow from u itself
        "log1p": (
            f"{head}v_log1p(V a) {{{kept}"
            "    V u = a + ONE, lost = (a - (u - ONE)) / u;\n"
            f"    I n = ((I)u >> {bits}) - {bias};\n"
            f"    V m = (V)((I)u - (n << {bits}));\n"
            "    I high = m > ALL(1.4142135623730951);\n"
            "    m = pick(high, m * ALL(.5), m);\n"
            "    n = n - high;\n"
            "    V t = (m - ONE) / (m + ONE), s = t * t, whole = __builtin_convertvector(n, V);\n"
            f"    V low = t * {_horner('s', *log)} + lost + whole * ALL(-2.12194440054690583e-4);\n"
            "    V o = low + whole * ALL(0.693359375);\n"
            "    o = pick(u < ALL(INFINITY), o, u);\n"
            "    return pick(u > ZERO, o, pick(u < ZERO, ALL(NAN), u - ALL(INFINITY)));\n}\n"
        ),
    }


_AT_ONCE = {
    torch.float32: _at_once(7, 23, 127, 89.0, 6),
    torch.float64: _at_once(13, 52, 1023, 710.0, 12),
}
_SIDE_BY_SIDE = 8
"""Sums of a product that are in registers at once, each an entry of its result."""


def _sums(count: int, entry: str) -> str:
    """Return C that adds up so many entries of a product from j on, side by side."""
    each = range(count)
    cells = "".join(f" V c{q} = {{0}};" for q in each)
    added = "".join(f" c{q} += v * {entry.format(q)};" for q in each)
    stored = "".join(f" *(U *)(to + (j + {q}) * LANES) = c{q};" for q in each)
    return (
        f"    for (; j + {count} <= to_count; j += {count}) {{\n       {cells}\n"
        f"        for (long i = 0; i < count; i++) {{\n"
        f"            V v = *(const U *)(from + i * LANES);{added}\n        }}\n"
        f"       {stored}\n    }}\n"
    )


_CURVES = {
    "tanh": ("v_tanh(v)", "ONE - v * v"),
    "sigmoid": ("ONE / (ONE + v_exp(-v))", "v * (ONE - v)"),
}
"""Curves, and their slopes by the values of the curves."""
_BEND = "".join(
    f"static void times_{name}(const REAL *from, REAL *to, long count) {{\n"
    "    for (long i = 0; i < count * LANES; i += LANES) {\n"
    f"        V v = *(const U *)(from + i);\n        *(U *)(to + i) = {value};\n    }}\n}}\n"
    f"static void back_times_{name}(const REAL *value, const REAL *from, REAL *to, long count) {{\n"
    "    for (long i = 0; i < count * LANES; i += LANES) {\n"
    "        V v = *(const U *)(value + i);\n"
    f"        *(U *)(to + i) = *(const U *)(from + i) * ({slope});\n    }}\n}}\n"
    for name, (value, slope) in _CURVES.items()
)
"""Curves of many numbers of a row, and the slopes of these numbers."""
_PRODUCT = "".join(
    f"static __attribute__((noinline)) void {name}(const REAL *restrict table, long count,"
    " long to_count, const REAL *restrict from, REAL *restrict to) {\n"
    "    long j = 0;\n" + _sums(_SIDE_BY_SIDE, entry) + _sums(1, entry) + "}\n"
    for name, entry in (
        ("times", "table[i * to_count + j + {0}]"),
        ("back_times", "table[(j + {0}) * count + i]"),
    )
)
"""Numbers [count] of a row times a matrix [count, to_count], and times the transposed of one."""


def _prelude(dtype: torch.dtype) -> str:
    """Return what stands at the top of a file in this precision."""
    single = dtype == torch.float32
    words = {
        "REAL": "float" if single else "double",
        "INT": "int" if single else "long long",
        "R(name)": "name##f" if single else "name",
    }
    defined = [f"#define {name} {text}\n" for name, text in words.items()]
    functions = _ONE_BY_ONE | _AT_ONCE[dtype]
    return "".join((*defined, _PRELUDE, *functions.values(), _PRODUCT, _BEND))


Calls = Mapping[str, Sequence[tuple[str, str]]]


class _Lanes(Body):
    """Writes a function of single numbers for a block of `LANES` rows.

    An entry of an argument or result stands so many numbers behind the one before it as `strides`
    says, and the rows of an entry stand side by side. Numbers `theta` are shared by all rows.

    Args:
        function: to be written.
        strides: of arguments and results, by name; `LANES` where not given.
        calls: which arguments are made from a result once this is complete, and by which
            statements; by the result's name.
    """

    REAL, FLAG = "V", "I"
    unrolled = math.inf
    joined: Mapping[int, str] = {
        ca.OP_NOT: "~{0}", ca.OP_AND: "{0} & {1}", ca.OP_OR: "{0} | {1}"
    }  # fmt: skip

    def __init__(self, function: ca.Function, strides: Mapping[str, str], calls: Calls) -> None:
        self.strides, self.calls = strides, calls
        self.given = list(function.name_out())
        super().__init__(function, Tables(""), _WHAT)

    def literal(self, value: float) -> str:
        return f"ALL({literal(value)})"

    def place(self, name: str, place: int) -> str:
        """Return where an entry stands."""
        return f"(U *)({name} + {place} * {self.strides.get(name, 'LANES')})"

    def argument(self, name: str, place: int) -> str:
        return f"ALL({name}[{place}])" if name == "theta" else f"(*{self.place(name, place)})"

    def put(self, result: int, column: Any) -> None:
        super().put(result, column)
        name, cells = self.given[result], self.results[result]
        if name in self.calls and len(cells) == self.function.numel_out(result):
            stored = [f"*{self.place(name, i)} = {cell};" for i, cell in enumerate(cells)]
            for made, text in self.calls[name]:
                self.lines.append((made, " ".join((*stored, text))))
                stored = []

    def real(self, cell: str, flag: bool) -> str:
        return f"pick({cell}, ALL(ONE), ALL(ZERO))" if flag else cell

    def truth(self, cell: str, flag: bool) -> str:
        return cell if flag else f"({cell} != ZERO)"

    def pick(self, condition: str, value: str, alternative: str) -> str:
        return f"pick({condition}, {value}, {alternative})"

    def call(self, name: str, row: Sequence[str]) -> str:
        return f"v_{name}({', '.join(row)})"


def _function(
    name: str,
    function: ca.Function,
    strides: Mapping[str, str],
    calls: Calls,
    begun: Mapping[str, str],
    added: Sequence[str] = (),
) -> str:
    """Return the C function of a step for a block of rows.

    Args:
        name: of the function.
        function: of single numbers.
        strides, calls: as `_Lanes` has them.
        begun: arguments and results that stand elsewhere, and the statement that says where.
        added: results that are added to what stands there.
    """
    body = _Lanes(function, strides, calls)
    ends = [f"(void){made};" for made, _ in chain(*calls.values())]
    for result, cells in zip(function.name_out(), body.results, strict=True):
        if result not in calls:
            sign = "+=" if result in added else "="
            ends += [
                f"*{body.place(result, i)} {sign} {cell};"
                for i, cell in enumerate(cells)
                if result not in added or cell != body.zero
            ]
    given = [f"const REAL *restrict {one}" for one in body.names if one not in begun]
    taken = [f"REAL *restrict {one}" for one in function.name_out() if one not in begun]
    apart = "const REAL *tables, REAL *held, REAL *pulled, const long stride"
    head = f"static void {name}({', '.join((*given, *taken, apart))})"
    return head + " {\n" + "\n".join((*begun.values(), *body.read(ends))) + "\n}\n"


def _source(
    parts: Parts,
    sizes: Mapping[str, int],
    trained: Sequence[int] | None,
    dtype: torch.dtype,
    *,
    apart: bool,
) -> tuple[str, dict[str, slice], dict[str, slice]]:
    """Return the source file with the functions `fly` and, where there is a gradient, `back`.

    With it come the places of what a step keeps for its gradient, and of slopes of products.

    Args:
        parts: of a step.
        sizes: number of entries of each of its arguments, and `a` of what acts.
        trained: places in `theta` that have a gradient; None where nothing has one.
        dtype: precision of the file.
        apart: whether each row has a gradient of matrices for itself.
    """
    step = in_numbers(parts.function)
    if not step.is_a("SXFunction") or step.n_instructions() > _LONGEST:
        raise ExportError("a step too long, or with tables too long, to be written for many rows")
    numbers = dict(enumerate(parts.products))
    matrices = [k for k, one in numbers.items() if not one.curve]
    tables = [0, *accumulate(one.numbers for one in parts.products)]
    size = {
        f"{name}_{k}{end}": one.rows * count
        for k, one in numbers.items()
        for name, count in (("product", one.given), ("factor", one.taken))
        for end in ("", "_slope")
    }
    strides = dict.fromkeys(
        ("x", "w", "s", "q", "own", "x_after", "s_after", "q_after", "a"), "stride"
    )

    def laid(array: str, names: Sequence[str]) -> tuple[dict[str, slice], dict[str, str]]:
        """Return places in an array of what is kept, and statements that say where it stands."""
        ends = [0, *accumulate(size[name] for name in names)]
        return (
            {name: slice(*pair) for name, pair in zip(names, pairwise(ends), strict=True)},
            {
                name: f"REAL *{name} = {array} + {begin} * LANES;"
                for name, begin in zip(names, ends, strict=False)
            },
        )

    def slope_of(k: int) -> str:
        return first.get(name := f"product_{k}_slope", name)

    def local(name: str) -> str:
        return f"REAL {name}[{size[name]} * LANES] __attribute__((aligned(BYTES)));"

    def calls(way: str, start: str, end: str) -> Calls:
        found: dict[str, list[tuple[str, str]]] = {}
        for k, one in numbers.items():
            a, b = start.format(k), end.format(k)
            a = first.get(a, a)
            here, there = size[a] // one.rows, size[b] // one.rows
            text = "".join(
                f"{way}(tables + {tables[k]}, {here}, {there}, {a} + {r * here} * LANES,"
                f" {b} + {r * there} * LANES);"
                for r in range(one.rows)
            )
            if one.curve:
                value = "" if way == "times" else f"product_{k}, "
                text = f"{way}_{one.curve}({value}{a}, {b}, {here});"
            found.setdefault(a, []).append((b, text))
        return found

    held, pulled = dict[str, slice](), dict[str, slice]()
    kept, first, back = dict[str, str](), dict[str, str](), list[str]()
    if trained is not None:
        alone = [k for k in matrices if numbers[k].rows == 1]
        slope, first = _slope(step, sizes, len(numbers), trained, alone)
        given = _symbols(slope)
        whole = ca.veccat(*slope.call(given))
        # products that slopes do not hang on, as those of an affine layer, are not kept
        values = {f"product_{k}": bool(one.curve) for k, one in numbers.items()}
        values |= {
            name: values[name] or ca.depends_on(whole, one)
            for name, one in zip(slope.name_in(), given, strict=True)
            if name in values
        }
        held, kept = laid(
            "held",
            [name for name, wanted in values.items() if wanted]
            + [f"factor_{k}" for k in sorted(matrices, key=slope_of)],
        )
        pulled, begun = laid("pulled", [*dict.fromkeys(map(slope_of, matrices))])
        pulled |= {f"product_{k}_slope": pulled[slope_of(k)] for k in matrices}
        begun |= {name: kept.get(name, "") for name in values}
        begun |= {n: local(n) for n in size if n.endswith("_slope") and n not in begun}
        back = [
            _function(
                "slope",
                slope,
                strides | dict.fromkeys(("x_slope", "a_slope", "x_before"), "stride"),
                calls("back_times", "product_{}_slope", "factor_{}_slope"),
                begun,
                ("x_before", "total"),
            )
        ]
    forward = kept | {n: local(n) for n in size if n not in kept and not n.endswith("_slope")}
    fly = _function(
        "step",
        _flowing(step, len(numbers)),
        strides,
        calls("times", "factor_{}", "product_{}"),
        forward,
    )
    plain = len(trained or ())
    outer = "".join(
        f"outer(KEPT(held, N_HELD, k) + {held[f'factor_{k}'].start + r * one.taken} * LANES,"
        f" {one.taken}, KEPT(pulled, N_PULLED, k)"
        f" + {pulled[f'product_{k}_slope'].start + r * one.given} * LANES, {one.given},"
        f" total + at * N_TOTAL + {plain + tables[k]} * LANES);\n"
        for k, one in numbers.items()
        for r in range(one.rows)
        if apart and not one.curve
    )
    counts = dict(sizes) | {
        "held": _end(held),
        "pulled": _end(pulled),
        "total": plain + apart * tables[-1],
    }
    text = "".join(f"#define N_{name.upper()} {value}L\n" for name, value in counts.items())
    if trained is not None:
        back.append(BACK.replace("OUTER\n", outer))
    return "".join((_prelude(dtype), text, fly, *back[:1], FLY, *back[1:])), held, pulled


_GIVEN = ("x", "w", "s", "q", "own", "theta")


def _symbols(step: ca.Function) -> list[ca.SX]:
    return [ca.SX.sym(name, step.numel_in(name)) for name in step.name_in()]


def _known(found: ca.SX, apart: Sequence[ca.SX], values: Sequence[ca.SX]) -> ca.SX:
    """Return an expression with what a step detaches put in."""
    # what is detached may hang on what was detached before it
    for symbol, value in zip(reversed(apart), reversed(values), strict=True):
        found = ca.substitute(found, symbol, value)
    return ca.densify(found)


def _flowing(step: ca.Function, products: int) -> ca.Function:
    """Return a step that computes what it detaches."""
    given = _symbols(step)
    inside = len(_GIVEN) + products
    names = step.name_out()[: products + len(_HANDED_ON) + 1]
    found = step.call(given)
    parts = [_known(one, given[inside:], found[len(names) :]) for one in found[: len(names)]]
    return ca.Function("step", given[:inside], ca.cse(parts), step.name_in()[:inside], names)


def _slope(
    step: ca.Function,
    sizes: Mapping[str, int],
    products: int,
    trained: Sequence[int],
    alone: Sequence[int],
) -> tuple[ca.Function, dict[str, str]]:
    """Return the product of a step's Jacobian with the slopes of what it gives.

    The slopes of a product need those of the factors of later ones alone, and stand in that order.
    Products that are added up have their slopes in common: of those in `alone`, slopes that are the
    same are told once, and the second of what is returned says by the name of which product.
    """
    given = _symbols(step)
    inside = len(_GIVEN) + products
    x, _, s, q, _, theta, *made = given[:inside]
    found = step.call(given)
    factors, results = found[:products], found[products : products + len(_HANDED_ON) + 1]
    slopes = [ca.SX.sym(f"{name}_slope", sizes[name]) for name in (*_HANDED_ON, "a")]
    inner = [ca.SX.sym(f"factor_{k}_slope", one.numel()) for k, one in enumerate(factors)]
    known = [*made, x, s, q, theta[list(trained)]]
    pulled = ca.jtimes(
        ca.vertcat(*results, *factors), ca.vertcat(*known), ca.vertcat(*slopes, *inner), True
    )
    pulled = _known(pulled, given[inside:], found[products + len(results) :])
    places = np.cumsum([0, *(one.numel() for one in known)]).tolist()
    parts = [pulled[a:b] for a, b in pairwise(places)]
    order = [*range(products)[::-1], *range(products, len(parts))]
    names = [f"product_{k}_slope" for k in range(products)]
    names += [*(f"{name}_before" for name in _HANDED_ON), "total"]
    whole = dict(zip((names[k] for k in order), ca.cse([parts[k] for k in order]), strict=True))
    first, seen = dict[str, str](), dict[tuple[int, ...], str]()
    for name in (names[k] for k in order if k in alone):
        cells = tuple(cell.element_hash() for cell in whole[name].elements())
        first[name] = seen.setdefault(cells, name)
    told = [name for name in whole if first.get(name, name) == name]
    function = ca.Function(
        "slope",
        [*given[:inside], *slopes, *inner],
        [whole[name] for name in told],
        [
            *step.name_in()[:inside],
            *(f"{name}_slope" for name in (*_HANDED_ON, "a")),
            *(f"factor_{k}_slope" for k in range(products)),
        ],
        told,
    )
    return function, first


class _Step(nn.Module):
    """One step of a rollout."""

    def __init__(self, rollout: Rollout) -> None:
        super().__init__()
        self.rollout = rollout

    def forward(self, x: Tensor, w: Tensor, s: Tensor, q: Tensor) -> tuple[Tensor, ...]:
        """Return state, memory of the vessel, memory of the source, and what acted.

        Inputs that are given are not told again.
        """
        acting, q = self.rollout.source(x, w, 0, q)
        x, s = self.rollout.model.step(x, acting, s)
        return x, s, q, acting[:, :0] if self.rollout.source.given else acting


@final
class CompiledRollout:
    """The free runs of a rollout, with a gradient for what is trained, the start and the memory.

    There is none where torch's gradients are switched off while this is made, or nothing is
    trained.

    Args:
        rollout: whose source does not count steps. Its numbers may change between runs.
        x, w, s: examples of its arguments, [B, nx], [B, T, m] and [B, n], in the precision of runs.
        own: names of parameters and buffers [B, ...] that every row has for itself; there is no
            gradient for them.
        most: how much of what is asked of a row reaches its gradient, as a multiple of the median
            over rows. A loop that is at the edge of swinging has flights whose gradients are
            millions of times as large as those of others.

    Raises:
        ExportError: where a step cannot be recorded or written, or no C compiler does its work.
    """

    def __init__(
        self,
        rollout: Rollout,
        x: Tensor,
        w: Tensor,
        s: Tensor,
        *,
        own: Sequence[str] = (),
        most: float = math.inf,
    ) -> None:
        self.rollout, self.dtype, self.own = rollout, x.dtype, tuple(own)
        self.most = math.inf
        alone = copy.deepcopy(rollout).double()
        held = _numbers(alone)
        self.shared = [
            name for name, part in held.items() if name not in self.own and part.is_floating_point()
        ]
        trained = torch.is_grad_enabled() and any(held[name].requires_grad for name in self.shared)
        self.apart = trained and not math.isinf(most)
        one = _Step(alone)
        own_shapes = [held[name][:1].shape for name in self.own]

        def step(x: Tensor, w: Tensor, s: Tensor, q: Tensor, own: Tensor, *shared: Tensor) -> Any:
            weights = dict(zip(self.shared, shared, strict=True))
            pieces = own[0].split([shape.numel() for shape in own_shapes])
            for name, shape, piece in zip(self.own, own_shapes, pieces, strict=True):
                weights[name] = piece.reshape(shape)
            return _called(one, weights, (x, w, s, q))

        rows = [("x", x[:1].double()), ("w", w[:1, 0].double()), ("s", s[:1].double())]
        with torch.no_grad():
            # a source whose rows have numbers of their own flies as many rows
            q = alone.source.initial(x.double())
            acting = alone.source(x.double(), w[:, 0].double(), 0, q)[0]
        rows += [("q", q[:1]), ("own", self._own(held, 1).double())]
        shared = [held[name].detach() for name in self.shared]
        names = [f"{name}_after" for name in _HANDED_ON]
        self.parts = in_parts(step, rows, shared, [*names, "a"], _WHAT)
        self.sizes = {name: example.shape[1] for name, example in rows}
        self.sizes["a"] = 0 if rollout.source.given else acting.shape[1]
        self.trained: list[int] | None = None
        if trained:
            # what follows from numbers that are not trained has no gradient
            self.trained, begin = [], 0
            with torch.enable_grad():
                found = self.parts.prepare(*(held[name] for name in self.shared))
            for part in (found[k] for k in self.parts.plain):
                self.trained += range(begin, begin + part.numel()) if part.requires_grad else ()
                begin += part.numel()
        self._made(x.dtype)
        self._check(alone, x[:_ROWS], w[:_ROWS], s[:_ROWS])
        self.most = most

    def _made(self, dtype: torch.dtype, *, quick: bool = False) -> None:
        source, self.held, self.pulled = _source(
            self.parts, self.sizes, self.trained, dtype, apart=self.apart
        )
        self.dtype, self.library = dtype, compiled_library(source, quick=quick)
        self.lanes = ctypes.c_long.in_dll(self.library, "lanes").value

    def of(self, rollout: Rollout) -> CompiledRollout:
        """Return the free runs of a rollout that differs in its numbers alone."""
        other = copy.copy(self)
        other.rollout = rollout
        return other

    def _own(self, held: Mapping[str, Tensor], count: int) -> Tensor:
        """Return the numbers [count, n] that every row has for itself."""
        parts = [held[name].detach()[:count].reshape(count, -1) for name in self.own]
        return torch.cat([torch.zeros(count, 0), *parts], dim=1)

    def prepared(self, held: Mapping[str, Tensor]) -> tuple[Tensor, Tensor]:
        """Return what follows from the shared numbers: `theta`, and the tables of products."""
        found = self.parts.prepare(*(held[name].double() for name in self.shared))
        return _flat([found[k] for k in self.parts.plain]).to(self.dtype), _flat(
            [
                found[one.place].reshape(-1, one.taken, one.given)[one.member]
                for one in self.parts.products
                if not one.curve
            ]
        ).to(self.dtype)

    def __call__(self, x: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return states, inputs that acted and the last memory, as the rollout does."""
        held = _numbers(self.rollout)
        rows = self._own(held, len(x) if self.own else 1).expand(len(x), -1)
        q = self.rollout.source.initial(x)
        with torch.set_grad_enabled(self.trained is not None and torch.is_grad_enabled()):
            theta, tables = self.prepared(held)
            states, acted, after = self.flown(theta, tables, x, s, rows, w, q)
        return states, w if self.rollout.source.given else acted, after

    def flown(self, *given: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return states, inputs and the last memory; the arguments are those of `_Flight`."""
        if not torch.is_grad_enabled():
            return self.fly(*given, keep=False)[0]
        apply: Any = _Flight.apply
        found: tuple[Tensor, Tensor, Tensor] = apply(*given, self)
        return found

    def fly(
        self,
        theta: Tensor,
        tables: Tensor,
        x: Tensor,
        s: Tensor,
        own: Tensor,
        w: Tensor,
        q: Tensor,
        *,
        keep: bool,
    ) -> tuple[tuple[Tensor, Tensor, Tensor], list[Tensor]]:
        """Return states, inputs and the last memory of runs, and all that is known of each step.

        The latter stand with the rows last, padded to whole blocks: `theta`, tables, own numbers,
        states, inputs and both memories; and, block by block, what a step keeps for its gradient.
        """
        count, steps = w.shape[:2]
        blocks = -(-count // self.lanes)
        width = blocks * self.lanes
        # rows that fill up the last block repeat the last one
        places = torch.arange(width).clamp(max=count - 1)

        def filled(part: Tensor) -> Tensor:
            part = part.detach().to(self.dtype)
            return part if width == count else part[places]

        def room(*sizes: int) -> Tensor:
            return torch.empty(*sizes, width, dtype=self.dtype)

        states = room(steps + 1, self.sizes["x"])
        memories = [room(steps + 1 if keep else 2, self.sizes[name]) for name in ("s", "q")]
        for whole, start in zip((states, *memories), (x, s, q), strict=True):
            whole[0] = filled(start).T
        inputs = filled(w).permute(1, 2, 0).contiguous()
        acting = room(steps, self.sizes["a"])
        held = self.kept(blocks, steps if keep else 0, self.held)
        rows = filled(own).T.contiguous()
        known = [theta.detach(), tables.detach(), rows, states, inputs, *memories]
        self.run("fly", blocks, *known, acting, held, int(keep), steps, width)
        last = memories[0][steps if keep else steps & 1]
        found = (
            states.permute(2, 0, 1)[:count],
            acting.permute(2, 0, 1)[:count],
            last.T[:count],
        )
        return found, [*known, held]

    def kept(self, blocks: int, steps: int, places: Mapping[str, slice]) -> Tensor:
        """Return room for what stands at these places, block by block and step by step."""
        return torch.empty(blocks * steps, _end(places), self.lanes, dtype=self.dtype)

    def run(self, name: str, blocks: int, *arguments: Tensor | int) -> None:
        """Call a function of the library for all blocks of rows, spread over free cores."""
        function = getattr(self.library, name)
        given = [
            ctypes.c_void_p(a.data_ptr()) if isinstance(a, Tensor) else ctypes.c_long(a)
            for a in arguments
        ]
        parts = min(max(torch.get_num_threads(), available_cores()), blocks)
        ends = [ctypes.c_long(blocks * k // parts) for k in range(parts + 1)]
        if parts == 1:
            function(*given, *ends)
            return
        with ThreadPoolExecutor(parts) as pool:
            list(pool.map(lambda part: function(*given, *part), pairwise(ends)))

    def _check(self, alone: Rollout, x: Tensor, w: Tensor, s: Tensor) -> None:
        """Compare a few steps from all that runs visit, and their gradient, with the rollout's own.

        Rounding doubles from step to step where a law is steep, and tells nothing then: the text of
        the library is compared in double precision, from equal states.

        Args:
            alone: the rollout in double precision.
            x, w, s: of some runs.

        Raises:
            ExportError: where they differ by more than the precision explains.
        """
        step = _Step(alone)
        held = {name: part.detach() for name, part in _numbers(alone).items()}
        for name in self.own:
            held[name] = held[name][: len(x)]

        def flown(*start: Tensor, taken: Tensor, numbers: dict[str, Tensor]) -> list[Any]:
            """Return x, s and q at every step, and what acted."""
            states, acted = [tuple(start)], []
            for k in range(taken.shape[1]):
                x, s, q = states[-1]
                *after, acting = _called(step, numbers, (x, taken[:, k], s, q))
                states.append(tuple(after))
                acted.append(acting)
            return [*zip(*states, strict=True), acted]

        count = min(_VISITED, w.shape[1])
        w, x, s = w[:, :count].double(), x.double(), s.double()
        with torch.no_grad():
            seen = flown(x, s, alone.source.initial(x), taken=w, numbers=held)
        # the rows of a visited step are one run each, under the inputs that came next
        last = max(count - _STEPS, 0) + 1
        starts = [torch.cat(parts[:last]) for parts in seen[:3]]
        taken = torch.cat([w[:, k : k + _STEPS] for k in range(last)])
        many = {name: held[name].repeat(last, *[1] * (held[name].dim() - 1)) for name in self.own}
        wanted = {name: p for name, p in alone.named_parameters() if p.requires_grad}
        weights = {name: held[name].requires_grad_() for name in self.shared if name in wanted}
        rows = torch.cat(
            [torch.zeros(len(taken), 0), *(part.reshape(len(taken), -1) for part in many.values())],
            dim=1,
        )

        def offs(fly: Any) -> tuple[list[Tensor], list[Tensor]]:
            """Return states, inputs and the gradient by the rollout's own steps, and by others."""
            states, memory, _, acted = flown(*starts, taken=taken, numbers=held | many | weights)
            pair = []
            for found in ((torch.stack(states, 1), torch.stack(acted, 1), memory[-1]), fly()):
                parts = list(found)
                if self.trained is not None:
                    cost = sum(part.double().square().mean() for part in parts if part.numel())
                    slopes = torch.autograd.grad(
                        torch.as_tensor(cost), list(weights.values()), allow_unused=True
                    )
                    parts += [slope for slope in slopes if slope is not None]
                pair.append([part.detach().double() for part in parts])
            return pair[0], pair[1]

        def fly(loop: CompiledRollout) -> tuple[Tensor, Tensor, Tensor]:
            theta, tables = loop.prepared(held | weights)
            x, s, q, taken_, own = (
                part.to(loop.dtype) for part in (starts[0], starts[1], starts[2], taken, rows)
            )
            return loop.flown(theta, tables, x, s, own, taken_, q)

        with torch.set_grad_enabled(self.trained is not None):
            slow, quick = offs(lambda: fly(self))
            if _off(quick, slow) <= (_SAME if self.dtype == torch.float64 else _CLOSE):
                return
            exact = copy.copy(self)
            exact._made(torch.float64, quick=True)
            slow, fast = offs(lambda: fly(exact))
            # rounding moves single rows far, a fault most of them
            usual = [
                ((a - b).abs().flatten(1).amax(1).median() / _size(b)).item()
                for a, b in zip(quick[:2], fast[:2], strict=True)
                if b.numel()
            ]
        off = max(_off(fast, slow), max(usual) * (_SAME / _ROUNDED))
        if not off <= _SAME:
            raise ExportError(f"the compiled rollout is off by {off:.2g} of its size")


_CLOSE = 1e-4
"""How far single precision may be off without a look at the same in double precision."""


def _size(wanted: Tensor) -> Tensor:
    return wanted.abs().max().clamp(min=1e-9)


def _off(found: Sequence[Tensor], wanted: Sequence[Tensor]) -> float:
    """Return the largest difference in shares of what is wanted; gradients are one of them."""
    pairs = [(a, b) for a, b in zip(found[:3], wanted[:3], strict=True) if b.numel()]
    if found[3:]:
        pairs.append((_flat(found[3:]), _flat(wanted[3:])))
    offs = [float((a - b).abs().max() / _size(b)) for a, b in pairs]
    return max((math.inf if math.isnan(one) else one for one in offs), default=0.0)


class _Flight(torch.autograd.Function):
    """Free runs in C, and their gradient for shared numbers, start and memory."""

    @staticmethod
    def forward(ctx: Any, *given: Any) -> tuple[Tensor, Tensor, Tensor]:
        """Return states [B, T+1, nx], inputs [B, T, m] and the last memory [B, n].

        The arguments are theta, tables, x, s, own numbers, w, q, and the compiled rollout.
        """
        *parts, loop = given
        found: tuple[Tensor, Tensor, Tensor]
        found, known = loop.fly(*parts, keep=True)
        ctx.loop, ctx.rows = loop, len(found[0])
        ctx.save_for_backward(*known)
        return found

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        """Return the gradient of theta, tables, x and s."""
        known, loop, count = ctx.saved_tensors, ctx.loop, ctx.rows
        steps, _, width = known[4].shape
        given = []
        for grad in (grads[0], grads[1], grads[2][:, None]):
            whole = torch.zeros(*grad.shape[1:], width, dtype=loop.dtype)
            whole[:, :, :count] = grad.permute(1, 2, 0)
            given.append(whole)
        # each row adds up for itself, so that the sum does not depend on the number of threads
        blocks, plain = width // loop.lanes, len(loop.trained)
        pulled = loop.kept(blocks, steps, loop.pulled)
        products = [(k, one) for k, one in enumerate(loop.parts.products) if not one.curve]
        shared = sum(one.numbers for _, one in products) if loop.apart else 0
        total = torch.zeros(blocks, plain + shared, loop.lanes, dtype=loop.dtype)
        loop.run("back", blocks, *known, *given, pulled, total, steps, width)
        rows = total.transpose(1, 2).reshape(width, -1)[:count]
        if not math.isinf(loop.most):
            asked = sum(grad.flatten(1).square().sum(1) for grad in grads)
            rows = _held(rows, torch.as_tensor(asked).sqrt(), loop.most)
        found, tables = rows.sum(0).split([plain, shared])
        if not loop.apart:
            by_table: dict[int, Tensor] = {}
            places = loop.pulled
            in_order = sorted(products, key=lambda p: loop.held[f"factor_{p[0]}"].start)
            for _, group in groupby(in_order, lambda p: places[f"product_{p[0]}_slope"].start):
                alike = [*group]
                (k, one), last = alike[0], loop.held[f"factor_{alike[-1][0]}"]
                ends = slice(loop.held[f"factor_{k}"].start, last.stop)
                factor = known[-1][:, ends].unflatten(1, (one.rows, -1))
                slope = pulled[:, places[f"product_{k}_slope"]].unflatten(1, (one.rows, -1))
                table = torch.zeros(factor.shape[2], one.given, dtype=loop.dtype)
                for a, b in zip(factor.unbind(1), slope.unbind(1), strict=True):
                    table.addbmm_(a, b.transpose(1, 2))
                split = table.split([each.taken for _, each in alike])
                by_table |= {k: part for (k, _), part in zip(alike, split, strict=True)}
            tables = _flat([by_table[k] for k, _ in products])
        theta = torch.zeros(len(known[0]), dtype=loop.dtype)
        theta[loop.trained] = found
        x, s = given[0][0].T[:count], given[2][0].T[:count]
        return theta, tables, x, s, *[None] * 4


def _end(places: Mapping[str, slice]) -> int:
    return max((place.stop for place in places.values()), default=0)


def _held(gradients: Tensor, asked: Tensor, most: float) -> Tensor:
    """Return gradients [B, n] of rows, none larger than a multiple of what the median row has.

    Args:
        gradients: of each row.
        asked: size [B] of the gradient that each row was given.
        most: the multiple; infinity leaves all as they are.
    """
    size = gradients.norm(dim=1)
    share = size / asked.clamp(min=1e-30)
    usual = share[asked > 0].nanmedian() if bool((asked > 0).any()) else share.new_zeros(())
    kept = (most * usual * asked / size.clamp(min=1e-30)).clamp(max=1.0)
    # what is no number says nothing
    return torch.where(torch.isfinite(size)[:, None], gradients * kept[:, None], 0.0)


def _numbers(rollout: Rollout) -> dict[str, Tensor]:
    """Return the parameters and buffers of a rollout by name, those of each module once."""
    # as `named_parameters` and `named_buffers` have them, in half the time of a short run
    return {
        f"{place}.{name}" if place else name: part
        for place, module in rollout.named_modules()
        for parts in (module._parameters, module._buffers)
        for name, part in parts.items()
        if part is not None
    }


def _called(step: nn.Module, numbers: Mapping[str, Tensor], given: tuple[Tensor, ...]) -> Any:
    """Return what a step makes with these numbers in place of its own."""
    numbers = {f"rollout.{name}": part for name, part in numbers.items()}
    # what a module has that stands in two places would be put in twice, and taken out once
    return torch.func.functional_call(step, numbers, given, tie_weights=False)


def _flat(parts: Sequence[Tensor]) -> Tensor:
    return torch.cat([torch.zeros(0), *(part.flatten() for part in parts)])
