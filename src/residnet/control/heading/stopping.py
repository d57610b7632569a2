"""The heading in which counter-rudder stops a yaw rate, as time-optimal laws need it."""

from __future__ import annotations

import torch
from torch import Tensor


def centred(
    error: Tensor, r: Tensor, acting: Tensor, force: Tensor, decay: Tensor, swing: float
) -> tuple[Tensor, Tensor]:
    """Return the error and yaw rate [B, 1] that will be left once the rudder is centred.

    The rudder acts with a share of its limit until it has gone to where it does nothing.

    Args:
        error: heading error [B, 1] in rad.
        r: yaw rate [B, 1] in rad/s.
        acting: rudder [B, 1] as a share of its limit.
        force: yaw acceleration [B, 1] of full rudder in rad/s^2.
        decay: 1/T [B, 1] in 1/s.
        swing: time in s that the rudder takes from amidships to its limit.
    """
    wait = acting.abs() * swing
    later = r + wait * (0.5 * force * acting - decay * r)
    return error - wait * (r + wait * (force * acting / 3.0 - 0.5 * decay * r)), later


def braking(
    r: Tensor, force: Tensor, decay: Tensor, stiffness: Tensor, stiff: Tensor, swing: float
) -> Tensor:
    """Return the heading [B, 1] that passes while r_dot = -force - decay r stops the yaw rate.

    It is r / nu near zero, with the same slope there.

    The rudder starts from amidships and comes back there: that takes half of its swing more, or a
    pulse that does not reach the limit. nu is chosen such that e'' + (decay + stiffness / nu) e' +
    stiffness e = 0 has the relative damping `stiff`.

    Args:
        r: yaw rate [B, 1] in rad/s.
        force: yaw acceleration that is counted on, in rad/s^2.
        decay: 1/T in 1/s.
        stiffness: yaw acceleration per heading error near the reference in 1/s^2.
        stiff: relative damping there.
        swing: time in s that the rudder takes from amidships to its limit.
    """
    line = ((2.0 * stiff * torch.sqrt(stiffness) - decay) / stiffness).clamp(min=1e-3)
    lead = (line - 0.5 * swing).clamp(min=1e-3)
    end = force * lead / (1.0 - decay * lead).clamp(min=0.1)
    if swing > 0.0:
        end = torch.where(line < 1.5 * swing, (line / 1.5).square() * force / swing, end)
    size = r.abs()
    beyond = torch.maximum(size, end)
    curve = (
        _distance(beyond, force, decay, swing) - _distance(end, force, decay, swing) + end * line
    )
    return r.sign() * torch.where(size < end, size * line, curve)


def _distance(r: Tensor, force: Tensor, decay: Tensor, swing: float) -> Tensor:
    """Return the heading [B, 1] in which a yaw rate r > 0 is stopped.

    It is the integral of r dr / (force + decay r), and what the rudder's swing adds.
    """
    braking_angle = (r - force / decay * torch.log1p(decay * r / force)) / decay
    if swing == 0.0:
        return braking_angle
    pulse = r * torch.sqrt(r * swing / force) - 0.5 * r.square() / force
    return braking_angle + torch.where(r < force * swing, pulse, 0.5 * swing * r)
