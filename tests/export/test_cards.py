"""The card in the file of every format: level, verdict, data findings and log split of its run."""

from __future__ import annotations

import importlib.util
import json
import os
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from exported_models import built
from tiny import read_json

from residnet.core.names import FORCE_CHANNELS
from residnet.core.samples import Samples
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.store import ModelSpec
from residnet.export import EXPORT_FORMATS, get_exporter
from residnet.export.vessel import ExportedVessel
from residnet.heads.force import ForceHead
from residnet.heads.linear import RidgeConfig
from residnet.runs.folder import RunFolder
from residnet.runs.task import ExportRequest

pytestmark = pytest.mark.usefixtures("short_parity")


def make_force_model(head: RidgeConfig | None) -> tuple[ModelSpec, HybridDynamics]:
    """A ferry driven by forces: the believed hull, and a head that doubles its damping."""
    content = {
        "schema": "residnet.model/1",
        "name": "mine",
        "role": "baseline" if head is None else "head",
        "signals": {"inputs": FORCE_CHANNELS},
        "baseline": {"kind": "believed", "vessel": "milliampere"},
        "head": None if head is None else head.model_dump(),
        "dt": 0.1,
        "integrator": "rk4",
        "low": (-2.0, -1.0, -0.5, -500.0, -500.0, -500.0),
        "high": (2.0, 1.0, 0.5, 500.0, 500.0, 500.0),
    }
    spec = ModelSpec.model_validate(content)
    model = spec.build().double()
    if isinstance(model.head, ForceHead):
        generator = torch.Generator().manual_seed(0)
        z = torch.randn(600, 6, generator=generator, dtype=torch.float64)
        z = z * torch.tensor([0.6, 0.4, 0.2, 200.0, 200.0, 200.0])
        with torch.no_grad():
            target = model.baseline(z) - 0.1 * z[:, :3]
            samples = Samples(
                z, target, torch.arange(600) // 60, torch.zeros(600), ("zigzag",) * 10, NAMES
            )
            residual = model.head.residual_samples(samples, model.baseline(z))
        model.head.calibrate(residual)
        model.head.fit_preferred(residual)
    return spec, model.eval()


NAMES = ("u", "v", "r", *FORCE_CHANNELS)
MODELS: dict[str, Callable[[], tuple[ModelSpec, HybridDynamics]]] = {
    "parameters": lambda: make_force_model(None),
    "feed_forward": lambda: make_force_model(RidgeConfig(space="force", choose="one_step")),
}
"""Models of the formats that do not export every vessel."""


def read_card(name: str, file: Path) -> Any:
    """Return the card as a user finds it in the exported file or next to it."""
    if name in ("torchscript", "feed_forward"):
        extra = {"card.json": ""}
        torch.jit.load(str(file), _extra_files=extra)
        return json.loads(extra["card.json"])
    if name == "onnx":
        import onnxruntime

        session = onnxruntime.InferenceSession(str(file))
        return json.loads(session.get_modelmeta().custom_metadata_map["card"])
    if name.startswith("fmu"):
        with zipfile.ZipFile(file) as archive:
            return json.loads(archive.read("resources/card.json"))
    return read_json(file if name == "parameters" else file.with_suffix(".card.json"))


def require_tools(name: str) -> None:
    """Skip a format whose optional tool is missing on this machine."""
    packages = {"onnx": ("onnx", "onnxscript", "onnxruntime")}.get(name, ())
    missing = [package for package in packages if importlib.util.find_spec(package) is None]
    compilers = (os.environ.get("CC", ""), "cc", "gcc", "clang")
    if name in ("aoti", "c", "fmu", "fmu2", "simulink") and not any(map(shutil.which, compilers)):
        missing.append("a C compiler")
    if missing:
        pytest.skip(f"format {name} needs {', '.join(missing)}")


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[pytest.mark.exporters] if name in ("onnx", "aoti") else [])
        for name in EXPORT_FORMATS.kind_names()
    ],
)
def test_the_card_holds_level_verdict_findings_and_split(
    name: str, tiny_run: Path, tmp_path: Path
) -> None:
    require_tools(name)
    run = tmp_path / "run"
    shutil.copytree(tiny_run, run)
    finding = {
        "level": "will mislead",
        "code": "lag",
        "text": "r lags",
        "action": "shift it",
    }
    inspection = read_json(run / "doctor.json")
    inspection["logs"][0]["findings"] = [finding, finding | {"level": "note"}]
    (run / "doctor.json").write_text(json.dumps(inspection))
    folder = RunFolder(run)
    spec, model = MODELS.get(name, lambda: built("plsr"))()
    file = tmp_path / "written" / f"boat{get_exporter(name).suffix}"
    file.parent.mkdir()
    (file.parent / "boat.masses.yaml").write_text("mass: 180\ninertia: 446\n")

    request = ExportRequest(folder, "predictor", file, name, allows_objections=True)
    written = request.write(ExportedVessel(spec, model), ["it drifts"])

    card = read_card(name, written)
    summary = read_json(run / "summary.json")
    assert card["level"] == summary["level"]
    assert card["verdict"] == summary["verdict"] != []
    assert card["findings"] == [finding | {"log": inspection["logs"][0]["name"]}]
    logs_of_split: dict[str, list[str]] = {"train": [], "validation": [], "test": []}
    for entry in read_json(run / "data_quality.json"):
        logs_of_split[entry["split"]].append(entry["log"])
    assert all(logs_of_split.values())
    logs_of_split["identification"] = logs_of_split.pop("train")
    assert card["split"] == logs_of_split
    assert card["objections"] == ["it drifts"]
    assert card["build"]["model_sha256"]
    if name not in ("feed_forward", "parameters"):
        # these two are no simulation; a vessel model says that it has no waves
        assert card["wave_loads"].startswith("none")
