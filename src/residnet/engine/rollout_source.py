"""Write one step of a rollout and its gradient as C, for blocks of rows.

One step becomes a CasADi function of scalars, and products with the matrices that all rows share.
The step and its vector-Jacobian product (VJP) are written with the vector types of gcc and clang.
A cotangent is the derivative of the loss with respect to a quantity.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib import resources
from itertools import accumulate, chain, pairwise
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
import torch

from residnet.core.errors import ExportError
from residnet.engine.c_code import FUNCTIONS, FunctionWriter, Tables, write_literal
from residnet.engine.lowering import to_scalar_function
from residnet.engine.step_parts import RowProduct, StepParts

STATE_NAMES = ("x", "s", "q")
"""Arguments that a step updates: state x, memory s of the model and memory q of the source."""
MODEL_NAME = "rollout"
"""Name of the model in messages."""
_MAX_INSTRUCTIONS = 20_000
"""Largest number of scalar operations of a step: for more, compilation takes minutes."""
# functions of the C library with two arguments
_BINARY_FUNCTIONS = ("atan2", "hypot", "pow", "fmod", "copysign")

_PRELUDE, FORWARD_LOOP, BACKWARD_LOOP = (
    resources.files("residnet.engine").joinpath(name).read_text()
    for name in ("lanes.h", "forward.c", "backward.c")
)
_SCALAR_FUNCTIONS = {
    name: f"static __attribute__((noinline)) V v_{name}"
    + ("(V a, V b)" if name in _BINARY_FUNCTIONS else "(V a)")
    + f" {{ V o; EACH o[l] = R({name})(a[l]{', b[l]' if name in _BINARY_FUNCTIONS else ''});"
    " return o; }\n"
    for name in sorted(set(FUNCTIONS.values()))
}
"""C code of functions that call the C library for each row of a block."""


def _write_horner(x: str, *coefficients: float) -> str:
    """Return Horner's scheme of a polynomial in x in C; coefficients in ascending order."""
    constant, *higher = coefficients
    return (
        f"(ALL({constant!r}) + {x} * {_write_horner(x, *higher)})"
        if higher
        else f"ALL({constant!r})"
    )


def _write_vector_functions(
    n_exp_terms: int, bits: int, bias: int, overflow: float, n_log_terms: int
) -> dict[str, str]:
    """Return vectorised exp, tanh and log1p in C by name, accurate to the last digits.

    Networks call these most. With the C library a step of a recurrent network takes six times as
    long.

    Args:
        n_exp_terms: terms of the exponential series after the constant, for arguments up to
            log(2)/2.
        bits: bits of the mantissa.
        bias: bias of the exponent.
        overflow: argument above which the exponential is infinite; below about its negative the
            exponential is zero.
        n_log_terms: odd terms of the series of the logarithm for arguments up to 0.172.
    """
    exp_coefficients = [2.0 / math.factorial(k + 1) for k in range(n_exp_terms)]
    log_coefficients = [2.0 / (2 * k + 1) for k in range(n_log_terms)]
    head = '__attribute__((noinline, optimize("no-associative-math"))) static V '
    # clang has a pragma for what gcc has an attribute for
    no_reassociation = "\n#pragma clang fp reassociate(off)\n"
    # adding and subtracting this number rounds to the nearest integer
    round_constant = f"ALL({1.5 * 2.0**bits!r})"
    # e^a = 2^n e^r with |r| <= log(2)/2. `half` is 2^(n-1), which cannot overflow, and `more` is
    # 2 (e^r - 1). log 2 is split into two parts (Cody and Waite): multiples of the first, which has
    # few digits, are exact
    range_reduction = (
        f"    V sum = a * ALL({1.0 / math.log(2.0)!r}) + {round_constant};\n"
        f"    V n = sum - {round_constant};\n"
        "    V r = a - n * ALL(0.693359375);\n"
        "    r = r - n * ALL(-2.12194440054690583e-4);\n"
        f"    V half = (V)(((I)sum << {bits}) + ((INT){bias - 1} << {bits}));\n"
        f"    V more = r * {_write_horner('r', *exp_coefficients)};\n"
    )
    return {
        "exp": (
            f"{head}v_exp(V a) {{{no_reassociation}{range_reduction}"
            f"    V o = pick(a < ALL({-(bias - 1.5) * math.log(2.0)!r}), ALL(ZERO),"
            " half * (more + ALL(2)));\n"
            f"    return pick(a > ALL({overflow!r}), ALL(INFINITY), o);\n}}\n"
        ),
        # by e^2a - 1, which is accurate for small arguments
        "tanh": (
            f"{head}v_tanh(V x) {{{no_reassociation}"
            "    V a = ALL(2) * pick(x < ZERO, -x, x);\n"
            f"    a = pick(a > ALL(50), ALL(50), a);\n{range_reduction}"
            "    V e = half * more + (ALL(2) * half - ONE), t = e / (e + ALL(2));\n"
            "    return pick(x < ZERO, -t, t);\n}\n"
        ),
        # log(u) of u = 1 + a = 2^n m with m near 1 by the series of log((1 + t) / (1 - t)), with a
        # correction `lost` for the rounding of u. Zero, negative and infinite u are special cases
        "log1p": (
            f"{head}v_log1p(V a) {{{no_reassociation}"
            "    V u = a + ONE, lost = (a - (u - ONE)) / u;\n"
            f"    I n = ((I)u >> {bits}) - {bias};\n"
            f"    V m = (V)((I)u - (n << {bits}));\n"
            "    I high = m > ALL(1.4142135623730951);\n"
            "    m = pick(high, m * ALL(.5), m);\n"
            "    n = n - high;\n"
            "    V t = (m - ONE) / (m + ONE), s = t * t, whole = __builtin_convertvector(n, V);\n"
            f"    V low = t * {_write_horner('s', *log_coefficients)} + lost"
            " + whole * ALL(-2.12194440054690583e-4);\n"
            "    V o = low + whole * ALL(0.693359375);\n"
            "    o = pick(u < ALL(INFINITY), o, u);\n"
            "    return pick(u > ZERO, o, pick(u < ZERO, ALL(NAN), u - ALL(INFINITY)));\n}\n"
        ),
    }


_VECTOR_FUNCTIONS = {
    torch.float32: _write_vector_functions(7, 23, 127, 89.0, 6),
    torch.float64: _write_vector_functions(13, 52, 1023, 710.0, 12),
}
"""Vectorised functions in C for single and double precision (mantissa, exponent: IEEE 754)."""
_N_ACCUMULATORS = 8
"""Number of entries of a matrix product that are computed together, in registers."""


def _write_accumulators(count: int, entry: str) -> str:
    """Return a loop in C that computes `count` entries of a product together.

    Args:
        count: number of entries.
        entry: format of the matrix entry for column j + {0} of the result.
    """
    indices = range(count)
    declarations = "".join(f" V c{q} = {{0}};" for q in indices)
    additions = "".join(f" c{q} += v * {entry.format(q)};" for q in indices)
    stores = "".join(f" *(U *)(to + (j + {q}) * LANES) = c{q};" for q in indices)
    return (
        f"    for (; j + {count} <= to_count; j += {count}) {{\n       {declarations}\n"
        f"        for (long i = 0; i < count; i++) {{\n"
        f"            V v = *(const U *)(from + i * LANES);{additions}\n        }}\n"
        f"       {stores}\n    }}\n"
    )


_ACTIVATION_CODE = {
    "tanh": ("v_tanh(v)", "ONE - v * v"),
    "sigmoid": ("ONE / (ONE + v_exp(-v))", "v * (ONE - v)"),
}
"""Activations in C, and their derivatives as functions of their values."""
_ACTIVATION_LOOPS = "".join(
    f"static void times_{name}(const REAL *from, REAL *to, long count) {{\n"
    "    for (long i = 0; i < count * LANES; i += LANES) {\n"
    f"        V v = *(const U *)(from + i);\n        *(U *)(to + i) = {value};\n    }}\n}}\n"
    f"static void back_times_{name}(const REAL *value, const REAL *from, REAL *to, long count) {{\n"
    "    for (long i = 0; i < count * LANES; i += LANES) {\n"
    "        V v = *(const U *)(value + i);\n"
    f"        *(U *)(to + i) = *(const U *)(from + i) * ({slope});\n    }}\n}}\n"
    for name, (value, slope) in _ACTIVATION_CODE.items()
)
"""Loops over the units of a layer for activations and their vector-Jacobian products."""
_MATRIX_PRODUCT_LOOPS = "".join(
    f"static __attribute__((noinline)) void {name}(const REAL *restrict table, long count,"
    " long to_count, const REAL *restrict from, REAL *restrict to) {\n"
    "    long j = 0;\n"
    + _write_accumulators(_N_ACCUMULATORS, entry)
    + _write_accumulators(1, entry)
    + "}\n"
    for name, entry in (
        ("times", "table[i * to_count + j + {0}]"),
        ("back_times", "table[(j + {0}) * count + i]"),
    )
)
"""Products of the vectors [count] of rows with a matrix [count, to_count] and its transpose."""


def _write_prelude(dtype: torch.dtype) -> str:
    """Return the definitions at the beginning of a C file in this precision."""
    single = dtype == torch.float32
    macros = {
        "REAL": "float" if single else "double",
        "INT": "int" if single else "long long",
        "R(name)": "name##f" if single else "name",
    }
    defined = [f"#define {name} {text}\n" for name, text in macros.items()]
    functions = _SCALAR_FUNCTIONS | _VECTOR_FUNCTIONS[dtype]
    return "".join(
        (*defined, _PRELUDE, *functions.values(), _MATRIX_PRODUCT_LOOPS, _ACTIVATION_LOOPS)
    )


Calls = Mapping[str, Sequence[tuple[str, str]]]
"""For each result of a step, pairs of a quantity that a loop computes from the result and the C
statement that calls the loop.
"""
_STEP_ARGUMENTS = ("x", "w", "s", "q", "row_values", "theta")
"""Arguments of a step before the products.

They are state, inputs, memories of model and source, tensors that differ from row to row, and the
entries of shared tensors.
"""


class _LaneWriter(FunctionWriter):
    """Writes a function of scalars in C for a block of `LANES` rows.

    The rows of an entry are contiguous; `strides` are the distances between entries. All rows share
    the argument `theta`.

    Args:
        function: the function.
        strides: strides of arguments and results by name; the default is `LANES`.
        calls: for each result, the arguments that are computed from it once it is complete, and
            the statements that compute them.
    """

    REAL = "V"
    FLAG = "I"
    max_unrolled_length = math.inf
    logical: Mapping[int, str] = {
        ca.OP_NOT: "~{0}", ca.OP_AND: "{0} & {1}", ca.OP_OR: "{0} | {1}"
    }  # fmt: skip

    def __init__(self, function: ca.Function, strides: Mapping[str, str], calls: Calls) -> None:
        self.strides = strides
        self.calls = calls
        self.result_names = list(function.name_out())
        super().__init__(function, Tables(""), MODEL_NAME)

    def write_literal(self, value: float) -> str:
        return f"ALL({write_literal(value)})"

    def address(self, name: str, position: int) -> str:
        """Return the C expression of the address of an entry of an argument or result."""
        return f"(U *)({name} + {position} * {self.strides.get(name, 'LANES')})"

    def argument_expression(self, name: str, position: int) -> str:
        return (
            f"ALL({name}[{position}])" if name == "theta" else f"(*{self.address(name, position)})"
        )

    def store_result(self, result: int, column: Any) -> None:
        super().store_result(result, column)
        name = self.result_names[result]
        expressions = self.results[result]
        if name in self.calls and len(expressions) == self.function.numel_out(result):
            stores = [f"*{self.address(name, i)} = {cell};" for i, cell in enumerate(expressions)]
            for name_of_call, text in self.calls[name]:
                self.lines.append((name_of_call, " ".join((*stores, text))))
                stores = []

    def to_real(self, cell: str, flag: bool) -> str:
        return f"pick({cell}, ALL(ONE), ALL(ZERO))" if flag else cell

    def to_truth(self, cell: str, flag: bool) -> str:
        return cell if flag else f"({cell} != ZERO)"

    def conditional_expression(self, condition: str, value: str, alternative: str) -> str:
        return f"pick({condition}, {value}, {alternative})"

    def call_expression(self, name: str, row: Sequence[str]) -> str:
        return f"v_{name}({', '.join(row)})"


def _write_function(
    name: str,
    function: ca.Function,
    strides: Mapping[str, str],
    calls: Calls,
    declarations: Mapping[str, str],
    accumulated: Sequence[str] = (),
) -> str:
    """Return a C function of a step for a block of rows.

    Args:
        name: name of the C function.
        function: function of scalars.
        strides: strides of arguments and results, see `_LaneWriter`.
        calls: calls of loops over products, see `_LaneWriter`.
        declarations: statements that declare the arguments and results which are local variables of
            the C function and not its parameters.
        accumulated: results that are added to the stored values.
    """
    body = _LaneWriter(function, strides, calls)
    stores = [f"(void){call_result};" for call_result, _ in chain(*calls.values())]
    for result, expressions in zip(function.name_out(), body.results, strict=True):
        if result not in calls:
            sign = "+=" if result in accumulated else "="
            stores += [
                f"*{body.address(result, i)} {sign} {cell};"
                for i, cell in enumerate(expressions)
                if result not in accumulated or cell != body.zero_literal
            ]
    parameters = [f"const REAL *restrict {name}" for name in body.names if name not in declarations]
    result_parameters = [
        f"REAL *restrict {name}" for name in function.name_out() if name not in declarations
    ]
    common_parameters = (
        "const REAL *tables, REAL *history, REAL *product_cotangents, const long stride"
    )
    head = f"static void {name}({', '.join((*parameters, *result_parameters, common_parameters))})"
    return (
        head + " {\n" + "\n".join((*declarations.values(), *body.used_statements(stores))) + "\n}\n"
    )


@dataclass(frozen=True)
class _ProductArrays:
    """Arrays of the products of a step in the C file.

    Attributes:
        products: the products by number.
        sizes: number of entries of each factor, product and cotangent by name.
        table_offsets: offset of the matrix of each product in the table, and the table's length.
        shared_cotangents: for a cotangent that equals another one, the name of the other one.
    """

    products: Mapping[int, RowProduct]
    sizes: Mapping[str, int]
    table_offsets: Sequence[int]
    shared_cotangents: Mapping[str, str] = field(default_factory=dict)

    @property
    def matrix_products(self) -> list[int]:
        """Numbers of the products that are no activations."""
        return [k for k, product in self.products.items() if not product.activation]

    def cotangent_of(self, k: int) -> str:
        """Return the name of the array with the cotangent of a product."""
        name = f"product_{k}_cotangent"
        return self.shared_cotangents.get(name, name)

    def declare_local(self, name: str) -> str:
        """Return the C declaration of a local array for a factor, product or cotangent."""
        return f"REAL {name}[{self.sizes[name]} * LANES] __attribute__((aligned(BYTES)));"


class _GradientSource(NamedTuple):
    """C code of the gradient of a step, and the values that it needs.

    Attributes:
        code: the function `step_vjp`.
        arrays: arrays of the products, with the shared cotangents.
        forward_storage: layout of the values that a step stores for its gradient.
        backward_storage: layout of the cotangents of products.
        stored_pointers: declarations of pointers to the stored values by name.
    """

    code: str
    arrays: _ProductArrays
    forward_storage: dict[str, slice]
    backward_storage: dict[str, slice]
    stored_pointers: dict[str, str]


def write_rollout_source(
    parts: StepParts,
    sizes: Mapping[str, int],
    trained_indices: Sequence[int] | None,
    dtype: torch.dtype,
    *,
    has_row_gradients: bool,
) -> tuple[str, dict[str, slice], dict[str, slice]]:
    """Write the C file with the functions `run_forward` and `run_backward` (gradient).

    Args:
        parts: the split step.
        sizes: number of entries of each argument, and of the applied inputs `a`.
        trained_indices: indices in `theta` that have a gradient; None for no gradient.
        dtype: precision of the file.
        has_row_gradients: whether each row has its own gradient of the matrices.

    Returns:
        The C code, the layout of the values that a step stores for its gradient, and the layout of
        the cotangents of products.
    """
    step = to_scalar_function(parts.function)
    _require_compilable(step)
    products = dict(enumerate(parts.products))
    table_offsets = [0, *accumulate(product.matrix_size for product in parts.products)]
    arrays = _ProductArrays(products, _count_entries(products), table_offsets)
    if trained_indices is None:
        gradient = _GradientSource("", arrays, {}, {}, {})
    else:
        gradient = _write_gradient(step, sizes, arrays, trained_indices)
    # the step: it writes stored values to the history, and all others to local arrays
    declarations = gradient.stored_pointers | {
        name: arrays.declare_local(name)
        for name in arrays.sizes
        if name not in gradient.stored_pointers and not name.endswith("_cotangent")
    }
    step_code = _write_function(
        "step",
        _forward_function(step, len(products)),
        dict.fromkeys(_STRIDED_ARRAYS, "stride"),
        _write_product_calls(gradient.arrays, "times", "factor_{}", "product_{}"),
        declarations,
    )
    # sizes as macros, which the loops over steps and rows use
    n_theta = len(trained_indices or ())
    counts = dict(sizes) | {
        "history": count_stored_values(gradient.forward_storage),
        "product_cotangents": count_stored_values(gradient.backward_storage),
        "gradient": n_theta + has_row_gradients * table_offsets[-1],
    }
    definitions = [f"#define N_{name.upper()} {value}L\n" for name, value in counts.items()]
    backward_loop = ""
    if trained_indices is not None:
        outer_products = (
            _write_outer_products(
                products,
                gradient.forward_storage,
                gradient.backward_storage,
                [n_theta + offset for offset in table_offsets],
            )
            if has_row_gradients
            else ""
        )
        backward_loop = BACKWARD_LOOP.replace("OUTER\n", outer_products)
    # the loops over the steps follow the functions that they call
    prelude = _write_prelude(dtype)
    code = (prelude, *definitions, step_code, gradient.code, FORWARD_LOOP, backward_loop)
    return "".join(code), gradient.forward_storage, gradient.backward_storage


def _write_gradient(
    step: ca.Function,
    sizes: Mapping[str, int],
    arrays: _ProductArrays,
    trained_indices: Sequence[int],
) -> _GradientSource:
    """Write the vector-Jacobian product of a step, and choose the values that a step stores for it.

    Args:
        step: the step as a function of scalars.
        sizes: number of entries of each argument, and of the applied inputs `a`.
        arrays: arrays of the products.
        trained_indices: indices in `theta` that have a gradient.
    """
    products = arrays.products
    matrices = arrays.matrix_products
    single_products = [k for k in matrices if products[k].n_repeats == 1]
    vjp_function, shared_cotangents = _vector_jacobian_function(
        step, sizes, len(products), trained_indices, single_products
    )
    arrays = replace(arrays, shared_cotangents=shared_cotangents)
    is_needed = _find_needed_products(vjp_function, products)
    forward_storage, stored_pointers = _build_layout(
        arrays.sizes,
        "history",
        [name for name, needed in is_needed.items() if needed]
        + [f"factor_{k}" for k in sorted(matrices, key=arrays.cotangent_of)],
    )
    backward_storage, declarations = _build_layout(
        arrays.sizes, "product_cotangents", [*dict.fromkeys(map(arrays.cotangent_of, matrices))]
    )
    backward_storage |= {
        f"product_{k}_cotangent": backward_storage[arrays.cotangent_of(k)] for k in matrices
    }
    declarations |= {name: stored_pointers.get(name, "") for name in is_needed}
    declarations |= {
        name: arrays.declare_local(name)
        for name in arrays.sizes
        if name.endswith("_cotangent") and name not in declarations
    }
    code = _write_function(
        "step_vjp",
        vjp_function,
        dict.fromkeys((*_STRIDED_ARRAYS, "x_cotangent", "a_cotangent", "x_before"), "stride"),
        _write_product_calls(arrays, "back_times", "product_{}_cotangent", "factor_{}_cotangent"),
        declarations,
        ("x_before", "gradient"),
    )
    return _GradientSource(code, arrays, forward_storage, backward_storage, stored_pointers)


_STRIDED_ARRAYS = ("x", "w", "s", "q", "row_values", "x_after", "s_after", "q_after", "a")
"""Arguments and results of a step in arrays of all rows, whose entries are `stride` apart."""


def _require_compilable(step: ca.Function) -> None:
    """Refuse a step whose compilation would take minutes.

    Raises:
        ExportError: if the step has too many operations or looks up a long table.
    """
    if not step.is_a("SXFunction") or step.n_instructions() > _MAX_INSTRUCTIONS:
        raise ExportError(
            f"the step has more than {_MAX_INSTRUCTIONS:,} operations or looks up a long table, so"
            " that it is not compiled for many rows"
        )


def _count_entries(products: Mapping[int, RowProduct]) -> dict[str, int]:
    """Return the number of entries of products, factors and their cotangents by name."""
    return {
        f"{name}_{k}{suffix}": product.n_repeats * count
        for k, product in products.items()
        for name, count in (("product", product.n_outputs), ("factor", product.n_inputs))
        for suffix in ("", "_cotangent")
    }


def _find_needed_products(
    vjp_function: ca.Function, products: Mapping[int, RowProduct]
) -> dict[str, bool]:
    """Return by name whether the gradient of a step needs the value of a product.

    It does not depend on products of affine layers: these are not stored.
    """
    symbols = _make_symbols(vjp_function)
    jacobian = ca.veccat(*vjp_function.call(symbols))
    is_needed = {f"product_{k}": bool(product.activation) for k, product in products.items()}
    return is_needed | {
        name: is_needed[name] or ca.depends_on(jacobian, product)
        for name, product in zip(vjp_function.name_in(), symbols, strict=True)
        if name in is_needed
    }


def _build_layout(
    sizes_by_name: Mapping[str, int], array: str, names: Sequence[str]
) -> tuple[dict[str, slice], dict[str, str]]:
    """Return the layout of quantities in an array, and declarations of pointers to them.

    Args:
        sizes_by_name: number of entries of each quantity.
        array: name of the array in C.
        names: the quantities, in their order in the array.
    """
    offsets = [0, *accumulate(sizes_by_name[name] for name in names)]
    layout = {name: slice(*pair) for name, pair in zip(names, pairwise(offsets), strict=True)}
    declarations = {
        name: f"REAL *{name} = {array} + {begin} * LANES;"
        for name, begin in zip(names, offsets, strict=False)
    }
    return layout, declarations


def _write_outer_products(
    products: Mapping[int, RowProduct],
    forward_storage: Mapping[str, slice],
    backward_storage: Mapping[str, slice],
    gradient_offsets: Sequence[int],
) -> str:
    """Return the calls in C that add the gradients of the matrices of each row.

    The gradient of a matrix is the outer product of the cotangent of its product and its factor.

    Args:
        products: the products by number; activations have no matrix.
        forward_storage: layout of the stored factors.
        backward_storage: layout of the cotangents of the products.
        gradient_offsets: offset of the gradient of each matrix.
    """
    return "".join(
        "outer(STORED(history, N_HISTORY, k)"
        f" + {forward_storage[f'factor_{k}'].start + r * product.n_inputs} * LANES,"
        f" {product.n_inputs}, STORED(product_cotangents, N_PRODUCT_COTANGENTS, k)"
        f" + {backward_storage[f'product_{k}_cotangent'].start + r * product.n_outputs} * LANES,"
        f" {product.n_outputs},"
        f" gradient + at * N_GRADIENT + {gradient_offsets[k]} * LANES);\n"
        for k, product in products.items()
        for r in range(product.n_repeats)
        if not product.activation
    )


def _write_product_calls(
    arrays: _ProductArrays, function_name: str, source_format: str, target_format: str
) -> Calls:
    """Write the calls of the loops over products, or over their transposes for a gradient.

    Args:
        arrays: arrays of the products of the step.
        function_name: `times`, or `back_times` for the vector-Jacobian product.
        source_format: format of the name of the multiplied vector, with the number of the product.
        target_format: format of the name of the result.

    Returns:
        For each source, the results that are computed once it is complete, with their statements.
    """
    statements: dict[str, list[tuple[str, str]]] = {}
    for k, product in arrays.products.items():
        source = source_format.format(k)
        target = target_format.format(k)
        source = arrays.shared_cotangents.get(source, source)
        n_source = arrays.sizes[source] // product.n_repeats
        n_target = arrays.sizes[target] // product.n_repeats
        text = "".join(
            f"{function_name}(tables + {arrays.table_offsets[k]}, {n_source}, {n_target},"
            f" {source} + {r * n_source} * LANES,"
            f" {target} + {r * n_target} * LANES);"
            for r in range(product.n_repeats)
        )
        if product.activation:
            # the derivative of an activation is a function of its value
            value = "" if function_name == "times" else f"product_{k}, "
            text = f"{function_name}_{product.activation}({value}{source}, {target}, {n_source});"
        statements.setdefault(source, []).append((target, text))
    return statements


def _make_symbols(step: ca.Function) -> list[ca.SX]:
    """Return a scalar symbol for each entry of the arguments of a step."""
    return [ca.SX.sym(name, step.numel_in(name)) for name in step.name_in()]


def _substitute_detached(
    expression: ca.SX, symbols: Sequence[ca.SX], values: Sequence[ca.SX]
) -> ca.SX:
    """Replace the symbols of detached values by these values.

    The symbols had no derivative, as `Tensor.detach` requires.
    """
    # a detached value may depend on earlier ones, so that the last is replaced first
    for symbol, value in zip(reversed(symbols), reversed(values), strict=True):
        expression = ca.substitute(expression, symbol, value)
    return ca.densify(expression)


def _forward_function(step: ca.Function, products: int) -> ca.Function:
    """Return the step as a function that also computes the values it detaches."""
    symbols = _make_symbols(step)
    n_arguments = len(_STEP_ARGUMENTS) + products
    names = step.name_out()[: products + len(STATE_NAMES) + 1]
    outputs = step.call(symbols)
    parts = [
        _substitute_detached(output, symbols[n_arguments:], outputs[len(names) :])
        for output in outputs[: len(names)]
    ]
    return ca.Function(
        "step", symbols[:n_arguments], ca.cse(parts), step.name_in()[:n_arguments], names
    )


def _vector_jacobian_function(
    step: ca.Function,
    sizes: Mapping[str, int],
    n_products: int,
    trained_indices: Sequence[int],
    single_products: Sequence[int],
) -> tuple[ca.Function, dict[str, str]]:
    """Return the vector-Jacobian product of a step.

    The cotangent of a product depends on the cotangents of the factors of later products alone; the
    results are in this order. Products that are added have equal cotangents, which are computed
    once.

    Args:
        step: the step as a function of scalars.
        sizes: number of entries of each argument.
        n_products: number of products.
        trained_indices: indices in `theta` that have a gradient.
        single_products: products of one vector per row, whose equal cotangents are merged.

    Returns:
        The function, and for each cotangent of a product the name of the one that represents it.
    """
    symbols = _make_symbols(step)
    n_arguments = len(_STEP_ARGUMENTS) + n_products
    x, _, s, q, _, theta, *product_values = symbols[:n_arguments]
    outputs = step.call(symbols)
    factors = outputs[:n_products]
    results = outputs[n_products : n_products + len(STATE_NAMES) + 1]
    cotangents = [ca.SX.sym(f"{name}_cotangent", sizes[name]) for name in (*STATE_NAMES, "a")]
    factor_cotangents = [
        ca.SX.sym(f"factor_{k}_cotangent", part.numel()) for k, part in enumerate(factors)
    ]
    variables = [*product_values, x, s, q, theta[list(trained_indices)]]
    # transposed Jacobian times the cotangents of results and factors
    pullback = ca.jtimes(
        ca.vertcat(*results, *factors),
        ca.vertcat(*variables),
        ca.vertcat(*cotangents, *factor_cotangents),
        True,
    )
    pullback = _substitute_detached(
        pullback, symbols[n_arguments:], outputs[n_products + len(results) :]
    )
    offsets = np.cumsum([0, *(part.numel() for part in variables)]).tolist()
    parts = [pullback[a:b] for a, b in pairwise(offsets)]
    # later products first: their cotangents are needed for those of earlier products
    order = [*range(n_products)[::-1], *range(n_products, len(parts))]
    names = [f"product_{k}_cotangent" for k in range(n_products)]
    names += [*(f"{name}_before" for name in STATE_NAMES), "gradient"]
    cotangent_by_name = dict(
        zip((names[k] for k in order), ca.cse([parts[k] for k in order]), strict=True)
    )
    representative = dict[str, str]()
    name_of_hash = dict[tuple[int, ...], str]()
    for name in (names[k] for k in order if k in single_products):
        # products whose results are added have the same expression as cotangent
        hashes = tuple(cell.element_hash() for cell in cotangent_by_name[name].elements())
        representative[name] = name_of_hash.setdefault(hashes, name)
    result_names = [name for name in cotangent_by_name if representative.get(name, name) == name]
    function = ca.Function(
        "step_vjp",
        [*symbols[:n_arguments], *cotangents, *factor_cotangents],
        [cotangent_by_name[name] for name in result_names],
        [
            *step.name_in()[:n_arguments],
            *(f"{name}_cotangent" for name in (*STATE_NAMES, "a")),
            *(f"factor_{k}_cotangent" for k in range(n_products)),
        ],
        result_names,
    )
    return function, representative


def count_stored_values(layout: Mapping[str, slice]) -> int:
    """Return the number of entries of a layout."""
    return max((entries.stop for entries in layout.values()), default=0)
