"""Models on disk: complete, harmless, and named when missing."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from residnet.baselines.given_config import ZeroBaselineConfig
from residnet.baselines.regressors_config import RegressorsConfig
from residnet.core.errors import ConfigError, UsageError
from residnet.dynamics.store import ModelSpec, load_model, model_names, rebuild_module, save_model
from residnet.heads.lstm_config import LstmConfig
from residnet.heads.mirror import Tanh
from residnet.heads.skip import SkipHead
from residnet.physics.signals_config import SignalsConfig
from residnet.physics.vessel import load_vessel

LOW = [-0.1, -0.2, -0.3, -4.0, -5.0]
HIGH = [0.1, 0.2, 0.3, 4.0, 5.0]


def spec(**changes: object) -> ModelSpec:
    fields: dict[str, object] = {
        "schema": "residnet.model/1",
        "name": "baseline",
        "role": "baseline",
        "signals": (
            SignalsConfig(inputs=("n_port", "n_stbd"), forces="wam_v_cal")
            .with_thrusters()
            .model_dump()
        ),
        "baseline": RegressorsConfig(terms=("u", "tau_x", "1")).model_dump(),
        "head": None,
        "dt": 0.05,
        "integrator": "semi_implicit_euler",
        "low": LOW,
        "high": HIGH,
    }
    return ModelSpec.model_validate({**fields, **changes})


def saved(folder: Path, **changes: object) -> ModelSpec:
    kept = spec(**changes)
    save_model(folder, kept, kept.build())
    return kept


def edited(folder: Path, **changes: object) -> None:
    """Change the description as an earlier version wrote it, without a sum of its own."""
    content = json.loads((folder / "model.json").read_text()) | changes
    content.pop("description_sha256")
    (folder / "model.json").write_text(json.dumps(content))


def test_round_trip(tmp_path: Path) -> None:
    kept = spec()
    model = spec().build()
    theta: Any = model.baseline.theta
    with torch.no_grad():
        theta.copy_(torch.randn(3, 3, dtype=torch.float64))
    save_model(tmp_path / "baseline", kept, model)
    names = sorted(path.name for path in (tmp_path / "baseline").iterdir())
    assert names == ["model.json", "model.safetensors"]
    loaded, again = load_model(tmp_path / "baseline")
    assert loaded == kept
    assert (again.dt, again.integrator) == (0.05, "semi_implicit_euler")
    pairs = (*zip(LOW, HIGH, strict=True),)
    assert loaded.ranges == dict(zip(("u", "v", "r", "n_port", "n_stbd"), pairs, strict=True))
    x, w = torch.randn(2, 6, dtype=torch.float64), torch.randn(2, 2, dtype=torch.float64) * 20
    assert torch.equal(model.step(x, w, x[:, :0])[0], again.step(x, w, x[:, :0])[0])
    # the vessel's file is not needed
    text = (tmp_path / "baseline" / "model.json").read_text()
    assert "wam_v_cal" not in text
    forward = json.loads(text)["signals"]["forces"]["forward"]
    assert forward == list(load_vessel("wam_v_cal").actuators.forward)


def test_a_rebuilt_model_is_the_loaded_one_bit_for_bit(tmp_path: Path) -> None:
    """Training in float32 rounds buffers that are not kept; a load builds them anew."""
    kept = spec(head={"kind": "mlp", "hidden": [3]})
    model = kept.build().to(torch.float32)
    save_model(tmp_path / "m", kept, model)
    _, loaded = load_model(tmp_path / "m")
    again = rebuild_module(kept, model)
    theirs = dict(loaded.named_buffers())
    rounded = dict(model.named_buffers())
    assert any(not torch.equal(theirs[name], rounded[name].double()) for name in theirs)
    for name, value in [*again.named_buffers(), *again.named_parameters()]:
        other = loaded.get_parameter(name) if name not in theirs else theirs[name]
        assert value.dtype == other.dtype, name
        assert torch.equal(value, other), name


def test_networks_of_earlier_versions_have_tanh_readouts_and_no_skip(
    tmp_path: Path,
) -> None:
    head = {"kind": "lstm", "hidden_size": 3, "readout": 4}
    kept = saved(tmp_path / "m", head={**head, "readout_activation": "tanh", "skip": "none"})
    content = json.loads((tmp_path / "m" / "model.json").read_text())
    del content["head"]["readout_activation"], content["head"]["skip"]
    edited(tmp_path / "m", head=content["head"])
    loaded, model = load_model(tmp_path / "m")
    assert loaded == kept
    readouts = [module for module in model.modules() if isinstance(module, Tanh | torch.nn.SiLU)]
    assert [type(module) for module in readouts] == [Tanh]
    assert not any(isinstance(module, SkipHead) for module in model.modules())
    # a new head has a readout that does not saturate
    new_config = LstmConfig(hidden_size=3, readout=4)
    assert any(
        isinstance(m, torch.nn.SiLU) for m in new_config.build(kept.signals.build().names).modules()
    )


def test_zero_has_no_numbers(tmp_path: Path) -> None:
    saved(
        tmp_path / "constant_velocity",
        name="constant_velocity",
        role="constant_velocity",
        baseline=ZeroBaselineConfig().model_dump(),
    )
    _, model = load_model(tmp_path / "constant_velocity")
    x = torch.tensor([[0.0, 0.0, 0.0, 1.0, 0.2, 0.0]])
    after, _ = model.step(x, torch.ones(1, 2), x[:, :0])
    assert torch.equal(after[:, 3:], x[:, 3:])
    torch.testing.assert_close(after[:, :2], torch.tensor([[0.05, 0.01]]))


def test_a_missing_model_names_its_neighbours(tmp_path: Path) -> None:
    saved(tmp_path / "baseline")
    (tmp_path / "unfinished").mkdir()
    assert model_names(tmp_path) == ["baseline"]
    with pytest.raises(UsageError, match="did you mean 'baseline'"):
        load_model(tmp_path / "basline")


def card(folder: Path, text: str) -> None:
    (folder / "model.json").write_text(text)


def weights(folder: Path, change: Callable[[bytes], bytes]) -> None:
    file = folder / "model.safetensors"
    file.write_bytes(change(file.read_bytes()))


def swap(folder: Path) -> None:
    saved(folder.parent / "other", baseline=RegressorsConfig(terms=("u", "v", "r", "1")))
    weights(folder, lambda _: (folder.parent / "other" / "model.safetensors").read_bytes())


def tamper(folder: Path) -> None:
    card(folder, json.dumps(json.loads((folder / "model.json").read_text()) | {"dt": 0.04}))


OTHER = RegressorsConfig(terms=("u", "1")).model_dump()
WEIGHTS = r"model\.safetensors: .*run the fit again"
JSON = r"model\.json: .* JSON.*run it again"


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (lambda f: weights(f, lambda b: b[:-20]), WEIGHTS),
        (lambda f: weights(f, lambda b: b[:-3] + bytes([b[-3] ^ 1]) + b[-2:]), WEIGHTS),
        (lambda f: weights(f, lambda _: b"PK\x03\x04 not tensors at all"), WEIGHTS),
        (swap, WEIGHTS),
        (lambda f: (f / "model.safetensors").unlink(), WEIGHTS),
        # though their hash is right
        (lambda f: edited(f, baseline=OTHER), "does not belong to the module of model.json"),
        (tamper, r"model\.json: was edited: .*run the fit again"),
        (lambda f: card(f, "{"), JSON),
        (lambda f: card(f, "[1, 2]"), JSON),
        (lambda f: card(f, "\x00"), JSON),
        (lambda f: edited(f, dt=-1.0), r"model\.json.*dt"),
        (
            lambda f: edited(f, schema="residnet.heading_policy/1"),
            r"holds 'residnet.heading_policy/1', expected",
        ),
    ],
)
def test_what_is_not_as_written_is_refused_in_one_line(
    tmp_path: Path, damage: Callable[[Path], object], said: str
) -> None:
    kept = saved(tmp_path / "m")
    edited(tmp_path / "m")
    assert load_model(tmp_path / "m")[0] == kept, "without a sum of its own it is older"
    saved(tmp_path / "m")
    damage(tmp_path / "m")
    with pytest.raises((UsageError, ConfigError), match=said) as caught:
        load_model(tmp_path / "m")
    assert "\n" not in str(caught.value)
