"""Skip connections: the linear part is PLSR, the network learns what it leaves and only acts in the
training range.
"""

from __future__ import annotations

from typing import Any

import pytest
import torch
from kinds import of_kind
from made_samples import NAMES, made
from torch import Tensor

from residnet.heads.linear import PlsrConfig
from residnet.heads.lstm_config import LstmConfig
from residnet.heads.mlp_config import MlpConfig
from residnet.heads.skip import SkipHead

CONFIGS: dict[str, Any] = {
    "mlp": MlpConfig(hidden=(6,)),
    "lstm": LstmConfig(hidden_size=4, readout=5),
}


def calibrated(kind: str, **samples: Any) -> SkipHead:
    torch.manual_seed(0)
    head = of_kind(CONFIGS[kind].build(NAMES), SkipHead)
    head.calibrate(made(**samples))
    return head.double()


def residual(head: Any, z: Tensor) -> Tensor:
    with torch.no_grad():
        rho: Tensor = head(z, z.new_zeros(len(z), head.n_state))[0]
    return rho


def perturb(head: SkipHead) -> None:
    with torch.no_grad():
        for parameter in head.parameters():
            parameter.add_(0.5 * torch.randn_like(parameter))


@pytest.mark.parametrize("kind", CONFIGS)
def test_training_begins_at_plsr_and_learns_what_it_leaves(kind: str) -> None:
    head = calibrated(kind)
    samples = made()
    plsr = PlsrConfig().build(NAMES)
    plsr.calibrate(samples)
    plsr.fit_preferred(samples)
    z = samples.z
    torch.testing.assert_close(residual(head, z), residual(plsr, z), rtol=0, atol=1e-12)
    remainder = samples.target - residual(plsr, z)
    torch.testing.assert_close(head.residual_scale(), remainder.std(0, correction=0))
    assert bool((head.residual_scale() < 0.5 * samples.target.std(0)).all())


@pytest.mark.parametrize("kind", CONFIGS)
def test_the_network_acts_in_the_training_range_only(kind: str) -> None:
    head = calibrated(kind)
    perturb(head)
    samples = made()
    low = samples.z.amin(0)
    high = samples.z.amax(0)
    width = high - low
    middle = 0.5 * (low + high)
    s = torch.zeros(1, head.n_state, dtype=torch.float64)
    for column in range(len(NAMES)):
        for edge, sign in ((low, -1.0), (high, 1.0)):
            for distance, weight in ((-0.01, 1.0), (0.05, 0.3679), (0.1, 0.0183), (0.5, 0.0)):
                z = middle.clone()
                z[column] = edge[column] + sign * distance * width[column]
                z = z[None]
                with torch.no_grad():
                    share = (head(z, s)[0] - head.linear(z, s)[0]) / head.network(z, s)[0]
                torch.testing.assert_close(share, torch.full_like(share, weight), atol=1e-4, rtol=0)


def test_a_manoeuvre_alone_determines_no_linear_part() -> None:
    head = calibrated("mlp", groups=1)
    assert not bool(head.linear.coefficients.any())
    target = made(groups=1).target
    torch.testing.assert_close(head.residual_scale(), target.std(0, correction=0))


def test_a_zero_residual_has_no_linear_part() -> None:
    head = calibrated("lstm")
    perturb(head)
    z = made().z
    assert bool(residual(head, z).any())
    head.zero_residual()
    assert not bool(residual(head, z).any())


def test_a_restoring_acceleration_does_not_decay_outside_the_training_range() -> None:
    head = LstmConfig(hidden_size=4, restoring=True).build(NAMES)
    head.calibrate(made())
    far = made().z.mean(0, keepdim=True)
    far[:, 0] += 100.0
    without = residual(calibrated("lstm"), far)
    assert float((residual(head.double(), far) - without)[0, 0]) < -1.0
