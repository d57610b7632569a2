"""Atomic file writing, reading of JSON and Parquet, and the configs shipped with residnet."""

from __future__ import annotations

import errno
import hashlib
import os
import re
import secrets
import shutil
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import residnet
from residnet.core.errors import ResidnetError, UsageError
from residnet.core.ownership import (
    FILE_MANIFEST,
    Manifest,
    find_manifest,
    find_run_manifest,
    require_regular,
    require_replaceable,
)
from residnet.core.ownership import sha256 as sha256
from residnet.core.run_loader import SIZE_LIMITS, read_json_value

if TYPE_CHECKING:
    import pandas as pd

_MIN_FREE_BYTES = 20_000_000
"""Bytes that must be free before a run."""
_PROBE_BYTES = 65_536
"""Bytes of a trial write: several disk blocks, because quotas count blocks."""
_PATH_MARGIN_BYTES = 300
"""Bytes reserved for the names of folders and files inside of a run folder."""


@contextmanager
def atomic_write(path: Path, manifest: Manifest | None = None) -> Iterator[Path]:
    """Yield a temporary path that replaces `path` at the end of the context.

    A process that is killed in between leaves the old file, or none. The folder is created. In a
    run folder, or with a manifest, the file is recorded, and only a file of residnet is replaced.

    Args:
        path: path of the file.
        manifest: manifest that records the file; None uses the one of the surrounding run folder.

    Raises:
        UsageError: if the file cannot be written, or is not owned by residnet.
    """
    manifest = manifest or find_run_manifest(path)
    # a random name, which no file of the user has
    temporary_path = path.with_name(f"{path.name}.{secrets.token_hex(4)}.partial")
    try:
        if manifest is not None:
            manifest.require_replaceable(path)
            manifest.record(temporary_path, None)
        path.parent.mkdir(parents=True, exist_ok=True)
        yield temporary_path
        if manifest is not None:
            manifest.record(path, sha256(temporary_path))
        temporary_path.replace(path)
    except BaseException as error:
        # if the folder is not writable, the error in progress reports it
        with suppress(OSError):
            temporary_path.unlink(missing_ok=True)
        if isinstance(error, OSError):
            raise write_error(path, error) from error
        raise


@contextmanager
def write_owned(path: Path) -> Iterator[Path]:
    """Yield a temporary path like `atomic_write`, for a file outside or inside of run folders.

    The file is recorded in the manifest of its run folder, or else of its own folder. It replaces
    only a file that residnet wrote and nobody edited.

    Raises:
        UsageError: if the file cannot be written, or is not owned by residnet.
    """
    manifest = find_manifest(path)
    with atomic_write(path, manifest) as temporary_path:
        yield temporary_path
    if manifest.path.name == FILE_MANIFEST:
        manifest.compact()


@contextmanager
def stage_files(file: Path, inputs: Iterable[Path] = ()) -> Iterator[Path]:
    """Yield a path with the same name in a temporary folder, for a writer of several files.

    At the end of the context all files of the temporary folder are moved to the folder of `file`,
    or none of them if one would replace a file that is not owned.

    Args:
        file: main file of the writer.
        inputs: files that the writer reads; they are copied into the temporary folder.

    Raises:
        UsageError: if a file is the user's or was edited, or cannot be written.
    """
    require_replaceable(file)
    with tempfile.TemporaryDirectory(prefix="residnet-") as name:
        staging = Path(name)
        copies = {Path(shutil.copy(path, staging)) for path in inputs}
        try:
            yield staging / file.name
        except ResidnetError as error:
            # the message names the folder of the user instead of the temporary one
            message = str(error).replace(str(staging), str(file.parent))
            raise type(error)(message) from error
        staged_files = (path for path in sorted(staging.rglob("*")) if path.is_file())
        sources = [path for path in staged_files if path not in copies]
        targets = [file.parent / path.relative_to(staging) for path in sources]
        for target in targets:
            require_replaceable(target)
        for source, target in zip(sources, targets, strict=True):
            with write_owned(target) as temporary_path:
                shutil.copyfile(source, temporary_path)


_UNSAFE_CHARACTERS = re.compile(r'[\x00-\x1f\x7f/\\:*?"<>|\ud800-\udfff]+')
_MAX_NAME_BYTES = 200
"""Largest length of a file name without suffix in bytes; file systems allow 255."""


def make_file_stem(name: str) -> str:
    """Convert the name of a log, a manoeuvre or a figure to a safe file stem.

    Characters that file systems reject or that separate folders become `_`. A changed name ends in
    a part of its hash, so that different names give different stems.
    """
    encoded_name = _UNSAFE_CHARACTERS.sub("_", name).lstrip(".").encode("utf-8")
    safe_name = encoded_name[:_MAX_NAME_BYTES].decode("utf-8", "ignore") or "_"
    if safe_name == name:
        return name
    return f"{safe_name}_{hashlib.sha256(name.encode('utf-8', 'surrogatepass')).hexdigest()[:8]}"


def read_json(path: Path) -> dict[str, Any]:
    """Read the JSON object in a file.

    Raises:
        UsageError: if the file is missing or does not contain a JSON object.
    """
    content = read_json_value(path)
    if not isinstance(content, dict):
        raise UsageError(
            f"{path}: expected a JSON object, found {_json_kind(content)}; restore the file or"
            " run it again"
        )
    return content


def _json_kind(value: Any) -> str:
    """Return the name of a JSON value's type for a message."""
    return "list" if isinstance(value, list) else type(value).__name__


def read_table(path: Path) -> pd.DataFrame:
    """Read the table in a Parquet file.

    Raises:
        UsageError: if the file is missing, truncated or not a Parquet file.
    """
    import pandas as pd
    import pyarrow as pa

    try:
        require_regular(path, SIZE_LIMITS[".parquet"])
        return pd.read_parquet(path)
    except (OSError, ValueError, TypeError, KeyError, pa.ArrowException) as error:
        first_line = next(iter(str(error).splitlines()), "")
        raise UsageError(
            f"{path}: not readable as Parquet ({first_line}); restore the file or run it again"
        ) from error


def require_free_space(folder: Path) -> None:
    """Check that a folder, existing or not, is writable and has enough free space for a run.

    Permissions, quotas and limits are tested by a trial write.

    Raises:
        UsageError: if it is not writable, its name is too long, or less than 20 MB are free.
    """
    try:
        existing_parent = next(
            candidate for candidate in (folder, *folder.absolute().parents) if candidate.exists()
        )
        if not existing_parent.is_dir():
            raise UsageError(
                f"{existing_parent}: exists and is not a folder; choose another folder"
            )
        path = folder.absolute()
        max_path_length = os.pathconf(existing_parent, "PC_PATH_MAX")
        if len(os.fsencode(path)) + _PATH_MARGIN_BYTES > max_path_length:
            raise OSError(errno.ENAMETOOLONG, "path too long")
        max_name_length = max((len(os.fsencode(path_part)) for path_part in path.parts), default=0)
        if max_name_length > os.pathconf(existing_parent, "PC_NAME_MAX"):
            raise OSError(errno.ENAMETOOLONG, "name too long")
        with tempfile.TemporaryFile(dir=existing_parent) as file:
            file.write(bytes(_PROBE_BYTES))
            file.flush()
            os.fsync(file.fileno())
        free_bytes = shutil.disk_usage(existing_parent).free
    except OSError as error:
        raise write_error(folder, error) from error
    except ValueError as error:
        raise UsageError(f"{folder}: is no path ({error})") from error
    if free_bytes < _MIN_FREE_BYTES:
        raise UsageError(
            f"{folder}: only {free_bytes / 1e6:.1f} MB are free there, and a run takes up to"
            f" {_MIN_FREE_BYTES / 1e6:.0f} MB or more; free some space or choose another folder"
        )


def require_writable_file(file: Path) -> None:
    """Check that a file can be written, before a long computation whose result it will hold.

    Raises:
        UsageError: if it cannot.
    """
    try:
        if file.is_dir():
            raise UsageError(f"{file}: is a folder; give the name of a file")
    except OSError as error:
        raise write_error(file, error) from error
    except ValueError as error:
        raise UsageError(f"{file}: is no path ({error})") from error
    require_free_space(file.parent)


def write_error(path: Path, error: OSError) -> UsageError:
    """Create the error for a file that cannot be written, with the reason of the system."""
    reason = error.strerror or str(error)
    return UsageError(
        f"{path}: cannot be written ({reason}); free some space or choose a writable folder"
    )


def find_config_folder() -> Path:
    """Return the folder `configs` shipped with residnet.

    It is inside an installed package, or at the top of a source checkout.
    """
    package = Path(residnet.__file__).parent
    installed_folder = package / "configs"
    return installed_folder if installed_folder.is_dir() else package.parents[1] / "configs"


def find_shipped_configs() -> dict[str, Path]:
    """Return the shipped configs by stem and by relative path."""
    folder = find_config_folder()
    files = [file for file in sorted(folder.rglob("*.yaml")) if file.parent.name != "vessels"]
    by_path = {file.relative_to(folder).with_suffix("").as_posix(): file for file in files}
    stems = [file.stem for file in files]
    # an ambiguous stem is omitted
    return {file.stem: file for file in files if stems.count(file.stem) == 1} | by_path
