"""Task `autopilot`: train heading policies, tune classical peers, and compare all of them."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar, Literal, final

from residnet.core.errors import UsageError
from residnet.core.names import nearest
from residnet.report.blocks import Section
from residnet.report.run_reader import RunFiles
from residnet.runs.folder import RunFolder
from residnet.runs.task import Outcome
from residnet.tasks.autopilot.config import AutopilotSettings


@final
class AutopilotConfig(AutopilotSettings):
    """Heading policies trained through the vessel, beside tuned classical controllers."""

    task: Literal["autopilot"]

    verbs: ClassVar[tuple[str, ...]] = ("report", "export")

    def check(self) -> None:
        """Check that the vessel and the learned models of it are there and turn steadily.

        Raises:
            ResidnetError: where one is missing, does not fit, or does not hold its turn.
        """
        from residnet.tasks.autopilot.requirements import check_vessels

        check_vessels(self)

    def carry_out(self, folder: RunFolder) -> Outcome:
        """Train, tune and compare.

        Raises:
            FitError: where tuning or training fails.
        """
        from residnet.tasks.autopilot.running import run_autopilot

        return run_autopilot(self, folder)

    @classmethod
    def report_sections(cls, run: RunFolder) -> Sequence[Section]:
        """Draw the figures and return the comparison of the controllers."""
        from residnet.report.sections.autopilot import draw, sections

        files = RunFiles(run.path)
        draw(files)
        return sections(files)

    def export_model(self, run: RunFolder, model: str, out: Path | None, file_format: str) -> Path:
        """Return the file of a policy, which was exported and checked when the run ended.

        As C it is written from the stored policy now.

        Raises:
            UsageError: where there is no such policy, or another format is given.
        """
        policies = {**self.policies, **self.recurrent}
        if model not in policies:
            raise UsageError(f"{run.path}: no policy '{model}'{nearest(model, policies)}")
        file = run.exports / f"{model}.pt"
        if not file.is_file():
            raise UsageError(f"{file}: no such file; the run writes it at its end")
        if file_format != "torchscript":
            return self._export_as(file_format, run, model, file, out)
        if out is None:
            return file
        out.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(file, out)
        return out

    def _export_as(
        self, file_format: str, run: RunFolder, model: str, scripted: Path, out: Path | None
    ) -> Path:
        """Write a policy at the step and with the card of its TorchScript file."""
        import torch

        from residnet.export import exporter
        from residnet.export.policy import ExportedHeading
        from residnet.tasks.autopilot.stored import stored_policy

        chosen, extra = exporter(file_format), {"card.json": ""}
        torch.jit.load(str(scripted), _extra_files=extra)
        card = json.loads(extra["card.json"])
        policy = stored_policy(self, run.models, model, card["dt"])
        file = out or scripted.with_name(f"{model}{chosen.suffix}")
        exported = ExportedHeading(
            model, policy, safe=self.safe, about=card, metrics=card["metrics"]
        )
        chosen.export(exported, file)
        return file
