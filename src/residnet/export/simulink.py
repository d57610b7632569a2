"""The format `simulink`: a level-2 S-function around the exported C, for Simulink.

Source: MathWorks, "S-Function Callback Methods" and "Guidelines for Writing C MEX S-Functions".
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar, final

import torch

from residnet.core.errors import UsageError
from residnet.export.base import Exported, Exporter, write_card
from residnet.export.c import CompiledModel, c_source
from residnet.export.c_code import compile_shared, identifier
from residnet.export.vessel import ExportedVessel

_SOURCE = """/* {about}, as a level-2 S-function; written by residnet.
   In MATLAB, with the files beside it: mex {name}.c {name}_model.c
   {ports}
   Sample time {dt} s. SI units and radians. {parameter} */
#define S_FUNCTION_NAME {name}
#define S_FUNCTION_LEVEL 2
#include "simstruc.h"
#include "{name}_model.h"

#define KEPT {kept}

static void mdlInitializeSizes(SimStruct *S) {{
    ssSetNumSFcnParams(S, {parameters});
    if (ssGetNumSFcnParams(S) != ssGetSFcnParamsCount(S)) return;
    ssSetNumContStates(S, 0);
    ssSetNumDiscStates(S, KEPT);
    if (!ssSetNumInputPorts(S, {inputs})) return;
{input_ports}    if (!ssSetNumOutputPorts(S, {outputs})) return;
{output_ports}    ssSetNumSampleTimes(S, 1);
    ssSetNumRWork(S, {next});
    ssSetOptions(S, SS_OPTION_EXCEPTION_FREE_CODE);
}}

static void mdlInitializeSampleTimes(SimStruct *S) {{
    ssSetSampleTime(S, 0, {dt});
    ssSetOffsetTime(S, 0, 0.0);
}}

#define MDL_INITIALIZE_CONDITIONS
static void mdlInitializeConditions(SimStruct *S) {{
    real_T *kept = ssGetRealDiscStates(S);
    int k;
    for (k = 0; k < KEPT; k++) kept[k] = 0.0;
{begin}}}

static void mdlOutputs(SimStruct *S, int_T tid) {{
    real_T *kept = ssGetRealDiscStates(S);
{given}{taken}    (void)tid;
{answer}}}

#define MDL_UPDATE
static void mdlUpdate(SimStruct *S, int_T tid) {{
    real_T *kept = ssGetRealDiscStates(S);
{update}    (void)tid;
}}

static void mdlTerminate(SimStruct *S) {{ (void)S; }}

#ifdef MATLAB_MEX_FILE
#include "simulink.c"
#else
#include "cg_sfun.h"
#endif
"""


def s_function(exported: Exported, prefix: str, name: str, sizes: Mapping[str, int]) -> str:
    """Return the source of the S-function of a vessel or a controller.

    Args:
        exported: with its step.
        prefix: of the functions in the C file.
    """
    given = dict(exported.arguments)
    vessel = isinstance(exported, ExportedVessel)
    held = ["x", "s"] if vessel else ["s"]
    ports = [part for part in given if part not in held]
    out = ["x"] if vessel else [one for one in exported.results if one in sizes][:1]
    widths = [given["x"]] if vessel else [sizes[one] for one in out]
    at, place = {}, 0
    for one in held:
        at[one], place = place, place + given[one]
    flags = len(exported.flags)
    kept = place + (flags if vessel else 1)
    read = "".join(
        f"    const real_T *{one} = (const real_T *)ssGetInputPortSignal(S, {k});\n"
        for k, one in enumerate(ports)
    )
    begin = f"    {prefix}_initial_state(kept + {at['s']});\n"
    if vessel:
        step = ", ".join(["kept", "w", f"kept + {at['s']}", "kept", f"kept + {at['s']}"])
        begin = (
            f"    for (k = 0; k < {given['x']}; k++) kept[k] = mxGetPr(ssGetSFcnParam(S, 0))[k];\n"
            + begin
        )
        answer = (
            f"    int k;\n    for (k = 0; k < {given['x']}; k++) x[k] = kept[k];\n"
            f"    flags[0] = kept[{place}];\n"
        )
        update = f"{read}    kept[{place}] = {prefix}_step({step});\n"
        read, work = "", 0
    else:
        begin, work = "", given["s"]
        named = {"s": f"kept + {at['s']}"}
        called = [*(named.get(one, one) for one in given), out[0], "ssGetRWork(S)"]
        more = "".join(f"    flags[{k}] = flag_{k};\n" for k in range(1, flags))
        declared = "".join(f"    int flag_{k};\n" for k in range(1, flags))
        called += [f"&flag_{k}" for k in range(1, flags)]
        answer = (
            f"{declared}    if (kept[{place}] == 0.0) {prefix}_initial_state("
            f"{ports[0]}, kept + {at['s']});\n"
            f"    flags[0] = {prefix}_step({', '.join(called)});\n{more}"
        )
        update = (
            f"    int k;\n    for (k = 0; k < {given['s']}; k++) kept[k] = ssGetRWork(S)[k];\n"
            f"    kept[{place}] = 1.0;\n"
        )
    told = [f"{one} [{given[one]}]" for one in ports]
    return _SOURCE.format(
        about=exported.what,
        name=name,
        ports=f"Inputs: {', '.join(told)}. Outputs: {out[0]} [{widths[0]}],"
        f" {', '.join(exported.flags)}.",
        dt=repr(float(exported.dt or 0.0)),
        parameter=f"Parameter: the state [{given['x']}] to start from." if vessel else "",
        parameters=int(vessel),
        kept=kept,
        inputs=len(ports),
        input_ports="".join(
            f"    ssSetInputPortWidth(S, {k}, {given[one]});\n"
            f"    ssSetInputPortRequiredContiguous(S, {k}, 1);\n"
            f"    ssSetInputPortDirectFeedThrough(S, {k}, {int(not vessel)});\n"
            for k, one in enumerate(ports)
        ),
        outputs=2,
        output_ports=f"    ssSetOutputPortWidth(S, 0, {widths[0]});\n"
        f"    ssSetOutputPortWidth(S, 1, {flags});\n",
        next=work,
        begin=begin,
        given=read,
        taken=f"    real_T *{out[0]} = ssGetOutputPortRealSignal(S, 0);\n"
        "    real_T *flags = ssGetOutputPortRealSignal(S, 1);\n",
        answer=answer,
        update=update,
    )


@final
class SimulinkExporter(Exporter):
    """A level-2 S-function in double precision, with the C that it calls."""

    name: ClassVar[str] = "simulink"
    suffix: ClassVar[str] = "_sfun.c"
    about: ClassVar[str] = "A level-2 S-function for Simulink around the C code."

    def export(self, exported: Exported, file: Path) -> Mapping[str, Any]:
        """Write the S-function, the C file and header that it calls, and the card."""
        if exported.dt is None:
            raise UsageError(f"{exported.what}: has no step of its own; export it as c")
        exported.require_numbers()
        name = identifier(file.stem)
        file = file.with_name(f"{name}.c")
        card = exported.card() | {
            "format": self.name,
            "dtype": "float64",
            "safety": "The file is source code: compile only what you trust.",
        }
        written = c_source(exported, card, f"{name}_model.h", double_only=True)
        with tempfile.TemporaryDirectory() as folder:
            partial = Path(folder) / f"{name}_model.c"
            partial.write_text(written.source)
            partial.with_suffix(".h").write_text(written.header)
            library = compile_shared([partial], partial.with_suffix(".so"))
            loaded = CompiledModel(library, exported, torch.float64)
            card |= {"parity": exported.check(loaded, "the S-function's code", torch.float64)}
        text = s_function(exported, written.prefix, name, loaded.outputs)
        file.parent.mkdir(parents=True, exist_ok=True)
        file.with_name(f"{name}_model.c").write_text(written.source)
        file.with_name(f"{name}_model.h").write_text(written.header)
        write_card(file, card)
        file.write_text(text)
        return card
