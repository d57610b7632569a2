"""The run folder: what a run leaves behind, and what other programs may rely on; provenance."""

from __future__ import annotations

import json
import os
import platform
import stat
import subprocess
import sys
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from residnet.core.errors import UsageError
from residnet.core.files import atomic_write, read_json, require_free_space, sha256
from residnet.core.ownership import RUN_MANIFEST, Manifest
from residnet.core.run_loader import require_trustworthy
from residnet.core.version import __version__

if TYPE_CHECKING:
    import pandas as pd


SUMMARY_SCHEMA = "residnet.summary/1"
"""Schema of summary.json."""

LOG_FILE = "log.txt"
"""File that holds the progress of a run, where that is kept."""
CHECKSUMS_FILE = RUN_MANIFEST
_RESULT_SUFFIXES = {".json", ".yaml", ".parquet", ".safetensors"}
_UNCHECKED_FOLDERS = {"figures", "exports", "tensorboard", "checkpoints"}
"""Folders that have no checksums: nothing reads them back as a result."""
_PRE_RESULT_FILES = {
    "resolved.yaml",
    "provenance.json",
    "doctor.json",
    "data_quality.json",
    LOG_FILE,
}
"""Files that a run writes before its first result; a folder of these alone may be used again."""


_LOCK_RETRIES = 20
"""Tenths of a second that the workers of a killed run have to end."""


class RunFolder:
    """The folder of one run: its paths, and writers that put a file in its place whole or not at
    all.

    Attributes:
        path: the folder itself.
        manifest: record of the files that residnet wrote into it.
        resolved_config: the complete configuration, with every default and in SI units.
        provenance: versions, seed, revision and the SHA-256 of every input file.
        summary: task, finished mark, verdict and main figures.
        report: the page for people.
        metrics: free-run errors of a fit, or what the task compares.
        models: one folder for each model.
        figures: pictures of the report.
        rollouts: stored free runs by split.
        exported_models: models for controllers.
        data_quality: what each log contributes.
        residuals: residual targets and predictions.
        limits: where models fail, and what limits them.
        goodness: goodness of fit of the regressions.
        booklet: standard manoeuvres of the identified model.
        selection: which model was selected, and why.
        sanity: whether each model behaves like a vessel.
        bands: how far free runs may be off.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.manifest = Manifest(path)
        self.resolved_config = path / "resolved.yaml"
        self.provenance = path / "provenance.json"
        self.summary = path / "summary.json"
        self.report = path / "report.html"
        self.metrics = path / "metrics.json"
        self.models = path / "models"
        self.figures = path / "figures"
        self.rollouts = path / "rollouts"
        self.exported_models = path / "exports"
        self.data_quality = path / "data_quality.json"
        self.residuals = path / "residuals.parquet"
        self.limits = path / "limits.json"
        self.goodness = path / "goodness.json"
        self.booklet = path / "booklet.json"
        self.selection = path / "selection.json"
        self.sanity = path / "sanity.json"
        self.bands = path / "bands.json"

    @classmethod
    def create(
        cls, path: Path, resolved: str, *, resume: bool = False, overwrite: bool = False
    ) -> RunFolder:
        """Make the folder of a run, or take up one that is there.

        A folder that an earlier run left without any result is used again.

        Args:
            resolved: text of the complete configuration.
            resume: continue a run of the same configuration.

        Raises:
            UsageError: if the folder exists and may not be used, or holds a run of another
                configuration.
        """
        folder = cls(path)
        folder.require_usable(resolved, resume=resume, overwrite=overwrite)
        if resume and folder.resolved_config.is_file() and folder._has_results():
            # what is done again must not look finished meanwhile
            folder.summary.unlink(missing_ok=True)
            return folder
        if folder._has_results():
            # the folder itself stays, since it is locked
            folder.manifest.remove_owned()
        folder.manifest.start_recording()
        folder.write(folder.resolved_config, resolved)
        return folder

    def require_usable(
        self, resolved: str, *, resume: bool = False, overwrite: bool = False
    ) -> None:
        """Check that `create` will do what it is asked for; nothing is changed.

        Raises:
            UsageError: as `create`.
        """
        if resume and overwrite:
            raise UsageError(f"{self.path}: give --resume or --overwrite, not both")
        require_free_space(self.path)
        if resume and self.resolved_config.is_file():
            require_recorded(self.path)
        if not self._has_results():
            if self.path.is_dir():
                self.manifest.require_all_owned()
            return
        if not (resume and self.resolved_config.is_file()):
            self._require_replaceable(overwrite)
        elif _read_text(self.resolved_config) != resolved:
            raise UsageError(
                f"{self.path}: was made with another configuration ({self.resolved_config} differs);"
                " resume with the same one or give another --out"
            )

    @contextmanager
    def lock(self) -> Iterator[None]:
        """Keep other processes from running into this folder within the context.

        Where the system or its disk knows no locks, nothing is held.

        Raises:
            UsageError: if another process runs into it.
        """
        self.path.mkdir(parents=True, exist_ok=True)
        try:
            import fcntl
        except ImportError:
            yield
            return
        descriptor = os.open(self.path, os.O_RDONLY)
        try:
            for retries_left in range(_LOCK_RETRIES, -1, -1):
                try:
                    fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    break
                except BlockingIOError:
                    if retries_left:
                        time.sleep(0.1)
                        continue
                    raise UsageError(
                        f"{self.path}: another run is being written here; wait for it, or give"
                        " another --out"
                    ) from None
                except OSError:
                    break
            yield
        finally:
            os.close(descriptor)

    @classmethod
    def open(cls, path: Path) -> RunFolder:
        """Open the folder of a finished run.

        Raises:
            UsageError: if there is no run, it is not finished, or a result is not as it was
                written.
        """
        folder = cls(path)
        if not stat.S_ISREG(
            folder.resolved_config.lstat().st_mode if folder.resolved_config.exists() else 0
        ):
            problem = "not a run folder (no resolved.yaml)" if path.exists() else "no such folder"
            raise UsageError(f"{path}: {problem}; `residnet runs` lists what there is")
        if not folder.is_finished:
            raise UsageError(
                f"{path}: the run is not finished (summary.json does not say so); continue it with"
                f" residnet run CONFIG --out {path} --resume"
            )
        verify_checksums(path)
        return folder

    @property
    def is_finished(self) -> bool:
        """Whether the run came to its end."""
        return self.summary.is_file() and bool(self.read_summary().get("finished"))

    def write(self, path: Path, text: str) -> None:
        """Write a text file, whole or not at all."""
        with atomic_write(path) as file:
            file.write_text(text, encoding="utf-8")

    def write_json(self, path: Path, content: Any) -> None:
        """Write JSON that every reader takes (no NaN)."""
        self.write(path, json.dumps(content, indent=1, allow_nan=False) + "\n")

    def write_table(self, path: Path, table: pd.DataFrame) -> None:
        """Write a table as Parquet, without its index."""
        with atomic_write(path) as file:
            table.to_parquet(file, index=False)

    def write_summary(
        self,
        task: str,
        verdict: Sequence[str],
        figures: Mapping[str, Mapping[str, Any]],
        *,
        level: str = "",
        is_finished: bool,
    ) -> None:
        """Write summary.json; its `is_finished` is the mark that the run came to its end."""
        content = {
            "schema": SUMMARY_SCHEMA,
            "task": task,
            "finished": is_finished,
            **({"level": level} if level else {}),
            "verdict": list(verdict),
            "figures": {name: dict(figure) for name, figure in figures.items()},
        }
        self.write_json(self.summary, content)

    def read_summary(self) -> Mapping[str, Any]:
        """Return the contents of summary.json.

        Raises:
            UsageError: if the file is not readable.
        """
        content = read_json(self.summary)
        sentences = content.get("verdict")
        if not isinstance(sentences, list) or not all(isinstance(text, str) for text in sentences):
            raise UsageError(f"{self.summary}: holds no verdict; restore the file or run it again")
        return content

    def read_metrics(self) -> Mapping[str, Any]:
        """Return the contents of metrics.json.

        Raises:
            UsageError: if there is no such file, or it is not readable.
        """
        return read_json(self.metrics)

    def read_fit_notes(self, model: str) -> dict[str, Any]:
        """Return what models/<model>/fit.json tells of a model's fit; empty if there is none."""
        path = self.models / model / "fit.json"
        return read_json(path) if path.is_file() else {}

    def _has_results(self) -> bool:
        entry_names = {entry.name for entry in self.path.iterdir()} if self.path.is_dir() else set()
        entry_names -= {self.manifest.path.name, self.manifest.journal.name}
        # without a configuration the files are somebody else's
        return bool(entry_names - _PRE_RESULT_FILES) or (
            bool(entry_names) and not self.resolved_config.is_file()
        )

    def _require_replaceable(self, overwrite: bool) -> None:
        if not self.resolved_config.is_file():
            raise UsageError(
                f"{self.path}: exists already and is not the folder of a run; give another --out"
            )
        if not overwrite:
            raise UsageError(
                f"{self.path}: exists already; give another --out (in Python `folder`), continue it"
                " with --resume (`resume=True`), or replace it with --overwrite (`overwrite=True`)"
            )
        self.manifest.require_all_owned()


def _read_text(path: Path) -> str:
    """Return the text of a file; what is no text in it shows as escapes."""
    try:
        return path.read_text(encoding="utf-8", errors="backslashreplace")
    except OSError as error:
        raise UsageError(f"{path}: cannot be read ({error.strerror})") from error


def require_recorded(run: Path) -> None:
    """Check that the files of a run folder are recorded, before more are written into it.

    Raises:
        UsageError: if there is no manifest, as in the run of an earlier version.
    """
    if not Manifest(run).is_recorded:
        raise UsageError(
            f"{run}: has no {CHECKSUMS_FILE}, so nothing says which of its files residnet wrote; give"
            " another --out"
        )


def require_apart(folder: Path, inputs: Iterable[Path]) -> None:
    """Check that a folder that is replaced holds none of the files that the work reads.

    Raises:
        UsageError: if it holds one.
    """
    place = folder.resolve()
    for file in inputs:
        if file.resolve().is_relative_to(place):
            raise UsageError(
                f"{file}: lies in {folder}, which --overwrite would empty; move it, or give another"
                " --out"
            )


def write_checksums(run: Path) -> None:
    """Bring checksums.json up to date: the SHA-256 of every file that residnet wrote there.

    In a folder without a manifest, such as that of a single model, the results that stand there are
    recorded. A run within the folder, such as an evaluation, has checksums of its own.
    """
    manifest = Manifest(run)
    if not manifest.is_recorded:
        for file in _iter_result_files(run, run):
            manifest.record(file, sha256(file))
    manifest.compact()


def verify_checksums(run: Path) -> None:
    """Check that the results of a finished run are those that it wrote.

    Raises:
        UsageError: if the manifest is missing or does not list a file, or if a file is missing, cut
            off, edited, from elsewhere, or no regular file.
    """
    require_trustworthy(run)


def _iter_result_files(folder: Path, run: Path) -> Iterator[Path]:
    for path in sorted(folder.iterdir()):
        if path.is_dir():
            if path.name not in _UNCHECKED_FOLDERS and not (path / "summary.json").is_file():
                yield from _iter_result_files(path, run)
        elif path.suffix in _RESULT_SUFFIXES and path != run / CHECKSUMS_FILE:
            yield path


_RECORDED_PACKAGES = (
    "torch",
    "lightning",
    "numpy",
    "scipy",
    "pandas",
    "scikit-learn",
    "pydantic",
    "pyarrow",
    "safetensors",
)


@dataclass(frozen=True)
class Provenance:
    """What a run is made from.

    Attributes:
        config_path: the file that describes it; None if Python called.
        overrides: of the config's keys.
        seed: of everything random.
        input_paths: inputs whose contents the run depends on.
        start_time: seconds since the epoch.
    """

    config_path: Path | None
    overrides: Sequence[str]
    seed: int
    input_paths: Sequence[Path]
    start_time: float

    def require_same_inputs(self, folder: RunFolder) -> None:
        """Check that no input file has changed since an interrupted run in the folder began.

        Raises:
            UsageError: if one has.
        """
        if not folder.provenance.is_file():
            return
        recorded_inputs = read_json(folder.provenance).get("inputs")
        recorded_checksums = recorded_inputs if isinstance(recorded_inputs, dict) else {}
        for path in self.input_paths:
            if recorded_checksums.get(str(path), "") != sha256(path):
                raise UsageError(
                    f"{path}: is not the file that the run in {folder.path} began with; bring it"
                    " back, or begin anew with --overwrite"
                )
        for name in sorted(recorded_checksums.keys() - {str(path) for path in self.input_paths}):
            raise UsageError(
                f"{name}: the run in {folder.path} began with this file, which is not among the"
                " inputs now; name it, too, or begin anew with --overwrite"
            )

    def write(self, folder: RunFolder) -> None:
        """Write provenance.json, with the seconds since the start."""
        content = {
            "residnet": __version__,
            "command": sys.argv,
            "config": None if self.config_path is None else str(self.config_path),
            "overrides": list(self.overrides),
            "seed": self.seed,
            "git": read_git_revision(),
            "python": platform.python_version(),
            "machine": f"{platform.system()} {platform.machine()}",
            "packages": {name: _package_version(name) for name in _RECORDED_PACKAGES},
            "started": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(self.start_time)),
            "seconds": round(time.time() - self.start_time, 1),
            "inputs": {str(path): sha256(path) for path in self.input_paths},
        }
        folder.write_json(folder.provenance, content)


def read_git_revision() -> str | None:
    """Return the revision of the checkout that residnet runs from; None outside a checkout.

    It ends in `+changes` where the checkout is not clean.
    """
    package_folder = Path(__file__).parent
    try:
        revision, changes = (
            subprocess.run(
                ["git", *arguments],
                cwd=package_folder,
                capture_output=True,
                text=True,
                timeout=10,
                check=True,
            ).stdout.strip()
            for arguments in (("rev-parse", "HEAD"), ("status", "--porcelain"))
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return revision + ("+changes" if changes else "")


def _package_version(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None
