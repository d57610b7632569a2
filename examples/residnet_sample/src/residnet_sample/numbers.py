"""An export format: the parameters of a model as a text table with one value per line."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar, final

import numpy as np

from residnet.core.errors import ExportError, UsageError
from residnet.export.base import Exportable, Exporter
from residnet.export.vessel import ExportedVessel


@final
class NumbersExporter(Exporter):
    """Exports the state of a model as lines `name,index,value`."""

    name: ClassVar[str] = "numbers"
    suffix: ClassVar[str] = ".csv"
    about: ClassVar[str] = "the state of a model as a text table (sample package)"

    def export(self, exported: Exportable, file: Path) -> Mapping[str, Any]:
        """Write the table, verify it, and return the number of values."""
        if not isinstance(exported, ExportedVessel):
            raise UsageError(
                f"{exported.label}: format numbers supports vessel models only; use another format"
            )
        numbers = [
            (f"{name},{index}", float(value))
            for name, tensor in exported.model.state_dict().items()
            for index, value in enumerate(tensor.reshape(-1).tolist())
        ]
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text("".join(f"{name},{value!r}\n" for name, value in numbers))
        written_values = [float(line.rsplit(",", 1)[1]) for line in file.read_text().splitlines()]
        if not np.array_equal(written_values, [value for _, value in numbers], equal_nan=True):
            raise ExportError(f"{file}: the written table differs from the model; export it again")
        return {"model": exported.name, "numbers": len(numbers)}
