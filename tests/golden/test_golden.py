"""Vessels and controllers against golden runs of another implementation (golden/README.md).

A group of files has a module in `support`, named by its folder, which reads the set-up from a
file's name, so that further files need no new code.
"""

from __future__ import annotations

import importlib
import os
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
from golden_tables import accelerations, name_of, over_its_length, rounding_bound, table
from kinds import of_kind

from residnet.physics.plant import HullPlant
from residnet.physics.vessel import load_vessel

GROUPS = ("g1_4dof", "g2_odin", "g3_milliampere", "g4_wamv", "g5_nomoto")


def set_up(group: str) -> Any:
    return importlib.import_module(f"golden_{group}")


def files(part: str) -> list[Any]:
    """The files of all groups that have a function of this name."""
    folder = Path(os.environ.get("RESIDNET_GOLDEN", "/nowhere"))
    found = [
        path
        for group in GROUPS
        if hasattr(set_up(group), part)
        for path in sorted((folder / group).glob("*.csv.gz"))
    ]
    absent = pytest.mark.skip(reason="set RESIDNET_GOLDEN to the folder that holds golden runs")
    return [pytest.param(path, id=f"{path.parent.name}-{name_of(path)}") for path in found] or [
        pytest.param(None, marks=absent)
    ]


@over_its_length
@pytest.mark.parametrize("path", files("flown"))
def test_trajectory(path: Path, seconds: float) -> None:
    """Every channel to 1e-6 of its range, unless its group says why not."""
    frame = table(path)
    group = set_up(path.parent.name)
    frame = frame[frame["t"] <= seconds + 1e-9]
    channels = group.flown(path, seconds)
    step = channels.pop("step")
    np.testing.assert_allclose(frame["t"], step * np.arange(len(frame)), atol=1e-9)
    for name, values in channels.items():
        truth = frame[name].to_numpy()
        allowed = 1e-6 * np.ptp(truth) + 1e-12
        if hasattr(group, "allowed"):
            allowed = group.allowed(path, name, frame, allowed)
        apart = np.abs(np.asarray(values)[: len(frame)] - truth).max()
        assert apart <= allowed, f"{name} differs by {apart:.3g} (allowed {allowed:.3g})"


@pytest.mark.parametrize("path", files("by_row"))
def test_rows(path: Path) -> None:
    """What each row says of itself: as exact as the largest part of a sum."""
    for name, found, truth, allowed in set_up(path.parent.name).by_row(path, table(path)):
        assert found.shape == truth.shape
        assert (np.abs(found - truth) <= allowed).all(), name


def test_the_rounding_bound_has_a_floor_where_terms_cancel_exactly() -> None:
    """A column of zeros: 1e-17 of a thrust is rounding there, 1e-14 of it is a fault."""
    parts = np.array([[200.0, 0.0], [150.0, 0.0]])
    truth = np.zeros((2, 2))
    thrust = 200.0
    bound = rounding_bound(parts, truth, thrust)
    assert (1e-17 * thrust < bound[:, 1]).all()
    assert (bound[:, 1] < 1e-14 * thrust).all()
    # beside large parts the floor changes nothing
    np.testing.assert_array_equal(bound[:, 0], 1e-12 * parts[:, 0])


def test_accelerations_agree_where_symmetric_thrust_leaves_one_unit_in_the_last_place() -> None:
    """Golden runs straight ahead: the moment of two thrusters is exactly zero or one rounding."""
    hull = of_kind(load_vessel("wam_v_cal").build(), HullPlant).hull
    nu = torch.tensor([[1.0, 0.0, 0.0]], dtype=torch.float64)
    tau = torch.tensor([[100.0, 0.0, 0.0]], dtype=torch.float64)
    values = hull(nu, tau).numpy()
    frame = pd.DataFrame(values, columns=["du", "dv", "dr"])
    for moment, agrees in ((2e-14, True), (1e-10, False)):
        tau[0, 2] = moment
        _, found, truth, allowed = accelerations(hull, nu, tau, frame)
        assert (np.abs(found - truth) <= allowed).all() == agrees


@pytest.mark.parametrize("group", GROUPS)
def test_names_of_further_files_are_understood(group: str) -> None:
    """Files are kept back for acceptance: names of the same pattern give the set-ups that
    golden/README.md describes.
    """
    module = set_up(group)
    for name, wanted in module.FURTHER.items():
        case = module.case_of(Path(f"{name}.csv.gz"))
        assert getattr(module, "described", lambda case: case)(case) == wanted, name
    if hasattr(module, "check_inputs"):
        module.check_inputs()
    for name in module.UNKNOWN:
        with pytest.raises(AssertionError, match=r"no (run|inputs|parameter set|manoeuvre)"):
            module.case_of(Path(f"{name}.csv.gz"))
