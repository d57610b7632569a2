"""The coefficients as text: Gazebo and VRX plugins, MSS, PythonVehicleSimulator."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from residnet.export.parameters.coefficients import Coefficients, Matrix

_PLACES = (0, 1, 5)
"""Of surge, sway and yaw among six degrees of freedom."""

_VEHICLE = '''"""{name}: a vessel of PythonVehicleSimulator, written by residnet.

M nu_dot + C(nu) nu + D nu + D_n |nu| nu = tau in surge, sway and yaw; SI units.
"""

import numpy as np


class {title}:
    """The controls are the forces tau_x, tau_y in N and the moment tau_n in N m."""

    def __init__(self):
        self.name = "{name}"
        self.controls = ["tau_x (N)", "tau_y (N)", "tau_n (N m)"]
        self.dimU = 3
        self.nu = np.zeros(6)
        self.u_actual = np.zeros(3)
        self.M = np.array({mass})
        self.D = np.array({linear})
        self.Dn = np.array({quadratic})

    def dynamics(self, eta, nu, u_actual, u_control, sampleTime):
        """Return nu and u_actual one sample later (forward Euler), nu = [u v w p q r]."""
        u, v, r = nu[0], nu[1], nu[5]
        planar = np.array([u, v, r])
        a = self.M[1, 1] * v + 0.5 * (self.M[1, 2] + self.M[2, 1]) * r
        b = self.M[0, 0] * u
        C = np.array([[0, 0, -a], [0, 0, b], [a, -b, 0]])
        tau = np.asarray(u_control, dtype=float)
        force = tau - C @ planar - self.D @ planar - self.Dn @ (np.abs(planar) * planar)
        planar = planar + sampleTime * np.linalg.solve(self.M, force)
        nu = np.array(nu, dtype=float)
        nu[[0, 1, 5]] = planar
        return nu, tau
'''


def vehicle_python(name: str, found: Coefficients) -> str:
    """Return a vehicle class for PythonVehicleSimulator."""
    title = "".join(part.capitalize() for part in name.split("_"))
    return _VEHICLE.format(
        name=name,
        title=title,
        mass=found.mass.tolist(),
        linear=found.linear.tolist(),
        quadratic=found.quadratic.tolist(),
    )


def mss(name: str, found: Coefficients) -> str:
    """Return a MATLAB function with the six-by-six matrices that MSS' vessels have."""

    def six(matrix: Matrix) -> str:
        whole = np.zeros((6, 6))
        whole[np.ix_(_PLACES, _PLACES)] = matrix
        rows = (" ".join(repr(float(value)) for value in row) for row in whole)
        return "[" + "; ".join(rows) + "]"

    return (
        f"function [M, D, Dn] = {name}_parameters()\n"
        f"% {name}: M nu_dot + C(nu) nu + D nu + Dn abs(nu).*nu = tau, C = m2c(M, nu)\n"
        "% surge, sway and yaw; heave, roll and pitch are zero: take rows and columns [1 2 6].\n"
        f"M = {six(found.mass)};\nD = {six(found.linear)};\nDn = {six(found.quadratic)};\nend\n"
    )


def gazebo(name: str, found: Coefficients, rigid: Mapping[str, float]) -> str:
    """Return the plugins of Gazebo and VRX as SDF, with the masses of the rigid body.

    Gazebo's coefficients are forces, and so negative; those of VRX are resistances.
    """
    added = (
        found.mass[0, 0] - rigid["mass"],
        found.mass[1, 1] - rigid["mass"],
        found.mass[2, 2] - rigid["inertia"],
    )
    entries = {
        name: float(value) for name, value in zip(("xDotU", "yDotV", "nDotR"), added, strict=True)
    }
    for i, axis in enumerate("xyn"):
        for j, speed in enumerate("UVR"):
            if found.linear[i, j] or found.quadratic[i, j]:
                entries[f"{axis}{speed}"] = float(found.linear[i, j])
                entries[f"{axis}{speed}abs{speed}"] = float(found.quadratic[i, j])
    general = "\n".join(f"  <{key}>{-value!r}</{key}>" for key, value in entries.items())
    doubled = {f"{a}{s}abs{s}": f"{a}{s}{s}" for a, s in ("xU", "yV", "nR")}
    own = ("xDotU", "yDotV", "nDotR", "xU", "yV", "nR", *doubled)
    simple = "\n".join(
        f"  <{doubled.get(key, key)}>{entries.get(key, 0.0)!r}</{doubled.get(key, key)}>"
        for key in own
    )
    return (
        f"<!-- {name}: rigid body mass {rigid['mass']!r} kg, inertia about z {rigid['inertia']!r}"
        " kg m^2 in the link's inertial -->\n"
        '<plugin filename="gz-sim-hydrodynamics-system" name="gz::sim::systems::Hydrodynamics">\n'
        f"  <link_name>base_link</link_name>\n{general}\n</plugin>\n"
        "<!-- the same for VRX, which has no damping across sway and yaw -->\n"
        '<plugin filename="libSimpleHydrodynamics.so" name="vrx::SimpleHydrodynamics">\n'
        f"  <link_name>base_link</link_name>\n{simple}\n</plugin>\n"
    )
