"""Published equations as baselines: their values by hand, their units, and what the document's
study holds.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from residnet.baselines.given import EquationsConfig
from residnet.core.config import load_config
from residnet.core.errors import ConfigError
from residnet.tasks.fit import FitConfig

FORCES = ("u", "v", "r", "tau_x", "tau_y", "tau_n")
STUDIES = Path(__file__).parents[2] / "configs" / "studies" / "halvorsen2019"


def test_values_by_hand() -> None:
    """Document 000 eqs. (6.30) and (6.32), in the plain arithmetic of NumPy."""
    config = EquationsConfig(
        u={"v r": 1.0, "tau_x": 0.0002026, "u|u|": -0.049199, "u": -0.010100},
        r={"r|r|": -0.14220, "r": -0.06111, "tau_n": 4.780e-5, "v": -0.061123},
    )
    z = np.random.default_rng(0).normal(size=(20, 6)) * [3, 1, 0.3, 3000, 900, 2000]
    u, v, r, tau_x, _, tau_n = z.T
    baseline = config.build(FORCES)
    out = baseline(torch.from_numpy(z)).numpy()
    np.testing.assert_allclose(
        out[:, 0], v * r + 0.0002026 * tau_x - 0.049199 * u * np.abs(u) - 0.0101 * u, rtol=1e-12
    )
    np.testing.assert_allclose(
        out[:, 2],
        -0.1422 * r * np.abs(r) - 0.06111 * r + 4.78e-5 * tau_n - 0.061123 * v,
        rtol=1e-12,
    )
    assert not out[:, 1].any()
    assert baseline.parameter_count() == [4, 0, 4]


def test_channels_in_other_units() -> None:
    """Revolutions in rpm, as document 000 eq. (7.2) has them, against channels in 1/s."""
    names = ("u", "v", "r", "cmd_n", "cmd_nozzle")
    config = EquationsConfig(
        u={"cmd_n": 0.000856, "cmd_n^3 |cmd_n|": 9.536e-14, "u": -0.155, "cos(cmd_nozzle)": 0.1},
        units={"cmd_n": "rpm"},
    )
    z = torch.tensor([[2.0, 0.1, 0.05, 15.0, 0.2]], dtype=torch.float64)
    rpm = 900.0
    wanted = 0.000856 * rpm + 9.536e-14 * rpm**4 - 0.31 + 0.1 * np.cos(0.2)
    assert float(config.build(names)(z)[0, 0]) == pytest.approx(wanted, rel=1e-12)
    with pytest.raises(ConfigError, match="needs cmd_nozzle in SI"):
        EquationsConfig(u={"cos(cmd_nozzle)": 1.0}, units={"cmd_nozzle": "deg"}).build(names)
    with pytest.raises(ValueError, match=r"units\.cmd_n"):
        EquationsConfig(u={"u": 1.0}, units={"cmd_n": "m/s"})
    with pytest.raises(ValueError, match="no axis has a term"):
        EquationsConfig()
    with pytest.raises(ConfigError, match="no channel 'tau_z'; did you mean"):
        EquationsConfig(r={"tau_z": 1.0}).build(FORCES)


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
    assert config.baselines[model].build(config.signals.build().names).parameter_count() == counts
