"""Given baselines: the accelerations of a plant, kept without its file, and published equations by
hand, in their units, as the document's study holds them.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from residnet.baselines.given_config import BelievedConfig, EquationsConfig
from residnet.core.config import load_config
from residnet.core.errors import ConfigError
from residnet.core.registry import find_vessel_files
from residnet.physics.signals_config import SignalsConfig
from residnet.physics.vessel import load_vessel
from residnet.tasks.fit.config import FitConfig

FORCES = ("u", "v", "r", "tau_x", "tau_y", "tau_n")
HULLS = ("milliampere", "odin_forces", "odin_jets", "wam_v_cal", "example_rudder_boat")
STUDIES = Path(__file__).parents[2] / "configs" / "studies" / "halvorsen2019"


def channels() -> torch.Tensor:
    z = np.random.default_rng(0).normal(size=(50, 6)) * [2, 0.5, 0.4, 500, 200, 300]
    return torch.from_numpy(z)


def assert_hull(baseline: Any, vessel: str) -> None:
    plant: Any = load_vessel(vessel).build()
    z = channels()
    torch.testing.assert_close(baseline(z), plant.hull(z[:, :3], z[:, 3:]), rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("name", HULLS)
def test_the_accelerations_of_the_plant(name: str) -> None:
    assert_hull(BelievedConfig(vessel=name).build(FORCES), name)


def test_the_factor_is_that_of_the_matrices() -> None:
    """As a vessel whose M, C and D are scaled; where no force acts the motion is the same."""
    half, whole = (
        BelievedConfig(vessel="milliampere", scale=scale).build(FORCES) for scale in (0.5, 1.0)
    )
    assert_hull(half, "milliampere_half")
    coasting = channels() * torch.tensor([1, 1, 1, 0, 0, 0], dtype=torch.float64)
    torch.testing.assert_close(half(coasting), whole(coasting), rtol=1e-12, atol=1e-13)


def test_a_resolved_config_needs_no_vessel_file(tmp_path: Path) -> None:
    copy = tmp_path / "mine.yaml"
    copy.write_text(find_vessel_files()["milliampere"].read_text())
    resolved = BelievedConfig(vessel=str(copy)).without_file_references()
    copy.unlink()
    written = resolved.model_dump_json()
    assert "mine.yaml" not in written
    assert_hull(BelievedConfig.model_validate_json(written).build(FORCES), "milliampere")


def test_forces_made_by_thrusters() -> None:
    """With thrusters the revolutions are the inputs; the channels of force follow from them."""
    signals = SignalsConfig(inputs=("n_port", "n_stbd"), forces="wam_v_cal").build()
    baseline = BelievedConfig(vessel="wam_v_cal").build(signals.names)
    plant = load_vessel("wam_v_cal").build()
    x, w = torch.randn(5, 6, dtype=torch.float64), torch.randn(5, 2, dtype=torch.float64) * 10
    full = torch.zeros(5, len(plant.input_names), dtype=torch.float64)
    rate = plant.derivative(torch.cat((x, w), dim=1), full)[:, 3:6]
    found = baseline(signals(x, signals.prepare(w)))
    torch.testing.assert_close(found, rate, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("vessel: milliampre", "did you mean 'milliampere'"),
        ("vessel: mariner", "kind 'abkowitz'.*fossen, mass_matrix or odin"),
        ("vessel: milliampere\nscale: 0", "scale"),
        ("vessel: {u: {w: 1.0}, v: {}, r: {}}", "no channel 'w'"),
        ("vessel: {u: {tau_x^-1: 1.0}, v: {}, r: {}}", "divides by a channel that may be zero"),
    ],
)
def test_wrong_configs_are_one_line(tmp_path: Path, content: str, message: str) -> None:
    file = tmp_path / "believed.yaml"
    file.write_text(content + "\n")
    with pytest.raises(ConfigError, match=message) as caught:
        load_config(file, [], BelievedConfig)
    assert "\n" not in str(caught.value)


def test_values_by_hand() -> None:
    """Document 000 eqs. (6.30) and (6.32), in the plain arithmetic of NumPy."""
    config = EquationsConfig(
        u={"v r": 1.0, "tau_x": 0.0002026, "u|u|": -0.049199, "u": -0.010100},
        r={"r|r|": -0.14220, "r": -0.06111, "tau_n": 4.780e-5, "v": -0.061123},
    )
    baseline = config.build(FORCES)
    u, v, r, tau_x, _, tau_n = channels().numpy().T
    surge = v * r + 0.0002026 * tau_x - 0.049199 * u * np.abs(u) - 0.0101 * u
    yaw = -0.1422 * r * np.abs(r) - 0.06111 * r + 4.78e-5 * tau_n - 0.061123 * v
    wanted = np.stack((surge, 0 * surge, yaw), axis=1)
    np.testing.assert_allclose(baseline(channels()), wanted, rtol=1e-11)
    assert baseline.parameter_counts() == [4, 0, 4]


JETS = ("u", "v", "r", "cmd_n", "cmd_nozzle")


def test_channels_in_other_units() -> None:
    """Revolutions in rpm, as document 000 eq. (7.2) has them, against channels in 1/s."""
    terms = {"cmd_n": 0.000856, "cmd_n^3 |cmd_n|": 9.536e-14, "u": -0.155, "cos(cmd_nozzle)": 0.1}
    z = torch.tensor([[2.0, 0.1, 0.05, 15.0, 0.2]], dtype=torch.float64)
    wanted = 0.000856 * 900 + 9.536e-14 * 900.0**4 - 0.31 + 0.1 * np.cos(0.2)
    found = EquationsConfig(u=terms, units={"cmd_n": "rpm"}).build(JETS)(z)
    assert float(found[0, 0]) == pytest.approx(wanted, rel=1e-12)


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (
            lambda: EquationsConfig(u={"cos(cmd_nozzle)": 1.0}, units={"cmd_nozzle": "deg"}),
            "needs cmd_nozzle in SI",
        ),
        (lambda: EquationsConfig(u={"u": 1.0}, units={"cmd_n": "m/s"}), r"units\.cmd_n"),
        (lambda: EquationsConfig(), "no axis has a term"),
        (lambda: EquationsConfig(r={"tau_z": 1.0}), "no channel 'tau_z'"),
        (lambda: BelievedConfig(vessel="milliampere"), "needs the channel 'tau_x'"),
    ],
)
def test_what_does_not_go_with_the_channels_is_said(build: Any, message: str) -> None:
    with pytest.raises((ConfigError, ValueError), match=message):
        build().build(JETS)


@pytest.mark.parametrize(
    ("file", "model", "counts"),
    [
        ("force_equations", "sea_trials", [14, 10, 11]),
        ("jet_equations", "sea_trials", [14, 8, 14]),
        ("force_equations", "input_1", [4, 4, 4]),
    ],
)
def test_terms_of_the_published_models(file: str, model: str, counts: list[int]) -> None:
    """Correction E9: (7.2) 14, (7.3) 8, (7.4) 14, (7.5) 14, (7.6) 10, (7.7) 11 terms."""
    config = load_config(STUDIES / f"{file}.yaml", [], FitConfig)
    assert config.baselines[model].build(config.signals.build().names).parameter_counts() == counts
