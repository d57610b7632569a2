"""Exported models under bad inputs and memories: those beyond the heads of `test_torchscript`."""

from __future__ import annotations

import functools
import warnings
from typing import Any

import pytest
import torch

from residnet.dynamics.ensemble import mean_of
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.store import ModelSpec
from residnet.export.vessel import ExportedModel
from residnet.heads.symbolic import DelayConfig, SymbolicConfig, SymbolicHead
from residnet.testing import check_bad_inputs
from residnet.testing.checks import example_models, example_samples, example_spec

RATIO = SymbolicConfig(
    terms=("u n_port^-1", "v", "n_port"), delay=DelayConfig(channels=("n_port",), longest=4)
)


def scripted(spec: ModelSpec, model: HybridDynamics) -> Any:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return torch.jit.script(ExportedModel(model.float().eval(), spec).eval())


@functools.cache
def delayed() -> tuple[ModelSpec, HybridDynamics]:
    """A term that divides by revolutions of some steps ago."""
    spec, known = example_spec(RATIO), example_samples()
    model = spec.build().eval()
    spec.baseline.fit(model.baseline, known)
    turning = known.z[known.z[:, 3] > 1.0]
    head = model.head
    assert isinstance(head, SymbolicHead)
    head.calibrate(known)
    head.features.low[3] = turning[:, 3].min()
    head.line.steps.fill_(3.0)
    head.coefficients.fill_(0.01)
    return spec, model


def ensemble() -> tuple[ModelSpec, HybridDynamics]:
    pairs = [*example_models()[1:], delayed()]
    spec = pairs[0][0].model_copy(
        update={"role": "ensemble", "head": None, "members": tuple(spec for spec, _ in pairs)}
    )
    return spec, mean_of([model for _, model in pairs])


@pytest.mark.parametrize("make", [delayed, ensemble])
def test_delays_and_ensembles(make: Any) -> None:
    spec, model = make()
    check_bad_inputs(scripted(spec, model), spec, model, cases=100)


def test_a_memory_of_another_batch_is_refused() -> None:
    spec, model = delayed()
    module = scripted(spec, model)
    x, w, s = torch.zeros(3, 6), torch.ones(3, 2), module.initial_state(3)
    for name, given in {
        "s": (x, w, module.initial_state(1)),
        "w": (x, w[:1], s),
        "x": (x[:1, :5], w, s),
    }.items():
        with pytest.raises(torch.jit.Error, match=f"{name} has the shape .*, expected"):
            module.step(*given)
    with pytest.raises(torch.jit.Error, match="s has the shape"):
        module.rollout(x, w[:, None], s[:2])
    with pytest.raises(torch.jit.Error, match="w_history has the shape"):
        module.warmup(x[:, None], w[:, None].expand(-1, 2, -1))
    assert module.step(x.double(), w.double(), s.double())[0].dtype == torch.float32


def test_a_delay_line_begins_with_its_first_sample() -> None:
    """A ratio of zeros would be no number."""
    _, model = delayed()
    head = model.head.double()
    z = example_samples().z[200:206][None]
    z[..., 3] = torch.linspace(5.0, 6.0, 6)
    first, memory = head(z[:, 0], torch.zeros(1, head.n_state, dtype=torch.float64))
    settled = head.warmup(z[:, :1].expand(-1, 9, -1))
    assert torch.isfinite(first).all()
    torch.testing.assert_close(memory, settled)
    again, memory = head(z[:, 1], memory)
    torch.testing.assert_close(memory, head.warmup(z[:, :2]))
    torch.testing.assert_close(torch.stack((first, again), dim=1), head.sequence(z[:, :2]))
    for _ in range(5):
        _, memory = head(z[:, 5], memory)
    torch.testing.assert_close(memory, head.warmup(z[:, 5:]))


def test_a_check_that_cannot_fail_is_none() -> None:
    """The model itself, without the guard, breaks the contract at the first bad sample."""
    spec, model = example_models()[2]
    model.float()

    class Naive:
        initial_state, warmup = model.initial_state, model.warmup

        def step(self, x: torch.Tensor, w: torch.Tensor, s: torch.Tensor) -> Any:
            after, s = model.step(x, w, s)
            return after, s, torch.zeros(len(x), dtype=torch.bool)

    with pytest.raises(AssertionError, match="step 3: a state is not finite"):
        check_bad_inputs(Naive(), spec, model, cases=20)
