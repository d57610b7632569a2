"""Every export format with every kind of model: one contract, whatever the format.

The exporter itself compares good and bad inputs with the model before it writes; here the file is
loaded back as a user would.
"""

from __future__ import annotations

import copy
import json
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import casadi
import numpy as np
import onnxruntime
import pytest
import torch
from exported_models import VARIANTS, AsTensors, built

from residnet.control.heading.policy import HeadingPolicy
from residnet.control.heading.turning import Turning
from residnet.core.errors import ExportError
from residnet.export import contract, exporter
from residnet.export.aoti import AotiModel
from residnet.export.autopilot import MEASURED
from residnet.export.c.compiled import STRICT, CompiledModel, compile_shared, compiler
from residnet.export.c.policy import export_autopilot_as_c
from residnet.export.casadi_function import CasadiModel
from residnet.export.contract import Stepped
from residnet.export.guard import GuardedDynamics
from residnet.export.lowering.build import lowered
from residnet.export.onnx_file import OnnxModel
from residnet.testing import check_bad_inputs

STEPS = 60


@pytest.fixture(scope="module", autouse=True)
def short_parity() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(contract, "PARITY_STEPS", STEPS)
        yield


@pytest.mark.exporters
@pytest.mark.parametrize("variant", VARIANTS)
def test_c_holds_every_head(variant: str, tmp_path: Path) -> None:
    spec, model = built(variant)
    file = tmp_path / "deep" / "boat.c"
    card = exporter("c").export(spec, model, file, [])
    stored = json.loads((tmp_path / "deep" / "boat.card.json").read_text())
    assert stored == json.loads(json.dumps(card))
    for precision, allowed in (("single", 1e-5), ("double", 1e-12)):
        assert max(card["parity"][precision]["share_of_range"].values()) <= allowed
        assert card["parity"][precision]["steps"] == STEPS
    source = compile_shared([file], tmp_path / "boat.so")
    stepped = CompiledModel(source, "mine", model.n_state, "single")
    check_bad_inputs(AsTensors(stepped, spec, model), spec, model, cases=60)
    assert sorted(path.name for path in file.parent.iterdir()) == [
        "boat.c",
        "boat.card.json",
        "boat.h",
    ]


@pytest.mark.exporters
@pytest.mark.parametrize("variant", ["plsr", "kernel", "mlp_mirror", "lstm"])
def test_onnx_needs_no_torch(variant: str, tmp_path: Path) -> None:
    spec, model = built(variant)
    card = exporter("onnx").export(spec, model, tmp_path / "boat.onnx", [])
    assert max(card["parity"]["share_of_range"].values()) <= 1e-5
    session = onnxruntime.InferenceSession(str(tmp_path / "boat.onnx"))
    stored = json.loads(session.get_modelmeta().custom_metadata_map["card"])
    assert stored == json.loads(json.dumps(card))
    stepped = OnnxModel(tmp_path / "boat.onnx", spec, model)
    check_bad_inputs(AsTensors(stepped, spec, model), spec, model, cases=60)


@pytest.mark.exporters
def test_a_compiled_package_takes_rows_of_a_transposed_array(tmp_path: Path) -> None:
    """The package reads memory without strides, so that a view of a row must be copied first."""
    spec, model = built("plsr")
    card = exporter("aoti").export(spec, model, tmp_path / "boat.pt2", [])
    assert max(card["parity"]["share_of_range"].values()) <= 1e-5
    stepped = AotiModel(tmp_path / "boat.pt2", spec, model)
    rows = np.asfortranarray([[9.0, 12, 3, 1], [4.0, 2, 1, 0.5]], dtype=np.float32)
    x, s = np.array([0, 0, 0, 1.0, 0, 0], np.float32), np.zeros(0, np.float32)
    for row in rows:
        np.testing.assert_array_equal(stepped.step(x, row, s)[0], stepped.step(x, row.copy(), s)[0])


@pytest.mark.exporters
@pytest.mark.parametrize("variant", VARIANTS)
def test_casadi_has_exact_derivatives(variant: str, tmp_path: Path) -> None:
    spec, model = built(variant)
    card = exporter("casadi").export(spec, model, tmp_path / "boat.casadi", [])
    assert max(card["parity"]["share_of_range"].values()) <= 1e-12
    stepped = CasadiModel(tmp_path / "boat.casadi", spec, model)
    model = model.double()
    x = torch.tensor([[1.0, 2, 0.3, 1.1, 0.05, 0.02]], dtype=torch.float64)
    w = torch.tensor([[9.0, 12, 3, 1]], dtype=torch.float64)
    s = model.initial_state(1).double()
    exact = torch.autograd.functional.jacobian(lambda at: model.step(at, w, s)[0][0], x)[:, 0]
    function = stepped.function
    symbols = [casadi.MX.sym(name, size) for name, size in (("x", 6), ("w", 4), ("s", s.shape[1]))]
    slope = casadi.Function("slope", symbols, [casadi.jacobian(function(*symbols)[0], symbols[0])])(
        *(part[0].numpy() for part in (x, w, s))
    )
    torch.testing.assert_close(torch.from_numpy(np.asarray(slope)), exact, rtol=1e-9, atol=1e-12)


def test_c_compiles_without_warnings_and_keeps_nothing(tmp_path: Path) -> None:
    spec, model = built("lstm")
    exporter("c").export(spec, model, tmp_path / "boat.c", [])
    text = (tmp_path / "boat.c").read_text()
    assert "malloc" not in text
    kept = [line for line in text.splitlines() if line.startswith("static") and "(" not in line]
    assert all(line.startswith("static const") for line in kept)
    (tmp_path / "main.c").write_text(
        '#include "boat.h"\n#include <stdio.h>\n'
        "int main(void) { float x[6] = {0, 0, 0, 1, 0, 0}, w[4] = {9, 9, 3, 1},"
        " s[MINE_MEMORY + 1]; int outside;\n"
        "mine_initial_state(s); outside = mine_step(x, w, s, x, s);"
        ' printf("%d %.9g", outside, x[3]); return 0; }\n'
    )
    (tmp_path / "empty.c").write_text("int main(void) { return 0; }\n")
    narrow = ("-m32", "-msse2", "-mfpmath=sse")
    tried = [compiler(), *narrow, "empty.c", "-o", "empty", "-lm"]
    # where the compiler has the libraries of a 32-bit target
    found = subprocess.run(tried, cwd=tmp_path, capture_output=True).returncode == 0
    more = [narrow] if found else []
    for flags in [(), ("-O3", "-Wconversion"), *more]:
        subprocess.run(
            [compiler(), *STRICT, *flags, "boat.c", "main.c", "-o", "main", "-lm"],
            cwd=tmp_path,
            check=True,
        )
        printed = subprocess.run([tmp_path / "main"], capture_output=True, text=True).stdout
        model = model.float()
        x, w = torch.tensor([[0.0, 0, 0, 1, 0, 0]]), torch.tensor([[9.0, 9, 3, 1]])
        with torch.no_grad():
            after, _ = model.step(x, w, model.initial_state(1))
        assert printed.split()[0] == "0"
        assert float(printed.split()[1]) == pytest.approx(float(after[0, 3]), rel=1e-6)


@pytest.mark.parametrize("left", [0, 5])
def test_coefficients_of_zero_are_left_out(left: int, tmp_path: Path) -> None:
    """A closed-form fit may find that most terms are nothing, or all of them."""
    spec, model = built("plsr")
    with torch.no_grad():
        model.head.coefficients[left:] = 0.0  # type: ignore[index, operator]
    card = exporter("c").export(spec, model, tmp_path / "boat.c", [])
    assert max(card["parity"]["double"]["share_of_range"].values()) <= 1e-12


@pytest.mark.parametrize("name", ["c", "onnx"])
def test_what_single_precision_does_not_determine_is_written_in_double(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Large coefficients that cancel make a model round; here no difference at all is let pass."""
    monkeypatch.setattr(contract, "SINGLE", -1.0)
    spec, model = built("plsr")
    file = tmp_path / f"boat.{name}"
    card = exporter(name).export(spec, model, file, [])
    assert card["dtype"] == "float64"
    given = copy.deepcopy(model).double()
    stepped: Stepped = (
        OnnxModel(file, spec, model)
        if name == "onnx"
        else CompiledModel(compile_shared([file], tmp_path / "boat.so"), "mine", 0, "double")
    )
    shares = contract.require_parity(spec, given, stepped, "the file", torch.float64, 1e-7)
    assert max(shares.values()) < 1e-7


def test_an_operation_that_is_not_known_is_refused_by_name() -> None:
    with pytest.raises(ExportError, match="model mine: its step uses torch's operation 'digamma'"):
        lowered(lambda x: torch.special.digamma(x + 1), [("x", 2)], ["y"], "model mine")
    with pytest.raises(ExportError, match="cannot be recorded"):
        lowered(lambda x: x if bool(x.sum() > 1) else -x, [("x", 2)], ["y"], "model mine")


def test_a_weight_that_is_not_finite_is_refused(tmp_path: Path) -> None:
    spec, model = built("mlp")
    with torch.no_grad():
        next(model.head.parameters())[0, 0] = torch.nan
    with pytest.raises(ExportError, match=r"model mine: head.net.0.weight holds nan"):
        exporter("c").export(spec, model, tmp_path / "boat.c", [])
    assert not list(tmp_path.iterdir())


def test_a_policy_is_written_as_c(tmp_path: Path) -> None:
    torch.manual_seed(0)
    turning = Turning(0.2, 3.9, 3.2)
    policy = HeadingPolicy(MEASURED, turning=turning, limit=0.35, dt=0.02, rate=0.2, hidden=(8,))
    card = {"dt": 0.02, "parity": {"steps": 1000}}
    export_autopilot_as_c("pilot", policy, tmp_path / "pilot.c", safe="hold", card=card)
    stored = json.loads((tmp_path / "pilot.card.json").read_text())
    assert stored["parity"]["share_of_limit"] <= 1e-4
    assert "int pilot_step(const pilot_real *y" in (tmp_path / "pilot.h").read_text()


def test_tracks_whose_inputs_jump_find_rounding_that_grows(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """What rounds states to four decimals is refused; the model itself is not."""
    monkeypatch.setattr(contract, "PARITY_STEPS", 200)
    spec, model = built("plsr")
    guard = GuardedDynamics(model.float(), spec).eval()

    def exact(x: Any, w: Any, s: Any) -> Any:
        with torch.no_grad():
            found = guard.flagged_step(*map(torch.from_numpy, (x, w, s)))
        return tuple(part.numpy() for part in found)

    def rounding(x: Any, w: Any, s: Any) -> Any:
        after, memory, outside = exact(x, w, s)
        return after.round(4), memory, outside

    contract.require_tracks(spec, model, exact, "the file", torch.float32, 1e-5)
    with pytest.raises(contract.Apart, match="the file differs from the model"):
        contract.require_tracks(spec, model, rounding, "the file", torch.float32, 1e-5)
