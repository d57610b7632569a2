"""A shipped vessel whose parameters are scattered at random."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml


def scattered(
    name: str,
    random: np.random.Generator,
    folder: Path,
    sections: Sequence[str] = ("added_mass", "damping"),
) -> Path:
    """Write a vessel's file with parameters of some sections scattered by about a fifth."""
    vessels = Path(__file__).resolve().parents[2] / "configs" / "vessels"
    content = yaml.safe_load((vessels / f"{name}.yaml").read_text(encoding="utf-8"))

    def moved(part: Any) -> Any:
        if isinstance(part, dict):
            return {key: value if key in _WORDS else moved(value) for key, value in part.items()}
        return float(part * np.exp(0.2 * random.standard_normal()))

    for section in sections:
        content[section] = moved(content[section])
    content["name"] = "scattered"
    path = folder / "scattered.yaml"
    path.write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")
    return path


_WORDS = ("unit", "source")
