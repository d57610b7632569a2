"""Import of a large csv table through a channel map, beside plain pandas.read_csv of the same file,
in one process.

python scripts/bench/readers.py [ROWS] [CHANNELS]
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd

from residnet.core.config import validate
from residnet.data.readers import ReaderConfig

NAMES = ("x", "y", "psi", "u", "v", "r", "delta", "n", "wind_speed", "wind_dir", "tau_x", "tau_y")
UNITS = ("m", "m", "deg", "kn", "m/s", "deg/s", "deg", "rpm", "m/s", "deg", "N", "N")


def written(path: Path, rows: int, channels: int) -> None:
    """A table of a time column and `channels` channels, ten digits per cell."""
    rng = np.random.default_rng(0)
    columns = {"t": 0.1 * np.arange(rows)}
    columns |= {name: np.cumsum(rng.normal(scale=1e-3, size=rows)) for name in NAMES[:channels]}
    pd.DataFrame(columns).to_csv(path, index=False, float_format="%.9f")


def shortest(call: Callable[[], object], repeats: int = 3) -> float:
    """Least time of a call in s."""
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        call()
        times.append(time.perf_counter() - start)
    return min(times)


def main() -> None:
    """Print both times and their ratio."""
    rows, channels = (
        int(sys.argv[1]) if len(sys.argv) > 1 else 1_000_000,
        (int(sys.argv[2]) if len(sys.argv) > 2 else 12),
    )
    config = {
        "kind": "csv",
        "time": {"column": "t"},
        "channels": {
            n: {"column": n, "unit": u} for n, u in zip(NAMES[:channels], UNITS, strict=False)
        },
    }
    reader = validate(config, ReaderConfig, "benchmark").build()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "table.csv"
        written(path, rows, channels)
        plain = shortest(lambda: pd.read_csv(path))
        ours = shortest(lambda: reader.read(path))
    print(
        f"{rows} rows x {channels} channels: pandas.read_csv {plain:.2f} s, import to a canonical"
        f" log {ours:.2f} s, ratio {ours / plain:.2f}"
    )


if __name__ == "__main__":
    main()
