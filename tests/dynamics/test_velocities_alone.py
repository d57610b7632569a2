"""A hybrid model that is asked for no positions: all else is as with them."""

from __future__ import annotations

from typing import get_args

import pytest
import torch

from residnet.baselines.regressors import RegressorBaseline
from residnet.core.layout import HEADING, MOTION, POSITION
from residnet.core.samples import Samples
from residnet.dynamics.base import Integrator
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.rollout import Rollout
from residnet.heads.base import FeatureConfig
from residnet.heads.lstm import LstmConfig
from residnet.heads.mlp import MlpConfig
from residnet.heads.recurrent import RecurrentConfig
from residnet.physics.signals import SignalsConfig

DT = 0.05
TERMS = {"linear": ["u", "v", "r", "a", "b"], "nonlinear": ["u", "v|v|", "r", "a", "u b"]}


@pytest.mark.parametrize("integrator", get_args(Integrator))
@pytest.mark.parametrize("wind", [False, True])
@pytest.mark.parametrize("terms", TERMS)
@pytest.mark.parametrize("told", [False, True])
def test_heading_and_velocities_do_not_hang_on_positions(
    integrator: Integrator, wind: bool, terms: str, told: bool
) -> None:
    torch.manual_seed(3)
    exogenous = ("wind_speed", "wind_dir") if wind else ()
    signals = SignalsConfig(inputs=("a", "b"), exogenous=exogenous).build()
    names = [*TERMS[terms], "wind_u", "wind_v"] if wind else TERMS[terms]
    baseline = RegressorBaseline([names] * 3, signals.names)
    baseline.theta.data.copy_(0.3 * torch.randn(3, len(names)) - 0.6 * torch.eye(3, len(names)))
    kind = RecurrentConfig(members=1, hidden_size=6, step=DT) if told else LstmConfig(hidden_size=6)
    head = kind.build(signals.names)
    model = HybridDynamics(signals, baseline, head, DT, integrator).double().eval()
    assert (model.missed is not None) == told
    x0 = torch.randn(5, 6, dtype=torch.float64)
    w = torch.randn(5, 40, 4 if wind else 2, dtype=torch.float64)
    slopes, states = [], []
    for model.positions in (True, False):
        held = w.clone().requires_grad_(True)
        x, _, _ = Rollout(model)(x0, held, model.initial_state(5).double())
        slopes.append(torch.autograd.grad(x[:, -1, HEADING : MOTION.stop].square().sum(), held)[0])
        states.append(x.detach())
    whole, alone = (x[..., HEADING : MOTION.stop] for x in states)
    assert float(whole.diff(dim=1).abs().max()) > 0.01
    torch.testing.assert_close(alone, whole, rtol=0, atol=1e-13)
    torch.testing.assert_close(*slopes, rtol=0, atol=1e-13)
    assert torch.equal(states[1][..., POSITION], x0[:, None, POSITION].expand(5, 41, 2))


@pytest.mark.parametrize(
    "head",
    [
        MlpConfig(hidden=(5, 4)),
        LstmConfig(hidden_size=4, features=("b", "r", "u"), readout=3, memory=("b",)),
        LstmConfig(hidden_size=4, readout=3, memory=("u", "a"), per_axis=True),
        RecurrentConfig(members=2, hidden_size=4, step=DT),
    ],
    ids=["mlp", "lstm of inputs", "lstm by axis", "recurrent"],
)
@pytest.mark.parametrize("terms", TERMS)
def test_gradients_are_those_of_single_steps(head: FeatureConfig, terms: str) -> None:
    torch.manual_seed(5)
    signals = SignalsConfig(inputs=("a", "b")).build()
    baseline = RegressorBaseline([TERMS[terms]] * 3, signals.names, bounded=terms != "linear")
    z = torch.randn(60, len(signals.names), dtype=torch.float64)
    log, start = torch.zeros(2, 60).long()
    known = Samples(z, z[:, :3].flip(1), log, start, ("a",), signals.names)
    if baseline.bound is not None:
        baseline.bound.calibrate(known)
    baseline.theta.data.copy_(0.2 * torch.randn(3, 5) - 0.6 * torch.eye(3, 5))
    built = head.build(signals.names)  # type: ignore[attr-defined]
    model = HybridDynamics(signals, baseline, built, DT)
    model.head.calibrate(known)
    model = model.double()
    rows = 3 * model.head.copies
    x0 = torch.randn(rows, 6, dtype=torch.float64)
    w, s = torch.randn(rows, 20, 2, dtype=torch.float64), torch.rand(rows, model.n_state).double()
    free = Rollout(model)
    # several stretches, the last one shorter
    free.together = 7 * rows
    found = []
    for model.positions in (True, False):
        model.zero_grad()
        states, _, memory = free(x0, w, s)
        (states[..., HEADING : MOTION.stop].square().sum() + memory.square().sum()).backward()
        slopes = [p.grad for p in model.head.parameters() if p.grad is not None]
        found.append([states[..., HEADING : MOTION.stop].detach(), memory.detach(), *slopes])
    assert len(found[0]) == len(found[1]) > 4
    for alone, ahead in zip(*found, strict=True):
        torch.testing.assert_close(ahead, alone, rtol=1e-8, atol=1e-10)
