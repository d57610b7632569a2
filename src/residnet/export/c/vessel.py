"""A vessel model as a C99 source file and header."""

from __future__ import annotations

import copy
import json
from collections.abc import Mapping
from typing import Any, NamedTuple

from torch import Tensor

from residnet.core.names import STATE
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.store import ModelSpec
from residnet.export.c.band import ABOUT, band_body, band_prototype
from residnet.export.c.source import CFunction, c_file, h_file, identifier
from residnet.export.guard import GuardedDynamics
from residnet.export.lowering.build import lowered

_WARMUP = """    {p}_real after[{P}_STATES];
    size_t k, good = count;
    for (k = 0; k < {P}_MEMORY; k++) s[k] = 0;
    for (k = 0; k < count && good == count; k++)
        if ({p}_measured(x + {P}_STATES * k, w + {P}_INPUTS * k)) good = k;
    for (k = 0; k < count && good < count; k++) {{
        if ({p}_measured(x + {P}_STATES * k, w + {P}_INPUTS * k)) good = k;
        (void){p}_step(x + {P}_STATES * good, w + {P}_INPUTS * good, s, after, s);
    }}
"""


class CSource(NamedTuple):
    """The two files of a model.

    Attributes:
        prefix: of all names in them.
        source: text of the .c file.
        header: text of the .h file, without the card.
    """

    prefix: str
    source: str
    header: str


def vessel_source(
    spec: ModelSpec,
    model: HybridDynamics,
    card: Mapping[str, Any],
    header: str,
    *,
    double_only: bool = False,
) -> CSource:
    """Return the source and header of a model.

    Args:
        spec: the model's description.
        model: in float64.
        card: stands as a comment in the header.
        header: name of the header file.
        double_only: whether single precision is not offered.

    Raises:
        ExportError: where the model has an operation that is not written in C.
    """
    guarded = GuardedDynamics(copy.deepcopy(model), spec).double().eval()
    what, prefix = f"model {spec.name}", identifier(spec.name)
    upper = prefix.upper()
    columns = len(spec.signals.columns)
    sample = [("x", len(STATE)), ("w", columns)]

    def measured(x: Tensor, w: Tensor) -> Tensor:
        return guarded.measured(x, w)

    functions = [
        CFunction(
            "measured",
            "1 where every entry of a state and its inputs is a measurement, else 0",
            lowered(measured, sample, ["good"], what),
        ),
        CFunction(
            "step",
            "state and memory one step later; returns 1 where anything was outside the training"
            "\n * range or no number, else 0; results may go where arguments came from",
            lowered(
                lambda x, w, s: guarded.flagged_step(x, w, s),
                [*sample, ("s", model.n_state)],
                ["x_after", "s_after", "outside"],
                what,
            ),
        ),
    ]
    begin = f"void {prefix}_initial_state({prefix}_real *s)"
    history = (
        f"void {prefix}_warmup(const {prefix}_real *x, const {prefix}_real *w, size_t count,"
        f" {prefix}_real *s)"
    )
    empty = "    size_t k;\n    for (k = 0; k < {P}_MEMORY; k++) s[k] = 0;\n"
    if model.n_state == 0:
        empty = "    (void)s;\n"
    bodies = [
        (begin, empty.format(P=upper)),
        (history, _warmup_body(model.n_state).format(p=prefix, P=upper)),
        (band_prototype(prefix), band_body(spec.band)),
    ]
    comments = [
        ("memory without a past", begin),
        (
            "memory that a measured past leaves: count states and inputs, oldest first",
            history,
        ),
        (ABOUT, band_prototype(prefix)),
    ]
    sizes: dict[str, tuple[int | str, str]] = {
        "STATES": (len(STATE), ", ".join(f"{e['name']} {e['unit']}" for e in card["states"])),
        "INPUTS": (columns, ", ".join(f"{e['name']} {e['unit']}" for e in card["inputs"])),
        "MEMORY": (model.n_state, "entries of the memory s"),
        "DT": (repr(float(spec.dt)), "step in s"),
    }
    about = (
        f"{spec.name}: a vessel model, written by residnet. All arrays are the caller's; nothing"
        " is\nallocated, nothing is kept between calls.\n\n"
        "x [STATES] state, w [INPUTS] inputs held over the step, s [MEMORY] memory.\n\n"
        + json.dumps(card, indent=1)
    )
    return CSource(
        prefix,
        c_file(prefix, functions, bodies, header),
        h_file(prefix, functions, comments, sizes, about, double_only=double_only),
    )


def _warmup_body(memory: int) -> str:
    if memory == 0:
        return "    (void)x;\n    (void)w;\n    (void)count;\n    (void)s;\n"
    return _WARMUP
