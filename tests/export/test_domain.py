"""The operating domain in every format with a step: the same flags, and small tables in C."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
import torch
from exported_models import HIGH, LOW, built

from residnet.dynamics.domain_config import (
    MAX_TABLE_BYTES,
    InputRelation,
    OperatingDomain,
)
from residnet.export import get_exporter
from residnet.export.base import LoadedExport
from residnet.export.c import CasadiModel, CompiledModel, compile_shared_library
from residnet.export.onnx_file import OnnxModel
from residnet.export.torchscript import ScriptedModel
from residnet.export.vessel import ExportedVessel

pytestmark = pytest.mark.usefixtures("short_parity")
CHANNELS = ("u", "v", "r", "n_port", "n_stbd")
_ROWS = 60


def exported_with_domain() -> ExportedVessel:
    """A model whose domain is a ball of ranges, with alike propellers on one course."""
    spec, model = built("mlp")
    centre = [0.5 * (low + high) for low, high in zip(LOW[:5], HIGH[:5], strict=True)]
    scale = [0.5 * (high - low) for low, high in zip(LOW[:5], HIGH[:5], strict=True)]
    random = np.random.default_rng(0)
    z = random.uniform(-1, 1, (400, 5))
    features = np.column_stack(
        (np.ones(400), z, *(z[:, i] * z[:, j] for i in range(5) for j in range(i, 5)))
    )
    factor = np.linalg.inv(np.linalg.cholesky(features.T @ features / 400))
    domain = OperatingDomain(
        channels=CHANNELS,
        centre=tuple(centre),
        scale=tuple(scale),
        factor=tuple(factor.reshape(-1).tolist()),
        limit=25.0,
        n_logs=4,
        relations=(
            InputRelation(
                input="n_stbd",
                kind="proportional",
                offset=0.0,
                channels=("n_port",),
                gains=(1.0,),
                tolerance=12.0,
            ),
            InputRelation(
                input="n_port",
                kind="feedback",
                offset=10.0,
                channels=("r",),
                gains=(5.0,),
                heading=0.5,
                heading_gain=8.0,
                max_heading=1.5,
                tolerance=14.0,
            ),
        ),
    )
    return ExportedVessel(spec.model_copy(update={"domain": domain}), model)


def load(name: str, file: Path, made: ExportedVessel) -> LoadedExport:
    if name == "c":
        library = compile_shared_library([file], file.with_suffix(".so"))
        return CompiledModel(library, made, torch.float32, file.stem)
    if name == "casadi":
        return CasadiModel(file)
    if name == "onnx":
        return OnnxModel(file, made)
    return ScriptedModel(torch.jit.load(str(file)), torch.float32)


@pytest.mark.parametrize("name", ["c", "casadi", "onnx", "torchscript"])
def test_every_format_flags_the_same_samples(name: str, tmp_path: Path) -> None:
    made = exported_with_domain()
    exporter = get_exporter(name)
    file = tmp_path / f"boat{exporter.suffix}"
    card = exporter.export(made, file)
    assert card["operating_domain"]["relations"][0]["input"] == "n_stbd"
    assert "n_port was set by a controller" in " ".join(card["operating_domain"]["in_words"])
    loaded = load(name, file, made)
    random = np.random.default_rng(1)
    low = np.array(LOW)
    high = np.array(HIGH)
    values = (low + (high - low) * random.random((_ROWS, len(LOW)))).astype(np.float32)
    x = np.zeros((_ROWS, 6), np.float32)
    x[:, 2] = random.uniform(-3, 3, _ROWS)
    x[:, 3:] = values[:, :3]
    w = values[:, 3:]
    s = np.zeros(made.model.n_state, np.float32)
    guarded = made.guard_model(torch.float32)
    with torch.no_grad():
        memory = torch.zeros(_ROWS, guarded.n_state)
        expected = guarded.flagged_step(torch.from_numpy(x), torch.from_numpy(w), memory)[2]
    assert 0.2 < float(expected.double().mean()) < 0.95
    flags = [bool(np.ravel(loaded.step(x[k], w[k], s)[2])[0]) for k in range(_ROWS)]
    assert flags == expected.tolist()


def test_the_tables_of_a_domain_are_small_in_c(tmp_path: Path) -> None:
    made = exported_with_domain()
    with_domain = tmp_path / "with_domain.c"
    without = tmp_path / "without.c"
    get_exporter("c").export(made, with_domain)
    spec = made.spec.model_copy(update={"domain": None})
    get_exporter("c").export(ExportedVessel(spec, made.model), without)
    numbers = [len(re.findall(r"\d\.\d+", file.read_text())) for file in (with_domain, without)]
    assert 0 < 8 * (numbers[0] - numbers[1]) <= MAX_TABLE_BYTES
