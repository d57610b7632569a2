"""Co-simulation units of both versions in FMPy: valid, stepped at the model's step and at a
multiple, and refused at other steps.
"""

from __future__ import annotations

import os
import zipfile
from pathlib import Path

import fmpy
import numpy as np
import pytest
import torch
from exported_models import built
from fmpy.validation import validate_fmu

from residnet.dynamics.c_code import compiler
from residnet.dynamics.rollout import Rollout
from residnet.export import exporter, fmu
from residnet.export.vessel import ExportedVessel

pytestmark = [pytest.mark.exporters, pytest.mark.usefixtures("short_parity")]
INPUTS = {"n_port": 20.0, "n_stbd": 25.0, "wind_speed": 3.0, "wind_dir": 1.0}


@pytest.mark.parametrize("name", ["fmu", "fmu2"])
def test_a_unit_is_imported_and_stepped(name: str, tmp_path: Path) -> None:
    spec, model = built("lstm_mirror")
    file = str(tmp_path / "boat.fmu")
    exporter(name).export(ExportedVessel(spec, model), Path(file))
    assert validate_fmu(file) == []
    model = model.double()
    x0 = torch.tensor([[0.0, 0, 0, 1, 0, 0]], dtype=torch.float64)
    w = torch.tensor([list(INPUTS.values())], dtype=torch.float64)
    with torch.no_grad():
        states, _, _ = Rollout(model)(
            x0, w.unsqueeze(1).expand(-1, 60, -1), model.initial_state(1).double()
        )
    signal = np.array(
        [(t, *INPUTS.values()) for t in (0.0, 100.0)],
        dtype=[("time", float), *((column, float) for column in INPUTS)],
    )

    def flown(step: float) -> np.ndarray:
        table: np.ndarray = fmpy.simulate_fmu(
            file,
            stop_time=6.0,
            step_size=step,
            output_interval=step,
            start_values={"u_start": 1.0},
            input=signal,
            output=["x", "y", "psi", "u", "v", "r", "outside"],
        )
        return table

    for every in (1, 3):
        table = flown(0.1 * every)
        for column, state in zip(["x", "y", "psi", "u", "v", "r"], states[0].T, strict=True):
            np.testing.assert_allclose(table[column], state[::every].numpy(), rtol=1e-9, atol=1e-9)
        assert not table["outside"].any()
    with pytest.raises(fmpy.fmi1.FMICallException, match="DoStep failed"):
        flown(0.25)


def test_compilers_for_other_machines_are_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("x86_64-w64-mingw32-gcc", "aarch64-linux-gnu-gcc"):
        tool = tmp_path / name
        tool.write_text(f'#!/bin/sh\nexec {compiler()} "$@"\n')
        tool.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    monkeypatch.setattr(fmu.platform, "machine", lambda: "x86_64")
    spec, model = built("plsr")
    for name, wanted in (
        ("fmu", {"x86_64-linux/model.so", "x86_64-windows/model.dll", "aarch64-linux/model.so"}),
        ("fmu2", {"linux64/model.so", "win64/model.dll"}),
    ):
        file = tmp_path / f"{name}.fmu"
        card = exporter(name).export(ExportedVessel(spec, model), file)
        found = {one for one in zipfile.ZipFile(file).namelist() if one.startswith("binaries/")}
        assert found == {f"binaries/{one}" for one in wanted}
        assert set(card["binaries"]) == {one.split("/")[0] for one in wanted}
