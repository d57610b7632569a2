"""Where a run comes from: versions, machine, revision, seed and the hash of every input file."""

from __future__ import annotations

import platform
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING

from residnet.core.errors import UsageError
from residnet.core.files import read_json, sha256
from residnet.core.version import __version__

if TYPE_CHECKING:
    from residnet.runs.folder import RunFolder

_PACKAGES = (
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
        config: the file that describes it; None where Python called.
        overrides: of the config's keys.
        seed: of everything random.
        files: inputs whose contents the run depends on.
        started: seconds since the epoch.
    """

    config: Path | None
    overrides: Sequence[str]
    seed: int
    files: Sequence[Path]
    started: float

    def require_same_inputs(self, folder: RunFolder) -> None:
        """Check that no input file has changed since an interrupted run in the folder began.

        Raises:
            UsageError: where one has.
        """
        if not folder.provenance.is_file():
            return
        before = read_json(folder.provenance).get("inputs")
        known = before if isinstance(before, dict) else {}
        for path in self.files:
            if known.get(str(path), "") != sha256(path):
                raise UsageError(
                    f"{path}: is not the file that the run in {folder.path} began with; bring it"
                    " back, or begin anew with --overwrite"
                )

    def write(self, folder: RunFolder) -> None:
        """Write provenance.json, with the seconds since the start."""
        content = {
            "residnet": __version__,
            "command": sys.argv,
            "config": None if self.config is None else str(self.config),
            "overrides": list(self.overrides),
            "seed": self.seed,
            "git": git_revision(),
            "python": platform.python_version(),
            "machine": f"{platform.system()} {platform.machine()}",
            "packages": {name: _version(name) for name in _PACKAGES},
            "started": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(self.started)),
            "seconds": round(time.time() - self.started, 1),
            "inputs": {str(path): sha256(path) for path in self.files},
        }
        folder.write_json(folder.provenance, content)


def git_revision() -> str | None:
    """Return the revision of the checkout that residnet runs from; None outside a checkout.

    It ends in `+changes` where the checkout is not clean.
    """
    here = Path(__file__).parent
    try:
        revision = _git("rev-parse", "HEAD", folder=here)
        changes = _git("status", "--porcelain", folder=here)
    except (OSError, subprocess.SubprocessError):
        return None
    return revision + ("+changes" if changes else "")


def _git(*words: str, folder: Path) -> str:
    done = subprocess.run(
        ["git", *words], cwd=folder, capture_output=True, text=True, timeout=10, check=True
    )
    return done.stdout.strip()


def _version(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None
