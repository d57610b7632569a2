"""The run folder: what a run leaves behind, and what other programs may rely on (DESIGN section 5).
"""

from __future__ import annotations

import hashlib
import json
import platform
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from residnet import __version__
from residnet.core.errors import UsageError

_PACKAGES = ("torch", "lightning", "numpy", "scipy", "pandas", "scikit-learn", "pydantic", "pyarrow", "safetensors")


class RunFolder:
    """Paths and writers of one run; every file is written beside its place and then put there,
    whole.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.resolved = path / "resolved.yaml"
        self.metrics = path / "metrics.json"
        self.report = path / "report.html"
        self.models = path / "models"
        self.figures = path / "figures"
        self.rollouts = path / "rollouts"
        self.exports = path / "exports"
        self.data_quality = path / "data_quality.json"
        self.residuals = path / "residuals.parquet"
        self.limits = path / "limits.json"
        self.goodness = path / "goodness.json"
        self.booklet = path / "booklet.json"

    @classmethod
    def create(cls, path: Path, resolved: str, *, resume: bool) -> RunFolder:
        """Make a new folder, or take up an unfinished one with the same configuration.

        Raises:
            UsageError: where the folder exists and is not to be resumed, or was made by another
                configuration.
        """
        folder = cls(path)
        if folder.resolved.is_file() and resume:
            if folder.resolved.read_text() != resolved:
                raise UsageError(
                    f"{path}: was made with another configuration ({folder.resolved} differs); resume with the same one or give another --out"
                )
            return folder
        if path.exists() and (not path.is_dir() or any(path.iterdir())):
            raise UsageError(f"{path}: exists already; give another --out, remove it, or continue it with --resume")
        path.mkdir(parents=True, exist_ok=True)
        folder.write(folder.resolved, resolved)
        return folder

    @classmethod
    def open(cls, path: Path) -> RunFolder:
        """A finished run.

        Raises:
            UsageError: where there is none.
        """
        folder = cls(path)
        if not folder.resolved.is_file():
            raise UsageError(f"{path}: not a run folder (no resolved.yaml)")
        if not folder.metrics.is_file():
            raise UsageError(f"{path}: the run is not finished (no metrics.json); continue it with residnet run CONFIG --out {path} --resume")
        return folder

    def write(self, path: Path, text: str) -> None:
        """Write a text file, whole or not at all."""
        path.parent.mkdir(parents=True, exist_ok=True)
        partial = path.with_name(path.name + ".partial")
        partial.write_text(text)
        partial.replace(path)

    def write_json(self, path: Path, content: Any) -> None:
        """Write JSON that every reader takes (no NaN)."""
        self.write(path, json.dumps(content, indent=1, allow_nan=False) + "\n")

    def write_provenance(self, *, config: Path, overrides: Sequence[str], seed: int, files: Sequence[Path], started: float) -> None:
        """Who made this run, with what, from which files."""
        content = {
            "residnet": __version__,
            "command": sys.argv,
            "config": str(config),
            "overrides": list(overrides),
            "seed": seed,
            "git": git_revision(),
            "python": platform.python_version(),
            "machine": f"{platform.system()} {platform.machine()}",
            "packages": {name: _version(name) for name in _PACKAGES},
            "started": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(started)),
            "seconds": round(time.time() - started, 1),
            "inputs": {str(path): sha256(path) for path in files},
        }
        self.write_json(self.path / "provenance.json", content)

    def read_metrics(self) -> Mapping[str, Any]:
        """Contents of metrics.json."""
        content: Mapping[str, Any] = json.loads(self.metrics.read_text())
        return content

    def fit_notes(self, model: str) -> dict[str, Any]:
        """What models/<model>/fit.json says about a model's fit; empty where there is none."""
        path = self.models / model / "fit.json"
        content: dict[str, Any] = json.loads(path.read_text()) if path.is_file() else {}
        return content


def sha256(path: Path) -> str:
    """Hexadecimal SHA-256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def git_revision() -> str | None:
    """Revision of the checkout that residnet runs from, with `+changes` where it is not clean; None
    outside a checkout.
    """
    here = Path(__file__).parent
    try:
        revision = subprocess.run(["git", "rev-parse", "HEAD"], cwd=here, capture_output=True, text=True, timeout=10, check=True).stdout.strip()
        dirty = subprocess.run(["git", "status", "--porcelain"], cwd=here, capture_output=True, text=True, timeout=10, check=True).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return None
    return revision + ("+changes" if dirty else "")


def _version(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None
