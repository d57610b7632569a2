"""An export format: the parameters of a model as one table of text, one number a line."""

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
    """Every number of a model, as `name,index,value` lines."""

    name: ClassVar[str] = "numbers"
    suffix: ClassVar[str] = ".csv"
    about: ClassVar[str] = "every number of a model as a table of text (sample package)"

    def export(self, exported: Exportable, file: Path) -> Mapping[str, Any]:
        """Write the table, read it back, and return how many numbers it holds."""
        if not isinstance(exported, ExportedVessel):
            raise UsageError(f"{exported.label}: only the numbers of vessel models are written")
        numbers = [
            (f"{name},{index}", float(value))
            for name, tensor in exported.model.state_dict().items()
            for index, value in enumerate(tensor.reshape(-1).tolist())
        ]
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text("".join(f"{name},{value!r}\n" for name, value in numbers))
        back = [float(line.rsplit(",", 1)[1]) for line in file.read_text().splitlines()]
        if not np.array_equal(back, [value for _, value in numbers], equal_nan=True):
            raise ExportError(f"{file}: the table does not give the model's numbers back")
        return {"model": exported.name, "numbers": len(numbers)}
