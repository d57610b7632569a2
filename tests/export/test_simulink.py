"""S-functions of vessels, built and stepped by a harness of Simulink's interface."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from exported_models import built
from s_functions import SFunction

from residnet.dynamics.rollout import Rollout
from residnet.export import vessel
from residnet.export.vessel import ExportedVessel


def test_a_vessel_moves_as_the_model(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(vessel, "PARITY_STEPS", 60)
    spec, model = built("lstm_mirror")
    made = SFunction(ExportedVessel(spec, model), tmp_path)
    x0 = torch.tensor([[0.0, 0, 0, 1, 0, 0]], dtype=torch.float64)
    w = torch.tensor([20.0, 25.0, 3.0, 1.0], dtype=torch.float64).expand(1, 60, -1)
    model = model.double()
    with torch.no_grad():
        states, _, _ = Rollout(model)(x0, w, model.initial_state(1).double())
    dt, out = made.fly(w[0].numpy(), 7, x0)
    assert dt == spec.dt
    np.testing.assert_allclose(out[:, :6], states[0, :60].numpy(), rtol=1e-9, atol=1e-9)
    assert not out[:, 6].any()
    # far outside of what the training data hold
    _, out = made.fly(1e3 * w[0].numpy(), 7, x0)
    assert out[1:, 6].all()
    assert np.isfinite(out).all()
    assert made.fly(w[0].numpy(), 7)[0] == -1.0
