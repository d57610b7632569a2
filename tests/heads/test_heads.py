"""What every head keeps beyond `residnet.testing.check_head`, by the union of heads itself."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from kinds import HEADS
from made_samples import NAMES, channels, made

from residnet.core.config import validate
from residnet.core.errors import ConfigError
from residnet.core.registry import kinds
from residnet.dynamics.store import load_model, save_model
from residnet.heads import HeadConfig
from residnet.heads.base import ClosedFormHead, Features, ResidualHead
from residnet.testing.checks import example_model, example_spec


def config_of(kind: str, **settings: Any) -> Any:
    if kind == "genetic":
        pytest.importorskip("deap", reason="genetic programming needs the extra gp")
    return validate({"kind": kind, **HEADS.get(kind, {}), **settings}, HeadConfig, "here")


@pytest.mark.parametrize("kind", kinds(HeadConfig))
def test_features_choose_what_a_head_sees(kind: str) -> None:
    head: ResidualHead = config_of(kind, features=["u", "v", "r"]).build(NAMES)
    head.calibrate(made())
    if isinstance(head, ClosedFormHead):
        head.solve(made())
    head = head.eval().double()
    z = torch.from_numpy(channels(48, seed=5).reshape(4, 12, len(NAMES)))
    changed = z.clone()
    changed[..., 3:] += 1000.0
    with torch.no_grad():
        assert torch.equal(head.sequence(z), head.sequence(changed))
    with pytest.raises(ConfigError, match="did you mean 'tau_x'"):
        config_of(kind, features=["u", "tau_z"]).build(NAMES)


@pytest.mark.parametrize("kind", ["mlp", "kernel", "recurrent", "sklearn"])
def test_a_model_stored_in_single_precision_keeps_its_answers(kind: str, tmp_path: Path) -> None:
    """Training leaves float32 weights; they come back as they were."""
    spec = example_spec(config_of(kind))
    model = example_model(spec).float()
    save_model(tmp_path / "mine", spec, model)
    again = load_model(tmp_path / "mine")[1].float().eval()
    torch.testing.assert_close(again.state_dict(), model.state_dict(), rtol=0, atol=0)
    x, w, s = torch.randn(4, 6), torch.randn(4, 2) * 20, torch.randn(4, model.n_state)
    with torch.no_grad():
        for one, other in zip(model.step(x, w, s), again.step(x, w, s), strict=True):
            assert torch.equal(one, other)


def test_guard_holds_features_at_the_widened_range() -> None:
    samples = made()
    features = Features(("r", "u"), NAMES, margin=0.25)
    features.calibrate(samples)
    low, high = samples.z.amin(0)[[2, 0]], samples.z.amax(0)[[2, 0]]
    reach = 0.25 * (high - low)
    inside = samples.z[:5]
    assert torch.equal(features.guarded(inside), inside[:, [2, 0]])
    far = torch.full((1, 5), 1e9, dtype=torch.float64)
    torch.testing.assert_close(features.guarded(far)[0], high + reach)
    torch.testing.assert_close(features.guarded(-far)[0], low - reach)
    out = features(samples.z)
    torch.testing.assert_close(out.mean(0), torch.zeros(2, dtype=torch.float64), rtol=0, atol=1e-12)
    torch.testing.assert_close(out.std(0, correction=0), torch.ones(2, dtype=torch.float64))
    # a constant feature is left unscaled
    z = samples.z.clone()
    z[:, 3] = 400.0
    still = Features(("tau_x",), NAMES, margin=0.1)
    still.calibrate(
        type(samples)(z, samples.target, samples.group, samples.t, samples.kinds, NAMES)
    )
    assert still(z).abs().max() == 0
    assert bool(torch.isfinite(still(z + 1)).all())
