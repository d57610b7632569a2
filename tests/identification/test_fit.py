"""A fit in Python: the numbers of the command line, models side by side, and who is compared."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import torch
import yaml
from tiny import TINY, call
from tiny_fit import DATA, logs_of, settings_of

from residnet.core.errors import DataError, FitError
from residnet.core.processes import free_cores, spread
from residnet.core.progress import Progress, listen
from residnet.dynamics.hybrid import HybridDynamics
from residnet.identification import fit as parts
from residnet.identification.bands import FoldModels
from residnet.identification.fit import fit
from residnet.identification.fitter import FitStore, FittedModel, Fitter, references
from residnet.identification.identified import Identified
from residnet.identification.prepared import PreparedSplits
from residnet.identification.settings import FitSettings


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
    return settings_of("heads", "ensembles", "training")


@pytest.fixture(scope="module")
def logs(settings: FitSettings) -> PreparedSplits:
    return logs_of(settings)


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
    bred = {"kind": "genetic", "evolution": {"population": 10, "generations": 1}, "optional": True}
    said: list[str] = []
    with listen(lambda event: said.append(str(event))):
        assert list(fit(logs, settings_of(heads={"bred": bred}))) == ["zero", "baseline"]
    assert "bred is left out" in " ".join(said)


def test_a_band_says_why_its_model_could_not_be_fitted_without_some_logs(
    logs: PreparedSplits, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: FittedModel) -> list[HybridDynamics]:
        raise FitError("the data do not excite it")

    monkeypatch.setattr(FoldModels, "_baseline", refuse)
    bands = fit(logs, settings_of(bands={"folds": 2}))["baseline"].bands
    assert bands
    for band in bands.values():
        assert "(the data do not excite it)" in band.cautions[0]


TRAINING: dict[str, Any] = {
    "steps": 2,
    "one_step": {"epochs": 2, "window": 2.0, "batch": 16},
    "multi_step": [{"horizon": 1.0, "epochs": 1, "batch": 16}],
}


def beside(**training: Any) -> FitSettings:
    heads = {"wide": {"kind": "mlp", "hidden": [5]}, "narrow": {"kind": "mlp", "hidden": [2]}}
    return settings_of(
        refit={"baseline": {"horizon": 2.0, "iterations": 2}},
        heads={**heads, "ridge": {"kind": "ridge"}},
        training={"wide": {**TRAINING, **training}, "narrow": TRAINING},
        bands=None,
    )


@pytest.fixture
def everything_long(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parts, "_LONG_TRAINING", 1)


@pytest.mark.long
@pytest.mark.usefixtures("everything_long")
def test_side_by_side_gives_the_same_models(logs: PreparedSplits) -> None:
    settings = beside()
    alone = fit(logs, settings)
    heard: list[Progress] = []
    with spread(2), listen(heard.append):
        found = fit(logs, settings)
    assert list(found) == list(alone) == ["zero", "baseline", "wide", "narrow", "ridge"]
    for name, model in alone.items():
        other = found[name].model.state_dict()
        for key, value in model.model.state_dict().items():
            assert torch.equal(value, other[key]), (name, key)
        notes = {key: value for key, value in model.notes.items() if key != "seconds"}
        assert {key: found[name].notes[key] for key in notes} == notes, name
    # what the processes report reaches who listens to this one
    assert {"training wide", "training narrow"} <= {event.stage for event in heard}


@pytest.mark.long
@pytest.mark.usefixtures("everything_long")
def test_a_part_that_fails_in_its_process_ends_the_fit_with_its_message(
    logs: PreparedSplits,
) -> None:
    settings = beside(multi_step=[{"horizon": 500.0, "epochs": 1, "batch": 16}])
    with spread(2), pytest.raises(DataError, match="no training log holds a window of 500"):
        fit(logs, settings)


def test_what_ends_soon_stays_in_this_process(
    logs: PreparedSplits, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = beside()
    fitter = Fitter(logs, settings, FitStore())
    with spread(8):
        assert parts.side_by_side(fitter) == 1
        monkeypatch.setattr(parts, "_LONG_TRAINING", 1)
        assert parts.side_by_side(fitter) == 2
    # a program of the user's own need not be made for processes
    assert free_cores() == 1
    assert parts.side_by_side(fitter) == 1
    with spread(8):
        gpu = beside(device="cuda")
        assert parts.side_by_side(Fitter(logs, gpu, FitStore())) == 1


ROLES = {
    "zero": "zero",
    "baseline": "baseline",
    "physics": "baseline",
    "hull": "baseline",
    "mlp": "head",
    "ridge": "head",
    "mean": "ensemble",
}
NOTES: dict[str, dict[str, Any]] = {
    "baseline": {"validation": 0.5},
    "physics": {"validation": 0.16},
    "hull": {"validation": 0.18},
    "mlp": {"baseline": "hull", "validation": 0.1},
    "ridge": {"validation": 0.2},
    "mean": {"validation": 0.1},
}
TO_FIRST = dict.fromkeys(("zero", "physics", "hull", "ridge", "truth"), "baseline")


@pytest.mark.parametrize(
    ("roles", "notes", "expected"),
    [
        (ROLES | {"truth": "truth"}, NOTES, {**TO_FIRST, "mlp": "hull", "mean": "physics"}),
        # what is not there is no reference
        ({"mlp": "head", "mean": "ensemble"}, {"mlp": {"baseline": "hull"}}, {}),
        # baselines without a recorded validation error: the first
        (
            {"baseline": "baseline", "b": "baseline", "mean": "ensemble"},
            {},
            {"b": "baseline", "mean": "baseline"},
        ),
        # a baseline that diverged is none while a steady one is there
        (
            {name: ROLES[name] for name in ("baseline", "physics", "hull", "mean")},
            NOTES | {"physics": {"validation": 0.16, "validation_diverged": 2}},
            {"physics": "baseline", "hull": "baseline", "mean": "hull"},
        ),
    ],
)
def test_who_is_compared_with_whom(
    roles: dict[str, str], notes: dict[str, dict[str, Any]], expected: dict[str, str]
) -> None:
    found = [
        SimpleNamespace(name=name, spec=SimpleNamespace(role=role), notes=notes.get(name, {}))
        for name, role in roles.items()
    ]
    assert references(cast(list[FittedModel], found)) == expected
