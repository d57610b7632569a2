"""The one order of work of every run: provenance first, the finished mark last."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal

import pytest
import torch
from read_page import plain

from residnet.core.errors import DataError, ExportError, FitError, UsageError, WithheldError
from residnet.report.blocks import Code, Section
from residnet.runs.folder import RunFolder
from residnet.runs.task import ComputingTask, SummaryMetric, TaskOutcome


class SampleTask(ComputingTask):
    """A task that notes what its folder holds when it is called."""

    task: Literal["sample"] = "sample"
    seed: int = 7
    fault: Literal["", "raises", "fails a check", "is not exported", "is withheld"] = ""

    def provenance_seed(self) -> int:
        return self.seed

    def execute(self, folder: RunFolder) -> TaskOutcome:
        assert json.loads(folder.provenance.read_text())["seed"] == self.seed
        assert not folder.is_finished
        if self.fault == "raises":
            raise FitError("nothing can be fitted")
        folder.write_json(folder.path / "found.json", {"threads": torch.get_num_threads()})
        failure = "a flight did not end" if self.fault == "fails a check" else ""
        figures = {"speed": SummaryMetric(1.5, "m/s"), "lost": SummaryMetric(float("nan"), "s")}

        def wild() -> Path:
            if self.fault == "is withheld":
                raise WithheldError("model wild is withheld: worse than constant_velocity")
            raise ExportError("model wild: diverges")

        def model() -> Path:
            assert folder.report.is_file()
            assert not folder.is_finished
            folder.write(folder.exported_models / "model.txt", "exported")
            return folder.exported_models / "model.txt"

        exports: dict[str, Callable[[], Path]] = {"model": model}
        if self.fault in ("is not exported", "is withheld"):
            exports = {"wild": wild, **exports}
        return TaskOutcome(["It works."], figures, "a table", failure, exports)

    @classmethod
    def report_sections(cls, run: RunFolder) -> Sequence[Section]:
        assert not run.is_finished
        return [Section("What was found", [Code((run.path / "found.json").read_text())])]


def test_a_run_leaves_report_summary_and_mark(tmp_path: Path) -> None:
    before = torch.get_num_threads()
    task = SampleTask(name="first", threads=before + 1)
    finished = task.run(output_folder=tmp_path / "run")
    assert torch.get_num_threads() == before, "threads are those of the task and put back"
    folder = RunFolder.open(tmp_path / "run")
    assert json.loads((folder.path / "found.json").read_text())["threads"] == before + 1
    assert finished.folder.path == folder.path
    assert [file.read_text() for file in finished.exports] == ["exported"]
    assert json.loads(folder.summary.read_text()) == {
        "schema": "residnet.summary/1",
        "task": "sample",
        "finished": True,
        "verdict": ["It works."],
        # what is not finite is null
        "figures": {"speed": {"value": 1.5, "unit": "m/s"}, "lost": {"value": None, "unit": "s"}},
    }
    page = plain(folder.report)
    assert "It works." in page
    assert "What was found" in page
    assert {path.name for path in folder.path.iterdir()} == {
        *("checksums.json", "exports", "exports.json", "found.json", "provenance.json"),
        *("report.html", "resolved.yaml", "summary.json"),
    }
    assert "of task 'sample'; it has: report" in str(task.unsupported_verb_error(finished.folder))


def test_the_folder_is_named_after_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    # without a report a run ends after its results
    folder = SampleTask(name="mine", seed=8).run(report=False).folder
    assert folder.path == Path("runs") / "mine"
    assert folder.is_finished
    assert not any(path.exists() for path in (folder.report, folder.exported_models))
    with pytest.raises(UsageError, match="exists already"):
        SampleTask(name="mine").run()
    SampleTask(name="mine", seed=8).run(resume=True, report=False)


def test_a_run_that_fails_is_not_finished_and_is_run_again(tmp_path: Path) -> None:
    run = tmp_path / "run"
    with pytest.raises(FitError, match="nothing can be fitted"):
        SampleTask(name="fails", fault="raises").run(output_folder=run)
    with pytest.raises(UsageError, match="is not finished"):
        RunFolder.open(run)
    # nothing was found, so that a corrected configuration may use the folder
    with pytest.raises(DataError, match="a flight did not end"):
        SampleTask(name="fails", fault="fails a check").run(output_folder=run)
    assert RunFolder.open(run).report.is_file(), "a result that fails a check is reported first"


def test_a_run_that_withholds_or_cannot_export_a_model_is_complete_and_says_so(
    tmp_path: Path,
) -> None:
    run = tmp_path / "run"
    finished = SampleTask(name="wild", fault="is withheld").run(output_folder=run)
    assert [file.name for file in finished.exports] == ["model.txt"]
    said = "Not exported: model wild is withheld: worse than constant_velocity."
    assert finished.folder.read_summary().verdict == ("It works.", said)
    assert "model wild is withheld" in finished.folder.report.read_text()
    with pytest.raises(ExportError, match=r"model wild: diverges; the run itself is complete"):
        SampleTask(name="wild", fault="is not exported").run(output_folder=run, overwrite=True)
    folder = RunFolder.open(run)
    assert (folder.exported_models / "model.txt").is_file()
    page = plain(folder.report)
    assert "Not exported: model wild: diverges." in page
    assert "exports/model.txt" in page.replace("<wbr>", "")
    assert folder.read_summary().verdict == ("It works.", "Not exported: model wild: diverges.")
    # what an earlier run exported is not shown as this one's
    SampleTask(name="wild").run(output_folder=run, overwrite=True)
    assert "wild: diverges" not in plain(folder.report)
