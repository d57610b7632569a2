"""Rollouts and their gradients as compiled C, for a batch of rows at once.

One step of a rollout becomes a CasADi function of scalars, and products with the matrices that all
rows share. The step and its vector-Jacobian product (VJP) are written for blocks of rows with the
vector types of gcc and clang, compiled for this machine and called for all steps of a run. A
cotangent is the derivative of the loss with respect to a quantity. The gradient of a matrix follows
from the stored factors and cotangents of all steps, in one product.
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
    FunctionWriter,
    Tables,
    load_library,
    write_literal,
)
from residnet.engine.rollout import Rollout
from residnet.engine.trace import RowProduct, StepParts, split_step, to_scalar_function

_MAX_INSTRUCTIONS = 20_000
"""Largest number of scalar operations of a step: for more, compilation takes minutes."""
_STATE_NAMES = ("x", "s", "q")
"""Arguments that a step updates: state x, memory s of the model and memory q of the source."""
_MODEL_NAME = "rollout"
"""Name of the model in messages."""
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
        super().__init__(function, Tables(""), _MODEL_NAME)

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


def _write_source(
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
    matrices = [k for k, product in products.items() if not product.activation]
    table_offsets = [0, *accumulate(product.matrix_size for product in parts.products)]
    sizes_by_name = _count_entries(products)
    strides = dict.fromkeys(_STRIDED_ARRAYS, "stride")

    def cotangent_of(k: int) -> str:
        return shared_cotangents.get(name := f"product_{k}_cotangent", name)

    def local(name: str) -> str:
        return f"REAL {name}[{sizes_by_name[name]} * LANES] __attribute__((aligned(BYTES)));"

    def calls(function_name: str, source_format: str, target_format: str) -> Calls:
        return _write_product_calls(
            products,
            sizes_by_name,
            table_offsets,
            shared_cotangents,
            function_name,
            source_format,
            target_format,
        )

    forward_storage = dict[str, slice]()
    backward_storage = dict[str, slice]()
    stored_pointers = dict[str, str]()
    shared_cotangents = dict[str, str]()
    backward = list[str]()
    if trained_indices is not None:
        single_products = [k for k in matrices if products[k].n_repeats == 1]
        vjp_function, shared_cotangents = _vector_jacobian_function(
            step, sizes, len(products), trained_indices, single_products
        )
        is_needed = _find_needed_products(vjp_function, products)
        forward_storage, stored_pointers = _build_layout(
            sizes_by_name,
            "history",
            [name for name, needed in is_needed.items() if needed]
            + [f"factor_{k}" for k in sorted(matrices, key=cotangent_of)],
        )
        backward_storage, declarations = _build_layout(
            sizes_by_name, "product_cotangents", [*dict.fromkeys(map(cotangent_of, matrices))]
        )
        backward_storage |= {
            f"product_{k}_cotangent": backward_storage[cotangent_of(k)] for k in matrices
        }
        declarations |= {name: stored_pointers.get(name, "") for name in is_needed}
        declarations |= {
            name: local(name)
            for name in sizes_by_name
            if name.endswith("_cotangent") and name not in declarations
        }
        backward = [
            _write_function(
                "step_vjp",
                vjp_function,
                strides | dict.fromkeys(("x_cotangent", "a_cotangent", "x_before"), "stride"),
                calls("back_times", "product_{}_cotangent", "factor_{}_cotangent"),
                declarations,
                ("x_before", "gradient"),
            )
        ]
    forward = stored_pointers | {
        name: local(name)
        for name in sizes_by_name
        if name not in stored_pointers and not name.endswith("_cotangent")
    }
    step_code = _write_function(
        "step",
        _forward_function(step, len(products)),
        strides,
        calls("times", "factor_{}", "product_{}"),
        forward,
    )
    n_theta = len(trained_indices or ())
    counts = dict(sizes) | {
        "history": _storage_size(forward_storage),
        "product_cotangents": _storage_size(backward_storage),
        "gradient": n_theta + has_row_gradients * table_offsets[-1],
    }
    definitions = [f"#define N_{name.upper()} {value}L\n" for name, value in counts.items()]
    if trained_indices is not None:
        outer = (
            _write_outer_products(
                products,
                forward_storage,
                backward_storage,
                [n_theta + offset for offset in table_offsets],
            )
            if has_row_gradients
            else ""
        )
        backward.append(BACKWARD_LOOP.replace("OUTER\n", outer))
    # the loop over the steps follows the functions that it calls
    code = (_write_prelude(dtype), *definitions, step_code, *backward[:1], FORWARD_LOOP)
    return "".join((*code, *backward[1:])), forward_storage, backward_storage


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
    products: Mapping[int, RowProduct],
    sizes: Mapping[str, int],
    table_offsets: Sequence[int],
    shared_cotangents: Mapping[str, str],
    function_name: str,
    source_format: str,
    target_format: str,
) -> Calls:
    """Write the calls of the loops over products, or over their transposes for a gradient.

    Args:
        products: the products of the step by number.
        sizes: number of entries of each quantity.
        table_offsets: offset of the matrix of each product in the table.
        shared_cotangents: for a cotangent that equals another one, the name of the other one.
        function_name: `times`, or `back_times` for the vector-Jacobian product.
        source_format: format of the name of the multiplied vector, with the number of the product.
        target_format: format of the name of the result.

    Returns:
        For each source, the results that are computed once it is complete, with their statements.
    """
    statements: dict[str, list[tuple[str, str]]] = {}
    for k, product in products.items():
        source = source_format.format(k)
        target = target_format.format(k)
        source = shared_cotangents.get(source, source)
        n_source = sizes[source] // product.n_repeats
        n_target = sizes[target] // product.n_repeats
        text = "".join(
            f"{function_name}(tables + {table_offsets[k]}, {n_source}, {n_target},"
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
    names = step.name_out()[: products + len(_STATE_NAMES) + 1]
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
    results = outputs[n_products : n_products + len(_STATE_NAMES) + 1]
    cotangents = [ca.SX.sym(f"{name}_cotangent", sizes[name]) for name in (*_STATE_NAMES, "a")]
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
    names += [*(f"{name}_before" for name in _STATE_NAMES), "gradient"]
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
            *(f"{name}_cotangent" for name in (*_STATE_NAMES, "a")),
            *(f"factor_{k}_cotangent" for k in range(n_products)),
        ],
        result_names,
    )
    return function, representative


class _RolloutStep(nn.Module):
    """One step of the source of the inputs and of the model of a rollout."""

    def __init__(self, rollout: Rollout) -> None:
        super().__init__()
        self.rollout = rollout

    def forward(self, x: Tensor, w: Tensor, s: Tensor, q: Tensor) -> tuple[Tensor, ...]:
        """Return state, memory of the model, memory of the source, and applied inputs.

        Applied inputs are omitted if the source returns the inputs of the rollout.
        """
        applied, q = self.rollout.source(x, w, 0, q)
        x, s = self.rollout.model.step(x, applied, s)
        return x, s, q, applied[:, :0] if self.rollout.source.is_playback else applied


@final
class CompiledRollout:
    """A rollout as compiled C, with gradients of parameters, initial states and initial memory.

    It has no gradient if gradients were disabled in torch when it was compiled, or if no parameter
    requires one.

    Args:
        rollout: rollout whose source does not depend on the number of the step. Parameters and
            buffers may change between runs.
        x: example of the initial states [B, nx], in the precision of the runs.
        w: example of the inputs [B, T, m].
        s: example of the memory [B, n].
        row_tensors: names of parameters and buffers [B, ...] that differ from row to row; they have
            no gradient.
        max_gradient_ratio: largest ratio of a row's gradient to its cotangent, as a multiple of the
            median over rows; larger gradients are scaled down. Rows of a marginally stable loop
            can have gradients 10^6 times larger than the other rows.

    Raises:
        ExportError: if the step cannot be traced or written in C, or compilation fails.
    """

    def __init__(
        self,
        rollout: Rollout,
        x: Tensor,
        w: Tensor,
        s: Tensor,
        *,
        row_tensors: Sequence[str] = (),
        max_gradient_ratio: float = math.inf,
    ) -> None:
        self.rollout = rollout
        self.row_tensor_names = tuple(row_tensors)
        self.max_gradient_ratio = max_gradient_ratio
        # traced in float64; the C code has the precision of the runs
        reference = copy.deepcopy(rollout).double()
        tensors = _named_tensors(reference)
        self.shared_names = [
            name
            for name, part in tensors.items()
            if name not in self.row_tensor_names and part.is_floating_point()
        ]
        is_trained = torch.is_grad_enabled() and any(
            tensors[name].requires_grad for name in self.shared_names
        )
        self.has_row_gradients = is_trained and not math.isinf(max_gradient_ratio)
        step_module = _RolloutStep(reference)
        row_shapes = [tensors[name][:1].shape for name in self.row_tensor_names]

        def step(
            x: Tensor, w: Tensor, s: Tensor, q: Tensor, row_values: Tensor, *shared: Tensor
        ) -> Any:
            weights = dict(zip(self.shared_names, shared, strict=True))
            row_parts = row_values[0].split([shape.numel() for shape in row_shapes])
            for name, shape, row_part in zip(
                self.row_tensor_names, row_shapes, row_parts, strict=True
            ):
                weights[name] = row_part.reshape(shape)
            return _call_with_tensors(step_module, weights, (x, w, s, q))

        rows = [("x", x[:1].double()), ("w", w[:1, 0].double()), ("s", s[:1].double())]
        with torch.no_grad():
            # a source with tensors for each row accepts this number of rows only
            q = reference.source.initial(x.double())
            applied = reference.source(x.double(), w[:, 0].double(), 0, q)[0]
        rows += [("q", q[:1]), ("row_values", self._row_tensors(tensors, 1).double())]
        shared = [tensors[name].detach() for name in self.shared_names]
        names = [f"{name}_after" for name in _STATE_NAMES]
        self.parts = split_step(step, rows, shared, [*names, "a"], _MODEL_NAME)
        self.sizes = {name: example.shape[1] for name, example in rows}
        self.sizes["a"] = 0 if rollout.source.is_playback else applied.shape[1]
        self.trained_indices: list[int] | None = None
        if is_trained:
            # entries of theta that depend on no trained parameter have no gradient
            self.trained_indices = []
            offset = 0
            with torch.enable_grad():
                prepared = self.parts.prepare(*(tensors[name] for name in self.shared_names))
            for part in (prepared[k] for k in self.parts.theta_indices):
                self.trained_indices += (
                    range(offset, offset + part.numel()) if part.requires_grad else ()
                )
                offset += part.numel()

        self.dtype = x.dtype
        source, self.forward_storage, self.backward_storage = _write_source(
            self.parts,
            self.sizes,
            self.trained_indices,
            self.dtype,
            has_row_gradients=self.has_row_gradients,
        )
        self.library = load_library(source)
        self.n_lanes = ctypes.c_long.in_dll(self.library, "lanes").value

    def with_rollout(self, rollout: Rollout) -> CompiledRollout:
        """Return the compiled rollout for a rollout of equal structure with other parameters."""
        compiled = copy.copy(self)
        compiled.rollout = rollout
        return compiled

    def _row_tensors(self, tensors: Mapping[str, Tensor], n_rows: int) -> Tensor:
        """Return the tensors that differ from row to row, flattened [n_rows, n]."""
        parts = [
            tensors[name].detach()[:n_rows].reshape(n_rows, -1) for name in self.row_tensor_names
        ]
        return torch.cat([torch.zeros(n_rows, 0), *parts], dim=1)

    def prepare_tables(self, tensors: Mapping[str, Tensor]) -> tuple[Tensor, Tensor]:
        """Compute `theta` and the matrices of products, concatenated, from named tensors."""
        prepared = self.parts.prepare(*(tensors[name].double() for name in self.shared_names))
        return _concatenate([prepared[k] for k in self.parts.theta_indices]).to(
            self.dtype
        ), _concatenate(
            [
                prepared[product.matrix_index].reshape(-1, product.n_inputs, product.n_outputs)[
                    product.matrix_member
                ]
                for product in self.parts.products
                if not product.activation
            ]
        ).to(self.dtype)

    def __call__(self, x: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return states, applied inputs and the final memory, as `Rollout.forward`."""
        tensors = _named_tensors(self.rollout)
        rows = self._row_tensors(tensors, len(x) if self.row_tensor_names else 1).expand(len(x), -1)
        q = self.rollout.source.initial(x)
        with torch.set_grad_enabled(self.trained_indices is not None and torch.is_grad_enabled()):
            theta, tables = self.prepare_tables(tensors)
            states, applied_inputs, memory = self.simulate(theta, tables, x, s, rows, w, q)
        return states, w if self.rollout.source.is_playback else applied_inputs, memory

    def simulate(self, *arguments: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return states, inputs and the final memory; arguments as in `run_forward`."""
        if not torch.is_grad_enabled():
            return self.run_forward(*arguments, keep_history=False)[0]
        apply: Any = _CompiledRun.apply
        result: tuple[Tensor, Tensor, Tensor] = apply(*arguments, self)
        return result

    def run_forward(
        self,
        theta: Tensor,
        tables: Tensor,
        x: Tensor,
        s: Tensor,
        row_values: Tensor,
        w: Tensor,
        q: Tensor,
        *,
        keep_history: bool,
    ) -> tuple[tuple[Tensor, Tensor, Tensor], list[Tensor]]:
        """Run all rows in C.

        Args:
            theta: entries of shared tensors that the scalar function reads.
            tables: matrices of products, one after the other.
            x: initial states [B, nx].
            s: initial memory of the model [B, n_state].
            row_values: tensors that differ from row to row, flattened [B, n].
            w: inputs [B, T, m].
            q: initial memory of the source [B, k].
            keep_history: whether to store the values that the gradient needs.

        Returns:
            States, inputs and final memory; and the arguments of the gradient: `theta`, tables,
            row tensors, states, inputs and both memories with the rows as last dimension, padded to
            complete blocks, and the stored values of all steps, block by block.
        """
        n_rows, n_steps = w.shape[:2]
        n_blocks = -(-n_rows // self.n_lanes)
        n_padded = n_blocks * self.n_lanes
        # the last block is padded with copies of the last row
        row_indices = torch.arange(n_padded).clamp(max=n_rows - 1)

        def pad_rows(part: Tensor) -> Tensor:
            part = part.detach().to(self.dtype)
            return part if n_padded == n_rows else part[row_indices]

        def empty(*sizes: int) -> Tensor:
            return torch.empty(*sizes, n_padded, dtype=self.dtype)

        states = empty(n_steps + 1, self.sizes["x"])
        memories = [
            empty(n_steps + 1 if keep_history else 2, self.sizes[name]) for name in ("s", "q")
        ]
        for history, initial in zip((states, *memories), (x, s, q), strict=True):
            history[0] = pad_rows(initial).T
        inputs = pad_rows(w).permute(1, 2, 0).contiguous()
        applied = empty(n_steps, self.sizes["a"])
        stored = self.allocate(n_blocks, n_steps if keep_history else 0, self.forward_storage)
        rows = pad_rows(row_values).T.contiguous()
        tensors = [theta.detach(), tables.detach(), rows, states, inputs, *memories]
        self.call_library(
            "run_forward", n_blocks, *tensors, applied, stored, int(keep_history), n_steps, n_padded
        )
        # without history two buffers alternate
        final_memory = memories[0][n_steps if keep_history else n_steps & 1]
        result = (
            states.permute(2, 0, 1)[:n_rows],
            applied.permute(2, 0, 1)[:n_rows],
            final_memory.T[:n_rows],
        )
        return result, [*tensors, stored]

    def allocate(self, n_blocks: int, n_steps: int, layout: Mapping[str, slice]) -> Tensor:
        """Return uninitialised storage of a layout for each block and step."""
        return torch.empty(
            n_blocks * n_steps, _storage_size(layout), self.n_lanes, dtype=self.dtype
        )

    def call_library(self, name: str, n_blocks: int, *arguments: Tensor | int) -> None:
        """Call a function of the library for all blocks of rows, in parallel on idle cores."""
        function = getattr(self.library, name)
        values = [
            ctypes.c_void_p(a.data_ptr()) if isinstance(a, Tensor) else ctypes.c_long(a)
            for a in arguments
        ]
        n_threads = min(max(torch.get_num_threads(), available_cores()), n_blocks)
        boundaries = [ctypes.c_long(n_blocks * k // n_threads) for k in range(n_threads + 1)]
        if n_threads == 1:
            function(*values, *boundaries)
            return
        with ThreadPoolExecutor(n_threads) as pool:
            list(
                pool.map(lambda block_range: function(*values, *block_range), pairwise(boundaries))
            )


class _CompiledRun(torch.autograd.Function):
    """The compiled rollout as an operation of torch with a gradient."""

    @staticmethod
    def forward(ctx: Any, *arguments: Any) -> tuple[Tensor, Tensor, Tensor]:
        """Return states [B, T+1, nx], inputs [B, T, m] and the last memory [B, n].

        The arguments are theta, tables, x, s, row tensors, w, q, and the compiled rollout.
        """
        *tensors, compiled = arguments
        result: tuple[Tensor, Tensor, Tensor]
        result, history = compiled.run_forward(*tensors, keep_history=True)
        ctx.compiled = compiled
        ctx.n_rows = len(result[0])
        ctx.save_for_backward(*history)
        return result

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        """Return the gradient of theta, tables, x and s."""
        history = ctx.saved_tensors
        compiled = ctx.compiled
        n_rows = ctx.n_rows
        n_steps, _, n_padded = history[4].shape
        cotangents = []
        for grad in (grads[0], grads[1], grads[2][:, None]):
            padded = torch.zeros(*grad.shape[1:], n_padded, dtype=compiled.dtype)
            padded[:, :, :n_rows] = grad.permute(1, 2, 0)
            cotangents.append(padded)
        # the gradient is accumulated for each row, so that the sum over rows does not depend on the
        # number of threads
        n_blocks = n_padded // compiled.n_lanes
        n_theta = len(compiled.trained_indices)
        backward_storage = compiled.allocate(n_blocks, n_steps, compiled.backward_storage)
        products = [
            (k, product)
            for k, product in enumerate(compiled.parts.products)
            if not product.activation
        ]
        n_matrix_entries = (
            sum(product.matrix_size for _, product in products) if compiled.has_row_gradients else 0
        )
        row_gradients = torch.zeros(
            n_blocks, n_theta + n_matrix_entries, compiled.n_lanes, dtype=compiled.dtype
        )
        compiled.call_library(
            "run_backward",
            n_blocks,
            *history,
            *cotangents,
            backward_storage,
            row_gradients,
            n_steps,
            n_padded,
        )
        rows = row_gradients.transpose(1, 2).reshape(n_padded, -1)[:n_rows]
        if not math.isinf(compiled.max_gradient_ratio):
            cotangent_square = sum(grad.flatten(1).square().sum(1) for grad in grads)
            rows = _clip_row_gradients(
                rows, torch.as_tensor(cotangent_square).sqrt(), compiled.max_gradient_ratio
            )
        theta_gradient, tables = rows.sum(0).split([n_theta, n_matrix_entries])
        if not compiled.has_row_gradients:
            gradient_of_product: dict[int, Tensor] = {}
            layout = compiled.backward_storage
            # products with one cotangent have adjacent factors: their matrices get their gradients
            # in one batched product of stored factors and cotangents
            ordered_products = sorted(
                products, key=lambda p: compiled.forward_storage[f"factor_{p[0]}"].start
            )
            for _, group in groupby(
                ordered_products, lambda p: layout[f"product_{p[0]}_cotangent"].start
            ):
                group_products = [*group]
                (k, product) = group_products[0]
                last_factor = compiled.forward_storage[f"factor_{group_products[-1][0]}"]
                factor_range = slice(
                    compiled.forward_storage[f"factor_{k}"].start, last_factor.stop
                )
                factor = history[-1][:, factor_range].unflatten(1, (product.n_repeats, -1))
                cotangent = backward_storage[:, layout[f"product_{k}_cotangent"]].unflatten(
                    1, (product.n_repeats, -1)
                )
                gradient = torch.zeros(factor.shape[2], product.n_outputs, dtype=compiled.dtype)
                for a, b in zip(factor.unbind(1), cotangent.unbind(1), strict=True):
                    gradient.addbmm_(a, b.transpose(1, 2))
                parts = gradient.split([member.n_inputs for _, member in group_products])
                gradient_of_product |= {
                    k: part for (k, _), part in zip(group_products, parts, strict=True)
                }
            tables = _concatenate([gradient_of_product[k] for k, _ in products])
        theta = torch.zeros(len(history[0]), dtype=compiled.dtype)
        theta[compiled.trained_indices] = theta_gradient
        x, s = cotangents[0][0].T[:n_rows], cotangents[2][0].T[:n_rows]
        return theta, tables, x, s, *[None] * 4


def _storage_size(layout: Mapping[str, slice]) -> int:
    """Return the number of entries of a layout."""
    return max((entries.stop for entries in layout.values()), default=0)


def _clip_row_gradients(gradients: Tensor, cotangent_norm: Tensor, max_ratio: float) -> Tensor:
    """Scale down the gradients of rows whose ratio to their cotangents is exceptionally large.

    Args:
        gradients: gradient of each row [B, n].
        cotangent_norm: norm of each row's cotangent [B].
        max_ratio: largest ratio of gradient and cotangent as a multiple of the median ratio.
    """
    gradient_norm = gradients.norm(dim=1)
    ratio = gradient_norm / cotangent_norm.clamp(min=1e-30)
    median_ratio = (
        ratio[cotangent_norm > 0].nanmedian()
        if bool((cotangent_norm > 0).any())
        else ratio.new_zeros(())
    )
    factor = (max_ratio * median_ratio * cotangent_norm / gradient_norm.clamp(min=1e-30)).clamp(
        max=1.0
    )
    # gradients that are not finite carry no information
    return torch.where(torch.isfinite(gradient_norm)[:, None], gradients * factor[:, None], 0.0)


def _named_tensors(rollout: Rollout) -> dict[str, Tensor]:
    """Return the parameters and buffers of a rollout by name."""
    # `named_parameters` and `named_buffers` would take half the time of a short run
    return {
        f"{module_name}.{name}" if module_name else name: tensor
        for module_name, module in rollout.named_modules()
        for tensors in (module._parameters, module._buffers)
        for name, tensor in tensors.items()
        if tensor is not None
    }


def _call_with_tensors(
    step: nn.Module, tensors: Mapping[str, Tensor], arguments: tuple[Tensor, ...]
) -> Any:
    """Call the step of a rollout with other parameters and buffers."""
    tensors = {f"rollout.{name}": tensor for name, tensor in tensors.items()}
    # a tensor shared by two modules would be replaced twice and restored once
    return torch.func.functional_call(step, tensors, arguments, tie_weights=False)


def _concatenate(parts: Sequence[Tensor]) -> Tensor:
    """Return all entries of tensors in one vector, empty for no tensors."""
    return torch.cat([torch.zeros(0), *(part.flatten() for part in parts)])
