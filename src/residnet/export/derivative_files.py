"""Files of hydrodynamic derivatives for other programs, and as a vessel of residnet.

| format | contents |
| --- | --- |
| `json`, `csv`, `matlab` | the table with standard errors |
| `vessel` | a vessel file of kind `abkowitz`, which residnet simulates |
| `mss` | a MATLAB function [xdot, U] = vessel(x, ui) as in the MSS toolbox (Fossen) |
| `sdf` | the hydrodynamics plugins of Gazebo and of VRX |

The simulators' names follow gz-sim (systems/hydrodynamics/Hydrodynamics.cc, SNAME 1950) and
of VRX (vrx_gz/src/SimpleHydrodynamics.cc).
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from residnet.core.config_yaml import dump_yaml
from residnet.core.errors import UsageError
from residnet.core.files import make_file_stem
from residnet.core.names import suggest_name
from residnet.evaluation.derivatives import DerivativeRow, DerivativesFile
from residnet.export.base import render_template
from residnet.physics.similarity import is_drive, is_rudder


def render_derivatives(table: DerivativesFile, file: Path, format_name: str | None) -> str:
    """Return the text of a file of derivatives.

    Args:
        table: the derivatives.
        file: path of the file; its name becomes the name of the vessel or of the function.
        format_name: name of the format; None for the one of the file's suffix.

    Raises:
        UsageError: if there is no such format, or it cannot represent the table.
    """
    if format_name is None:
        format_name = _FORMAT_OF_SUFFIX.get(file.suffix)
        if format_name is None:
            raise UsageError(
                f"{file}: no format has the suffix '{file.suffix}'; choose one of"
                f" {', '.join(_FORMAT_OF_SUFFIX)}, or give --format"
            )
    if format_name not in _WRITERS:
        raise UsageError(
            f"no format '{format_name}' of derivatives{suggest_name(format_name, _WRITERS)}; choose"
            f" one of {', '.join(_WRITERS)}"
        )
    return _WRITERS[format_name](table, make_file_stem(file.stem))


def _inputs_of(table: DerivativesFile) -> list[str]:
    """Return the inputs that act on the vessel, in the order of the model."""
    used = {variable for row in table.rows for variable in row.variables}
    return [name for name in table.operating_point if name in used]


def _rigid_body(table: DerivativesFile) -> tuple[float, float, float] | None:
    """Return mass in kg, moment of inertia about the origin in kg m^2 and x_G in m, if known."""
    mass = table.particulars["mass"]
    length = table.particulars["length"]
    gyradius = table.particulars["gyradius"]
    centre = table.particulars["centre_of_gravity"] or 0.0
    if table.quantity != "force" or mass is None or length is None or gyradius is None:
        return None
    return mass, mass * ((gyradius * length) ** 2 + centre**2), centre


def _mass_matrix(table: DerivativesFile) -> list[list[float]]:
    """Return the mass matrix; the identity where the table has accelerations."""
    return table.mass_matrix or [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]


def _describe_table(table: DerivativesFile) -> list[str]:
    """Return sentences for the header of a file: expansion point, validity, remarks."""
    ranges = ", ".join(
        f"{name} {low:.4g} to {high:.4g}" for name, (low, high) in table.ranges.items()
    )
    sentences = [
        f"Derivatives of the {'forces' if table.quantity == 'force' else 'accelerations'} of model"
        f" {table.model} about U = {table.particulars['speed']:.6g} m/s; SI units, angles in rad,"
        " revolutions in 1/s; rudder angles are positive to starboard.",
    ]
    if ranges:
        sentences.append(f"Range of the tests: {ranges}.")
    return [*sentences, *table.remarks]


def _write_vessel(table: DerivativesFile, stem: str) -> str:
    """Return a vessel file of kind `abkowitz` in SI units.

    Raises:
        UsageError: if the vessel has other inputs than one rudder and one propeller.
    """
    inputs = _inputs_of(table)
    rudders = [name for name in inputs if is_rudder(name)]
    shafts = [name for name in inputs if name.removeprefix("cmd_") == "n"]
    other_inputs = [name for name in inputs if name not in (*rudders, *shafts)]
    if len(rudders) != 1 or other_inputs:
        raise UsageError(
            "derivatives as a vessel file: it has one rudder and the revolutions of one propeller;"
            f" this model has the inputs {', '.join(inputs) or 'none'}: choose --format mss"
        )
    variable_of = {"u": "du", rudders[0]: "delta"} | dict.fromkeys(shafts, "dn")
    coefficients: dict[str, dict[str, float]] = {axis: {} for axis in "XYN"}
    for row in table.rows:
        names = [variable_of.get(name, name) for name in row.variables]
        powers = Counter(names)
        term = " ".join(name if power == 1 else f"{name}^{power}" for name, power in powers.items())
        coefficients[row.axis][term or "1"] = row.value
    mass = _mass_matrix(table)
    body = _rigid_body(table)
    # without the rigid body only the sums of mass and added mass are known, and the derivatives
    # contain its centripetal terms
    m, inertia, centre = body or (mass[0][0], mass[2][2], 0.0)
    low, high = table.ranges.get(rudders[0], (-0.6109, 0.6109))
    content: dict[str, Any] = {
        "kind": "abkowitz",
        "name": stem,
        "description": f"Taylor series of model {table.model}, identified from tests",
        "length": {
            "value": table.particulars["length"],
            "unit": "m",
            "source": "main particulars of the table",
        },
        "units": "si",
        "speed": table.particulars["speed"],
        "density": table.particulars["density"],
        "coriolis": "included" if body is None else "rigid_body",
        "delta_sign": 1,
        "source": f"residnet derivatives, model {table.model}",
        "mass": {
            "m": m,
            "I_z": inertia,
            "x_G": centre,
            "X_udot": m - mass[0][0],
            "Y_vdot": m - mass[1][1],
            "Y_rdot": m * centre - mass[1][2],
            "N_vdot": m * centre - mass[2][1],
            "N_rdot": inertia - mass[2][2],
        },
        "coefficients": {axis: terms for axis, terms in coefficients.items() if terms},
        # the largest tested angle: the series is not valid beyond it
        "rudder": {"limit": max(abs(low), abs(high))},
    }
    if shafts:
        shaft_range = table.ranges.get(shafts[0], (0.0, table.operating_point[shafts[0]]))
        content["shaft"] = {
            "n_0": table.operating_point[shafts[0]],
            "n_max": max(abs(limit) for limit in shaft_range),
        }
    header = "".join(f"# {sentence}\n" for sentence in _describe_table(table))
    return header + dump_yaml(content)


def _matlab_name(row: DerivativeRow) -> str:
    name = row.name.removesuffix("/m")
    return "".join(character if character.isalnum() else "_" for character in name)


def _write_mss(table: DerivativesFile, stem: str) -> str:
    """Return a MATLAB function of the accelerations, like the vessels of the MSS toolbox.

    Raises:
        UsageError: if the name of the file is no name of a function.
    """
    if not re.fullmatch(r"[A-Za-z]\w*", stem, flags=re.ASCII):
        raise UsageError(
            f"{stem}.m: MATLAB names the function like its file; choose a name of letters, digits"
            " and underscores, such as vessel.m"
        )
    inputs = _inputs_of(table)
    variables = {"u": "du"} | {name: name if is_rudder(name) else f"d{name}" for name in inputs}
    variables |= {f"|{name}|": f"abs({name})" for name in ("v", "r")}
    sums: dict[str, list[str]] = {axis: [] for axis in "XYN"}
    assignments = []
    for row in table.rows:
        assignments.append(f"{_matlab_name(row)} = {row.value!r};")
        factors = [_matlab_name(row), *(variables.get(name, name) for name in row.variables)]
        sums[row.axis].append("*".join(factors))
    body = _rigid_body(table)
    return render_template(
        "mss_vessel.m",
        name=stem,
        header=_describe_table(table),
        inputs=[
            # adding zero removes the sign of a negative zero
            {"name": name, "variable": variables[name], "value": table.operating_point[name] + 0.0}
            for name in inputs
        ],
        speed=table.particulars["speed"],
        assignments=assignments,
        forces={axis: " + ".join(terms) or "0" for axis, terms in sums.items()},
        mass=_mass_matrix(table),
        rigid_mass=0.0 if body is None else body[0],
        centre=0.0 if body is None else body[2],
    )


def _write_sdf(table: DerivativesFile, stem: str) -> str:
    """Return the plugins of Gazebo and VRX with the derivatives at the service speed.

    Gazebo computes the Coriolis forces of the added mass itself, so that its linear coefficients do
    not contain them. VRX has neither these forces nor damping across sway and yaw.

    Raises:
        UsageError: if the mass of the rigid body is unknown, which the simulators need.
    """
    body = _rigid_body(table)
    if body is None or table.mass_matrix is None:
        raise UsageError(
            "derivatives for Gazebo: the simulators need the added masses apart from the mass of"
            " the vessel; give --mass, --beam and --draught"
        )
    mass, inertia, centre = body
    speed = table.particulars["speed"] or 0.0
    length = table.particulars["length"] or 1.0
    values = {row.name: row.value for row in table.rows}
    matrix = table.mass_matrix
    added_surge = matrix[0][0] - mass
    added_sway = matrix[1][1] - mass
    added_yaw = matrix[2][2] - inertia
    added_coupling = 0.5 * (matrix[1][2] + matrix[2][1]) - mass * centre
    linear_surge, quadratic_surge = _split_resistance(table, values, speed)
    gazebo = {
        "xDotU": -added_surge,
        "yDotV": -added_sway,
        "yDotR": -added_coupling,
        "nDotV": -added_coupling,
        "nDotR": -added_yaw,
        "xU": -linear_surge,
        "xUabsU": -quadratic_surge,
        # F = -C_A(nu) nu + damping, linearised at (U, 0, 0) (Fossen 2011, section 6.3)
        "yV": values.get("Y_v", 0.0),
        "yR": values.get("Y_r", 0.0) + added_surge * speed,
        "nV": values.get("N_v", 0.0) + (added_sway - added_surge) * speed,
        "nR": values.get("N_r", 0.0) + added_coupling * speed,
    }
    for axis in "YN":
        for first in "vr":
            for second in "vr":
                name = f"{axis}_{first}|{second}|"
                if name in values:
                    gazebo[f"{axis.lower()}{first.upper()}abs{second.upper()}"] = values[name]
    vrx = {
        "xDotU": added_surge,
        "yDotV": added_sway,
        "nDotR": added_yaw,
        "xU": linear_surge,
        "xUU": quadratic_surge,
        "yV": -values.get("Y_v", 0.0),
        "yVV": -values.get("Y_v|v|", 0.0),
        "nR": -values.get("N_r", 0.0),
        "nRR": -values.get("N_r|r|", 0.0),
        # VRX limits its forces and torques to 10,000 by default
        "max_effort": 9.81 * mass * max(length, 1.0),
    }
    placed = {"X_u", "Y_v", "Y_r", "N_v", "N_r", "X_tau_x"} | {
        f"{axis}_{first}|{second}|" for axis in "YN" for first in "vr" for second in "vr"
    }
    return render_template(
        "derivatives.sdf",
        name=stem,
        # two hyphens end a comment in XML
        header=[sentence.replace("--", "- -") for sentence in _describe_table(table)],
        mass=mass,
        inertia=inertia,
        centre=centre,
        gazebo=gazebo,
        vrx=vrx,
        omitted=[name for name in values if name not in placed],
        thrust=linear_surge * speed + quadratic_surge * speed**2,
        speed=speed,
    )


def _split_resistance(
    table: DerivativesFile, values: Mapping[str, float], speed: float
) -> tuple[float, float]:
    """Return the linear and the quadratic coefficient of the resistance.

    Its slope at the service speed is -X_u. With a logged thrust tau_x its value is the thrust at
    equilibrium; otherwise the resistance is assumed to be quadratic.
    """
    slope = -values.get("X_u", 0.0)
    if "tau_x" in table.operating_point and is_drive("tau_x"):
        resistance = table.operating_point["tau_x"] * values.get("X_tau_x", 0.0)
        quadratic = (slope - resistance / speed) / speed
        linear = slope - 2.0 * quadratic * speed
        if quadratic >= 0.0 and linear >= 0.0:
            return linear, quadratic
    return 0.0, 0.5 * slope / speed


_WRITERS: dict[str, Callable[[DerivativesFile, str], str]] = {
    "json": lambda table, _: table.to_json_text(),
    "csv": lambda table, _: table.to_csv(),
    "matlab": lambda table, _: table.to_matlab(),
    "vessel": _write_vessel,
    "mss": _write_mss,
    "sdf": _write_sdf,
}
DERIVATIVE_FORMATS = tuple(_WRITERS)
"""Names of the formats."""
_FORMAT_OF_SUFFIX = {
    ".json": "json",
    ".csv": "csv",
    ".m": "matlab",
    ".yaml": "vessel",
    ".sdf": "sdf",
}
