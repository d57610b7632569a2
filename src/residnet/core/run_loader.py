"""Check run folders from other people before anything in them is read.

A folder is read only if it holds regular files and folders (no symbolic links, devices or FIFOs),
each below the size limit of its kind, and if its manifest lists every file that is read, with the
SHA-256 that it has. A folder without a manifest is refused; `residnet trust RUN` accepts it.

Values inside of the files are checked where they are used. `JsonObject` and `JsonArray` remember
the last key that was read, so that `name_damaged_key` can say which file and key an error is about.
"""

from __future__ import annotations

import json
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Any

from residnet.core.errors import ResidnetError, UsageError
from residnet.core.ownership import (
    Manifest,
    find_run_manifest,
    read_regular_file,
    require_inside,
    sha256,
)

SIZE_LIMITS = {
    ".json": 256_000_000,
    ".yaml": 4_000_000,
    ".safetensors": 4_000_000_000,
    ".parquet": 8_000_000_000,
    ".png": 64_000_000,
}
"""Bytes of the largest file of each kind that is read from a run folder."""
UNREAD_FOLDERS = frozenset({"exports", "tensorboard", "checkpoints"})
"""Folders whose files no command reads back as a result."""
READ_FOLDERS = frozenset({"figures", "logs", "models", "rollouts"})
"""Folders in which files of these kinds are read under any name."""
READ_NAMES = frozenset(
    {
        "bands.json",
        "controllers.json",
        "excitation.json",
        "metrics.json",
        "model.json",
        "model.safetensors",
        "fit.json",
        "provenance.json",
        "resolved.yaml",
        "sanity.json",
        "summary.json",
    }
)
"""Files at the top of a run folder or model that are read; `RunFiles` checks the others itself."""
_MAX_ENTRIES = 1_000_000
"""Largest number of files and folders in a run folder. A run has far fewer; the limit bounds the
time that an untrusted folder can take.
"""
_MAX_DEPTH = 32
"""Largest depth of nested folders, for the same reason."""
_ACCEPT = "if you trust where it comes from, accept it as it is with: residnet trust"


def files_of_run(run: Path) -> Iterator[Path]:
    """Yield the regular files of a run folder, including nested runs.

    Raises:
        UsageError: if an entry is a symbolic link, a device, a FIFO or too large, or if there are
            too many.
    """
    count = 0
    folders = [(run, 0)]
    while folders:
        folder, depth = folders.pop()
        for entry in sorted(folder.iterdir()):
            count += 1
            if depth > _MAX_DEPTH or count > _MAX_ENTRIES:
                raise UsageError(f"{entry}: nested too deeply, or the folder has too many files")
            status = entry.lstat()
            if stat.S_ISDIR(status.st_mode):
                folders.append((entry, depth + 1))
            elif stat.S_ISREG(status.st_mode):
                limit = SIZE_LIMITS.get(entry.suffix)
                if limit is not None and status.st_size > limit:
                    raise UsageError(
                        f"{entry}: has {status.st_size / 1e6:.0f} MB, expected at most"
                        f" {limit / 1e6:.0f} MB; restore the folder or run it again"
                    )
                yield entry
            elif not (stat.S_ISLNK(status.st_mode) and entry.suffix == ".lock"):
                # the journal of a sweep is locked by a link, which nothing reads
                kind = "symbolic link" if stat.S_ISLNK(status.st_mode) else "device or FIFO"
                raise UsageError(
                    f"{entry}: is a {kind}; residnet reads only regular files of a run folder, so"
                    " replace it by the file itself or remove it"
                )


def require_trustworthy(run: Path) -> None:
    """Check the folder of a run or of a single model before anything in it is read.

    Raises:
        UsageError: if the manifest is missing, if an entry is no regular file or too large, or if a
            file that may be read is not listed, missing, incomplete, edited or from another run.
    """
    try:
        files = [*files_of_run(run)]
    except OSError as error:
        place = error.filename or run
        raise UsageError(f"{place}: cannot be read ({error.strerror})") from None
    manifest = Manifest(run)
    if not os.path.lexists(manifest.path) and not os.path.lexists(manifest.journal):
        raise UsageError(f"{run}: has no {manifest.path.name}; {_ACCEPT} {run}")
    recorded = manifest.read()
    manifest.verify(skipped={*UNREAD_FOLDERS, "report.html"})
    nested = {file.parent for file in files if file.name == manifest.path.name} - {run}
    for file in files:
        name = file.relative_to(run)
        in_folder = len(name.parts) > 1 and name.parts[0] in READ_FOLDERS and file.suffix != ".png"
        is_read = file.suffix in SIZE_LIMITS and (in_folder or str(name) in READ_NAMES)
        if file == manifest.path or not is_read or nested.intersection(file.parents):
            continue
        if name.as_posix() not in recorded:
            raise _unlisted(file, run)


def require_listed(run: Path, name: str) -> None:
    """Check that the manifest around a file of a run folder, if there is one, lists it.

    A model has a manifest of its own inside of its run.

    Raises:
        UsageError: if the manifest does not list it.
    """
    path = run / name
    manifest = find_run_manifest(path)
    if manifest is None or not manifest.folder.is_relative_to(run):
        # not a run folder: `require_trustworthy` has checked the manifest of a run
        return
    if path.relative_to(manifest.folder).as_posix() not in manifest.read():
        raise _unlisted(path, run)


def _unlisted(file: Path, run: Path) -> UsageError:
    return UsageError(f"{file}: is not listed in {Manifest(run).path.name}; {_ACCEPT} {run}")


def accept_run(run: Path) -> list[str]:
    """Rewrite the manifest of a run folder, so that its present contents are accepted.

    Returns:
        One line for each file that the manifest did not list, or listed with another SHA-256.

    Raises:
        UsageError: if there is no such folder, if an entry is no regular file or too large, or if
            the manifest cannot be written.
    """
    if not run.is_dir():
        raise UsageError(f"{run}: no such folder; give the folder of a run")
    files = [*files_of_run(run)]
    if not any(file.name in ("resolved.yaml", "model.json") for file in files):
        raise UsageError(f"{run}: neither the folder of a run nor that of a model")
    name = Manifest(run).path.name
    # the folder of a model has a manifest of its own, since a model may be copied out of its run
    nested = {file.parent for file in files if file.name in (name, "model.json")} - {run}
    lines = []
    for folder in (*sorted(nested, key=lambda path: -len(path.parts)), run):
        manifest = Manifest(folder)
        try:
            previous_digests = manifest.read()
        except UsageError:
            previous_digests = {}
        manifest.path.unlink(missing_ok=True)
        manifest.journal.unlink(missing_ok=True)
        manifest.start_recording()
        inner = {path for path in nested if path != folder and path.is_relative_to(folder)}
        for file in files:
            is_covered = file.is_relative_to(folder) and not inner.intersection(file.parents)
            is_manifest = file.name in (name, manifest.journal.name)
            if not is_covered or is_manifest or file.suffix not in SIZE_LIMITS:
                continue
            digest = sha256(file)
            manifest.record(file, digest)
            if digest not in previous_digests.get(file.relative_to(folder).as_posix(), ()):
                lines.append(f"{file}: {file.stat().st_size} bytes, SHA-256 {digest}")
        manifest.compact()
    return lines


# ------------------------------------------------------------------------------ JSON of a run

_last_key: ContextVar[tuple[Path, str] | None] = ContextVar("residnet_last_key", default=None)


class JsonObject(dict[str, Any]):
    """JSON object that records the key that was read last."""

    place: tuple[Path, str]

    def __getitem__(self, key: str) -> Any:
        _last_key.set((self.place[0], f"{self.place[1]}.{key}".lstrip(".")))
        return super().__getitem__(key)

    def get(self, key: str, default: Any = None) -> Any:
        _last_key.set((self.place[0], f"{self.place[1]}.{key}".lstrip(".")))
        return super().get(key, default)


class JsonArray(list[Any]):
    """JSON array that records the element that was read last."""

    place: tuple[Path, str]

    def __getitem__(self, index: Any) -> Any:
        _last_key.set((self.place[0], f"{self.place[1]}.{index}".lstrip(".")))
        return super().__getitem__(index)


def _tracked(value: Any, file: Path, key: str) -> Any:
    """Convert JSON values to objects and arrays that record their file and key."""
    if isinstance(value, dict):
        prefix = f"{key}." if key else ""
        tracked_object = JsonObject(
            (name, _tracked(part, file, f"{prefix}{name}")) for name, part in value.items()
        )
        tracked_object.place = (file, key)
        return tracked_object
    if isinstance(value, list):
        array = JsonArray(
            _tracked(part, file, f"{key}.{place}".lstrip(".")) for place, part in enumerate(value)
        )
        array.place = (file, key)
        return array
    return value


def read_json_value(path: Path, folder: Path | None = None) -> Any:
    """Read a JSON file of a run folder as objects that record their keys.

    Args:
        path: path of the file.
        folder: folder that no symbolic link may leave; None for the folder of the file.

    Raises:
        UsageError: if there is no such regular file, or it is too large or no JSON.
    """
    from residnet.core.run_shapes import require_shape

    require_inside(folder or path.parent, path)
    try:
        text = read_regular_file(path, SIZE_LIMITS[".json"]).decode("utf-8")
        _last_key.set((path, ""))
        content = json.loads(text)
    except FileNotFoundError:
        raise UsageError(f"{path}: no such file; is this the folder of a finished run?") from None
    except (OSError, ValueError, RecursionError) as error:
        raise UsageError(
            f"{path}: not readable as JSON ({error}); restore the file or run it again"
        ) from error
    require_shape(path, content)
    try:
        return _tracked(content, path, "")
    except RecursionError:
        raise UsageError(f"{path}: is nested too deeply; restore the file") from None


@contextmanager
def name_damaged_key(run: Path) -> Iterator[None]:
    """Turn an error about a value of a run folder into one line that names its file and key.

    Raises:
        UsageError: if anything but a `ResidnetError` or an error of the system is raised within.
    """
    token = _last_key.set(None)
    try:
        yield
    except (ResidnetError, OSError, MemoryError):
        raise
    except Exception as error:
        last = _last_key.get()
        if last is None:
            # no file of the folder was read, so that the error has another cause
            raise
        file, key = last
        first_line = next(iter(str(error).splitlines()), "")
        location = f"key '{key}'" if key else "its contents"
        raise UsageError(
            f"{file}: {location} cannot be used ({type(error).__name__}: {first_line[:200]});"
            f" restore the folder or run it again, and report it if {run} is as residnet wrote it"
        ) from error
    finally:
        _last_key.reset(token)
