"""A fit in Python: no config file, no run folder, the numbers of the command line."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from tiny import TINY, call

from residnet.core.config import validate
from residnet.core.progress import Progress, listen
from residnet.data.simulated import SimulatedTrials
from residnet.data.sources import read_logs
from residnet.identification.fit import fit
from residnet.identification.fitter import FitStore, FittedModel
from residnet.identification.identified import Identified
from residnet.identification.prepared import PreparedSplits, prepare_logs
from residnet.identification.settings import FitSettings

DATA = validate(TINY["data"], SimulatedTrials, "here")
SETTINGS = {
    key: value
    for key, value in TINY.items()
    if key in ("prepare", "signals", "baseline", "heads", "ensembles", "training", "evaluation")
}


class MemoryStore(FitStore):
    """Keeps models in memory and hands heads back."""

    def __init__(self) -> None:
        super().__init__()
        self.models: dict[str, FittedModel] = {}

    def finished(self, name: str) -> FittedModel | None:
        return self.models.get(name)

    def keep(self, fitted: FittedModel) -> None:
        self.models[fitted.name] = fitted


@pytest.fixture(scope="module")
def settings() -> FitSettings:
    return validate(SETTINGS, FitSettings, "here")


@pytest.fixture(scope="module")
def logs(settings: FitSettings) -> PreparedSplits:
    return prepare_logs(read_logs(DATA), settings)


@pytest.fixture(scope="module")
def store() -> MemoryStore:
    return MemoryStore()


@pytest.fixture(scope="module")
def heard() -> list[Progress]:
    return []


@pytest.fixture(scope="module")
def identified(
    settings: FitSettings,
    logs: PreparedSplits,
    store: MemoryStore,
    heard: list[Progress],
    tmp_path_factory: pytest.TempPathFactory,
) -> Identified:
    with pytest.MonkeyPatch.context() as patch, listen(heard.append):
        patch.chdir(tmp_path_factory.mktemp("here"))
        found = fit(logs, settings, store=store)
        assert not list(Path.cwd().iterdir())
    return found


@pytest.mark.long
def test_python_and_command_line_give_the_same_metrics(
    identified: Identified,
    settings: FitSettings,
    logs: PreparedSplits,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    path = tmp_path / "tiny.yaml"
    path.write_text(yaml.safe_dump({**TINY, "export": {"models": []}}, sort_keys=False))
    assert call(monkeypatch, "run", path, "--out", tmp_path / "run") == 0
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    splits = settings.evaluation.splits
    judged = identified.evaluate({str(split): logs[split] for split in splits}, DATA)
    rows: list[dict[str, Any]] = [row for part in judged.values() for row in part.rows]
    chosen = identified.select(judged)
    assert chosen.selected == metrics["selected"]
    assert chosen.selected_ensemble == metrics["selected_ensemble"] == "mean"
    assert chosen.content() == json.loads((tmp_path / "run" / "selection.json").read_text())
    for row in metrics["rows"]:
        row.pop("selected")
    # JSON holds every float exactly
    assert json.loads(json.dumps(rows)) == metrics["rows"]


def test_models_stand_in_order(identified: Identified) -> None:
    assert list(identified) == ["zero", "baseline", "ridge", "lstm", "mean"]
    assert [entry.spec.role for entry in identified.values()] == [
        "zero",
        "baseline",
        "head",
        "head",
        "ensemble",
    ]
    assert identified.limit.shape == (3,)
    assert np.all(identified.limit > 0)


@pytest.mark.long
def test_finished_heads_are_taken_from_the_store(
    identified: Identified,
    settings: FitSettings,
    logs: PreparedSplits,
    store: MemoryStore,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    told: list[Progress] = []
    with listen(told.append):
        again = fit(logs, settings, store=store)
    assert again["lstm"].model is identified["lstm"].model
    assert again["baseline"] is not identified["baseline"]
    assert not any(event.stage == "training lstm" for event in told)
    assert any("validation free-run error" in event.message for event in told)
    assert not list(tmp_path.iterdir())


def test_training_reports_every_epoch(identified: Identified, heard: list[Progress]) -> None:
    epochs = [event.done for event in heard if event.stage == "training lstm"]
    assert epochs == list(range(1, 8))


def test_an_optional_head_is_left_out_where_its_package_is_absent(
    logs: PreparedSplits, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "deap", None)
    plain = {key: SETTINGS[key] for key in ("prepare", "signals", "baseline", "evaluation")}
    bred = {"kind": "genetic", "evolution": {"population": 10, "generations": 1}}
    said: list[str] = []

    def hear(event: object) -> None:
        said.append(str(event))

    settings = validate(plain | {"heads": {"bred": bred | {"optional": True}}}, FitSettings, "here")
    with listen(hear):
        assert list(fit(logs, settings)) == ["zero", "baseline"]
    assert "bred is left out" in " ".join(said)
