"""The operating domain in every format with a step: the same flags, and small tables in C."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
import torch
from exported_models import (
    HIGH,
    LOW,
    draw_samples_around_ranges,
    expected_flags,
    exported_with_domain,
)

from residnet.dynamics.domain_config import (
    MAX_TABLE_BYTES,
    OperatingDomain,
)
from residnet.export import get_exporter
from residnet.export.base import LoadedExport
from residnet.export.c import CasadiModel, CompiledModel, compile_shared_library
from residnet.export.onnx_file import OnnxModel
from residnet.export.torchscript import ScriptedModel
from residnet.export.vessel import ExportedVessel

pytestmark = pytest.mark.usefixtures("short_parity")


def load(name: str, file: Path, made: ExportedVessel) -> LoadedExport:
    if name == "c":
        library = compile_shared_library([file], file.with_suffix(".so"))
        return CompiledModel(library, made, torch.float32, file.stem)
    if name == "casadi":
        return CasadiModel(file)
    if name == "onnx":
        return OnnxModel(file, made)
    return ScriptedModel(torch.jit.load(str(file)), torch.float32)


@pytest.mark.parametrize(
    "name", ["c", "casadi", pytest.param("onnx", marks=pytest.mark.exporters), "torchscript"]
)
def test_every_format_flags_the_same_samples(name: str, tmp_path: Path) -> None:
    made = exported_with_domain()
    exporter = get_exporter(name)
    file = tmp_path / f"boat{exporter.suffix}"
    card = exporter.export(made, file)
    assert card["operating_domain"]["relations"][0]["input"] == "n_stbd"
    assert "n_port was set by a controller" in " ".join(card["operating_domain"]["in_words"])
    loaded = load(name, file, made)
    x, w = draw_samples_around_ranges(60)
    s = np.zeros(made.model.n_state, np.float32)
    expected = expected_flags(made, x, w)
    assert 0.2 < np.mean(expected) < 0.95
    flags = [bool(np.ravel(loaded.step(x[k], w[k], s)[2])[0]) for k in range(len(x))]
    assert flags == expected


def test_a_margin_extends_the_range_without_a_flag() -> None:
    made = exported_with_domain()
    domain = made.spec.domain
    assert domain is not None
    # ranges alone, so that neither relation nor density decides
    ranges_only = OperatingDomain(n_logs=4, range_margins=domain.range_margins)
    spec = made.spec.model_copy(update={"domain": ranges_only})
    x = np.zeros((4, 6), np.float32)
    w = np.tile([0.5 * (a + b) for a, b in zip(LOW[3:], HIGH[3:], strict=True)], (4, 1))
    w = w.astype(np.float32)
    x[:, 3:] = [0.5 * (a + b) for a, b in zip(LOW[:3], HIGH[:3], strict=True)]
    # within and beyond the margin of u; within that of n_port; v has none
    x[0, 3] = HIGH[0] + 0.19 * (HIGH[0] - LOW[0])
    x[1, 3] = HIGH[0] + 0.21 * (HIGH[0] - LOW[0])
    w[2, 0] = LOW[3] - 0.09 * (HIGH[3] - LOW[3])
    x[3, 4] = HIGH[1] + 0.01 * (HIGH[1] - LOW[1])
    assert expected_flags(ExportedVessel(spec, made.model), x, w) == [False, True, False, True]


def test_the_tables_of_a_domain_are_small_in_c(tmp_path: Path) -> None:
    made = exported_with_domain()
    with_domain = tmp_path / "with_domain.c"
    without = tmp_path / "without.c"
    get_exporter("c").export(made, with_domain)
    spec = made.spec.model_copy(update={"domain": None})
    get_exporter("c").export(ExportedVessel(spec, made.model), without)
    numbers = [len(re.findall(r"\d\.\d+", file.read_text())) for file in (with_domain, without)]
    assert 0 < 8 * (numbers[0] - numbers[1]) <= MAX_TABLE_BYTES
