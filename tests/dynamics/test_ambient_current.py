"""A vessel carried by a current, against the same hull that feels the current through its velocity
relative to the water.
"""

from __future__ import annotations

import pytest
import torch

from residnet.control.heading.vessels import SteeredPlant
from residnet.core.frames import to_body
from residnet.dynamics.rollout import Rollout
from residnet.dynamics.simulated import InAmbientCurrent
from residnet.physics.vessel import load_vessel


def test_it_moves_over_ground_as_a_hull_in_the_current() -> None:
    """With little rudder: the other leaves out the current's part along the rolled vessel's
    vertical axis, of the roll angle's second order.
    """
    calm, felt = (
        SteeredPlant(load_vessel("patrol_p06").build()),
        SteeredPlant(load_vessel("patrol_p06").build(), calm=False),
    )
    current = torch.tensor([[0.7, -0.4], [0.0, 1.0]], dtype=torch.float64)
    nominal = torch.tensor([[1.0, 1.0, 0.0]], dtype=torch.float64).expand(2, -1)
    steps, rudder = 600, 0.01
    x, w = calm.start(torch.ones(2, dtype=torch.float64))
    w[:, 0] = rudder
    water, _, _ = Rollout(InAmbientCurrent(calm.model(0.1), calm.state))(
        x, w.unsqueeze(1).expand(-1, steps, -1), torch.cat((current, nominal), dim=1)
    )
    y, w = felt.start(torch.ones(2, dtype=torch.float64))
    w[:, 0] = rudder
    w[:, felt.inputs.index("current_north")], w[:, felt.inputs.index("current_east")] = current.T
    # over ground it begins with the current's speed on top
    carried = torch.stack(to_body(current[:, 0], current[:, 1], y[:, felt.column("psi")]), dim=1)
    y[:, [felt.column("u"), felt.column("v")]] += carried
    ground, _, _ = Rollout(felt.model(0.1))(y, w.unsqueeze(1).expand(-1, steps, -1), nominal)
    for name in ("x", "y", "psi", "r", "p"):
        assert water[:, -1, calm.column(name)].tolist() == pytest.approx(
            ground[:, -1, felt.column(name)].tolist(), rel=1e-4, abs=1e-6
        ), name
    assert float((water[:, -1, 0] - x[:, 0]).abs().min()) > 50.0
