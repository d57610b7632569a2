"""The run folder: paths and writers of result files, checksums, locks and provenance."""

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
from typing import TYPE_CHECKING, Any, Final

from residnet.core.errors import UsageError
from residnet.core.files import atomic_write, read_json, require_free_space, sha256
from residnet.core.ownership import RUN_MANIFEST, Manifest
from residnet.core.run_loader import require_trustworthy
from residnet.core.run_records import MainFigure, ProvenanceFile, SummaryFile
from residnet.core.version import __version__

if TYPE_CHECKING:
    import pandas as pd

    from residnet.core.records import StoredFile
    from residnet.evaluation.data_records import ExcitationFile
    from residnet.evaluation.records import MetricsFile


SUMMARY_SCHEMA: Final = "residnet.summary/1"
"""Schema of summary.json."""

LOG_FILE = "log.txt"
"""File with the progress messages of a run with --verbose."""
CHECKSUMS_FILE = RUN_MANIFEST
_RESULT_SUFFIXES = {".json", ".yaml", ".parquet", ".safetensors"}
_UNCHECKED_FOLDERS = {"figures", "exports", "tensorboard", "checkpoints"}
"""Folders without checksums: their files are never read as results."""
_PRE_RESULT_FILES = {
    "resolved.yaml",
    "provenance.json",
    "doctor.json",
    "data_quality.json",
    LOG_FILE,
}
"""Files written before the first result; a folder with only these may be reused."""


_LOCK_RETRIES = 20
"""Number of attempts, a tenth of a second apart, while the workers of a killed run end."""


class RunFolder:
    """The folder of one run: paths of its files, and writers that replace files atomically.

    Attributes:
        path: path of the folder.
        manifest: record of the files that residnet wrote into it.
        resolved_config: the complete configuration, with every default and in SI units.
        provenance: versions, seed, revision and the SHA-256 of every input file.
        summary: task, finished mark, verdict and main figures.
        report: the HTML page.
        metrics: free-run errors of a fit, or the comparison of another task.
        models: folder with a subfolder for each model.
        figures: pictures of the report.
        rollouts: stored free runs by split.
        exported_models: models for controllers.
        data_quality: samples, masks and ranges of each log.
        residuals: residual targets and predictions.
        limits: errors of the models by horizon and condition.
        goodness: goodness of fit of the regressions.
        booklet: manoeuvring booklet, the standard manoeuvres of the identified model.
        selection: the selected model and the reason.
        sanity: findings of the physical checks of each model.
        bands: prediction intervals of free runs.
        inspection: findings of the data checks.
        currents: estimated currents of the logs.
        indices: manoeuvring indices of simulated manoeuvres.
        exports: outcomes of the exports.
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
        self.derivatives = path / "derivatives.json"
        self.ship_derivatives = path / "derivatives_ship.json"
        self.selection = path / "selection.json"
        self.sanity = path / "sanity.json"
        self.excitation = path / "excitation.json"
        self.bands = path / "bands.json"
        self.inspection = path / "doctor.json"
        self.currents = path / "currents.json"
        self.indices = path / "indices.json"
        self.exports = path / "exports.json"

    @classmethod
    def create(
        cls, path: Path, resolved: str, *, resume: bool = False, overwrite: bool = False
    ) -> RunFolder:
        """Create the folder of a run, or reuse an existing one.

        A folder of an earlier run without any result is reused.

        Args:
            path: the folder.
            resolved: text of the complete configuration.
            resume: continue a run of the same configuration.
            overwrite: replace the files of an earlier run.

        Raises:
            UsageError: if the folder exists and may not be used, or contains a run of another
                configuration.
        """
        folder = cls(path)
        folder.require_usable(resolved, resume=resume, overwrite=overwrite)
        if resume and folder.resolved_config.is_file() and folder._has_results():
            # the run must not appear finished while it is repeated
            folder.summary.unlink(missing_ok=True)
            return folder
        if folder._has_results():
            # the folder itself is locked, so only its files are removed
            folder.manifest.remove_owned()
        folder.manifest.start_recording()
        folder.write(folder.resolved_config, resolved)
        return folder

    def require_usable(
        self, resolved: str, *, resume: bool = False, overwrite: bool = False
    ) -> None:
        """Check that `create` with the same arguments will succeed, without changing anything.

        Raises:
            UsageError: if the folder may not be used, see `create`.
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
                f"{self.path}: the run has another configuration ({self.resolved_config} differs);"
                " resume with the same configuration, or choose another --out"
            )

    @contextmanager
    def lock(self) -> Iterator[None]:
        """Lock the folder against runs of other processes within the context.

        If the system or the file system does not support locks, the folder is not locked.

        Raises:
            UsageError: if another process writes a run into the folder.
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
                        f"{self.path}: another run is being written here; wait for it, or choose"
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
            UsageError: if there is no run, the run is not finished, or a result has changed since
                it was written.
        """
        folder = cls(path)
        if not stat.S_ISREG(
            folder.resolved_config.lstat().st_mode if folder.resolved_config.exists() else 0
        ):
            problem = "not a run folder (no resolved.yaml)" if path.exists() else "no such folder"
            raise UsageError(f"{path}: {problem}; `residnet runs` lists the runs")
        if not folder.is_finished:
            raise UsageError(
                f"{path}: the run is not finished (summary.json does not say so); continue it with"
                f" residnet run CONFIG --out {path} --resume"
            )
        verify_checksums(path)
        return folder

    @property
    def is_finished(self) -> bool:
        """Whether the summary of the run exists and says that all results are written."""
        return self.summary.is_file() and self.read_summary().finished

    def write(self, path: Path, text: str) -> None:
        """Write a text file atomically."""
        with atomic_write(path) as file:
            file.write_text(text, encoding="utf-8")

    def write_json(self, path: Path, content: Any) -> None:
        """Write a file of standard JSON, without NaN and infinity."""
        self.write(path, json.dumps(content, indent=1, allow_nan=False) + "\n")

    def write_record(self, path: Path, record: StoredFile) -> None:
        """Write the typed contents of a JSON file."""
        self.write(path, record.to_json_text())

    def write_table(self, path: Path, table: pd.DataFrame) -> None:
        """Write a table as Parquet, without its index."""
        with atomic_write(path) as file:
            table.to_parquet(file, index=False)

    def write_summary(
        self,
        task: str,
        verdict: Sequence[str],
        figures: Mapping[str, MainFigure],
        *,
        level: str = "",
        is_finished: bool,
    ) -> None:
        """Write summary.json; `is_finished` marks the run as complete."""
        summary = SummaryFile(
            schema=SUMMARY_SCHEMA,
            task=task,
            finished=is_finished,
            verdict=tuple(verdict),
            figures=dict(figures),
        )
        if level:
            # a task without a verdict has no level in the file
            summary = summary.model_copy(update={"level": level})
        self.write_record(self.summary, summary)

    def read_summary(self) -> SummaryFile:
        """Return the contents of summary.json.

        Raises:
            UsageError: if the file is not readable, or a key is missing, unknown or of another
                type.
        """
        return SummaryFile.read(self.summary)

    def read_metrics(self) -> MetricsFile:
        """Return the contents of metrics.json of a fit.

        Raises:
            UsageError: if there is no such file, it is not readable, or it is not that of a fit.
        """
        from residnet.evaluation.records import MetricsFile

        return MetricsFile.read(self.metrics)

    def read_excitation(self) -> ExcitationFile | None:
        """Return the contents of excitation.json; None for runs of earlier versions."""
        from residnet.evaluation.data_records import ExcitationFile

        return ExcitationFile.read_optional(self.path, self.excitation.name)

    def read_fit_notes(self, model: str) -> dict[str, Any]:
        """Return the content of models/<model>/fit.json; empty if the file does not exist."""
        path = self.models / model / "fit.json"
        return read_json(path) if path.is_file() else {}

    def _has_results(self) -> bool:
        entry_names = {entry.name for entry in self.path.iterdir()} if self.path.is_dir() else set()
        entry_names -= {self.manifest.path.name, self.manifest.journal.name}
        # files without a configuration belong to the user
        return bool(entry_names - _PRE_RESULT_FILES) or (
            bool(entry_names) and not self.resolved_config.is_file()
        )

    def _require_replaceable(self, overwrite: bool) -> None:
        if not self.resolved_config.is_file():
            raise UsageError(
                f"{self.path}: exists already and is not a run folder; choose another --out"
            )
        if not overwrite:
            raise UsageError(
                f"{self.path}: exists already; choose another --out (in Python `folder`),"
                f" continue it"
                " with --resume (`resume=True`), or replace it with --overwrite (`overwrite=True`)"
            )
        self.manifest.require_all_owned()


def _read_text(path: Path) -> str:
    """Return the text of a file; bytes that are not UTF-8 are shown as escapes."""
    try:
        return path.read_text(encoding="utf-8", errors="backslashreplace")
    except OSError as error:
        raise UsageError(f"{path}: cannot be read ({error.strerror})") from error


def require_recorded(run: Path) -> None:
    """Check that a run folder has a manifest, before further files are written into it.

    Raises:
        UsageError: if there is no manifest, as in runs of early versions.
    """
    if not Manifest(run).is_recorded:
        raise UsageError(
            f"{run}: has no {CHECKSUMS_FILE}, which lists the files that residnet wrote;"
            " choose another --out"
        )


def require_apart(folder: Path, inputs: Iterable[Path]) -> None:
    """Check that a folder to be replaced contains none of the input files.

    Raises:
        UsageError: if it contains one.
    """
    place = folder.resolve()
    for file in inputs:
        if file.resolve().is_relative_to(place):
            raise UsageError(
                f"{file}: lies in {folder}, which --overwrite would empty; move it, or choose"
                f" another"
                " --out"
            )


def write_checksums(run: Path) -> None:
    """Update checksums.json: the SHA-256 of every file that residnet wrote into the folder.

    In a folder without a manifest, such as the folder of a single model, all result files are
    recorded. A run inside the folder, such as an evaluation, has its own checksums.
    """
    manifest = Manifest(run)
    if not manifest.is_recorded:
        for file in _iter_result_files(run, run):
            manifest.record(file, sha256(file))
    manifest.compact()


def verify_checksums(run: Path) -> None:
    """Check that the result files of a finished run are unchanged.

    Raises:
        UsageError: if the manifest is missing or does not list a file, or if a file is missing,
            truncated, edited, replaced, or not a regular file.
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
    """Inputs and settings that a run was made from.

    Attributes:
        config_path: file of the config; None for a config made in Python.
        overrides: overrides of keys of the config.
        seed: seed of all random numbers.
        input_paths: input files that determine the results.
        start_time: time of the start in s since the epoch.
    """

    config_path: Path | None
    overrides: Sequence[str]
    seed: int
    input_paths: Sequence[Path]
    start_time: float

    def require_same_inputs(self, folder: RunFolder) -> None:
        """Check that no input file has changed since an interrupted run in the folder began.

        Raises:
            UsageError: if a file has changed, or is no longer an input.
        """
        if not folder.provenance.is_file():
            return
        recorded_checksums = ProvenanceFile.read(folder.provenance).inputs
        for path in self.input_paths:
            if recorded_checksums.get(str(path)) != sha256(path):
                raise UsageError(
                    f"{path}: has changed since the run in {folder.path} was started; restore"
                    " it, or restart with --overwrite"
                )
        for name in sorted(recorded_checksums.keys() - {str(path) for path in self.input_paths}):
            raise UsageError(
                f"{name}: the run in {folder.path} was started with this file, which is no longer"
                " an input; add it again, or restart with --overwrite"
            )

    def write(self, folder: RunFolder, part_packages: Mapping[str, str]) -> None:
        """Write provenance.json, including the time since the start.

        Args:
            folder: the run folder.
            part_packages: versions of the packages that registered parts of the config.
        """
        provenance = ProvenanceFile(
            residnet=__version__,
            command=tuple(sys.argv),
            config=None if self.config_path is None else str(self.config_path),
            overrides=tuple(self.overrides),
            seed=self.seed,
            git=read_git_revision(),
            python=platform.python_version(),
            machine=f"{platform.system()} {platform.machine()}",
            packages={name: _package_version(name) for name in _RECORDED_PACKAGES},
            part_packages=dict(part_packages),
            started=time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(self.start_time)),
            seconds=round(time.time() - self.start_time, 1),
            inputs={str(path): sha256(path) for path in self.input_paths},
        )
        folder.write_record(folder.provenance, provenance)


def read_git_revision() -> str | None:
    """Return the Git revision of residnet's source; None if it is not a checkout.

    The revision has the suffix `+changes` if the checkout has uncommitted changes.
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
