"""Export of a force-space model as a controller's feed-forward tau = F(nu_dot, nu).

Source: document 002 eq. (3.24).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, final

import numpy as np
import torch
from torch import Tensor, nn

from residnet.core.errors import ExportError, UsageError
from residnet.core.layout import PLANAR, RANGE_VELOCITIES
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.store import ModelSpec
from residnet.export.base import Exported, Exporter, Loaded, released
from residnet.export.guard import Ranges, widening
from residnet.export.torchscript import (
    TorchScriptExporter,
    require_shape,
    size,
    trace_function,
)
from residnet.export.vessel import ExportedVessel
from residnet.heads.force import ForceHead
from residnet.physics.force_model import MOTION
from residnet.physics.signals import FORCE_CHANNELS

FADE = 0.25
"""Share of the width of a training range, beyond its edge, over which a correction fades out."""
EFFORT = 1.2
"""Most force outside the training range, in forces of the believed model, axis by axis."""
_SAME = 1e-9
"""Largest difference of a file, as a share of each force's range."""
_EDGE = 0.05
"""Share of the width of a training range, within its edge, over which that limit sets in."""


@final
class BelievedForce(nn.Module):
    """The force [B, 3] that a baseline believes a motion needs: M (nu_dot - nu_dot_0), SI.

    nu_dot_0 is its acceleration without forces.
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
        return self.head.force(nu_dot, torch.cat((nu, torch.zeros_like(nu)), dim=-1))


@final
class RequiredForce(nn.Module):
    """The force tau [B, 3] = F(nu_dot [B, 3], nu [B, 3]) of a believed model and its correction.

    A vessel is the same to port and starboard, while a correction that was fitted to a log is not
    quite: with `mirrored` it is the mean of itself and its mirror image, so that a straight course
    needs neither sway force nor yaw moment.
    """

    def __init__(self, believed: nn.Module, correction: nn.Module, *, mirrored: bool) -> None:
        super().__init__()
        self.believed, self.correction, self.mirrored = believed, correction, mirrored
        self.turned = nn.Buffer(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))

    def forward(self, nu_dot: Tensor, nu: Tensor) -> Tensor:
        """Return the force [B, 3] at nu_dot [B, 3] and nu [B, 3]."""
        believed, more = self.parts(nu_dot, nu)
        return believed + more

    def parts(self, nu_dot: Tensor, nu: Tensor) -> tuple[Tensor, Tensor]:
        """Return the believed force and the correction, [B, 3] each."""
        believed: Tensor = self.believed(nu_dot, nu)
        more: Tensor = self.correction(nu_dot, nu)
        if self.mirrored:
            other: Tensor = self.correction(nu_dot * self.turned, nu * self.turned)
            more = 0.5 * (more + other * self.turned)
        return believed, more


@final
class GuardedForce(nn.Module):
    """A feed-forward that knows where its correction was identified, with a flag.

    Outside the training range the correction fades out over a quarter of the range's width, and no
    axis commands more than 1.2 times the believed model's force; that limit sets in over the
    outermost twentieth of the range, so that nothing jumps. The answer is finite whatever it is
    given: motions are treated as `residnet.export.base` says, not a number becomes the middle of
    the training range, what is farther off than the accepted range its nearest value. Such a motion
    commands no more than 1.2 times the believed force of itself either, where that is a number.

    Args:
        model: the believed force and its correction.
        ranges: of nu_dot and nu in the training data, six.
    """

    def __init__(self, model: RequiredForce, ranges: Sequence[tuple[float, float]]) -> None:
        super().__init__()
        self.model = model
        low, high = torch.tensor(ranges, dtype=torch.float64).T
        reach = torch.tensor([widening(*limits) for limits in ranges], dtype=torch.float64)
        self.ranges = Ranges(low, high, reach, torch.float64)
        self.width = nn.Buffer((high - low).clamp(min=1e-9))
        self.dof = PLANAR.dof
        self.fade, self.edge, self.effort = FADE, _EDGE, EFFORT

    def forward(self, nu_dot: Tensor, nu: Tensor) -> tuple[Tensor, Tensor]:
        """Return the force tau [B, 3] in N, N, N m and `outside` [B].

        `outside` is True where a motion is beyond the training range or no number.
        """
        seen = torch.cat((nu_dot, nu), dim=-1).to(torch.float64)
        low, high, used = self.ranges.low, self.ranges.high, self.ranges.replaced(seen)
        believed, more = self.model.parts(used[:, : self.dof], used[:, self.dof :])
        # how deep inside the range in widths, the least of all channels; negative outside
        depth = torch.minimum((seen - low) / self.width, (high - seen) / self.width)
        depth = torch.nan_to_num(depth, nan=-1.0).amin(dim=-1, keepdim=True)
        force = believed + (1.0 + depth / self.fade).clamp(0.0, 1.0) * more
        free = (depth / self.edge).clamp(0.0, 1.0)
        # a motion that was replaced may itself need less than what stands in its place
        itself: Tensor = self.model.believed(seen[:, : self.dof], seen[:, self.dof :])
        unknown = float("inf")
        least = torch.nan_to_num(itself.abs(), nan=unknown, posinf=unknown)
        most = self.effort * torch.minimum(believed.abs(), least)
        most = most + free * (believed.abs() + more.abs())
        force = torch.minimum(torch.maximum(force, -most), most)
        return force, ~self.ranges.inside(seen)


@final
class TracedForce(nn.Module):
    """The TorchScript file of a feed-forward; see `GuardedForce`.

    Tensors of a wrong shape are refused, never broadcast. TorchScript compiles this class; the
    feed-forward itself is traced.
    """

    def __init__(self, force: GuardedForce) -> None:
        super().__init__()
        self.dof = force.dof
        examples = (torch.zeros(2, self.dof).double(), torch.zeros(2, self.dof).double())
        self.force = trace_function(force, examples, "feed-forward")

    def forward(self, nu_dot: Tensor, nu: Tensor) -> tuple[Tensor, Tensor]:
        """Return the force tau [B, 3] in N, N, N m and `outside` [B]."""
        rows = size(nu, 2, 0)
        require_shape("nu_dot", nu_dot, [rows, self.dof])
        require_shape("nu", nu, [rows, self.dof])
        found: tuple[Tensor, Tensor] = self.force(nu_dot.double(), nu.double())
        return found


def required_force(
    spec: ModelSpec, model: HybridDynamics
) -> tuple[RequiredForce, list[tuple[float, float]]]:
    """Return the feed-forward of a model, with the ranges of nu_dot and nu that it was fitted on.

    Raises:
        UsageError: where the model is not in force space, or its inputs are not the forces.
    """
    head = model.head
    if not isinstance(head, ForceHead):
        raise UsageError(
            f"model {spec.name}: no residual in force space, so no feed-forward; fit a head of kind"
            " plsr or ridge with space: force"
        )
    if spec.signals.columns != FORCE_CHANNELS:
        raise UsageError(
            f"model {spec.name}: a feed-forward needs the inputs {', '.join(FORCE_CHANNELS)}, in"
            " this order, and no others"
        )
    model = model.to(torch.float64)
    believed = BelievedForce(model.baseline, head.mass)
    force = RequiredForce(believed, ResidualForce(head), mirrored=True)
    ranges = list(
        zip(
            (*head.lowest.tolist(), *spec.low[RANGE_VELOCITIES]),
            (*head.highest.tolist(), *spec.high[RANGE_VELOCITIES]),
            strict=True,
        )
    )
    return force.eval().requires_grad_(False), ranges


@final
class ExportedForce(Exported):
    """A feed-forward (tau, outside) = F(nu_dot, nu), in double precision.

    Args:
        name: of the model that it comes from.
        model: the believed force and its correction.
        ranges: of nu_dot and nu in the data that identified the correction, six.
        lag: of the thrusters, for the card; None where it was not fitted.
    """

    dt = None
    arguments = (("nu_dot", PLANAR.dof), ("nu", PLANAR.dof))
    results = ("tau", "outside")
    flags = ("outside",)
    precisions = (torch.float64,)

    def __init__(
        self,
        name: str,
        model: RequiredForce,
        ranges: Sequence[tuple[float, float]],
        lag: dict[str, float] | None = None,
    ) -> None:
        self.name, self.what = name, f"feed-forward of {name}"
        self.inner, self.ranges, self.lag = model.eval(), ranges, lag

    def module(self, dtype: torch.dtype) -> nn.Module:
        return TracedForce(self.graph(dtype)).eval()

    def graph(self, dtype: torch.dtype) -> GuardedForce:
        return GuardedForce(self.inner, self.ranges).eval()

    def check(
        self, loaded: Loaded, what: str, dtype: torch.dtype, tolerance: float | None = None
    ) -> dict[str, Any]:
        """Compare the force at random motions, in and far beyond the training ranges.

        Raises:
            ExportError: where it differs, or a flag does.
        """
        low, high = torch.tensor(self.ranges, dtype=torch.float64).T
        random = torch.Generator().manual_seed(0)
        share = torch.rand(200, 2 * PLANAR.dof, generator=random, dtype=torch.float64)
        # a tenth is replaced by what no vessel does
        share[180:] = 1e6 * (share[180:] - 0.5)
        motion = low + share * (high - low)
        motion[190:195, 0] = torch.nan
        parts = motion.split(PLANAR.dof, dim=1)
        with torch.no_grad():
            tau, outside = self.graph(dtype)(*parts)
        found = [loaded.step(*(part[k].numpy() for part in parts)) for k in range(len(motion))]
        off = (torch.from_numpy(np.stack([force for force, _ in found])) - tau).abs()
        worst = float((off[:180].amax(0) / (tau[:180].amax(0) - tau[:180].amin(0))).max())
        flags = [bool(flag) for _, flag in found] == outside.tolist()
        if not (worst < _SAME and bool((off <= _SAME * (1.0 + tau.abs())).all()) and flags):
            raise ExportError(
                f"{self.what}: {what} differs from the model by {worst:.1e} of its range; allowed"
                f" {_SAME:g}"
            )
        return {"steps": len(motion), "share_of_range": worst}

    def contents(self) -> dict[str, Any]:
        known = GuardedForce(self.inner, self.ranges).ranges
        accepted = torch.stack((known.least, known.most), dim=1).tolist()
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
            "accepted": dict(zip(MOTION, accepted, strict=True)),
            "outside_the_training_range": (
                f"the correction of the believed model fades out over {FADE:g} of the range's"
                f" width; no axis commands more than {EFFORT:g} times the believed model's force,"
                " beyond `accepted` neither that of the motion nor that of its nearest value"
            ),
            "mirror": (
                "the correction is the mean of itself and its mirror image: a straight course needs"
                " no sway force and no yaw moment beyond the believed model's"
                if self.inner.mirrored
                else "the correction is as it was fitted, not the same to port and starboard"
            ),
            "training_range": {
                name: list(limits) for name, limits in zip(MOTION, self.ranges, strict=True)
            },
            "thruster_lag": self.lag,
        }


@final
class FeedForwardExporter(Exporter):
    """The force that a motion needs, as TorchScript, of a model in force space."""

    name: ClassVar[str] = "feed_forward"
    suffix: ClassVar[str] = "_feed_forward.pt"
    about: ClassVar[str] = (
        "The force tau = F(nu_dot, nu) that a motion needs, from a model in force space."
    )

    def export(self, exported: Exported, file: Path) -> Mapping[str, Any]:
        if not isinstance(exported, ExportedVessel):
            raise UsageError(f"{exported.what}: a feed-forward is made of a vessel model alone")
        force, ranges = required_force(exported.spec, exported.at(torch.float64))
        made = released(
            ExportedForce(exported.name, force, ranges), exported.objections, anyway=True
        )
        made.assessment = exported.assessment
        return TorchScriptExporter().export(made, file)
