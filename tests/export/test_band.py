"""The band of an exported model: a method in TorchScript and in C, a table in the card."""

from __future__ import annotations

import ctypes
from pathlib import Path

import numpy as np
import pytest
import torch

from residnet.dynamics.store import BandTable
from residnet.export import exporter, vessel
from residnet.export.c import compile_shared
from residnet.export.vessel import ExportedVessel
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
LAYOUTS = (SIGNALS, ROLLING, SUBMERGED)


@pytest.mark.parametrize(
    ("table", "signals"),
    [(TABLE, SIGNALS), (ROLLS, ROLLING), (SIX, SUBMERGED), *((None, s) for s in LAYOUTS)],
)
def test_half_widths_are_those_of_the_table_in_torchscript_and_in_c(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    table: BandTable | None,
    signals: SignalsConfig,
) -> None:
    monkeypatch.setattr(vessel, "PARITY_STEPS", 5)
    spec = example_spec(None, signals).model_copy(update={"band": table})
    exported, file = ExportedVessel(spec, example_model(spec)), tmp_path / "boat.c"
    card = exporter("torchscript").export(exported, tmp_path / "model.pt")
    loaded = torch.jit.load(str(tmp_path / "model.pt"))
    exporter("c").export(exported, file)
    library = ctypes.CDLL(str(compile_shared([file], tmp_path / "boat.so", ["-DEXAMPLE_DOUBLE"])))
    half = np.zeros(len(signals.live.layout.banded))
    for k in (-3, 0, 1, 7, 10, 20, 29, 30, 60):
        library.example_band(k, half.ctypes.data_as(ctypes.c_void_p))
        assert half.tolist() == pytest.approx(loaded.band(k).tolist(), rel=1e-6)
    assert loaded.band(0).tolist() == [0.0] * len(half)
    if table is None:
        assert card["band"] is None
        assert torch.isinf(loaded.band(7)).all()
        return
    first, middle, last = torch.tensor(table.columns).T
    wanted = {1: first, 10: middle, 20: 0.5 * (middle + last), 30: last, 60: 2.0 * last}
    for k, row in wanted.items():
        torch.testing.assert_close(loaded.band(k), row)
    assert card["band"]["horizon"] == pytest.approx(30 * spec.dt)
    assert card["band"]["cautions"] == ["It is a test."]
    assert ("phi" in card["band"]) == signals.live.rolls


def test_a_column_of_another_length_is_refused() -> None:
    with pytest.raises(ValueError, match="one half width for each of steps"):
        BandTable.model_validate(TABLE.model_dump() | {"u": (0.1,)})
