"""The SHA-256 of what a finished run holds, so that damage is seen before anything is believed.

Pictures, the page, exports, training logs and checkpoints are left out: nothing reads them back as
a result. A run within the folder, such as an evaluation, has checksums of its own.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

from residnet.core.errors import UsageError
from residnet.core.files import read_json, whole
from residnet.runs.provenance import sha256

FILE = "checksums.json"
SCHEMA = "residnet.checksums/1"
_SUMMARY = "summary.json"
_RESULTS = {".json", ".yaml", ".parquet", ".safetensors"}
_ELSEWHERE = {"figures", "exports", "tensorboard", "checkpoints"}


def seal(run: Path) -> None:
    """Write checksums.json: the SHA-256 of every result that stands in the folder."""
    sums = {file.relative_to(run).as_posix(): sha256(file) for file in _results(run, run)}
    with whole(run / FILE) as file:
        file.write_text(json.dumps({"schema": SCHEMA, "files": sums}, indent=1) + "\n")


def require_sealed(run: Path) -> None:
    """Check that the results of a finished run are those that it wrote.

    A run of an earlier version has no checksums, and is taken as it is.

    Raises:
        UsageError: where a file is missing, cut off, edited or from elsewhere.
    """
    if not (run / FILE).is_file():
        return
    sums = read_json(run / FILE).get("files")
    if not isinstance(sums, dict):
        raise UsageError(f"{run / FILE}: holds no checksums; restore the folder")
    for name, expected in sums.items():
        try:
            found = sha256(run / name)
        except (OSError, ValueError) as error:
            raise UsageError(
                f"{run / name}: cannot be read ({error}); restore the folder or run it again"
            ) from error
        if found != expected:
            raise UsageError(
                f"{run / name}: its SHA-256 is not the one in {FILE}, so it is cut off, edited or"
                " from elsewhere; restore the folder or run it again"
            )


def _results(folder: Path, run: Path) -> Iterator[Path]:
    for path in sorted(folder.iterdir()):
        if path.is_dir():
            if path.name not in _ELSEWHERE and not (path / _SUMMARY).is_file():
                yield from _results(path, run)
        elif path.suffix in _RESULTS and not (folder == run and path.name in (FILE, _SUMMARY)):
            yield path
