"""Baselines and heads side by side: the same models as one after the other."""

from __future__ import annotations

import copy
from typing import Any

import pytest
import torch
from tiny import TINY

from residnet.core.config import validate
from residnet.core.errors import DataError
from residnet.core.processes import free_cores, spread
from residnet.core.progress import Progress, listen
from residnet.data.simulated import SimulatedTrials
from residnet.data.sources import read_logs
from residnet.identification import fit as parts
from residnet.identification.fit import fit
from residnet.identification.fitter import FitStore, Fitter
from residnet.identification.prepared import PreparedSplits, prepare_logs
from residnet.identification.settings import FitSettings

_KEYS = ("prepare", "signals", "baseline", "evaluation")
_TRAINING: dict[str, Any] = {
    "steps": 2,
    "one_step": {"epochs": 2, "window": 2.0, "batch": 16},
    "multi_step": [{"horizon": 1.0, "epochs": 1, "batch": 16}],
}


def _settings(**training: Any) -> FitSettings:
    content = {
        **{key: copy.deepcopy(TINY[key]) for key in _KEYS},
        "refit": {"baseline": {"horizon": 2.0, "iterations": 2}},
        "heads": {
            "wide": {"kind": "mlp", "hidden": [5]},
            "narrow": {"kind": "mlp", "hidden": [2]},
            "ridge": {"kind": "ridge"},
        },
        "training": {"wide": {**_TRAINING, **training}, "narrow": _TRAINING},
        "bands": None,
    }
    return validate(content, FitSettings, "here")


@pytest.fixture(scope="module")
def logs() -> PreparedSplits:
    data = TINY["data"]
    return prepare_logs(read_logs(validate(data, SimulatedTrials, "here")), _settings())


@pytest.fixture
def everything_long(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parts, "_LONG_TRAINING", 1)


@pytest.mark.long
@pytest.mark.usefixtures("everything_long")
def test_side_by_side_gives_the_same_models(logs: PreparedSplits) -> None:
    settings = _settings()
    alone = fit(logs, settings)
    heard: list[Progress] = []
    with spread(2), listen(heard.append):
        beside = fit(logs, settings)
    assert list(beside) == list(alone) == ["zero", "baseline", "wide", "narrow", "ridge"]
    for name, model in alone.items():
        other = beside[name].model.state_dict()
        for key, value in model.model.state_dict().items():
            assert torch.equal(value, other[key]), (name, key)
        notes = {key: value for key, value in model.notes.items() if key != "seconds"}
        assert {key: beside[name].notes[key] for key in notes} == notes, name
    # what the processes report reaches who listens to this one
    assert {"training wide", "training narrow"} <= {event.stage for event in heard}


@pytest.mark.long
@pytest.mark.usefixtures("everything_long")
def test_a_part_that_fails_in_its_process_ends_the_fit_with_its_message(
    logs: PreparedSplits,
) -> None:
    settings = _settings(multi_step=[{"horizon": 500.0, "epochs": 1, "batch": 16}])
    with spread(2), pytest.raises(DataError, match="no training log holds a window of 500"):
        fit(logs, settings)


def test_what_ends_soon_stays_in_this_process(
    logs: PreparedSplits, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = _settings()
    fitter = Fitter(logs, settings, FitStore())
    with spread(8):
        assert parts.side_by_side(fitter) == 1
        monkeypatch.setattr(parts, "_LONG_TRAINING", 1)
        assert parts.side_by_side(fitter) == 2
    # a program of the user's own need not be made for processes
    assert free_cores() == 1
    assert parts.side_by_side(fitter) == 1
    with spread(8):
        gpu = _settings(device="cuda")
        assert parts.side_by_side(Fitter(logs, gpu, FitStore())) == 1
