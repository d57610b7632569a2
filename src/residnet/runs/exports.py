"""The last work of a run: models for controllers, each of which may fail without the others."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple

from residnet.core.errors import ResidnetError
from residnet.report.page import EXPORTS
from residnet.runs.folder import RunFolder

Exports = Mapping[str, Callable[[], Path]]
"""What writes each export and returns its file, by the name of the model."""


class Exported(NamedTuple):
    """What came of the exports of a run.

    Attributes:
        files: that were written.
        faults: one line for each export that failed.
    """

    files: tuple[Path, ...] = ()
    faults: tuple[str, ...] = ()


def write_exports(folder: RunFolder, exports: Exports) -> Exported:
    """Write all exports, and exports.json, which says what came of each.

    A model that cannot be exported does not keep the others, or the run, from coming to their end.
    """
    files, faults, rows = [], [], []
    for name, write in exports.items():
        try:
            file = write()
        except ResidnetError as error:
            faults.append(str(error))
            rows.append({"model": name, "file": None, "fault": str(error)})
        else:
            files.append(file)
            place = file.relative_to(folder.path) if file.is_relative_to(folder.path) else file
            rows.append({"model": name, "file": place.as_posix(), "fault": None})
    folder.write_json(folder.path / EXPORTS, {"schema": "residnet.exports/1", "exports": rows})
    return Exported(tuple(files), tuple(faults))
