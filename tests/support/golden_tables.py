"""Golden runs as tables and tensors, what their names say, and how residnet flies them."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
from torch import Tensor

from residnet.dynamics.base import Dynamics
from residnet.engine.rollout import Rollout, Source
from residnet.physics.plant import Hull


def name_of(path: Path) -> str:
    """What a file's set-up is told by."""
    return path.name.removesuffix(".csv.gz")


def made_by(path: Path, part: str, makers: Mapping[str, Callable[..., Any]], what: str) -> Any:
    """What the first pattern that matches a part of a name makes of its groups."""
    for pattern, make in makers.items():
        if match := re.fullmatch(pattern, part):
            return make(*match.groups())
    raise AssertionError(f"{name_of(path)}: no {what} is written {part}")


def beside(folder: Path, alike: Callable[[Path], bool]) -> tuple[list[Path], float]:
    """The files that are flown side by side, and the end of the longest, s."""
    files = [path for path in sorted(folder.glob("*.csv.gz")) if alike(path)]
    return files, max(float(table(path)["t"].iloc[-1]) for path in files)


def run(model: Dynamics, x0: Tensor, w: Tensor, source: Source | None = None) -> list[Tensor]:
    """States [B, T + 1, nx] and inputs [B, T, m] of free runs without a memory."""
    with torch.no_grad():
        states, inputs, _ = (Rollout(model, source) if source else Rollout(model))(x0, w, x0[:, :0])
    return [states, inputs]


@cache
def table(path: Path) -> pd.DataFrame:
    """All columns, float64."""
    names = pd.read_csv(path, nrows=0).columns
    # every digit counts: not pandas' fast parser
    return pd.DataFrame(np.loadtxt(path, delimiter=",", skiprows=1), columns=names)


def over_its_length(test: Callable[..., None]) -> Callable[..., None]:
    """Run a test over the first 10 s of a run, and over all of it among the long ones."""
    whole = pytest.param(np.inf, marks=pytest.mark.long, id="whole")
    return pytest.mark.parametrize("seconds", [pytest.param(10.0, id="10s"), whole])(test)


Row = tuple[str, np.ndarray, np.ndarray, np.ndarray]
"""What a comparison is called, what is found, the truth, and by how much they may differ."""


def accelerations(hull: Hull, nu: Tensor, tau: Tensor, frame: pd.DataFrame) -> Row:
    """The right-hand side of a hull row by row: no more exact than its largest term."""
    forces = hull.terms(nu).abs() @ hull.coefficients.abs() + tau.abs()
    parts = forces @ hull.inverse_mass.abs().T
    truth = frame[["du", "dv", "dr"]].to_numpy()
    allowed = rounding_bound(
        parts.numpy(), truth, forces.amax() * hull.inverse_mass.abs().sum(dim=1)
    )
    return "accelerations", hull(nu, tau).numpy(), truth, allowed


def rounding_bound(
    parts: np.ndarray, truth: np.ndarray, column_scale: np.ndarray | Tensor | float
) -> np.ndarray:
    """The largest difference that rounding explains, in each row and column.

    A share of 1e-12 of the largest part of the sum vanishes where all parts do, for example the yaw
    moment of two equal thrusters. Whether their difference is exactly zero or one unit in the last
    place of a thrust depends on the processor (fused multiply-add), hence an absolute floor of four
    such units.

    Args:
        parts: magnitudes of the parts of each sum [T, n].
        truth: the sums of the reference implementation [T, n].
        column_scale: largest magnitude that terms of a column have in the run before they cancel,
            one number or [n].
    """
    floor = 4.0 * np.finfo(np.float64).eps * np.asarray(column_scale)
    bound: np.ndarray = np.maximum(1e-12 * np.maximum(parts, np.abs(truth)), floor)
    return bound


def tensor(frame: pd.DataFrame, *columns: str) -> Tensor:
    """Columns [T, n], float64."""
    return torch.tensor(frame[list(columns)].to_numpy(), dtype=torch.float64)
