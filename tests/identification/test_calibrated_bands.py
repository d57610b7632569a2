"""Bands of a fit say why a model could not be judged on logs that it leaves out."""

from __future__ import annotations

import pytest
from tiny import TINY

from residnet.core.config import validate
from residnet.core.errors import FitError
from residnet.data.simulated import SimulatedTrials
from residnet.data.sources import read_logs
from residnet.dynamics.hybrid import HybridDynamics
from residnet.identification.bands import FoldModels
from residnet.identification.fit import fit
from residnet.identification.fitter import FittedModel
from residnet.identification.prepared import prepare_logs
from residnet.identification.settings import FitSettings


def test_a_band_says_why_its_model_could_not_be_fitted_without_some_logs(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def refuse(*_: FittedModel) -> list[HybridDynamics]:
        raise FitError("the data do not excite it")

    monkeypatch.setattr(FoldModels, "_baseline", refuse)
    content = {key: TINY[key] for key in ("prepare", "signals", "baseline", "evaluation")}
    settings = validate(content | {"bands": {"folds": 2}}, FitSettings, "here")
    logs = prepare_logs(read_logs(validate(TINY["data"], SimulatedTrials, "here")), settings)
    bands = fit(logs, settings)["baseline"].bands
    assert bands
    for band in bands.values():
        assert "(the data do not excite it)" in band.cautions[0]
