"""Writes a baseline's coefficients in the forms of Gazebo, VRX, MSS and PythonVehicleSimulator."""

from __future__ import annotations

import copy
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, final

from residnet.core.config_yaml import parse
from residnet.core.errors import UsageError
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.store import ModelSpec
from residnet.export.base import Exporter
from residnet.export.c.source import identifier
from residnet.export.contract import require_numbers
from residnet.export.parameters.coefficients import coefficients
from residnet.export.parameters.forms import gazebo, mss, vehicle_python

_RIGID = {"mass": "kg", "inertia": "kg m^2 about z"}


@final
class ParametersExporter(Exporter):
    """Hydrodynamic coefficients of a baseline, without the learned part."""

    name: ClassVar[str] = "parameters"
    suffix: ClassVar[str] = ".parameters.json"
    about: ClassVar[str] = (
        "A baseline's masses and damping for Gazebo, VRX, MSS and PythonVehicleSimulator."
    )

    def export(
        self,
        spec: ModelSpec,
        model: HybridDynamics,
        file: Path,
        rows: Sequence[Mapping[str, Any]],
    ) -> Mapping[str, Any]:
        """Write the coefficients as JSON, and beside it one file for each simulator.

        The masses of the rigid body, which no acceleration tells, are read from a file of the same
        name that ends in `.masses.yaml`.
        """
        require_numbers(spec, model)
        found = coefficients(spec, copy.deepcopy(model).double().eval())
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
        }
        texts = {
            f"{stem}.sdf": gazebo(name, found, rigid),
            f"{name}_parameters.m": mss(name, found),
            f"{name}_vehicle.py": vehicle_python(name, found),
            file.name: json.dumps(card, indent=1) + "\n",
        }
        file.parent.mkdir(parents=True, exist_ok=True)
        for part, text in texts.items():
            file.with_name(part).write_text(text)
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
    found = {name: content.get(name) for name in _RIGID} if isinstance(content, dict) else {}
    wrong = [
        name
        for name in _RIGID
        if not isinstance(found.get(name), int | float) or not 0 < float(found[name]) < math.inf  # type: ignore[arg-type]
    ]
    if wrong:
        raise UsageError(f"{ask}; {wrong[0]} is missing or no positive number")
    return {name: float(value) for name, value in found.items() if value is not None}
