"""The file bands.json: the bands of a fit by model and protocol."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from residnet.judge.bands.band import Band, Bands

SCHEMA = "residnet.bands/1"


def bands_content(run: str, bands: Bands) -> dict[str, Any]:
    """Return the contents of bands.json.

    Args:
        run: name of the run.
        bands: by model and protocol; models without any are left out.
    """
    return {
        "schema": SCHEMA,
        "run": run,
        "models": {
            model: {protocol: band.content() for protocol, band in known.items()}
            for model, known in bands.items()
            if known
        },
    }


def read_bands(content: Mapping[str, Any]) -> dict[str, dict[str, Band]]:
    """Return the bands by model and protocol from the contents of bands.json; none where empty."""
    return {
        model: {protocol: Band.read(band) for protocol, band in known.items()}
        for model, known in content.get("models", {}).items()
    }
