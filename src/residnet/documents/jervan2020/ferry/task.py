"""Task `ferry_study`: identify the force residual of a believed ferry in closed loop, and fly again
with it (document 002 chapter 4).
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Literal, final

from residnet.core.config import dump_config
from residnet.documents.jervan2020.ferry.config import FerrySettings
from residnet.runs.folder import RunFolder


@final
class FerryStudyConfig(FerrySettings):
    """A course flown with the believed model, models of what it lacks, and the course again with
    them.
    """

    task: Literal["ferry_study"]

    def check(self) -> None:
        """Everything was checked when the config was read."""

    def run(
        self, *, source: Path, overrides: Sequence[str], out: Path | None, resume: bool
    ) -> RunFolder:
        """Fly, identify, fly again; writes ferry.json, ferry.md and figures.

        Raises:
            ResidnetError: where a model cannot be identified or flown.
        """
        import torch

        from residnet.documents.jervan2020.ferry.report import write
        from residnet.documents.jervan2020.ferry.study import study

        started = time.time()
        torch.set_num_threads(1)
        folder = RunFolder.create(out or Path("runs") / self.name, dump_config(self), resume=resume)
        text = write(self, study(self), folder)
        folder.write_provenance(
            config=source, overrides=overrides, seed=self.seed, files=[], started=started
        )
        print(text)
        print(f"study: {folder.path / 'ferry.md'}")
        return folder
