"""Co-simulation units of FMI 2.0 in FMPy: valid, stepped at the model's step and at a
multiple, and refused at other steps.
"""

from __future__ import annotations

import contextlib
import os
import zipfile
from pathlib import Path
from typing import Any

import fmpy
import numpy as np
import pytest
import torch
from exported_models import (
    built,
    draw_samples_around_ranges,
    expected_flags,
    exported_with_domain,
)
from fmpy.fmi1 import FMICallException
from fmpy.simulation import instantiate_fmu
from fmpy.validation import validate_fmu

from residnet.core.errors import ConfigError
from residnet.engine.c_code import find_compiler
from residnet.engine.rollout import Rollout
from residnet.export import fmu, get_exporter
from residnet.export.vessel import ExportedVessel

pytestmark = [pytest.mark.exporters, pytest.mark.usefixtures("short_parity")]
INPUTS = {"n_port": 20.0, "n_stbd": 25.0, "wind_speed": 3.0, "wind_dir": 1.0}


@pytest.mark.parametrize("variant", ["lstm_mirror", "gru_encoder"])
def test_a_unit_is_imported_and_stepped(variant: str, tmp_path: Path) -> None:
    spec, model = built(variant)
    file = str(tmp_path / "boat.fmu")
    get_exporter("fmu2").export(ExportedVessel(spec, model), Path(file))
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


def test_a_unit_flags_the_same_samples_as_the_model(tmp_path: Path) -> None:
    made = exported_with_domain()
    get_exporter("fmu2").export(made, tmp_path / "boat.fmu")
    x, w = draw_samples_around_ranges(30)
    flags = []
    for state, inputs in zip(x.tolist(), w.tolist(), strict=True):
        unit = Unit(tmp_path)
        unit.initialize(0.0)
        for name, value in zip(("x", "y", "psi", "u", "v", "r"), state, strict=True):
            unit.set(f"{name}_start", value)
        for name, value in zip(made.spec.signals.input_columns, inputs, strict=True):
            unit.set(name, value)
        unit.unit.exitInitializationMode()
        unit.step(0.0, made.spec.dt)
        flags.append(bool(unit.unit.getBoolean([unit.references["outside"]])[0]))
        unit.unit.terminate()
        unit.unit.freeInstance()
    assert flags == expected_flags(made, x, w)


class Unit:
    """An instance of a unit, called function by function, with the messages that it logs."""

    def __init__(self, folder: Path) -> None:
        file = folder / "boat.fmu"
        if not file.is_file():
            get_exporter("fmu2").export(ExportedVessel(*built("plsr")), file)
        description = fmpy.read_model_description(str(file))
        self.references = {v.name: v.valueReference for v in description.modelVariables}
        self.messages: list[str] = []
        self.unit = instantiate_fmu(
            fmpy.extract(str(file)),
            description,
            fmi_type="CoSimulation",
            logger=self.log,
        )

    def log(self, *given: Any) -> None:
        self.messages.append(given[-1].decode())

    def initialize(self, start: float, stop: float | None = None) -> None:
        self.unit.setupExperiment(startTime=start, stopTime=stop)
        self.unit.enterInitializationMode()

    def set(self, name: str, value: float) -> None:
        self.unit.setReal([self.references[name]], [value])

    def value(self, name: str) -> float:
        return float(self.unit.getReal([self.references[name]])[0])

    def step(self, point: float, size: float) -> None:
        self.unit.doStep(currentCommunicationPoint=point, communicationStepSize=size)


def test_an_ensemble_starts_all_members_from_the_start_values(tmp_path: Path) -> None:
    """Its memory then has no prediction, also after a reset in the middle of a free run."""
    spec, model = built("mean")
    get_exporter("fmu2").export(ExportedVessel(spec, model), tmp_path / "boat.fmu")
    model = model.double()
    names = ("x", "y", "psi", "u", "v", "r")
    inputs = torch.tensor([list(INPUTS.values())], dtype=torch.float64).unsqueeze(1)
    unit = Unit(tmp_path)
    x0 = torch.tensor([[1.0, -2.0, 0.3, 1.0, 0.1, -0.05]], dtype=torch.float64)
    for _ in range(2):
        unit.initialize(0.0)
        for name, value in zip(names, x0[0].tolist(), strict=True):
            unit.set(f"{name}_start", value)
        for name, value in INPUTS.items():
            unit.set(name, value)
        unit.unit.exitInitializationMode()
        with torch.no_grad():
            states, _, _ = Rollout(model)(
                x0, inputs.expand(-1, 40, -1), model.initial_state(1).double()
            )
        for k in range(1, 41):
            unit.step(0.1 * (k - 1), 0.1)
            computed = [unit.value(name) for name in names]
            np.testing.assert_allclose(computed, states[0, k].numpy(), rtol=0, atol=1e-12)
        unit.unit.reset()
        # the next run starts from the state that the members would have continued from
        x0 = states[:, -1]
    unit.unit.freeInstance()


def test_simulation_time_may_be_unix_time(tmp_path: Path) -> None:
    """Steps that are differences of rounded times, as an importer computes them."""
    ends = []
    for start in (0.0, 1.764e9):
        unit = Unit(tmp_path)
        unit.initialize(start, start + 200.0)
        unit.set("u_start", 1.0)
        unit.set("n_port", 20.0)
        unit.unit.exitInitializationMode()
        time = start
        for k in range(2000):
            following = start + 0.1 * (k + 1)
            unit.step(time, following - time)
            time = following
        ends.append([unit.value(state) for state in ("x", "y", "psi", "u", "v", "r")])
        assert unit.messages == []
        # beyond the stop time, at a size of a step and a half, and from another time
        for point, size, why, refuses in (
            (time, 0.1, "no step beyond the stop time", True),
            (time, 0.15, "is not a multiple of the model's step of 0.1 s", True),
            (start, 0.1, "the importer's time is used", False),
        ):
            with pytest.raises(FMICallException) if refuses else contextlib.nullcontext():
                unit.step(point, size)
            assert why in unit.messages.pop()
    assert ends[0] == ends[1]
    # a time that does not resolve the step makes no size a multiple of it
    unit = Unit(tmp_path)
    unit.initialize(1e15)
    unit.unit.exitInitializationMode()
    with pytest.raises(FMICallException):
        unit.step(1e15, 0.125)


def test_calls_in_the_wrong_phase_are_refused_with_a_message(tmp_path: Path) -> None:
    unit = Unit(tmp_path)
    before = "no step before the initialization mode was entered and left"
    with pytest.raises(FMICallException):
        unit.step(0.0, 0.1)
    unit.set("u_start", 0.5)
    unit.initialize(0.0)
    with pytest.raises(FMICallException):
        unit.step(0.0, 0.1)
    assert unit.messages == [before, before]
    unit.set("u_start", 1.0)
    # an output follows its start value during initialization
    assert unit.value("u") == 1.0
    unit.unit.exitInitializationMode()
    unit.step(0.0, 0.1)
    u = unit.value("u")
    assert 0.5 < u < 1.0
    for variable, why in (("u_start", "start values can be set until"), ("u", "an output cannot")):
        with pytest.raises(FMICallException):
            unit.set(variable, 2.0)
        assert unit.messages.pop().startswith(why)
    assert (unit.value("u_start"), unit.value("u")) == (1.0, u)
    with pytest.raises(FMICallException):
        unit.initialize(0.0)
    unit.unit.terminate()
    with pytest.raises(FMICallException):
        unit.step(0.1, 0.1)
    # reset instances begin anew
    unit.unit.reset()
    assert unit.value("u_start") == 0.0
    unit.initialize(5.0)
    unit.set("u_start", 1.0)
    unit.unit.exitInitializationMode()
    unit.step(5.0, 0.1)
    assert unit.value("u") == u


def test_compilers_for_other_machines_are_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tool = tmp_path / "x86_64-w64-mingw32-gcc"
    tool.write_text(f'#!/bin/sh\nexec {find_compiler()} "$@"\n')
    tool.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    monkeypatch.setattr(fmu.platform, "machine", lambda: "x86_64")
    spec, model = built("plsr")
    file = tmp_path / "boat.fmu"
    card = get_exporter("fmu2").export(ExportedVessel(spec, model), file)
    binaries = {one for one in zipfile.ZipFile(file).namelist() if one.startswith("binaries/")}
    assert binaries == {"binaries/linux64/model.so", "binaries/win64/model.dll"}
    assert set(card["binaries"]) == {"linux64", "win64"}


@pytest.mark.parametrize("name", ["fmu", "simulink"])
def test_a_removed_format_names_its_replacement(name: str) -> None:
    with pytest.raises(ConfigError, match="fmu2"):
        get_exporter(name)
