"""Task `force_residual`: what a believed hull leaves of measured forces, and whether any regression
explains it (document 002 chapter 5).
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Literal, final

from residnet.core.config import dump_config
from residnet.documents.jervan2020.measured.config import ForceSettings
from residnet.runs.folder import RunFolder


@final
class ForceResidualConfig(ForceSettings):
    """The residual force of a believed hull on measured logs, explained by regressions and judged
    where they saw nothing.
    """

    task: Literal["force_residual"]

    def check(self) -> None:
        """That the logs' files are there.

        Raises:
            ConfigError: where they are not.
        """
        self.data.files()

    def run(
        self, *, source: Path, overrides: Sequence[str], out: Path | None, resume: bool
    ) -> RunFolder:
        """Read, fit, judge; writes force_residual.json, force_residual.md, tables of the models and
        figures.

        Raises:
            ResidnetError: where a log cannot be used or a model is not determined.
        """
        import torch

        from residnet.documents.jervan2020.measured.report import write
        from residnet.documents.jervan2020.measured.study import force_study

        started = time.time()
        torch.set_num_threads(1)
        files = self.data.files()
        folder = RunFolder.create(out or Path("runs") / self.name, dump_config(self), resume=resume)
        text = write(self, force_study(self), folder)
        folder.write_provenance(
            config=source, overrides=overrides, seed=0, files=files, started=started
        )
        print(text)
        print(f"study: {folder.path / 'force_residual.md'}")
        return folder
