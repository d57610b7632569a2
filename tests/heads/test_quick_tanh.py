"""The hyperbolic tangent of large batches is that of small ones."""

from __future__ import annotations

import pytest
import torch

from residnet.heads.mirror import Tanh, quick_tanh


@pytest.mark.parametrize(("dtype", "within"), [(torch.float32, 3e-7), (torch.float64, 1e-15)])
def test_both_ways_agree_with_torch(dtype: torch.dtype, within: float) -> None:
    x = torch.linspace(-30.0, 30.0, 10_001, dtype=dtype).reshape(73, 137)
    with torch.no_grad():
        quick = quick_tanh(x)
        torch.testing.assert_close(quick, torch.tanh(x), rtol=0.0, atol=within)
        # few numbers and traces take torch's own
        assert torch.equal(quick_tanh(x[:2]), torch.tanh(x[:2]))
        assert not torch.equal(quick, torch.tanh(x))
        assert torch.equal(torch.jit.script(Tanh())(x), quick)
        traced = torch.export.export(Tanh(), (x,))
        assert torch.equal(traced.module()(x), torch.tanh(x))
    x.requires_grad_()
    slopes = [torch.autograd.grad(f(x).sum(), x)[0] for f in (quick_tanh, torch.tanh)]
    torch.testing.assert_close(*slopes, rtol=0.0, atol=2.0 * within)


def test_limits_are_exact_and_what_is_no_number_stays_so() -> None:
    x = torch.full((3, 8_192), torch.inf)
    x[1], x[2] = -torch.inf, torch.nan
    with torch.no_grad():
        found = quick_tanh(x)
    assert found[0].eq(1.0).all()
    assert found[1].eq(-1.0).all()
    assert found[2].isnan().all()
