"""Weights and notes of what a run has trained, so that an interrupted run can go on."""

from __future__ import annotations

import json
from typing import Any

from torch import nn

from residnet.runs.folder import RunFolder


def store_weights(module: nn.Module, name: str, folder: RunFolder, notes: dict[str, Any]) -> None:
    """Write `models/<name>/weights.safetensors`, then `fit.json`."""
    from safetensors.torch import save_file

    place = folder.models / name
    place.mkdir(parents=True, exist_ok=True)
    save_file(
        {key: value.contiguous() for key, value in module.state_dict().items()},
        place / "weights.safetensors",
    )
    folder.write_json(place / "fit.json", notes)


def stored_weights(module: nn.Module, name: str, folder: RunFolder) -> dict[str, Any] | None:
    """Put the stored weights into a module and freeze it; returns the notes, or None where its
    training had not ended.
    """
    from safetensors.torch import load_file

    place = folder.models / name
    if not (place / "fit.json").is_file():
        return None
    module.load_state_dict(load_file(place / "weights.safetensors"))
    module.eval().requires_grad_(False)
    notes: dict[str, Any] = json.loads((place / "fit.json").read_text())
    return notes
