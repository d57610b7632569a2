"""What every head keeps beyond `residnet.testing.check_head`, by the union of heads itself."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from made_samples import CENTRE, NAMES, SPREAD, channels, made

from residnet.baselines.regressors import RegressorsConfig
from residnet.core.errors import ConfigError
from residnet.core.registry import kinds
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.store import ModelSpec, load_model, save_model
from residnet.heads import HeadConfig
from residnet.heads.base import ClosedFormHead, FeatureConfig, Features, ResidualHead
from residnet.physics.signals import SignalsConfig

KINDS: dict[str, type[FeatureConfig]] = kinds(HeadConfig)
# what makes a kind quick enough for a contract
QUICK: dict[str, dict[str, Any]] = {"genetic": {"evolution": {"population": 60, "generations": 3}}}
SIGNALS = SignalsConfig(inputs=("tau_x", "tau_n"))


def ready(kind: str, **config: Any) -> ResidualHead:
    """A head of this kind with scales from the made samples, fitted where it has a closed form."""
    torch.manual_seed(3)
    if kind == "genetic":
        pytest.importorskip("deap", reason="genetic programming needs the extra gp")
    settings: Any = KINDS[kind](**QUICK.get(kind, {}), **config)
    head: ResidualHead = settings.build(NAMES)
    head.calibrate(made())
    if isinstance(head, ClosedFormHead):
        head.solve(made())
    return head.eval()


@pytest.fixture(params=KINDS)
def kind(request: pytest.FixtureRequest) -> str:
    return request.param


def typical(batch: int = 4, length: int = 12) -> torch.Tensor:
    return torch.from_numpy(channels(batch * length, seed=5).reshape(batch, length, len(NAMES)))


def test_the_union_names_each_kind_once() -> None:
    assert len(KINDS) >= 7


def test_sequence_equals_steps_in_single_precision(kind: str) -> None:
    head, z = ready(kind).float(), typical().float()
    s = torch.zeros(4, head.n_state)
    out = []
    with torch.no_grad():
        for k in range(z.shape[1]):
            rho, s = head(z[:, k], s)
            out.append(rho)
        torch.testing.assert_close(head.sequence(z), torch.stack(out, dim=1), rtol=1e-6, atol=1e-6)
        torch.testing.assert_close(head.warmup(z), s, rtol=1e-6, atol=1e-6)


def test_finite_far_outside_the_training_range(kind: str) -> None:
    """The guard holds the features at the edge: the residual there is that of the edge, not an
    extrapolation.
    """
    head = ready(kind).double()
    far = torch.from_numpy(CENTRE + SPREAD * 1e6)[None]
    further = torch.from_numpy(CENTRE + SPREAD * 1e9)[None]
    s = torch.zeros(1, head.n_state, dtype=torch.float64)
    with torch.no_grad():
        one, memory = head(far, s)
        two, _ = head(further, s)
        inside = head.sequence(typical()).abs().max()
    assert bool(torch.isfinite(one).all())
    assert bool(torch.isfinite(memory).all())
    assert torch.equal(one, two)
    assert float(one.abs().max()) < 50 * float(inside) + 10
    held = head.sequence(far.expand(200, -1)[None])
    assert bool(torch.isfinite(held).all())


def test_features_choose_what_a_head_sees(kind: str) -> None:
    head, z = ready(kind, features=("u", "v", "r")).double(), typical()
    changed = z.clone()
    changed[..., 3:] += 1000.0
    with torch.no_grad():
        assert torch.equal(head.sequence(z), head.sequence(changed))
    with pytest.raises(ConfigError, match="did you mean 'tau_x'"):
        KINDS[kind](features=("u", "tau_z")).build(NAMES)  # type: ignore[attr-defined]


def spec_of(config: FeatureConfig) -> ModelSpec:
    return ModelSpec.model_validate(
        {
            "schema": "residnet.model/1",
            "name": "mine",
            "role": "head",
            "signals": SIGNALS.model_dump(),
            "baseline": RegressorsConfig(terms=("u", "v", "r", "tau_x", "1")).model_dump(),
            "head": config.model_dump(),
            "dt": 0.1,
            "integrator": "rk4",
            "low": [-1.0] * 5,
            "high": [1.0] * 5,
        }
    )


def test_a_stored_model_is_the_same_to_the_last_bit(kind: str, tmp_path: Path) -> None:
    spec = spec_of(KINDS[kind]())
    model = spec.build()
    model.head = ready(kind)
    model.head.set_step(model.dt)
    theta: Any = model.baseline.theta
    with torch.no_grad():
        theta.copy_(torch.randn(3, 5, dtype=torch.float64) * 0.1)
    save_model(tmp_path / "mine", spec, model)
    again_spec, again = load_model(tmp_path / "mine")
    assert again_spec == spec
    # once more, from what was loaded
    save_model(tmp_path / "again", again_spec, again)
    assert (tmp_path / "again" / "model.safetensors").read_bytes() == (
        tmp_path / "mine" / "model.safetensors"
    ).read_bytes()
    assert (tmp_path / "again" / "model.json").read_text() == (
        tmp_path / "mine" / "model.json"
    ).read_text()
    assert_same(model, again)


def test_a_model_stored_in_single_precision_keeps_its_answers(kind: str, tmp_path: Path) -> None:
    """Training leaves float32 weights; they come back as they were."""
    spec = spec_of(KINDS[kind]())
    model = spec.build()
    model.head = ready(kind)
    model.head.set_step(model.dt)
    model.float()
    save_model(tmp_path / "mine", spec, model)
    _, again = load_model(tmp_path / "mine")
    assert_same(model, again.float())


def assert_same(one: HybridDynamics, two: HybridDynamics) -> None:
    one, two = one.eval(), two.eval()
    state = one.state_dict()
    assert list(state) == list(two.state_dict())
    for name, value in two.state_dict().items():
        assert value.dtype == state[name].dtype, name
        assert torch.equal(value, state[name]), name
    dtype = next(iter(state.values())).dtype
    one, two = one.to(dtype), two.to(dtype)
    x, w = torch.randn(4, 6, dtype=dtype), torch.randn(4, 2, dtype=dtype) * 100
    s = torch.randn(4, one.n_state, dtype=dtype)
    with torch.no_grad():
        for a, b in zip(one.step(x, w, s), two.step(x, w, s), strict=True):
            assert torch.equal(a, b)


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


def test_a_constant_feature_is_left_unscaled() -> None:
    samples = made()
    z = samples.z.clone()
    z[:, 3] = 400.0
    features = Features(("tau_x",), NAMES, margin=0.1)
    features.calibrate(
        type(samples)(z, samples.target, samples.group, samples.t, samples.kinds, NAMES)
    )
    assert features(z).abs().max() == 0
    assert bool(torch.isfinite(features(z + 1)).all())
