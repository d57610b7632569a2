"""The format `parameters`: a baseline as M nu_dot + C(nu) nu + D nu + D_n |nu| nu = tau.

It is written as JSON and for Gazebo, VRX, MSS and PythonVehicleSimulator. C is Fossen's
skew-symmetric form of M (Fossen 2011, section 6.3). Terms of the baseline beyond this form are
projected onto the damping over the training range, and the unexplained share is stated.

Accelerations determine masses only if the inputs are forces. For a model of propeller and rudder
commands, the ratios of forces to masses are identifiable: the coefficients of the accelerations
are written, and the masses and forces that they do not determine are listed.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, final

import numpy as np
import numpy.typing as npt
import torch

from residnet.baselines.given import FixedBaseline
from residnet.baselines.regressors import RegressorBaseline
from residnet.core.config_yaml import parse_yaml
from residnet.core.errors import UsageError
from residnet.core.names import ACCELERATION_NAMES, FORCE_CHANNELS, VELOCITY_NAMES
from residnet.core.progress import log_message
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.store import ModelSpec
from residnet.export.base import Exportable, Exporter, render_template
from residnet.export.c import to_c_identifier
from residnet.export.vessel import ExportedVessel

Matrix = npt.NDArray[np.float64]
_N_SAMPLES = 4000
"""Number of random velocities for the fit of the damping, with at most four coefficients per axis.
"""
# damping of surge depends on u, damping of sway and yaw on v and r
_DAMPING_VELOCITIES = ((0,), (1, 2), (1, 2))


@dataclass(frozen=True)
class VesselCoefficients:
    """A vessel in three degrees of freedom, SI.

    Attributes:
        mass: M [3, 3], rigid body and added mass together.
        linear: D [3, 3].
        quadratic: D_n [3, 3], coefficients of |nu| nu.
        unrepresented_share: root mean square force of the baseline that these matrices do not
            represent, relative to the root mean square force, by axis.
        unrepresented_terms: terms of the baseline that are not of this form, by axis.
    """

    mass: Matrix
    linear: Matrix
    quadratic: Matrix
    unrepresented_share: dict[str, float]
    unrepresented_terms: dict[str, list[str]]


def compute_coriolis_force(mass: Matrix, nu: Matrix) -> Matrix:
    """Return C(nu) nu [N, 3] for velocities nu [N, 3]."""
    u, v, r = nu.T
    sway_momentum = mass[1, 1] * v + 0.5 * (mass[1, 2] + mass[2, 1]) * r
    surge_momentum = mass[0, 0] * u
    return np.stack(
        (-sway_momentum * r, surge_momentum * r, sway_momentum * u - surge_momentum * v), axis=-1
    )


def has_terms(spec: ModelSpec) -> bool:
    """Return whether the baseline of a model is a sum of terms of velocities and inputs."""
    return spec.baseline.kind in _KINDS_WITH_TERMS


def tabulate_accelerations(
    theta: Matrix, terms: Sequence[str], axis_names: Sequence[str]
) -> dict[str, dict[str, float]]:
    """Return the nonzero coefficients of the accelerations by axis and term.

    Args:
        theta: coefficients [n, J] of nu_dot = theta phi.
        terms: names of the J terms phi.
        axis_names: names of the n accelerations.
    """
    return {
        axis: {term: float(value) for term, value in zip(terms, row, strict=True) if value != 0.0}
        for axis, row in zip(axis_names, theta, strict=True)
    }


def list_unidentifiable(
    theta: Matrix, terms: Sequence[str], axis_names: Sequence[str]
) -> list[str]:
    """Return the parameters that the accelerations do not determine, one sentence each.

    The coefficients of tau_x, tau_y and tau_n are the inverse of the mass matrix.

    Args:
        theta: coefficients [n, J] of nu_dot = theta phi.
        terms: names of the J terms phi.
        axis_names: names of the n accelerations.
    """
    if tuple(axis_names) != ACCELERATION_NAMES:
        return [f"M, D and D_n: the model has the accelerations {', '.join(axis_names)} alone"]
    missing_forces = [name for name in FORCE_CHANNELS if name not in terms]
    if not missing_forces:
        force_columns = [terms.index(name) for name in FORCE_CHANNELS]
        if np.linalg.matrix_rank(theta[:, force_columns]) == 3:
            return []
        return ["M, D and D_n: the coefficients of tau_x, tau_y and tau_n are linearly dependent"]
    names = ", ".join(missing_forces)
    missing = f"{names} {'is' if len(missing_forces) == 1 else 'are'} no input of the model"
    return [
        f"M, D and D_n: {missing}, and accelerations determine masses only if forces are known",
        "forces of propellers, rudders and damping: each coefficient is a force divided by masses",
    ]


def identify_coefficients(spec: ModelSpec, model: HybridDynamics) -> VesselCoefficients:
    """Return the coefficients of a model's baseline, whose terms include three forces.

    Raises:
        UsageError: if the baseline is not a sum of terms of velocities and forces.
    """
    theta, terms, _ = _baseline_terms(spec, model)
    force_coefficients = theta[:, [terms.index(name) for name in FORCE_CHANNELS]]
    # nu_dot = M^-1 (tau - ...): the coefficients of the forces are the inverse of the mass matrix
    mass: Matrix = np.linalg.inv(force_coefficients).astype(np.float64)
    lower = np.array(spec.low[:3])
    upper = np.array(spec.high[:3])
    nu = np.random.default_rng(0).uniform(lower, upper, (_N_SAMPLES, 3))
    z = np.zeros((_N_SAMPLES, len(model.signals.names)))
    z[:, :3] = nu
    with torch.no_grad():
        acceleration = model.baseline(torch.from_numpy(z)).numpy()
    force = acceleration @ mass.T
    damping_force = force + compute_coriolis_force(mass, nu)
    linear = np.zeros((3, 3))
    quadratic = np.zeros((3, 3))
    residual_share = {}
    for i, axis in enumerate(VELOCITY_NAMES):
        damping_columns = _DAMPING_VELOCITIES[i]
        basis = np.concatenate(
            (nu[:, damping_columns], np.abs(nu[:, damping_columns]) * nu[:, damping_columns]),
            axis=1,
        )
        damping_coefficients = -np.linalg.lstsq(basis, damping_force[:, i], rcond=None)[0]
        linear[i, damping_columns], quadratic[i, damping_columns] = (
            damping_coefficients[: len(damping_columns)],
            damping_coefficients[len(damping_columns) :],
        )
        residual_force = damping_force[:, i] + basis @ damping_coefficients
        residual_share[axis] = float(
            np.sqrt(np.mean(residual_force**2) / max(np.mean(force[:, i] ** 2), 1e-30))
        )
    return VesselCoefficients(
        mass, linear, quadratic, residual_share, _find_unrepresented_terms(theta, terms)
    )


def _baseline_terms(
    spec: ModelSpec, model: HybridDynamics
) -> tuple[Matrix, list[str], tuple[str, ...]]:
    """Return the coefficients [n, J] of the accelerations, their terms and their names."""
    baseline = model.baseline
    if isinstance(baseline, RegressorBaseline):
        theta = (baseline.theta * baseline.term_mask).detach().double().numpy()
        return theta, list(baseline.library.terms), tuple(baseline.output_names)
    if isinstance(baseline, FixedBaseline) and baseline.library.n_terms:
        terms = list(baseline.library.terms)
        return baseline.theta.double().numpy(), terms, ACCELERATION_NAMES
    raise UsageError(
        f"model {spec.name}: its baseline '{spec.baseline.kind}' is no sum of terms of velocities"
        " and forces; choose a model with a baseline of kind regressors or believed (--model)"
    )


def _find_unrepresented_terms(theta: Matrix, terms: list[str]) -> dict[str, list[str]]:
    """Return the terms of each axis that are neither damping, Coriolis force nor actuator force."""
    damping_terms = {f"{name}" for name in VELOCITY_NAMES} | {
        f"{name}|{name}|" for name in VELOCITY_NAMES
    }
    represented_terms = (
        damping_terms | set(FORCE_CHANNELS) | {"v r", "r v", "u r", "r u", "u v", "v u", "r^2"}
    )
    return {
        ACCELERATION_NAMES[i]: [
            term
            for j, term in enumerate(terms)
            if theta[i, j] != 0 and term not in represented_terms
        ]
        for i in range(3)
    }


_PLANAR_INDICES = (0, 1, 5)
"""Indices of surge, sway and yaw in six degrees of freedom."""
_VRX_NAMES = ("xDotU", "yDotV", "nDotR", "xU", "yV", "nR")
"""Names of coefficients that VRX and Gazebo share, with different definitions."""


def render_simulator_files(
    name: str, vessel_coefficients: VesselCoefficients, rigid_body: Mapping[str, float]
) -> dict[str, str]:
    """Return the text of each simulator's file by the suffix of its name.

    The SDF file has rigid-body masses and coefficients for the plugins of Gazebo, which are forces
    and therefore negative, and of VRX, which are resistances. The other files are a MATLAB function
    with six-by-six matrices as in MSS, and a vehicle of PythonVehicleSimulator.
    """
    matrices = {
        "M": vessel_coefficients.mass,
        "D": vessel_coefficients.linear,
        "Dn": vessel_coefficients.quadratic,
    }
    matrices_6x6 = {letter: np.zeros((6, 6)) for letter in matrices}
    for letter, matrix in matrices.items():
        matrices_6x6[letter][np.ix_(_PLANAR_INDICES, _PLANAR_INDICES)] = matrix
    rigid_body_mass = (rigid_body["mass"], rigid_body["mass"], rigid_body["inertia"])
    added_mass = (vessel_coefficients.mass.diagonal() - rigid_body_mass).tolist()
    sdf_coefficients = dict(zip(_VRX_NAMES, added_mass, strict=False))
    for i, axis in enumerate("xyn"):
        for j, velocity_letter in enumerate("UVR"):
            if vessel_coefficients.linear[i, j] or vessel_coefficients.quadratic[i, j]:
                sdf_coefficients[f"{axis}{velocity_letter}"] = float(
                    vessel_coefficients.linear[i, j]
                )
                sdf_coefficients[f"{axis}{velocity_letter}abs{velocity_letter}"] = float(
                    vessel_coefficients.quadratic[i, j]
                )
    # VRX writes quadratic damping as xUU, Gazebo as xUabsU
    vrx_names = {key: key for key in _VRX_NAMES}
    vrx_names |= {f"{key}{key[-1]}": f"{key}abs{key[-1]}" for key in _VRX_NAMES[3:]}
    class_name = "".join(name_part.capitalize() for name_part in name.split("_"))
    matrix_lists = {
        "mass": vessel_coefficients.mass.tolist(),
        "linear": vessel_coefficients.linear.tolist(),
        "quadratic": vessel_coefficients.quadratic.tolist(),
    }
    return {
        ".sdf": render_template(
            "gazebo.sdf", name=name, rigid=rigid_body, entries=sdf_coefficients, simple=vrx_names
        ),
        "_parameters.m": render_template(
            "parameters.m",
            name=name,
            six={key: value.tolist() for key, value in matrices_6x6.items()},
        ),
        "_vehicle.py": render_template("vehicle.py", name=name, title=class_name, **matrix_lists),
    }


_KINDS_WITH_TERMS = ("regressors", "believed")
"""Kinds of baselines that are sums of terms."""
_RIGID_BODY_UNITS = {"mass": "kg", "inertia": "kg m^2 about z"}


@final
class ParametersExporter(Exporter):
    """Hydrodynamic coefficients of a baseline, without the learned part."""

    name: ClassVar[str] = "parameters"
    suffix: ClassVar[str] = ".parameters.json"
    about: ClassVar[str] = (
        "A baseline's masses and damping for Gazebo, VRX, MSS and PythonVehicleSimulator."
    )

    def supports(self, spec: ModelSpec) -> bool:
        return has_terms(spec)

    def export(self, exported: Exportable, file: Path) -> Mapping[str, Any]:
        """Write the coefficients as JSON and one file for each simulator.

        Simulators need masses: their files are written only if the inputs of the model are forces.
        Rigid-body masses cannot be identified from accelerations; they are read from a file of the
        same name with the suffix `.masses.yaml`.
        """
        if not isinstance(exported, ExportedVessel):
            raise UsageError(f"{exported.label}: only vessel models have masses and damping")
        exported.require_finite_numbers()
        spec = exported.spec
        model = exported.to_precision(torch.float64)
        theta, terms, axis_names = _baseline_terms(spec, model)
        # accelerations of velocities that the logs lack are no part of the model
        modelled_axes = [f"{velocity}_dot" for velocity in spec.signals.velocities]
        rows = [row for row, axis in enumerate(axis_names) if axis in modelled_axes]
        theta = theta[rows]
        axis_names = tuple(axis_names[row] for row in rows)
        unidentifiable = list_unidentifiable(theta, terms, axis_names)
        accelerations = tabulate_accelerations(theta, terms, axis_names)
        head_left_out = None if spec.head is None else spec.head.kind
        if unidentifiable:
            card = {
                "schema": "residnet.parameters/1",
                "model": spec.name,
                "form": "acceleration = sum of coefficient times term; terms in SI units and rad,"
                " accelerations in m/s^2 and rad/s^2",
                "accelerations": accelerations,
                "training_range": {
                    channel: [low, high]
                    # velocities and inputs come first; computed channels have no range
                    for channel, low, high in zip(
                        model.signals.names, spec.low, spec.high, strict=False
                    )
                },
                "not_identifiable": unidentifiable,
                "head_left_out": head_left_out,
                **exported.provenance(),
            }
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(json.dumps(card, indent=1) + "\n")
            log_message(f"  model {spec.name}: not identifiable: {'; '.join(unidentifiable)}")
            return card
        vessel_coefficients = identify_coefficients(spec, model)
        name = to_c_identifier(spec.name)
        file_stem = file.name.removesuffix(self.suffix)
        rigid_body = _read_rigid_body(file.with_name(f"{file_stem}.masses.yaml"))
        card = {
            "schema": "residnet.parameters/1",
            "model": spec.name,
            "form": "M nu_dot + C(nu) nu + D nu + D_n |nu| nu = tau; u, v, r; SI",
            "rigid_body": rigid_body,
            "M": vessel_coefficients.mass.tolist(),
            "D": vessel_coefficients.linear.tolist(),
            "D_n": vessel_coefficients.quadratic.tolist(),
            "share_left_out": vessel_coefficients.unrepresented_share,
            "terms_left_out": vessel_coefficients.unrepresented_terms,
            "accelerations": accelerations,
            "not_identifiable": [],
            "head_left_out": head_left_out,
            **exported.provenance(),
        }
        file.parent.mkdir(parents=True, exist_ok=True)
        for file_ending, text in render_simulator_files(
            name, vessel_coefficients, rigid_body
        ).items():
            file.with_name(
                f"{file_stem if file_ending == '.sdf' else name}{file_ending}"
            ).write_text(text)
        file.write_text(json.dumps(card, indent=1) + "\n")
        return card


def _read_rigid_body(file: Path) -> dict[str, float]:
    """Return the masses of the rigid body.

    Raises:
        UsageError: if the file is missing or has other contents.
    """
    required_keys = ", ".join(f"{name} ({unit})" for name, unit in _RIGID_BODY_UNITS.items())
    instruction = (
        f"{file}: write there {required_keys} of the loaded vessel, for example 'mass: 180'"
    )
    if not file.is_file():
        raise UsageError(
            f"{instruction}; accelerations do not tell how much of a mass is added mass"
        )
    content, _ = parse_yaml(file.read_text(), str(file))
    content = content if isinstance(content, dict) else {}
    masses: dict[str, float] = {}
    for name in _RIGID_BODY_UNITS:
        value = content.get(name)
        if not isinstance(value, int | float) or not 0 < value < math.inf:
            raise UsageError(f"{instruction}; {name} is missing or no positive number")
        masses[name] = float(value)
    return masses
