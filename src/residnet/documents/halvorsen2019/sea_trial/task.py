"""Task `sea_trial`: fit Odin's standard model and equations on a simulated sea trial, by phase
(document 000 section 7.5).
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Literal, final

from residnet.core.config import dump_config
from residnet.documents.halvorsen2019.sea_trial.study import PhasesSettings
from residnet.runs.folder import RunFolder


@final
class SeaTrialTaskConfig(PhasesSettings):
    """The standard model by bounded weighted least squares against equations from forces and from
    controls, by phase.
    """

    task: Literal["sea_trial"]

    def check(self) -> None:
        """Everything was checked when the config was read."""

    def run(
        self, *, source: Path, overrides: Sequence[str], out: Path | None, resume: bool
    ) -> RunFolder:
        """Sail, fit, judge; writes study.json, study.md and figures.

        Raises:
            ResidnetError: where a trial cannot be sailed or a model is not determined.
        """
        import torch

        from residnet.documents.halvorsen2019.sea_trial.report import write
        from residnet.documents.halvorsen2019.sea_trial.study import study

        started = time.time()
        torch.set_num_threads(1)
        folder = RunFolder.create(out or Path("runs") / self.name, dump_config(self), resume=resume)
        text = write(self, study(self), folder)
        folder.write_provenance(
            config=source,
            overrides=overrides,
            seed=next(iter(self.trials.values())).seed,
            files=[],
            started=started,
        )
        print(text)
        print(f"study: {folder.path / 'study.md'}")
        return folder
