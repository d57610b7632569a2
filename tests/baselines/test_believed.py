"""The given hull as a baseline: the accelerations of the plant, kept without its file, and
exported.
"""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from residnet.baselines.given import BelievedConfig
from residnet.core.config import load_config
from residnet.core.errors import ConfigError
from residnet.dynamics.store import ModelSpec, load_model, save_model
from residnet.physics.plant import HullPlant
from residnet.physics.signals import SignalsConfig
from residnet.physics.vessel import load_vessel, vessel_files

NAMES = ("u", "v", "r", "tau_x", "tau_y", "tau_n")
HULLS = ("milliampere", "odin_forces", "odin_jets", "wam_v_cal", "example_rudder_boat")


def channels(seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(50, 6, dtype=torch.float64, generator=generator) * torch.tensor(
        [2, 0.5, 0.4, 500, 200, 300], dtype=torch.float64
    )


def believed(**changes: object) -> ModelSpec:
    fields: dict[str, object] = {"kind": "believed", "vessel": "milliampere", "scale": 0.5}
    content = {
        "schema": "residnet.model/1", "name": "baseline", "role": "baseline",
        "signals": SignalsConfig(inputs=NAMES[3:]).model_dump(),
        "baseline": BelievedConfig.model_validate(fields | changes).resolved().model_dump(),
        "dt": 0.1, "integrator": "rk4",
        "low": [-1.0, -0.5, -0.3, -100, -50, -80], "high": [2.0, 0.5, 0.3, 300, 50, 80],
    }  # fmt: skip
    return ModelSpec.model_validate(content)


@pytest.mark.parametrize("name", HULLS)
def test_the_accelerations_of_the_plant(name: str) -> None:
    plant, z = load_vessel(name).build(), channels()
    assert isinstance(plant, HullPlant)
    baseline = BelievedConfig(vessel=name).build(NAMES)
    torch.testing.assert_close(baseline(z), plant.hull(z[:, :3], z[:, 3:]), rtol=1e-12, atol=1e-13)


def test_the_factor_is_that_of_the_matrices() -> None:
    """As a vessel whose M, C and D are scaled; where no force acts the motion is the same."""
    z = channels()
    half = load_vessel("milliampere_half").build()
    assert isinstance(half, HullPlant)
    baseline = BelievedConfig(vessel="milliampere", scale=0.5).build(NAMES)
    torch.testing.assert_close(baseline(z), half.hull(z[:, :3], z[:, 3:]), rtol=1e-12, atol=1e-13)
    coasting = z * torch.tensor([1, 1, 1, 0, 0, 0], dtype=torch.float64)
    torch.testing.assert_close(
        baseline(coasting),
        BelievedConfig(vessel="milliampere").build(NAMES)(coasting),
        rtol=1e-12,
        atol=1e-13,
    )


def test_a_stored_model_needs_no_vessel_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    copy = tmp_path / "mine.yaml"
    copy.write_text(vessel_files()["milliampere"].read_text())
    spec = believed(vessel=str(copy))
    before = spec.build()
    save_model(tmp_path / "m", spec, before)
    copy.unlink()
    assert "mine.yaml" not in (tmp_path / "m" / "model.json").read_text()
    loaded, after = load_model(tmp_path / "m")
    assert loaded == spec
    x, w = torch.randn(4, 6, dtype=torch.float64), torch.randn(4, 3, dtype=torch.float64) * 100
    assert torch.equal(after.step(x, w, x[:, :0])[0], before.step(x, w, x[:, :0])[0])


def test_forces_made_by_thrusters() -> None:
    """With thrusters the revolutions are the inputs; the channels of force follow from them."""
    signals = SignalsConfig(inputs=("n_port", "n_stbd"), forces="wam_v_cal").build()
    baseline, plant = (
        BelievedConfig(vessel="wam_v_cal").build(signals.names),
        load_vessel("wam_v_cal").build(),
    )
    x, w = torch.randn(5, 6, dtype=torch.float64), torch.randn(5, 2, dtype=torch.float64) * 10
    full = torch.zeros(5, len(plant.inputs), dtype=torch.float64)
    rate = plant.rate(torch.cat((x, w), dim=1), full)[:, 3:6]
    torch.testing.assert_close(
        baseline(signals(x, signals.prepare(w))), rate, rtol=1e-12, atol=1e-12
    )


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("vessel: milliampre", "did you mean 'milliampere'"),
        ("vessel: mariner", "kind 'abkowitz'.*fossen, mass_matrix or odin"),
        ("vessel: milliampere\nscale: 0", "scale"),
        ("vessel: {u: {w: 1.0}, v: {}, r: {}}", "no channel 'w'"),
        ("vessel: {u: {tau_x^-1: 1.0}, v: {}, r: {}}", "divides by what may be zero"),
    ],
)
def test_wrong_configs(tmp_path: Path, content: str, message: str) -> None:
    file = tmp_path / "believed.yaml"
    file.write_text(content + "\n")
    with pytest.raises(ConfigError, match=message) as caught:
        load_config(file, [], BelievedConfig)
    assert "\n" not in str(caught.value)


def test_the_force_channels_must_be_there() -> None:
    with pytest.raises(ConfigError, match="needs the channel 'tau_y'"):
        BelievedConfig(vessel="milliampere").build(("u", "v", "r", "tau_x", "tau_n"))
