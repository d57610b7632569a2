"""Golden runs as tables and tensors."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from torch import Tensor


@cache
def table(path: Path) -> pd.DataFrame:
    """All columns, float64."""
    names = pd.read_csv(path, nrows=0).columns
    # every digit counts: not pandas' fast parser
    return pd.DataFrame(np.loadtxt(path, delimiter=",", skiprows=1), columns=names)


def tensor(frame: pd.DataFrame, *columns: str) -> Tensor:
    """Columns [T, n], float64."""
    return torch.tensor(frame[list(columns)].to_numpy(), dtype=torch.float64)
