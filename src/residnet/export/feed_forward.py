"""Export of a force-space model as a controller's feed-forward tau = F(nu_dot, nu).

Source: Jervan 2020, eq. (3.24).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, final

import numpy as np
import torch
from torch import Tensor, nn

from residnet.core.errors import ExportError, UsageError
from residnet.core.layout import PLANAR_LAYOUT, RANGE_VELOCITIES
from residnet.core.names import FORCE_CHANNELS
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.store import ModelSpec
from residnet.export.base import Exportable, Exporter, LoadedExport, require_releasable
from residnet.export.guard import GuardRanges, accepted_margin
from residnet.export.torchscript import (
    TorchScriptExporter,
    get_size,
    require_shape,
    trace_function,
)
from residnet.export.vessel import ExportedVessel
from residnet.heads.force import ForceHead
from residnet.physics.force_terms import MOTION_CHANNELS

FADE_SHARE = 0.25
"""Share of the width of a training range, beyond its edge, over which a correction fades out."""
MAX_FORCE_RATIO = 1.2
"""Largest force of an axis outside the training range, relative to that of the believed model."""
_TOLERANCE = 1e-9
"""Largest difference of an exported file, relative to the range of each force."""
_EDGE_SHARE = 0.05
"""Share of the width of a training range, within its edge, over which this limit is blended in."""


@final
class BelievedForce(nn.Module):
    """The force [B, 3] of a motion according to the baseline: M (nu_dot - nu_dot_0), SI.

    nu_dot_0 is the acceleration of the baseline without actuator forces.
    """

    def __init__(self, baseline: nn.Module, mass: Tensor) -> None:
        super().__init__()
        self.baseline = baseline
        self.mass = nn.Buffer(mass.clone())

    def forward(self, nu_dot: Tensor, nu: Tensor) -> Tensor:
        """Return the force [B, 3] at nu_dot [B, 3] and nu [B, 3]."""
        baseline: Tensor = self.baseline(torch.cat((nu, torch.zeros_like(nu)), dim=-1))
        return (nu_dot - baseline) @ self.mass.to(nu.dtype).T


@final
class ResidualForce(nn.Module):
    """The residual force [B, 3] of a head in force space, SI."""

    def __init__(self, head: ForceHead) -> None:
        super().__init__()
        self.head = head

    def forward(self, nu_dot: Tensor, nu: Tensor) -> Tensor:
        """Return the force [B, 3] at nu_dot [B, 3] and nu [B, 3]."""
        return self.head.residual_force(nu_dot, torch.cat((nu, torch.zeros_like(nu)), dim=-1))


@final
class RequiredForce(nn.Module):
    """The force tau [B, 3] = F(nu_dot [B, 3], nu [B, 3]) of a believed model and its correction.

    A vessel is symmetric, but a correction that was fitted to a log is not exactly. With
    `is_mirrored` it is averaged with its mirror image, so that a straight course needs neither sway
    force nor yaw moment.
    """

    def __init__(self, believed: nn.Module, correction: nn.Module, *, is_mirrored: bool) -> None:
        super().__init__()
        self.believed = believed
        self.correction = correction
        self.is_mirrored = is_mirrored
        self.mirror_sign = nn.Buffer(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))

    def forward(self, nu_dot: Tensor, nu: Tensor) -> Tensor:
        """Return the force [B, 3] at nu_dot [B, 3] and nu [B, 3]."""
        believed_force, correction_force = self.split_forces(nu_dot, nu)
        return believed_force + correction_force

    def split_forces(self, nu_dot: Tensor, nu: Tensor) -> tuple[Tensor, Tensor]:
        """Return the believed force and the correction, [B, 3] each."""
        believed_force: Tensor = self.believed(nu_dot, nu)
        correction_force: Tensor = self.correction(nu_dot, nu)
        if self.is_mirrored:
            mirrored_correction: Tensor = self.correction(
                nu_dot * self.mirror_sign, nu * self.mirror_sign
            )
            correction_force = 0.5 * (correction_force + mirrored_correction * self.mirror_sign)
        return believed_force, correction_force


@final
class GuardedForce(nn.Module):
    """A feed-forward whose correction is limited to its training range, with a flag.

    Outside the training range the correction fades out over a quarter of the range width, and the
    force of each axis is limited to 1.2 times that of the believed model. This limit is blended in
    over the outermost twentieth of the range, so that the force is continuous. The result is finite
    for every input: NaN is replaced by the middle of the training range, and values beyond the
    accepted range by its nearest limit (see `residnet.export.guard`). The limit of 1.2 times the
    believed force also applies to such motions if their believed force is finite.

    Args:
        model: the believed force and its correction.
        ranges: training ranges of nu_dot and nu (six rows).
    """

    def __init__(self, model: RequiredForce, ranges: Sequence[tuple[float, float]]) -> None:
        super().__init__()
        self.model = model
        lower, upper = torch.tensor(ranges, dtype=torch.float64).T
        margin = torch.tensor([accepted_margin(*limits) for limits in ranges], dtype=torch.float64)
        self.ranges = GuardRanges(lower, upper, margin, torch.float64)
        self.range_width = nn.Buffer((upper - lower).clamp(min=1e-9))
        self.n_dof = PLANAR_LAYOUT.n_dof
        self.fade_width = FADE_SHARE
        self.edge_width = _EDGE_SHARE
        self.max_force_ratio = MAX_FORCE_RATIO

    def forward(self, nu_dot: Tensor, nu: Tensor) -> tuple[Tensor, Tensor]:
        """Return the force tau [B, 3] in N, N, N m and `outside` [B].

        `outside` is True for a motion beyond the training range or with NaN.
        """
        motion = torch.cat((nu_dot, nu), dim=-1).to(torch.float64)
        lower = self.ranges.lower
        upper = self.ranges.upper
        replaced_motion = self.ranges.replace_unaccepted(motion)
        believed_force, correction_force = self.model.split_forces(
            replaced_motion[:, : self.n_dof], replaced_motion[:, self.n_dof :]
        )
        # distance from the nearest edge of the range, in widths, of the worst channel; negative
        # outside
        depth = torch.minimum(
            (motion - lower) / self.range_width, (upper - motion) / self.range_width
        )
        depth = torch.nan_to_num(depth, nan=-1.0).amin(dim=-1, keepdim=True)
        force = believed_force + (1.0 + depth / self.fade_width).clamp(0.0, 1.0) * correction_force
        unlimited_share = (depth / self.edge_width).clamp(0.0, 1.0)
        # the force of the original motion may be smaller than that of the replaced one
        force_of_motion: Tensor = self.model.believed(
            motion[:, : self.n_dof], motion[:, self.n_dof :]
        )
        infinite = float("inf")
        min_believed = torch.nan_to_num(force_of_motion.abs(), nan=infinite, posinf=infinite)
        force_limit = self.max_force_ratio * torch.minimum(believed_force.abs(), min_believed)
        force_limit = force_limit + unlimited_share * (
            believed_force.abs() + correction_force.abs()
        )
        force = torch.minimum(torch.maximum(force, -force_limit), force_limit)
        return force, ~self.ranges.is_in_training_range(motion)


@final
class TracedForce(nn.Module):
    """The TorchScript file of a feed-forward; see `GuardedForce`.

    Tensors of a wrong shape are refused, never broadcast. TorchScript compiles this class; the
    feed-forward itself is traced.
    """

    def __init__(self, force: GuardedForce) -> None:
        super().__init__()
        self.dof = force.n_dof
        examples = (torch.zeros(2, self.dof).double(), torch.zeros(2, self.dof).double())
        self.force = trace_function(force, examples, "feed-forward")

    def forward(self, nu_dot: Tensor, nu: Tensor) -> tuple[Tensor, Tensor]:
        """Return the force tau [B, 3] in N, N, N m and `outside` [B]."""
        rows = get_size(nu, 2, 0)
        require_shape("nu_dot", nu_dot, [rows, self.dof])
        require_shape("nu", nu, [rows, self.dof])
        result: tuple[Tensor, Tensor] = self.force(nu_dot.double(), nu.double())
        return result


def build_feed_forward(
    spec: ModelSpec, model: HybridDynamics
) -> tuple[RequiredForce, list[tuple[float, float]]]:
    """Return the feed-forward of a model, with the ranges of nu_dot and nu that it was fitted on.

    Raises:
        UsageError: if the model is not in force space, or its inputs are not the forces.
    """
    head = model.head
    if not isinstance(head, ForceHead):
        raise UsageError(
            f"model {spec.name}: no residual in force space, so no feed-forward; fit a head of kind"
            " plsr or ridge with space: force"
        )
    if spec.signals.input_columns != FORCE_CHANNELS:
        raise UsageError(
            f"model {spec.name}: a feed-forward needs the inputs {', '.join(FORCE_CHANNELS)}, in"
            " this order, and no others"
        )
    model = model.to(torch.float64)
    believed = BelievedForce(model.baseline, head.mass)
    required = RequiredForce(believed, ResidualForce(head), is_mirrored=True)
    motion_ranges = list(
        zip(
            (*head.lower_velocities.tolist(), *spec.low[RANGE_VELOCITIES]),
            (*head.upper_velocities.tolist(), *spec.high[RANGE_VELOCITIES]),
            strict=True,
        )
    )
    return required.eval().requires_grad_(False), motion_ranges


@final
class ExportedForce(Exportable):
    """A feed-forward (tau, outside) = F(nu_dot, nu), in double precision.

    Args:
        name: name of the model.
        model: the believed force and its correction.
        ranges: ranges of nu_dot and nu in the identification data (six).
        thruster_lag: lag of the thrusters, for the model card; None if it was not fitted.
    """

    dt = None
    arguments = (("nu_dot", PLANAR_LAYOUT.n_dof), ("nu", PLANAR_LAYOUT.n_dof))
    results = ("tau", "outside")
    flags = ("outside",)
    precisions = (torch.float64,)

    def __init__(
        self,
        name: str,
        model: RequiredForce,
        ranges: Sequence[tuple[float, float]],
        thruster_lag: dict[str, float] | None = None,
    ) -> None:
        self.name = name
        self.label = f"feed-forward of {name}"
        self.force_model = model.eval()
        self.ranges = ranges
        self.thruster_lag = thruster_lag

    def build_module(self, dtype: torch.dtype) -> nn.Module:
        return TracedForce(self.build_step_module(dtype)).eval()

    def build_step_module(self, dtype: torch.dtype) -> GuardedForce:
        return GuardedForce(self.force_model, self.ranges).eval()

    def check_parity(
        self, loaded: LoadedExport, subject: str, dtype: torch.dtype, tolerance: float | None = None
    ) -> dict[str, Any]:
        """Compare the force at random motions, in and far beyond the training ranges.

        Raises:
            ExportError: if a force or a flag differs.
        """
        lower, upper = torch.tensor(self.ranges, dtype=torch.float64).T
        generator = torch.Generator().manual_seed(0)
        range_share = torch.rand(
            200, 2 * PLANAR_LAYOUT.n_dof, generator=generator, dtype=torch.float64
        )
        # a tenth of the motions is far outside of any training range
        range_share[180:] = 1e6 * (range_share[180:] - 0.5)
        motion = lower + range_share * (upper - lower)
        motion[190:195, 0] = torch.nan
        motion_parts = motion.split(PLANAR_LAYOUT.n_dof, dim=1)
        with torch.no_grad():
            tau, outside = self.build_step_module(dtype)(*motion_parts)
        answers = [
            loaded.step(*(part[k].numpy() for part in motion_parts)) for k in range(len(motion))
        ]
        differences = (torch.from_numpy(np.stack([force for force, _ in answers])) - tau).abs()
        max_difference = float(
            (differences[:180].amax(0) / (tau[:180].amax(0) - tau[:180].amin(0))).max()
        )
        are_flags_equal = [bool(flag) for _, flag in answers] == outside.tolist()
        if not (
            max_difference < _TOLERANCE
            and bool((differences <= _TOLERANCE * (1.0 + tau.abs())).all())
            and are_flags_equal
        ):
            raise ExportError(
                f"{self.label}: {subject} differs from the model by {max_difference:.1e} of its"
                f" range; allowed"
                f" {_TOLERANCE:g}"
            )
        return {"steps": len(motion), "share_of_range": max_difference}

    def card_contents(self) -> dict[str, Any]:
        guard_ranges = GuardedForce(self.force_model, self.ranges).ranges
        accepted = torch.stack(
            (guard_ranges.accepted_lower, guard_ranges.accepted_upper), dim=1
        ).tolist()
        return {
            "schema": "residnet.feed_forward/1",
            "arguments": {
                "nu_dot": ["u_dot m/s^2", "v_dot m/s^2", "r_dot rad/s^2"],
                "nu": ["u m/s", "v m/s", "r rad/s"],
            },
            "returns": ["tau [B, 3]: tau_x N, tau_y N, tau_n N m", "outside [B]"],
            "bad_inputs": (
                "a motion that is no number becomes the middle of its training range, one beyond"
                " `accepted` the nearest value of the training range; `outside` is then true, as"
                " for every motion beyond the training range"
            ),
            "accepted": dict(zip(MOTION_CHANNELS, accepted, strict=True)),
            "outside_the_training_range": (
                f"the correction of the believed model fades out over {FADE_SHARE:g} of the range's"
                f" width; no axis commands more than {MAX_FORCE_RATIO:g} times the believed"
                f" model's force,"
                " beyond `accepted` neither that of the motion nor that of its nearest value"
            ),
            "mirror": (
                "the correction is the mean of itself and its mirror image: a straight course needs"
                " no sway force and no yaw moment beyond the believed model's"
                if self.force_model.is_mirrored
                else "the correction is as it was fitted, not the same to port and starboard"
            ),
            "training_range": {
                name: list(limits)
                for name, limits in zip(MOTION_CHANNELS, self.ranges, strict=True)
            },
            "thruster_lag": self.thruster_lag,
        }


@final
class FeedForwardExporter(Exporter):
    """The force that a motion needs, as TorchScript, of a model in force space."""

    name: ClassVar[str] = "feed_forward"
    suffix: ClassVar[str] = "_feed_forward.pt"
    about: ClassVar[str] = (
        "The force tau = F(nu_dot, nu) that a motion needs, from a model in force space."
    )

    def export(self, exported: Exportable, file: Path) -> Mapping[str, Any]:
        if not isinstance(exported, ExportedVessel):
            raise UsageError(f"{exported.label}: a feed-forward is made of a vessel model alone")
        force, ranges = build_feed_forward(exported.spec, exported.to_precision(torch.float64))
        exported_force = require_releasable(
            ExportedForce(exported.name, force, ranges), exported.objections, allows_objections=True
        )
        exported_force.assessment = exported.assessment
        return TorchScriptExporter().export(exported_force, file)
