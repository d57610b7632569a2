"""Golden runs as tables and tensors."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from torch import Tensor

from residnet.physics.plant import Hull


@cache
def table(path: Path) -> pd.DataFrame:
    """All columns, float64."""
    names = pd.read_csv(path, nrows=0).columns
    # every digit counts: not pandas' fast parser
    return pd.DataFrame(np.loadtxt(path, delimiter=",", skiprows=1), columns=names)


def over_its_length(test: Callable[..., None]) -> Callable[..., None]:
    """Run a test over the first 20 s of a run, and over all of it among the long ones."""
    whole = pytest.param(np.inf, marks=pytest.mark.long, id="whole")
    return pytest.mark.parametrize("seconds", [pytest.param(20.0, id="20s"), whole])(test)


Row = tuple[str, np.ndarray, np.ndarray, np.ndarray]
"""What a comparison is called, what is found, the truth, and by how much they may differ."""


def accelerations(hull: Hull, nu: Tensor, tau: Tensor, frame: pd.DataFrame) -> Row:
    """The right-hand side of a hull row by row: no more exact than its largest term."""
    parts = (hull.terms(nu).abs() @ hull.coefficients.abs() + tau.abs()) @ hull.inverse.abs().T
    truth = frame[["du", "dv", "dr"]].to_numpy()
    allowed = 1e-12 * np.maximum(parts.numpy(), np.abs(truth))
    return "accelerations", hull(nu, tau).numpy(), truth, allowed


def tensor(frame: pd.DataFrame, *columns: str) -> Tensor:
    """Columns [T, n], float64."""
    return torch.tensor(frame[list(columns)].to_numpy(), dtype=torch.float64)
