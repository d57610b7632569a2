"""Ownership of files: residnet replaces or deletes a file only if it wrote it and nobody edited it.

The rule is the same for every command. A *manifest* in the folder lists the SHA-256 of each file
that residnet wrote there. A file is *owned* if the manifest lists its name and its contents have
that SHA-256. A file that is not owned is neither replaced nor deleted: the command ends with one
line that names it.

A run folder has the manifest `checksums.json`, which lists every file below it. Files elsewhere
(`export --out`, `new --out`, `inspect --out`, the logs of `demo`, the cache) are listed in
`.residnet.json` in their folder: one record for all formats, which also covers files that
cannot contain a mark. If that record is lost, the files count as the user's.

While a command runs, the manifest grows by a journal (`checksums.jsonl`, `.residnet.jsonl`): one
line of JSON is appended *before* the file is moved to its place, so that after a kill every file
is still recognised, the earlier one and the new one. `Manifest.compact` merges the journal into the
manifest. An entry without a SHA-256 belongs to a file that is still growing, such as a
log or a checkpoint; it is recognised by its name.

Checksums detect accidents, not attackers: whoever can edit a folder can edit its manifest.
"""

from __future__ import annotations

import hashlib
import json
import os
import stat
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path, PurePosixPath
from typing import Any, final

from residnet.core.errors import UsageError

RUN_MANIFEST = "checksums.json"
"""Name of the manifest of a run folder."""
FILE_MANIFEST = ".residnet.json"
"""Name of the manifest of files that are written outside of a run folder."""
SCHEMA = "residnet.checksums/1"

_MAX_MANIFEST_BYTES = 64_000_000
"""Bytes of the largest manifest that is read; 100,000 files need 15 MB."""
_FORBIDDEN_CHARACTERS = frozenset("\\\0")
_FORBIDDEN_PARTS = frozenset(("", ".", ".."))

Digests = dict[str, set[str | None]]
"""Name of a file -> SHA-256 of each version that residnet wrote; None if it is still growing."""


def sha256(path: Path) -> str:
    """Return the hexadecimal SHA-256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def resolve_name(folder: Path, name: object, source: Path | None = None) -> Path:
    """Return the path of a file by its relative name in a JSON file.

    The name must be a normalised relative POSIX path without `..`. Symbolic links are not checked,
    see `require_inside`.

    Args:
        folder: folder of the relative name.
        name: value in the JSON file.
        source: the JSON file, for the error message; the folder if None.

    Raises:
        UsageError: if the name is no text, or leads out of the folder.
    """
    return folder / _require_inner_name(folder, name, source)


def _require_inner_name(folder: Path, name: object, source: Path | None = None) -> str:
    """Return a relative name after the check of `resolve_name`.

    The parts are compared as text: journals hold thousands of names, and a `PurePosixPath` of each
    takes ten times as long.
    """
    if (
        isinstance(name, str)
        and _FORBIDDEN_CHARACTERS.isdisjoint(name)
        # an empty part is the start of an absolute path, or a second or final slash
        and _FORBIDDEN_PARTS.isdisjoint(name.split("/"))
    ):
        return name
    raise UsageError(
        f"{source or folder}: {name!r} is not the name of a file inside of the folder; restore the"
        " folder or run it again"
    )


def require_inside(folder: Path, path: Path) -> None:
    """Check that no symbolic link below a folder leads a path out of it.

    The folder itself may be a link; the path need not exist.

    Raises:
        UsageError: if the path, or a folder between, is a symbolic link.
    """
    current = folder
    for part in path.relative_to(folder).parts:
        current = current / part
        if current.is_symlink():
            raise UsageError(
                f"{current}: is a symbolic link; residnet reads and writes only inside of {folder}:"
                " replace the link by the folder or file itself"
            )


def read_regular_file(path: Path, limit: int) -> bytes:
    """Return the contents of a regular file that is no symbolic link.

    Raises:
        OSError: if the file is missing or cannot be read.
        ValueError: if it is a device, a FIFO or a link, or larger than the limit in bytes.
    """
    # without O_NONBLOCK a FIFO would wait for its writer for ever
    flags = os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)
    if path.is_symlink():
        raise ValueError("it is a symbolic link")
    with os.fdopen(os.open(path, flags), "rb") as file:
        status = os.fstat(file.fileno())
        if not stat.S_ISREG(status.st_mode):
            raise ValueError("it is no regular file")
        content = file.read(limit + 1)
    if len(content) > limit:
        raise ValueError(f"it is larger than {limit / 1e6:.0f} MB")
    return content


def require_regular(path: Path, limit: int) -> None:
    """Check that a file can be read to its end: regular, no symbolic link, below a size.

    Raises:
        OSError: if the file is missing.
        ValueError: if it is a device, a FIFO or a link, or larger than the limit in bytes.
    """
    status = path.lstat()
    if not stat.S_ISREG(status.st_mode):
        raise ValueError("it is no regular file")
    if status.st_size > limit:
        raise ValueError(f"it is larger than {limit / 1e6:.0f} MB")


@final
class Manifest:
    """The record of the files that residnet wrote into a folder and the folders below it.

    Args:
        folder: folder of the relative names.
        name: name of the manifest file.

    Attributes:
        folder: folder of the relative names.
        path: path of the manifest file.
        journal: path of the journal, whose lines are not merged into the manifest yet.
    """

    def __init__(self, folder: Path, name: str = RUN_MANIFEST) -> None:
        self.folder = folder
        self.path = folder / name
        self.journal = folder / f"{name}l"

    @property
    def is_recorded(self) -> bool:
        """Whether residnet recorded any file here; a file of that name by others does not count."""
        if self.journal.is_file():
            return True
        if not self.path.is_file():
            return False
        try:
            self._read_merged()
        except UsageError:
            return False
        return True

    def read(self) -> Digests:
        """Return the SHA-256 of each recorded file; empty if there is no manifest.

        Raises:
            UsageError: if the manifest is damaged, no regular file, or larger than 64 MB.
        """
        digests: Digests = {}
        if os.path.lexists(self.path):
            digests = {name: {digest} for name, digest in self._read_merged().items()}
        if os.path.lexists(self.journal):
            for line in self._read(self.journal).splitlines():
                # a process that was killed leaves its last line incomplete
                with suppress(ValueError):
                    entry = json.loads(line)
                    if isinstance(entry, dict) and set(entry) == {"name", "sha256"}:
                        name = self._validate_name(entry["name"], self.journal)
                        digests.setdefault(name, set()).add(entry["sha256"])
        return digests

    def start_recording(self) -> None:
        """Record all files that are written below the folder from now on.

        Raises:
            UsageError: if the manifest is damaged, has another format, or cannot be written.
        """
        self.read()
        self._append("")

    def record(self, path: Path, digest: str | None) -> None:
        """Append to the journal that residnet writes a file; to be called before it is in place.

        Args:
            path: path of the file, inside of the folder.
            digest: SHA-256 of its contents; None for a file that is still growing.

        Raises:
            UsageError: if the journal cannot be written.
        """
        self._append(json.dumps({"name": self._relative_name(path), "sha256": digest}) + "\n")

    def record_existing(self) -> None:
        """Record every regular file of the folder with its SHA-256, without nested manifests."""
        for path, manifest in self._iterate_files(self.folder):
            if manifest is self and not path.is_symlink() and path.is_file():
                self.record(path, sha256(path))

    def is_owned(self, path: Path) -> bool:
        """Return whether residnet wrote a file of the folder, and its contents are the same."""
        return path.is_relative_to(self.folder) and self._is_owned(path, self.read())

    def require_replaceable(self, path: Path) -> None:
        """Check that a file may be written: it does not exist, or is owned.

        Raises:
            UsageError: if residnet did not write it, it was edited, or a symbolic link leads to it.
        """
        require_inside(self.folder, path)
        if not os.path.lexists(path):
            return
        digests = self.read()
        if self._is_owned(path, digests):
            return
        raise self._ownership_error(path, digests)

    def require_recorded_unchanged(self, *names: str) -> None:
        """Check that recorded files may be written again: each is unchanged or deleted.

        Args:
            names: names of files, and of folders whose recorded files are checked.

        Raises:
            UsageError: if a file was edited, or a symbolic link leads to it.
        """
        for name in names:
            require_inside(self.folder, self.folder / name)
        digests = self.read()
        for name in digests:
            path = self.folder / name
            if any(PurePosixPath(name).is_relative_to(start) for start in names) and (
                os.path.lexists(path) and not self._is_owned(path, digests)
            ):
                raise self._ownership_error(path, digests)

    def remove_if_owned(self, path: Path) -> None:
        """Delete a file that residnet wrote and nobody edited; leave any other."""
        if self.is_owned(path):
            require_inside(self.folder, path)
            path.unlink()

    def require_all_owned(self, subfolder: Path | None = None) -> None:
        """Check that every file of the folder, or of one below it, is owned.

        A folder below with a manifest of its own, such as an evaluation, is checked by that.

        Raises:
            UsageError: if one is the user's or was edited; it names the file.
        """
        digests_of_folder: dict[Path, Digests] = {}
        for path, manifest in self._iterate_files(subfolder or self.folder):
            if manifest.folder not in digests_of_folder:
                digests_of_folder[manifest.folder] = manifest.read()
            digests = digests_of_folder[manifest.folder]
            if not manifest._is_owned(path, digests):
                raise manifest._ownership_error(path, digests)

    def remove_owned(self, subfolder: Path | None = None) -> None:
        """Delete every file of the folder, or of one below it; all of them must be owned.

        Folders that become empty are deleted, except the folder of the manifest.

        Raises:
            UsageError: if a file is the user's or was edited; then nothing was deleted.
        """
        start_folder = subfolder or self.folder
        if not start_folder.is_dir():
            return
        require_inside(self.folder, start_folder)
        self.require_all_owned(start_folder)
        paths = [path for path, _ in self._iterate_files(start_folder, with_manifests=True)]
        manifest_files = {self.path, self.journal}
        # the manifest is last, so that a kill leaves nothing that is not recorded
        for path in [
            *(path for path in paths if path not in manifest_files),
            *(manifest_files & set(paths)),
        ]:
            path.unlink(missing_ok=True)
        parents = {parent for path in paths for parent in path.parents if parent != self.folder}
        for parent in sorted(parents, key=lambda parent: -len(parent.parts)):
            if parent.is_relative_to(self.folder):
                with suppress(OSError):
                    parent.rmdir()

    def compact(self) -> None:
        """Merge the journal into the manifest, which is replaced in one step.

        Files that no longer exist are left out. An edited file keeps the SHA-256 of its original
        contents, so that it is recognised as edited, unless a nested manifest lists it.

        Raises:
            UsageError: if the manifest is damaged or somebody else's, or cannot be written.
        """
        digests = self.read()
        files: dict[str, str | None] = {}
        for name, versions in sorted(digests.items()):
            path = self.folder / name
            if not os.path.lexists(path):
                continue
            if None in versions:
                # a log may grow even after the command has ended
                files[name] = None
            elif self._is_owned(path, digests):
                files[name] = sha256(path)
            elif (
                nearest_manifest := find_run_manifest(path)
            ) is None or nearest_manifest.path == self.path:
                files[name] = max(digest for digest in versions if digest is not None)
        temporary_path = self.path.with_name(f"{self.path.name}.{os.getpid()}.partial")
        content = {"schema": SCHEMA, "files": files}
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            temporary_path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
            temporary_path.replace(self.path)
            self.journal.unlink(missing_ok=True)
        except OSError as error:
            with suppress(OSError):
                temporary_path.unlink(missing_ok=True)
            raise UsageError(f"{self.path}: cannot be written ({error.strerror})") from error

    def verify(self, skipped: Collection[str] = ()) -> None:
        """Check that each recorded file exists, is a regular file and has the recorded SHA-256.

        Args:
            skipped: first parts of the names of files that are not checked.

        Raises:
            UsageError: if a file is missing, a link or a device, truncated, edited or replaced.
        """
        for name, versions in self.read().items():
            if PurePosixPath(name).parts[0] in skipped or None in versions:
                continue
            path = resolve_name(self.folder, name, self.path)
            require_inside(self.folder, path)
            try:
                if not stat.S_ISREG(path.lstat().st_mode):
                    raise ValueError("it is no regular file")
                digest = sha256(path)
            except (OSError, ValueError) as error:
                raise UsageError(
                    f"{path}: cannot be read ({error}); restore the folder or run it again"
                ) from error
            if digest not in versions:
                raise UsageError(
                    f"{path}: its SHA-256 is not the one in {self.path.name}, so it is incomplete,"
                    " edited or from another run; restore the folder or run it again"
                )

    def _append(self, line: str) -> None:
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            if self.journal.is_symlink():
                raise UsageError(f"{self.journal}: is a symbolic link; remove it")
            with self.journal.open("a", encoding="utf-8") as file:
                file.write(line)
        except OSError as error:
            raise UsageError(
                f"{self.journal}: cannot be written ({error.strerror}); free some space"
                " or choose a writable folder"
            ) from error

    def _relative_name(self, path: Path) -> str:
        return path.relative_to(self.folder).as_posix()

    def _validate_name(self, name: object, source: Path) -> str:
        return _require_inner_name(self.folder, name, source)

    def _is_owned(self, path: Path, digests: Digests) -> bool:
        versions = digests.get(self._relative_name(path))
        try:
            mode = path.lstat().st_mode
            if versions is None or not (stat.S_ISREG(mode) or stat.S_ISLNK(mode)):
                return False
            # a lock file may be a link; its deletion does not affect the target
            return None in versions or (stat.S_ISREG(mode) and sha256(path) in versions)
        except FileNotFoundError:
            return False

    def _ownership_error(self, path: Path, digests: Digests) -> UsageError:
        if path.is_symlink():
            reason = "is a symbolic link, which residnet did not make"
        elif self._relative_name(path) in digests:
            reason = "was edited after residnet wrote it"
        else:
            reason = f"exists, and {self.path.name} does not say that residnet wrote it"
        return UsageError(f"{path}: {reason}; move it away, or choose another path")

    def _read(self, path: Path) -> str:
        try:
            return read_regular_file(path, _MAX_MANIFEST_BYTES).decode("utf-8")
        except (OSError, ValueError) as error:
            raise UsageError(
                f"{path}: cannot be read ({error}); restore the file or run it again"
            ) from error

    def _read_merged(self) -> dict[str, str | None]:
        """Return the entries of the manifest file, without the journal."""
        try:
            content: Any = json.loads(self._read(self.path))
        except (ValueError, RecursionError) as error:
            raise UsageError(
                f"{self.path}: not readable as JSON ({error}); restore the file or run it again"
            ) from error
        files = content.get("files") if isinstance(content, dict) else None
        if (
            not isinstance(files, dict)
            or content.get("schema") != SCHEMA
            or not all(digest is None or isinstance(digest, str) for digest in files.values())
        ):
            raise UsageError(f"{self.path}: holds no checksums; restore the folder")
        return {self._validate_name(name, self.path): digest for name, digest in files.items()}

    def _iterate_files(
        self, folder: Path, *, with_manifests: bool = False
    ) -> Iterator[tuple[Path, Manifest]]:
        """Yield each file, link or device below a folder, and the manifest that it belongs to.

        Symbolic links are not followed.
        """
        for entry in sorted(folder.iterdir()):
            if entry.is_dir() and not entry.is_symlink():
                nested = Manifest(entry)
                yield from (nested if nested.is_recorded else self)._iterate_files(
                    entry, with_manifests=with_manifests
                )
            elif with_manifests or entry not in (self.path, self.journal):
                yield entry, self


def find_run_manifest(path: Path) -> Manifest | None:
    """Return the manifest of the run folder that a path lies in; None outside of run folders.

    In nested run folders it is the innermost one. A symbolic link to a folder counts only if no
    other run folder is above it.
    """
    linked_manifest: Manifest | None = None
    for folder in path.parents:
        manifest = Manifest(folder)
        if not manifest.is_recorded:
            continue
        if not folder.is_symlink():
            return manifest
        linked_manifest = linked_manifest or manifest
    return linked_manifest


def find_manifest(path: Path) -> Manifest:
    """Return the manifest that a file belongs to: of its run folder, else of its own folder."""
    return find_run_manifest(path) or Manifest(path.parent, FILE_MANIFEST)


def require_replaceable(path: Path) -> None:
    """Check that a file may be written: it does not exist, or is an unchanged file of residnet.

    Call it before a long computation, so that its result can be written.

    Raises:
        UsageError: if residnet did not write it, it was edited, or a symbolic link leads to it.
    """
    find_manifest(path).require_replaceable(path)


@contextmanager
def record_folder(folder: Path) -> Iterator[Manifest]:
    """Record each file that is written below a folder within the context in its `checksums.json`.

    Raises:
        UsageError: if the manifest is damaged, has another format, or cannot be written.
    """
    manifest = Manifest(folder)
    manifest.start_recording()
    try:
        yield manifest
    finally:
        manifest.compact()
