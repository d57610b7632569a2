"""Times as sources print them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pandas as pd

EPOCH = 1_700_000_000


def printed(ns: np.ndarray, style: str) -> np.ndarray:
    """Dates of ns since 1970, with fractions of a second as a source would print them."""
    seconds = ns // 10**9
    rest = ns % 10**9
    styles: dict[str, Callable[[int], str]] = {
        "padded": lambda k: f"{k:09d}",
        "unpadded": str,
        "trimmed": lambda k: f"{k:09d}".rstrip("0") or "0",
    }
    fraction = styles[style]
    return np.array(
        [
            f"{pd.Timestamp(int(s), unit='s'):%Y-%m-%d %H:%M:%S}.{fraction(int(k))}"
            for s, k in zip(seconds, rest, strict=True)
        ],
        dtype=object,
    )
