"""Models on disk: complete, harmless, and named when missing."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from residnet.baselines.given import StillConfig
from residnet.baselines.regressors import RegressorsConfig
from residnet.core.errors import ConfigError, UsageError
from residnet.dynamics.store import ModelSpec, load_model, model_names, rebuilt, save_model
from residnet.physics.signals import SignalsConfig
from residnet.physics.vessel import load_vessel


def spec(**changes: object) -> ModelSpec:
    fields: dict[str, object] = {
        "schema": "residnet.model/1",
        "name": "baseline",
        "role": "baseline",
        "signals": (
            SignalsConfig(inputs=("n_port", "n_stbd"), forces="wam_v_cal").resolved().model_dump()
        ),
        "baseline": RegressorsConfig(terms=("u", "tau_x", "1")).model_dump(),
        "head": None,
        "dt": 0.05,
        "integrator": "semi_implicit_euler",
        "low": [-0.1, -0.2, -0.3, -4.0, -5.0],
        "high": [0.1, 0.2, 0.3, 4.0, 5.0],
    }
    return ModelSpec.model_validate({**fields, **changes})


def test_round_trip(tmp_path: Path) -> None:
    saved, model = spec(), spec().build()
    theta: Any = model.baseline.theta
    with torch.no_grad():
        theta.copy_(torch.randn(3, 3, dtype=torch.float64))
    save_model(tmp_path / "baseline", saved, model)
    assert sorted(path.name for path in (tmp_path / "baseline").iterdir()) == [
        "model.json",
        "model.safetensors",
    ]
    loaded, again = load_model(tmp_path / "baseline")
    assert loaded == saved
    found: Any = again.baseline.theta
    assert torch.equal(found, theta)
    assert (again.dt, again.integrator) == (0.05, "semi_implicit_euler")
    assert loaded.ranges == {
        "u": (-0.1, 0.1),
        "v": (-0.2, 0.2),
        "r": (-0.3, 0.3),
        "n_port": (-4.0, 4.0),
        "n_stbd": (-5.0, 5.0),
    }
    x, w = torch.randn(2, 6, dtype=torch.float64), torch.randn(2, 2, dtype=torch.float64) * 20
    for a, b in zip(model.step(x, w, x[:, :0]), again.step(x, w, x[:, :0]), strict=True):
        assert torch.equal(a, b)


def test_a_rebuilt_model_is_the_loaded_one_bit_for_bit(tmp_path: Path) -> None:
    """Training in float32 rounds buffers that are not kept; a load builds them anew."""
    saved = spec(head={"kind": "mlp", "hidden": [3]})
    model = saved.build().to(torch.float32)
    save_model(tmp_path / "m", saved, model)
    _, loaded = load_model(tmp_path / "m")
    again = rebuilt(saved, model)
    theirs, rounded = dict(loaded.named_buffers()), dict(model.named_buffers())
    assert any(not torch.equal(theirs[name], rounded[name].double()) for name in theirs)
    for name, value in [*again.named_buffers(), *again.named_parameters()]:
        other = loaded.get_parameter(name) if name not in theirs else theirs[name]
        assert value.dtype == other.dtype, name
        assert torch.equal(value, other), name


def test_a_stored_model_needs_no_vessel_file(tmp_path: Path) -> None:
    save_model(tmp_path / "m", spec(), spec().build())
    text = (tmp_path / "m" / "model.json").read_text()
    assert "wam_v_cal" not in text
    assert json.loads(text)["signals"]["forces"]["forward"] == list(
        load_vessel("wam_v_cal").actuators.forward
    )


def test_zero_has_no_numbers(tmp_path: Path) -> None:
    saved = spec(name="zero", role="zero", baseline=StillConfig().model_dump())
    save_model(tmp_path / "zero", saved, saved.build())
    _, model = load_model(tmp_path / "zero")
    x = torch.tensor([[0.0, 0.0, 0.0, 1.0, 0.2, 0.0]])
    after, _ = model.step(x, torch.ones(1, 2), x[:, :0])
    assert torch.equal(after[:, 3:], x[:, 3:])
    torch.testing.assert_close(after[:, :2], torch.tensor([[0.05, 0.01]]))


def test_a_missing_model_names_its_neighbours(tmp_path: Path) -> None:
    save_model(tmp_path / "baseline", spec(), spec().build())
    (tmp_path / "unfinished").mkdir()
    assert model_names(tmp_path) == ["baseline"]
    with pytest.raises(UsageError, match="did you mean 'baseline'"):
        load_model(tmp_path / "basline")


def test_a_card_that_was_tampered_with_is_refused(tmp_path: Path) -> None:
    save_model(tmp_path / "m", spec(), spec().build())
    card = tmp_path / "m" / "model.json"
    content = json.loads(card.read_text())
    card.write_text(json.dumps(content | {"dt": 0.04}))
    with pytest.raises(UsageError, match=r"model\.json: was edited: .*run the fit again"):
        load_model(tmp_path / "m")
    # an earlier version wrote no sum of the description
    content.pop("description_sha256")
    card.write_text(json.dumps(content))
    load_model(tmp_path / "m")
    card.write_text(json.dumps(content | {"dt": -1.0}))
    with pytest.raises(ConfigError, match=r"model\.json.*dt"):
        load_model(tmp_path / "m")


def cut(file: Path) -> None:
    file.write_bytes(file.read_bytes()[:-20])


def flip(file: Path) -> None:
    content = bytearray(file.read_bytes())
    content[-3] ^= 1
    file.write_bytes(bytes(content))


def swap(file: Path) -> None:
    other = spec(baseline=RegressorsConfig(terms=("u", "v", "r", "1")).model_dump())
    save_model(file.parent.parent / "other", other, other.build())
    file.write_bytes((file.parent.parent / "other" / file.name).read_bytes())


def foreign(file: Path) -> None:
    file.write_bytes(b"PK\x03\x04 not tensors at all")


def remove(file: Path) -> None:
    file.unlink()


@pytest.mark.parametrize("damage", [cut, flip, swap, foreign, remove])
def test_weights_that_are_not_as_written_are_refused_in_one_line(
    tmp_path: Path, damage: Callable[[Path], None]
) -> None:
    save_model(tmp_path / "m", spec(), spec().build())
    damage(tmp_path / "m" / "model.safetensors")
    with pytest.raises(UsageError, match=r"model\.safetensors: .*run the fit again") as caught:
        load_model(tmp_path / "m")
    assert "\n" not in str(caught.value)


def test_weights_of_another_module_are_refused_though_their_hash_is_right(tmp_path: Path) -> None:
    save_model(tmp_path / "m", spec(), spec().build())
    card = tmp_path / "m" / "model.json"
    content = json.loads(card.read_text())
    content.pop("description_sha256")
    content["baseline"] = RegressorsConfig(terms=("u", "1")).model_dump()
    card.write_text(json.dumps(content))
    with pytest.raises(UsageError, match=r"does not belong to what model.json describes"):
        load_model(tmp_path / "m")


@pytest.mark.parametrize("text", ["{", "[1, 2]", "\x00"])
def test_a_description_that_is_no_json_is_refused_in_one_line(tmp_path: Path, text: str) -> None:
    save_model(tmp_path / "m", spec(), spec().build())
    (tmp_path / "m" / "model.json").write_text(text)
    with pytest.raises(UsageError, match=r"model\.json: .* JSON.*run it again") as caught:
        load_model(tmp_path / "m")
    assert "\n" not in str(caught.value)


def test_another_kind_is_named(tmp_path: Path) -> None:
    save_model(tmp_path / "m", spec(), spec().build())
    card = tmp_path / "m" / "model.json"
    content = json.loads(card.read_text()) | {"schema": "residnet.heading_policy/1"}
    content.pop("description_sha256")
    card.write_text(json.dumps(content))
    with pytest.raises(UsageError, match=r"holds 'residnet.heading_policy/1', expected"):
        load_model(tmp_path / "m")


@pytest.mark.parametrize(
    ("key", "idle", "busy"),
    [("disturbance", None, {"settle": 20.0}), ("encoder", False, True)],
)
def test_keys_of_before_that_did_nothing_are_dropped(
    tmp_path: Path, key: str, idle: object, busy: object
) -> None:
    saved = spec()
    save_model(tmp_path / "baseline", saved, saved.build())
    file = tmp_path / "baseline" / "model.json"
    content = json.loads(file.read_text())
    content[key] = idle
    # one without a sum of its own is older still
    del content["description_sha256"]
    file.write_text(json.dumps(content))
    assert load_model(tmp_path / "baseline")[0] == saved
    file.write_text(json.dumps(content | {key: busy}))
    with pytest.raises(ConfigError, match=key):
        load_model(tmp_path / "baseline")
