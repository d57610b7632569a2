"""The format `parameters`: a baseline as M nu_dot + C(nu) nu + D nu + D_n |nu| nu = tau.

It is written as JSON and in the forms of Gazebo, VRX, MSS and PythonVehicleSimulator. C is Fossen's
skew form of M (Fossen 2011, section 6.3). What the baseline has beyond that form is projected onto
the damping over the training range, and the share that remains is stated.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, final

import numpy as np
import numpy.typing as npt
import torch

from residnet.baselines.given import GivenBaseline
from residnet.baselines.regressors import RegressorBaseline
from residnet.core.config_yaml import parse
from residnet.core.errors import UsageError
from residnet.core.names import ACCELERATION, VELOCITY
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.store import ModelSpec
from residnet.export.base import Exported, Exporter, filled
from residnet.export.c import identifier
from residnet.export.vessel import ExportedVessel
from residnet.physics.signals import FORCE_CHANNELS

Matrix = npt.NDArray[np.float64]
_SAMPLES = 4000
"""Velocities that damping is fitted to; chosen by hand, for at most four coefficients an axis."""
# surge is damped by itself, sway and yaw by both
_DAMPED_BY = ((0,), (1, 2), (1, 2))


@dataclass(frozen=True)
class Coefficients:
    """A vessel in three degrees of freedom, SI.

    Attributes:
        mass: M [3, 3], rigid body and added mass together.
        linear: D [3, 3].
        quadratic: D_n [3, 3], of |nu| nu.
        left_out: share of the baseline's force that the form cannot hold, by axis.
        terms_left_out: terms of the baseline that the form has no place for, by axis.
    """

    mass: Matrix
    linear: Matrix
    quadratic: Matrix
    left_out: dict[str, float]
    terms_left_out: dict[str, list[str]]


def coriolis(mass: Matrix, nu: Matrix) -> Matrix:
    """Return C(nu) nu [N, 3] for velocities nu [N, 3]."""
    u, v, r = nu.T
    a = mass[1, 1] * v + 0.5 * (mass[1, 2] + mass[2, 1]) * r
    b = mass[0, 0] * u
    return np.stack((-a * r, b * r, a * u - b * v), axis=-1)


def coefficients(spec: ModelSpec, model: HybridDynamics) -> Coefficients:
    """Return the coefficients of a model's baseline.

    Raises:
        UsageError: where the baseline is no sum of terms of velocities and forces.
    """
    theta, terms = _linear(spec, model)
    forces = [terms.index(name) if name in terms else -1 for name in FORCE_CHANNELS]
    by_force = theta[:, forces] if min(forces) >= 0 else np.zeros((3, 3))
    if np.linalg.matrix_rank(by_force) < 3:
        missing = [name for name, at in zip(FORCE_CHANNELS, forces, strict=True) if at < 0]
        raise UsageError(
            f"model {spec.name}: its accelerations do not tell all masses"
            f" ({', '.join(missing) or 'the forces act alike'} is not among the baseline's terms);"
            " fit a baseline of kind believed, or one of regressors with tau_x, tau_y and tau_n"
        )
    mass: Matrix = np.linalg.inv(by_force).astype(np.float64)
    low, high = np.array(spec.low[:3]), np.array(spec.high[:3])
    nu = np.random.default_rng(0).uniform(low, high, (_SAMPLES, 3))
    z = np.zeros((_SAMPLES, len(model.signals.names)))
    z[:, :3] = nu
    with torch.no_grad():
        known = model.baseline(torch.from_numpy(z)).numpy()
    force = known @ mass.T
    rest = force + coriolis(mass, nu)
    linear, quadratic, left = np.zeros((3, 3)), np.zeros((3, 3)), {}
    for i, axis in enumerate(VELOCITY):
        by = _DAMPED_BY[i]
        basis = np.concatenate((nu[:, by], np.abs(nu[:, by]) * nu[:, by]), axis=1)
        found = -np.linalg.lstsq(basis, rest[:, i], rcond=None)[0]
        linear[i, by], quadratic[i, by] = found[: len(by)], found[len(by) :]
        remains = rest[:, i] + basis @ found
        left[axis] = float(np.sqrt(np.mean(remains**2) / max(np.mean(force[:, i] ** 2), 1e-30)))
    return Coefficients(mass, linear, quadratic, left, _unplaced(theta, terms))


def _linear(spec: ModelSpec, model: HybridDynamics) -> tuple[Matrix, list[str]]:
    """Return the coefficients [3, J] of the accelerations and the terms that they belong to."""
    baseline = model.baseline
    if isinstance(baseline, RegressorBaseline):
        theta = (baseline.theta * baseline.allowed).detach().double().numpy()
        return theta, list(baseline.library.terms)
    if isinstance(baseline, GivenBaseline) and baseline.library.count:
        return baseline.theta.double().numpy(), list(baseline.library.terms)
    raise UsageError(
        f"model {spec.name}: its baseline '{spec.baseline.kind}' is no sum of terms of velocities"
        " and forces; the parameters of a baseline of kind regressors or believed can be exported"
    )


def _unplaced(theta: Matrix, terms: list[str]) -> dict[str, list[str]]:
    """Return the terms of each axis that are neither damping, Coriolis force nor a force."""
    own = {f"{name}" for name in VELOCITY} | {f"{name}|{name}|" for name in VELOCITY}
    placed = own | set(FORCE_CHANNELS) | {"v r", "r v", "u r", "r u", "u v", "v u", "r^2"}
    return {
        ACCELERATION[i]: [
            term for j, term in enumerate(terms) if theta[i, j] != 0 and term not in placed
        ]
        for i in range(3)
    }


_PLACES = (0, 1, 5)
"""Of surge, sway and yaw among six degrees of freedom."""
_SIMPLE = ("xDotU", "yDotV", "nDotR", "xU", "yV", "nR")
"""What VRX knows under the names that Gazebo has for it."""


def texts(name: str, found: Coefficients, rigid: Mapping[str, float]) -> dict[str, str]:
    """Return what the simulators read by the ends of file names.

    The plugins of Gazebo and VRX as SDF, with the masses of the rigid body: Gazebo's coefficients
    are forces, and so negative; those of VRX are resistances. A MATLAB function with the six-by-six
    matrices that MSS' vessels have. A vehicle of PythonVehicleSimulator.
    """
    matrices = {"M": found.mass, "D": found.linear, "Dn": found.quadratic}
    six = {letter: np.zeros((6, 6)) for letter in matrices}
    for letter, matrix in matrices.items():
        six[letter][np.ix_(_PLACES, _PLACES)] = matrix
    own = (rigid["mass"], rigid["mass"], rigid["inertia"])
    added = (found.mass.diagonal() - own).tolist()
    entries = dict(zip(_SIMPLE, added, strict=False))
    for i, axis in enumerate("xyn"):
        for j, speed in enumerate("UVR"):
            if found.linear[i, j] or found.quadratic[i, j]:
                entries[f"{axis}{speed}"] = float(found.linear[i, j])
                entries[f"{axis}{speed}abs{speed}"] = float(found.quadratic[i, j])
    simple = {key: key for key in _SIMPLE}
    simple |= {f"{key}{key[-1]}": f"{key}abs{key[-1]}" for key in _SIMPLE[3:]}
    title = "".join(part.capitalize() for part in name.split("_"))
    lists = {
        "mass": found.mass.tolist(),
        "linear": found.linear.tolist(),
        "quadratic": found.quadratic.tolist(),
    }
    return {
        ".sdf": filled("gazebo.sdf", name=name, rigid=rigid, entries=entries, simple=simple),
        "_parameters.m": filled(
            "parameters.m", name=name, six={key: value.tolist() for key, value in six.items()}
        ),
        "_vehicle.py": filled("vehicle.py", name=name, title=title, **lists),
    }


_RIGID = {"mass": "kg", "inertia": "kg m^2 about z"}


@final
class ParametersExporter(Exporter):
    """Hydrodynamic coefficients of a baseline, without the learned part."""

    name: ClassVar[str] = "parameters"
    suffix: ClassVar[str] = ".parameters.json"
    about: ClassVar[str] = (
        "A baseline's masses and damping for Gazebo, VRX, MSS and PythonVehicleSimulator."
    )

    def export(self, exported: Exported, file: Path) -> Mapping[str, Any]:
        """Write the coefficients as JSON, and beside it one file for each simulator.

        The masses of the rigid body, which no acceleration tells, are read from a file of the same
        name that ends in `.masses.yaml`.
        """
        if not isinstance(exported, ExportedVessel):
            raise UsageError(f"{exported.what}: only vessel models have masses and damping")
        exported.require_numbers()
        spec = exported.spec
        found = coefficients(spec, exported.at(torch.float64))
        name = identifier(spec.name)
        stem = file.name.removesuffix(self.suffix)
        rigid = _rigid(file.with_name(f"{stem}.masses.yaml"))
        card = {
            "schema": "residnet.parameters/1",
            "model": spec.name,
            "form": "M nu_dot + C(nu) nu + D nu + D_n |nu| nu = tau; u, v, r; SI",
            "rigid_body": rigid,
            "M": found.mass.tolist(),
            "D": found.linear.tolist(),
            "D_n": found.quadratic.tolist(),
            "share_left_out": found.left_out,
            "terms_left_out": found.terms_left_out,
            "head_left_out": None if spec.head is None else spec.head.kind,
            **exported.provenance(),
        }
        file.parent.mkdir(parents=True, exist_ok=True)
        for end, text in texts(name, found, rigid).items():
            file.with_name(f"{stem if end == '.sdf' else name}{end}").write_text(text)
        file.write_text(json.dumps(card, indent=1) + "\n")
        return card


def _rigid(file: Path) -> dict[str, float]:
    """Return the masses of the rigid body.

    Raises:
        UsageError: where the file is missing or holds something else.
    """
    wanted = ", ".join(f"{name} ({unit})" for name, unit in _RIGID.items())
    ask = f"{file}: write there {wanted} of the loaded vessel, for example 'mass: 180'"
    if not file.is_file():
        raise UsageError(f"{ask}; accelerations do not tell how much of a mass is added mass")
    content, _ = parse(file.read_text(), str(file))
    content = content if isinstance(content, dict) else {}
    found: dict[str, float] = {}
    for name in _RIGID:
        value = content.get(name)
        if not isinstance(value, int | float) or not 0 < value < math.inf:
            raise UsageError(f"{ask}; {name} is missing or no positive number")
        found[name] = float(value)
    return found
