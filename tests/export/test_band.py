"""The band of an exported model: a method in TorchScript, a table in the card."""

from __future__ import annotations

import ctypes
from pathlib import Path

import numpy as np
import pytest
import torch

from residnet.dynamics.store import BandTable
from residnet.export import exporter, vessel
from residnet.export.c import compile_shared
from residnet.export.vessel import ExportedModel, ExportedVessel
from residnet.physics.signals import SignalsConfig
from residnet.testing.checks import ROLLING, SIGNALS, SUBMERGED, example_model, example_spec

TABLE = BandTable(
    level=0.9,
    steps=(1, 10, 30),
    u=(0.1, 0.2, 0.4),
    v=(0.1, 0.1, 0.1),
    r=(0.01, 0.02, 0.02),
    heading=(0.001, 0.1, 0.3),
    position=(0.01, 1.0, 5.0),
    logs=12,
    cautions=("It is a test.",),
)
ROLLS = TABLE.model_copy(update={"p": (0.01, 0.03, 0.03), "phi": (0.001, 0.02, 0.05)})
SIX = ROLLS.model_copy(
    update={"w": (0.1, 0.2, 0.3), "q": (0.01, 0.02, 0.03), "z": (0.1, 0.3, 0.9), "theta": ROLLS.phi}
)
CASES = pytest.mark.parametrize(
    ("table", "signals"),
    [
        (TABLE, SIGNALS),
        (None, SIGNALS),
        (ROLLS, ROLLING),
        (None, ROLLING),
        (SIX, SUBMERGED),
        (None, SUBMERGED),
    ],
    ids=["band", "none", "roll", "none of roll", "six", "none of six"],
)


@CASES
def test_half_widths_are_those_of_the_table(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    table: BandTable | None,
    signals: SignalsConfig,
) -> None:
    monkeypatch.setattr(vessel, "PARITY_STEPS", 5)
    spec = example_spec(None, signals).model_copy(update={"band": table})
    exported = ExportedVessel(spec, example_model(spec))
    card = exporter("torchscript").export(exported, tmp_path / "model.pt")
    loaded = torch.jit.load(str(tmp_path / "model.pt"))
    assert loaded.band(0).tolist() == [0.0] * len(signals.live.layout.banded)
    if table is None:
        assert card["band"] is None
        assert torch.isinf(loaded.band(7)).all()
        return
    wanted = torch.tensor(table.columns).T
    torch.testing.assert_close(loaded.band(1), wanted[0])
    torch.testing.assert_close(loaded.band(10), wanted[1])
    torch.testing.assert_close(loaded.band(20), 0.5 * (wanted[1] + wanted[2]))
    torch.testing.assert_close(loaded.band(30), wanted[2])
    torch.testing.assert_close(loaded.band(60), 2.0 * wanted[2])
    assert card["band"]["horizon"] == pytest.approx(30 * spec.dt)
    assert card["band"]["cautions"] == ["It is a test."]
    assert ("phi" in card["band"]) == signals.live.rolls


@CASES
def test_c_has_the_same_half_widths(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    table: BandTable | None,
    signals: SignalsConfig,
) -> None:
    monkeypatch.setattr(vessel, "PARITY_STEPS", 5)
    spec = example_spec(None, signals).model_copy(update={"band": table})
    model = example_model(spec)
    exporter("c").export(ExportedVessel(spec, model), tmp_path / "boat.c")
    library = ctypes.CDLL(
        str(compile_shared([tmp_path / "boat.c"], tmp_path / "boat.so", ["-DEXAMPLE_DOUBLE"]))
    )
    half = np.zeros(len(signals.live.layout.banded))

    def band(k: int) -> list[float]:
        library.example_band(k, half.ctypes.data_as(ctypes.c_void_p))
        return half.tolist()

    exported = ExportedModel(model.float(), spec)
    for k in (-3, 0, 1, 7, 10, 20, 29, 30, 60):
        assert band(k) == pytest.approx(exported.band(k).tolist(), rel=1e-6)


def test_a_column_of_another_length_is_refused() -> None:
    with pytest.raises(ValueError, match="one half width for each of steps"):
        BandTable.model_validate(TABLE.model_dump() | {"u": (0.1,)})
