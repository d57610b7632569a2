"""The contract of export formats."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from pathlib import Path

import torch

from residnet.core.errors import UsageError
from residnet.export import ExportedVessel, Exporter
from residnet.testing.examples import example_models
from residnet.testing.require import require, require_equal


def check_exporter(exporter: Exporter) -> None:
    """Check everything that residnet relies on in an export format.

    It writes the file that it is given, in a folder that does not exist yet, returns a card, leaves
    the model's numbers as they are, and refuses with one line what it cannot hold.

    Args:
        exporter: the format.

    Raises:
        AssertionError: one line that says which contract is broken.
    """
    who = f"export format {exporter.name}"
    require(bool(exporter.about) and "\n" not in exporter.about, f"{who}: `about` is not one line")
    require(exporter.suffix.count(".") >= 1, f"{who}: the suffix {exporter.suffix!r} has no ending")
    for spec, model in example_models():
        before = {name: value.clone() for name, value in model.state_dict().items()}
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "exports" / f"{spec.name}{exporter.suffix}"
            try:
                card = exporter.export(ExportedVessel(spec, model), file)
            except UsageError as error:
                require("\n" not in str(error), f"{who}: refuses a model in more than one line")
                require(not file.exists(), f"{who}: leaves a file of a model that it refuses")
                continue
            require(file.exists(), f"{who}: writes no {file.name}")
            require(isinstance(card, Mapping) and bool(card), f"{who}: returns no card")
            left = [path.name for path in file.parent.iterdir() if path.name.endswith(".partial")]
            require(not left, f"{who}: leaves {', '.join(left)} behind")
        for name, value in model.state_dict().items():
            wanted = before[name].to(torch.float64)
            message = f"{who}: changes '{name}' of the model"
            require_equal(value.to(torch.float64), wanted, 1e-6, message)
