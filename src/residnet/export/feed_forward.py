"""Export of a force-space model as a controller's feed-forward tau = F(nu_dot, nu).

Source: document 002 eq. (3.24).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, final

import torch
from torch import Tensor, nn

from residnet.core.errors import ExportError, UsageError
from residnet.core.layout import PLANAR, RANGE_VELOCITIES
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.store import ModelSpec
from residnet.export.base import Exporter
from residnet.export.guard import replaced, widening
from residnet.export.scripting import require_shape, size, within, write_scripted
from residnet.heads import ForceHead
from residnet.physics.force_model import MOTION
from residnet.physics.signals import FORCE_CHANNELS


@final
class RequiredForce(nn.Module):
    """The force tau [B, 3] = F(nu_dot [B, 3], nu [B, 3]) of a hybrid model in force space.

    It is M (nu_dot - nu_dot_0 without forces) + eps, float64, SI.
    """

    def __init__(self, baseline: nn.Module, head: ForceHead) -> None:
        super().__init__()
        self.baseline, self.head = baseline, head

    def forward(self, nu_dot: Tensor, nu: Tensor) -> Tensor:
        """Return the force tau [B, 3] in N, N, N m that the motion needs."""
        z = torch.cat((nu, torch.zeros_like(nu)), dim=-1)
        baseline: Tensor = self.baseline(z)
        force: Tensor = (nu_dot - baseline) @ self.head.mass.to(nu.dtype).T + self.head.force(
            nu_dot, z
        )
        return force


@final
class GuardedForce(nn.Module):
    """A feed-forward whose answer is finite whatever it is given, with a flag.

    Motions are treated as `residnet.export.guard` says: not a number becomes the middle of the
    training range, what is farther off than the accepted range its nearest value.

    Args:
        model: tau [B, 3] from nu_dot and nu [B, 3].
        ranges: of nu_dot and nu in the training data, six.
    """

    def __init__(self, model: nn.Module, ranges: Sequence[tuple[float, float]]) -> None:
        super().__init__()
        self.model = model
        low, high = torch.tensor(ranges, dtype=torch.float64).T
        reach = torch.tensor([widening(*limits) for limits in ranges], dtype=torch.float64)
        for name, value in {
            "low": low,
            "high": high,
            "least": low - reach,
            "most": high + reach,
            "middle": 0.5 * (low + high),
        }.items():
            self.register_buffer(name, value.clone())
        self.low: Tensor
        self.high: Tensor
        self.least: Tensor
        self.most: Tensor
        self.middle: Tensor
        self.dof = PLANAR.dof

    def forward(self, nu_dot: Tensor, nu: Tensor) -> tuple[Tensor, Tensor]:
        """Return the force tau [B, 3] in N, N, N m and `outside` [B].

        `outside` is True where a motion is beyond the training range or no number.
        """
        rows = size(nu, 2, 0)
        require_shape("nu_dot", nu_dot, [rows, self.dof])
        require_shape("nu", nu, [rows, self.dof])
        seen = torch.cat((nu_dot, nu), dim=-1).to(torch.float64)
        used = replaced(seen, self.low, self.high, self.least, self.most, self.middle)
        force: Tensor = self.model(used[:, : self.dof], used[:, self.dof :])
        return force, ~within(seen, self.low, self.high).squeeze(-1)


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
    ranges = list(
        zip(
            (*head.lowest.tolist(), *spec.low[RANGE_VELOCITIES]),
            (*head.highest.tolist(), *spec.high[RANGE_VELOCITIES]),
            strict=True,
        )
    )
    return RequiredForce(model.baseline, head).eval().requires_grad_(False), ranges


def export_feed_forward(
    model: nn.Module,
    lag: dict[str, float] | None,
    ranges: Sequence[tuple[float, float]],
    file: Path,
) -> dict[str, Any]:
    """Write (tau, outside) = F(nu_dot, nu) as TorchScript with its card.

    Args:
        model: tau [B, 3] from nu_dot and nu [B, 3].
        lag: of the thrusters, for the card; None where it was not fitted.
        ranges: of nu_dot and nu in the training data, six.
        file: where to write.

    Returns:
        The card.

    Raises:
        ExportError: where the exported module differs from the model.
    """
    model = model.eval()
    guarded = GuardedForce(model, ranges).eval()

    def check(exported: Any) -> float:
        """Return the largest difference at random motions within the training ranges.

        It is a share of each force's range.
        """
        low, high = torch.tensor(ranges, dtype=torch.float64).T
        motion = low + torch.rand(
            200, 6, generator=torch.Generator().manual_seed(0), dtype=torch.float64
        ) * (high - low)
        with torch.no_grad():
            eager = model(motion[:, : PLANAR.dof], motion[:, PLANAR.dof :])
            scripted, _ = exported(motion[:, : PLANAR.dof], motion[:, PLANAR.dof :])
        share = float(((eager - scripted).abs().amax(0) / (eager.amax(0) - eager.amin(0))).max())
        if not share < 1e-9:
            raise ExportError(
                f"{file.name}: the exported feed-forward differs from the model by {share:.1e} of"
                " its range; allowed 1e-9"
            )
        return share

    def card(share: float) -> dict[str, Any]:
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
            "accepted": {
                name: list(limits)
                for name, limits in zip(
                    MOTION,
                    zip(guarded.least.tolist(), guarded.most.tolist(), strict=True),
                    strict=True,
                )
            },
            "training_range": {
                name: list(limits) for name, limits in zip(MOTION, ranges, strict=True)
            },
            "thruster_lag": lag,
            "parity_share_of_range": share,
            "safety": "TorchScript is code that runs when loaded: load only files that you trust.",
        }

    return write_scripted(file, guarded, (), check, card)


@final
class FeedForwardExporter(Exporter):
    """The force that a motion needs, as TorchScript, of a model in force space."""

    name: ClassVar[str] = "feed_forward"
    suffix: ClassVar[str] = "_feed_forward.pt"
    about: ClassVar[str] = (
        "The force tau = F(nu_dot, nu) that a motion needs, from a model in force space."
    )

    def export(
        self,
        spec: ModelSpec,
        model: HybridDynamics,
        file: Path,
        rows: Sequence[Mapping[str, Any]],
    ) -> Mapping[str, Any]:
        """Write the feed-forward of a model and return its card; `rows` are not part of it."""
        force, ranges = required_force(spec, model)
        return export_feed_forward(force, None, ranges, file)
