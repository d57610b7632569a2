"""Refits without some logs: one step of Gauss-Newton against refits that have run anew."""

from __future__ import annotations

import copy

import pytest
import torch
from made_system import LINEAR, SCALES, model_of, trials

from residnet.baselines.base import ParametricBaseline
from residnet.baselines.regressors import RegressorsConfig
from residnet.data.prepare import samples
from residnet.data.windows import WindowStore
from residnet.training.left_out import without_logs
from residnet.training.refit import RefitConfig, refit


@pytest.mark.long
def test_one_step_goes_where_a_refit_without_the_logs_goes() -> None:
    logs = trials()[:4]
    config = RefitConfig(horizon=4.0, every=4.0, iterations=4, prior=1e-4)
    model = model_of(LINEAR)
    known, store = samples(logs, model.signals), WindowStore.gather(logs, torch.float64)
    RegressorsConfig(terms=tuple(LINEAR)).fit(model.baseline, known)
    assert isinstance(model.baseline, ParametricBaseline)
    first = model.baseline.theta.detach().clone()
    refit(model, known, store, config, SCALES)
    assert isinstance(model.baseline, ParametricBaseline)
    whole = model.baseline.theta.detach().clone()
    fold = torch.tensor([i % 2 for i in range(len(logs))])
    found = without_logs(model, known, store, config, SCALES, fold)
    assert len(found) == 2
    torch.testing.assert_close(model.baseline.theta.detach(), whole)
    apart, moved = 0.0, 0.0
    for k, theta in enumerate(found):
        kept = [log for i, log in enumerate(logs) if i % 2 != k]
        other = copy.deepcopy(model)
        assert isinstance(other.baseline, ParametricBaseline)
        # its prior stands where least squares put the parameters, as that of the whole refit does
        with torch.no_grad():
            other.baseline.theta.copy_(first)
        refit(
            other,
            samples(kept, model.signals),
            WindowStore.gather(kept, torch.float64),
            config,
            SCALES,
            begin=whole,
        )
        assert isinstance(other.baseline, ParametricBaseline)
        wanted = other.baseline.theta.detach()
        scale = whole.abs() + 0.1
        apart += float(((theta - wanted) / scale).square().sum())
        moved += float(((whole - wanted) / scale).square().sum())
    assert apart < 0.25 * moved
