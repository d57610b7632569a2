"""Task `simulate`: sea trials of a simulated vessel, as canonical logs that a fit reads."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from pydantic import Field

from residnet.core.config import Config, dump_config
from residnet.data.simulate import SimulatedTrials
from residnet.run_folder import RunFolder


class SimulateConfig(Config):
    """Simulated trials, written as logs/<split>/<log>.parquet.

    Attributes:
        name: of the run.
        data: vessel, manoeuvres, noise, disturbance, splits, seed.
    """

    task: Literal["simulate"]
    name: str = Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$")
    description: str = ""
    data: SimulatedTrials

    def check(self) -> None:
        """Everything was checked when the config was read."""

    def run(self, *, source: Path, overrides: Sequence[str], out: Path | None, resume: bool) -> RunFolder:
        """Simulate and write.

        Raises:
            UsageError: where the folder exists.
        """
        from residnet.data.sources import read_logs

        started = time.time()
        folder = RunFolder.create(out or Path("runs") / self.name, dump_config(self), resume=resume)
        count = 0
        for split, logs in read_logs(self.data).items():
            target = folder.path / "logs" / split
            target.mkdir(parents=True, exist_ok=True)
            for log in logs:
                log.save(target / f"{log.name}.parquet")
                count += 1
        folder.write_provenance(config=source, overrides=overrides, seed=self.data.seed, files=[], started=started)
        print(f"{count} logs in {folder.path / 'logs'}")
        return folder
