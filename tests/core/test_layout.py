"""Columns, functions and names of the planar model say the same, compiled or not."""

from __future__ import annotations

import torch

from residnet.core import columns, layout
from residnet.core.names import POSE, STATE, VELOCITY

X = torch.arange(16.0).reshape(2, 8)


def test_columns_are_those_of_the_names() -> None:
    assert layout.PLANAR.names == STATE
    assert layout.PLANAR.dof == 3
    assert STATE[layout.POSE] == POSE
    assert STATE[layout.VELOCITIES] == VELOCITY
    assert STATE[layout.POSITION] == ("x", "y")
    assert STATE[layout.LATERAL] == ("v", "r")
    places = (layout.HEADING, layout.SURGE, layout.SWAY, layout.YAW_RATE)
    assert tuple(STATE[place] for place in places) == ("psi", "u", "v", "r")


def test_functions_take_the_same_columns() -> None:
    for function, part in (
        (columns.pose, layout.POSE),
        (columns.velocities, layout.VELOCITIES),
        (columns.motion, layout.MOTION),
        (columns.actuators, layout.ACTUATORS),
    ):
        assert torch.equal(function(X), X[:, part])
        assert torch.equal(torch.jit.script(function)(X), X[:, part])
    assert torch.equal(columns.zero_acceleration(X), torch.zeros(2, layout.PLANAR.dof))


def test_other_degrees_of_freedom() -> None:
    rolling = layout.StateLayout(("x", "y", "psi", "phi"), ("u", "v", "r", "p"))
    assert rolling.names[rolling.velocity_columns] == ("u", "v", "r", "p")
    assert rolling.dof == 4
    surging = layout.StateLayout(("x",), ("u",))
    assert surging.names == ("x", "u")
