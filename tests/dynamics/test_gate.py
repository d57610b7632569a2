"""The gate between network and physics: as it was inside the data, the baseline far outside."""

from __future__ import annotations

import pytest
import torch

from residnet.core.samples import Samples
from residnet.dynamics.ensemble import MeanHead
from residnet.dynamics.gate import GatedHead
from residnet.heads.base import ClosedFormHead
from residnet.heads.linear import RidgeConfig
from residnet.heads.mlp import MlpConfig

NAMES = ("u", "v", "r", "n")


def known(target: torch.Tensor | None = None, seed: int = 0) -> Samples:
    generator = torch.Generator().manual_seed(seed)
    z = 2 * torch.rand(2000, 4, generator=generator, dtype=torch.float64) - 1
    line = torch.stack((z[:, 0], z[:, 1], z[:, 2]), dim=1)
    return Samples(
        z,
        line if target is None else target,
        torch.arange(2000) // 200,
        torch.zeros(2000),
        ("zigzag",) * 10,
        NAMES,
    )


def gated() -> GatedHead:
    head = RidgeConfig().build(NAMES)
    assert isinstance(head, ClosedFormHead)
    head.calibrate(known())
    head.solve(known())
    out = GatedHead(head, len(NAMES))
    out.calibrate(known())
    return out


def test_inside_the_data_nothing_changes_and_far_outside_nothing_is_left() -> None:
    head = gated()
    z = known().z[:50]
    none = z[:, :0]
    torch.testing.assert_close(head(z, none)[0], head.inner(z, none)[0])
    torch.testing.assert_close(head.sequence(z[None]), head.inner.sequence(z[None]))
    far = z.clone()
    far[:, 3] = 1e3
    assert float((head(far, none)[0].abs() / head.inner(far, none)[0].abs()).max()) < 1e-5
    # at the chosen distance from the range half is left
    edge = torch.tensor([[0.5, 0.5, 0.5, float(head.high[3] + head.reach[3])]], dtype=z.dtype)
    torch.testing.assert_close(head(edge, none[:1])[0], 0.5 * head.inner(edge, none[:1])[0])


def test_the_fade_follows_what_holding_would_have_told() -> None:
    """Steps go on beyond an inner box as they were at its edge, bumps do not."""
    z = known().z
    steps = torch.sign(z[:, :3]).clone()
    bumps = torch.where(z[:, :3].abs() < 0.5, torch.ones_like(steps), -torch.ones_like(steps))
    target = torch.stack((steps[:, 0], bumps[:, 1], torch.zeros_like(steps[:, 2])), dim=1)
    taught = known(target)

    class Told(torch.nn.Module):
        n_state = 0

        def sequence(self, z: torch.Tensor) -> torch.Tensor:
            bump = torch.where(z[..., 1].abs() < 0.6, 1.0, -1.0)
            return torch.stack((torch.sign(z[..., 0]), bump, z[..., 2]), dim=-1)

    head = gated()
    head.inner = Told()  # type: ignore[assignment]
    left = head.learn_fade(taught, (0.05, 0.5, 100.0))
    assert head.fade[0] == 100.0
    assert head.fade[2] == 0.05
    assert set(left) == {"0.05", "0.5", "100"}


def test_members_that_disagree_lose_their_say() -> None:
    torch.manual_seed(0)
    members = [MlpConfig(hidden=(8,)).build(NAMES).double() for _ in range(3)]
    samples = known()
    for member in members:
        member.calibrate(samples)
    head = GatedHead(MeanHead(members), len(NAMES))
    head.calibrate(samples)
    z = samples.z[:20]
    mean, spread, _ = head.inner.with_spread(z, z[:, :0])
    torch.testing.assert_close(mean, head.inner(z, z[:, :0])[0])
    told = torch.stack([member(z, z[:, :0])[0] for member in members])
    torch.testing.assert_close(spread, told.std(dim=0, correction=0), rtol=1e-4, atol=1e-7)
    rho = head.agreed.expand_as(spread)
    torch.testing.assert_close(head.kept(z, rho, 0.9 * rho), rho)
    # members that differ by as much again as they say
    torch.testing.assert_close(head.kept(z, rho, 2.0**0.5 * rho), 0.5 * rho)
    assert head.parameter_count()[0] == pytest.approx(head.inner.parameter_count()[0] + 1)
