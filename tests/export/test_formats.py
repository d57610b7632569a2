"""Every export format with every kind of model, its band and its refusals: one contract.

The exporter itself compares good and bad inputs with the model before it writes; here the file is
loaded back as a user would.
"""

from __future__ import annotations

import copy
import ctypes
import functools
import json
import subprocess
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import casadi
import numpy as np
import onnxruntime
import pytest
import torch
from exported_models import HIGH, LOW, VARIANTS, AsTensors, built, spec_of

from residnet.core.errors import ExportError, ResidnetError, WithheldError
from residnet.dynamics.ensemble import mean_of
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.store import BandTable, ModelSpec
from residnet.engine.c_code import find_compiler
from residnet.engine.lowering import lower
from residnet.evaluation.records import MetricsRow
from residnet.export import EXPORT_FORMATS as REGISTERED
from residnet.export import base, get_exporter, torchscript, vessel
from residnet.export.base import LoadedExport, RoundingError, require_releasable
from residnet.export.c import (
    STRICT_FLAGS,
    CasadiModel,
    CFunction,
    CompiledModel,
    compile_shared_library,
    render_c_files,
)
from residnet.export.onnx_file import OnnxModel, _translate_arctangent
from residnet.export.torchscript import AotiModel, ScriptedModel
from residnet.export.vessel import ExportedVessel, GuardedVesselModule
from residnet.heads.symbolic import SymbolicHead
from residnet.heads.symbolic_config import DelayConfig, SymbolicConfig
from residnet.physics.signals_config import SignalsConfig
from residnet.testing import check_bad_inputs
from residnet.testing.checks import (
    EXAMPLE_SIGNALS,
    ROLLING_SIGNALS,
    SUBMERGED_SIGNALS,
    make_example_model,
    make_example_models,
    make_example_samples,
    make_example_spec,
)

pytestmark = pytest.mark.usefixtures("short_parity")
# the figures that the guard and the card read
ROW = MetricsRow.model_construct(
    model="mine", split="test", protocol="T30", manoeuvre="all", nrmse={"mean": 0.1}
)


def exported(variant: str) -> ExportedVessel:
    return ExportedVessel(*built(variant), [ROW])


def compiled(file: Path, made: ExportedVessel) -> LoadedExport:
    library = compile_shared_library([file], file.with_suffix(".so"))
    # a track that depends on rounding is written in double precision
    card = json.loads(file.with_suffix(".card.json").read_text())
    dtype = torch.float64 if card["dtype"].startswith("float64") else torch.float32
    return CompiledModel(library, made, dtype, file.stem)


LOADED: dict[str, Callable[[Path, ExportedVessel], LoadedExport]] = {
    "c": compiled,
    "onnx": lambda file, made: OnnxModel(file, made),
    "casadi": lambda file, made: CasadiModel(file),
    "aoti": lambda file, made: AotiModel(file),
}
SOME = ("plsr", "kernel", "mlp_mirror", "lstm", "lstm_encoder")
CASES = [
    *(("c", variant) for variant in VARIANTS),
    *(("casadi", variant) for variant in VARIANTS),
    *(("onnx", variant) for variant in SOME),
    ("aoti", "plsr"),
]
QUICK = {("c", "plsr"), ("casadi", "plsr")}


@pytest.mark.parametrize(
    ("name", "variant"),
    [pytest.param(*case, marks=() if case in QUICK else pytest.mark.exporters) for case in CASES],
)
def test_a_file_keeps_the_contract(name: str, variant: str, tmp_path: Path) -> None:
    made = exported(variant)
    file = tmp_path / "deep" / f"boat{get_exporter(name).suffix}"
    card = get_exporter(name).export(made, file)
    parities = card["parity"].values() if name == "c" else [card["parity"]]
    for parity in parities:
        assert parity["steps"] == 60
        assert max(parity["share_of_range"].values()) <= 1e-5
    assert card["format"] == name
    loaded = AsTensors(LOADED[name](file, made), made)
    check_bad_inputs(loaded, made.spec, copy.deepcopy(made.model), cases=60)
    if name == "onnx":
        held = onnxruntime.InferenceSession(str(file)).get_modelmeta().custom_metadata_map["card"]
    else:
        held = file.with_suffix(".card.json").read_text()
    assert json.loads(held) == json.loads(json.dumps(card))


@pytest.mark.parametrize(
    "variant",
    [
        name if name in ("lstm_mirror", "symbolic") else pytest.param(name, marks=pytest.mark.long)
        for name in VARIANTS
    ],
)
def test_torchscript_is_the_model(variant: str, tmp_path: Path) -> None:
    """With all its methods, in single precision; the model itself is left alone."""
    made = exported(variant)
    before = copy.deepcopy(made.model.state_dict())
    card = get_exporter("torchscript").export(made, tmp_path / "boat.pt")
    extra = {"card.json": ""}
    module: Any = torch.jit.load(str(tmp_path / "boat.pt"), _extra_files=extra)
    assert json.loads(extra["card.json"]) == json.loads(json.dumps(card))
    for name, value in made.model.state_dict().items():
        torch.testing.assert_close(value, before[name], rtol=0, atol=0, equal_nan=True)
    check_bad_inputs(module, made.spec, made.to_precision(torch.float32), cases=100)
    random = np.random.default_rng(1)
    model = made.to_precision(torch.float32)
    x = random.normal(size=(3, 6)) * [50, 50, 3, 0.5, 0.1, 0.1] + [0, 0, 0, 1, 0, 0]
    inputs = random.uniform(LOW[3:], HIGH[3:], size=(3, 30, 4))
    x0, w = (torch.from_numpy(part).float() for part in (x, inputs))
    past = torch.cat((x0[:, None, :3].expand(-1, 8, -1), torch.full((3, 8, 3), 0.2)), dim=-1)
    with torch.no_grad():
        s = model.warmup(past, w[:, :8])
        together, last, outside = module.rollout(x0, w, module.warmup(past, w[:, :8]))
        at = x0
        for k in range(30):
            at, s = model.step(at, w[:, k], s)
    torch.testing.assert_close(together[:, -1], at, rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(last, s, rtol=1e-4, atol=1e-5)
    assert (together.dtype, outside.dtype, outside.shape) == (torch.float32, torch.bool, (3, 30))


def test_what_is_worse_than_nothing_is_withheld_or_marked() -> None:
    made = exported("lstm")
    with pytest.raises(WithheldError, match=r"model mine is withheld: it drifts; .* --anyway"):
        require_releasable(made, ["it drifts"], allows_objections=False)
    assert require_releasable(made, ["it drifts"], allows_objections=True).build_card()[
        "objections"
    ] == ["it drifts"]
    assert require_releasable(made, [], allows_objections=False).build_card()["objections"] == []


def test_the_card_says_what_a_controller_needs() -> None:
    made = exported("lstm")
    card = made.build_card()
    units = {"x": "m", "y": "m", "psi": "rad", "u": "m/s", "v": "m/s", "r": "rad/s"}
    assert card["schema"] == "residnet.card/1"
    assert card["states"] == [{"name": name, "unit": unit} for name, unit in units.items()]
    names = ("u", "v", "r", "n_port", "n_stbd", "wind_speed", "wind_dir")
    about = zip(names[3:], ("1/s", "1/s", "m/s", "rad"), strict=True)
    roles = (*["command"] * 2, *["exogenous"] * 2)
    assert card["inputs"] == [
        {"name": name, "unit": unit, "role": role}
        for (name, unit), role in zip(about, roles, strict=True)
    ]
    assert (card["dt"], card["integrator"], card["model"]) == (0.1, "rk4", "mine")
    ranges = zip(names, zip(LOW, HIGH, strict=True), strict=True)
    assert card["training_range"] == {name: list(limits) for name, limits in ranges}
    assert card["metrics"] == [ROW.model_dump(exclude_unset=True)]
    assert (card["memory"], card["members"], card["band"]) == (made.model.n_state, [], None)
    assert (card["head"]["kind"], card["baseline"]["kind"]) == ("lstm", "regressors")
    mean = ExportedVessel(*built("mean")).build_card()
    told = [(member["name"], member["head"]["kind"]) for member in mean["members"]]
    assert told[:2] == [("member_0", "plsr"), ("member_1", "lstm")]


def test_outside_flags_each_channel_beyond_its_range() -> None:
    made = exported("lstm")
    module: Any = made.build_module(torch.float32)
    low = torch.tensor(LOW)
    high = torch.tensor(HIGH)
    middle = 0.5 * (low + high)
    # rows: the middle, both corners, then each channel just below and just above its range
    own = torch.eye(len(LOW))
    below, above = (
        middle + own * (edge + step - middle) for edge, step in ((low, -1e-3), (high, 1e-3))
    )
    rows = torch.cat((torch.stack((middle, low, high)), below, above))
    # position and heading have no training range
    x = torch.cat((torch.full((len(rows), 3), 6e3), rows[:, :3]), dim=1)
    _, _, outside = module.step(x, rows[:, 3:], module.initial_state(len(rows)))
    assert outside.tolist() == [False] * 3 + [True] * (2 * len(LOW))


@pytest.mark.exporters
def test_a_compiled_package_takes_rows_of_a_transposed_array(tmp_path: Path) -> None:
    """The package reads memory without strides, so that a view of a row must be copied first."""
    made = exported("plsr")
    get_exporter("aoti").export(made, tmp_path / "boat.pt2")
    loaded = AotiModel(tmp_path / "boat.pt2")
    rows = np.asfortranarray([[9.0, 12, 3, 1], [4.0, 2, 1, 0.5]], dtype=np.float32)
    x, s = np.array([0, 0, 0, 1.0, 0, 0], np.float32), np.zeros(0, np.float32)
    for row in rows:
        np.testing.assert_array_equal(loaded.step(x, row, s)[0], loaded.step(x, row.copy(), s)[0])


def test_casadi_has_exact_derivatives(tmp_path: Path) -> None:
    made = exported("lstm")
    card = get_exporter("casadi").export(made, tmp_path / "boat.casadi")
    assert max(card["parity"]["share_of_range"].values()) <= 1e-12
    model = made.to_precision(torch.float64)
    x = torch.tensor([[1.0, 2, 0.3, 1.1, 0.05, 0.02]], dtype=torch.float64)
    w = torch.tensor([[9.0, 12, 3, 1]], dtype=torch.float64)
    s = model.initial_state(1).double()
    exact = torch.autograd.functional.jacobian(lambda at: model.step(at, w, s)[0][0], x)[:, 0]
    function = CasadiModel(tmp_path / "boat.casadi").function
    symbols = [casadi.MX.sym(name, size) for name, size in made.arguments]
    slope = casadi.Function("slope", symbols, [casadi.jacobian(function(*symbols)[0], symbols[0])])
    found = slope(*(part[0].numpy() for part in (x, w, s)))
    torch.testing.assert_close(torch.from_numpy(found.full()), exact, rtol=1e-9, atol=1e-12)


def test_c_compiles_without_warnings_and_keeps_nothing(tmp_path: Path) -> None:
    made = exported("lstm")
    size = get_exporter("c").export(made, tmp_path / "boat.c")["size"]
    assert 0 < size["stack_bytes"]["boat_step"] < size["code_bytes"]
    text = (tmp_path / "boat.c").read_text()
    assert "malloc" not in text
    kept = [line for line in text.splitlines() if line.startswith("static") and "(" not in line]
    assert all(line.startswith("static const") for line in kept)
    (tmp_path / "main.c").write_text(
        '#include "boat.h"\n#include <stdio.h>\n'
        "int main(void) { float x[6] = {0, 0, 0, 1, 0, 0}, w[4] = {9, 9, 3, 1},"
        " s[BOAT_MEMORY + 1]; int outside;\n"
        "boat_initial_state(s); outside = boat_step(x, w, s, x, s);"
        ' printf("%d %.9g", outside, x[3]); return 0; }\n'
    )
    model = made.to_precision(torch.float32)
    x, w = torch.tensor([[0.0, 0, 0, 1, 0, 0]]), torch.tensor([[9.0, 9, 3, 1]])
    with torch.no_grad():
        after, _ = model.step(x, w, model.initial_state(1))
    for flags in [(), ("-O3", "-Wconversion")]:
        call = [find_compiler(), *STRICT_FLAGS, *flags, "boat.c", "main.c", "-o", "main", "-lm"]
        subprocess.run(call, cwd=tmp_path, check=True)
        printed = subprocess.run([tmp_path / "main"], capture_output=True, text=True).stdout.split()
        assert printed[0] == "0"
        assert float(printed[1]) == pytest.approx(float(after[0, 3]), rel=1e-6)


@pytest.mark.parametrize("left", [0, pytest.param(5, marks=pytest.mark.long)])
def test_coefficients_of_zero_are_left_out(left: int, tmp_path: Path) -> None:
    """A closed-form fit may find that most terms are nothing, or all of them."""
    spec, model = built("plsr")
    with torch.no_grad():
        model.head.coefficients[left:] = 0.0  # type: ignore[index, operator]
    card = get_exporter("c").export(ExportedVessel(spec, model), tmp_path / "boat.c")
    assert max(card["parity"]["double"]["share_of_range"].values()) <= 1e-12


@pytest.mark.parametrize("name", ["c", pytest.param("onnx", marks=pytest.mark.exporters)])
def test_what_single_precision_does_not_determine_is_written_in_double(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Large coefficients that cancel make a model round; here no difference at all is let pass."""
    monkeypatch.setattr(base, "SINGLE_TOLERANCE", -1.0)
    made = exported("plsr")
    file = tmp_path / f"boat.{name}"
    allowed = {torch.float32: -1.0, torch.float64: 1e-7}
    monkeypatch.setattr("residnet.export.onnx_file._TOLERANCES", allowed)
    card = get_exporter(name).export(made, file)
    assert card["dtype"] == "float64"
    loaded = (
        OnnxModel(file, made)
        if name == "onnx"
        else CompiledModel(
            compile_shared_library([file], tmp_path / "boat.so"), made, torch.float64, file.stem
        )
    )
    assert max(made.check_long_run(loaded, "the file", torch.float64, 1e-7).values()) < 1e-7


class Angle(torch.nn.Module):
    def forward(self, y: torch.Tensor, x: torch.Tensor) -> torch.Tensor:
        return torch.atan2(y, x)


@pytest.mark.exporters
def test_onnx_has_the_angles_of_doubles(tmp_path: Path) -> None:
    points = torch.randn(200, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    axes = [[0, 0], [0, 1], [0, -1], [1, 0], [-1, 0], [1e-9, -1], [1, 1e-9], [-1, -1e-9]]
    points = torch.cat((points, torch.tensor(axes, dtype=torch.float64)))
    torch.onnx.export(
        Angle(),
        tuple(points.T.contiguous()),
        str(file := tmp_path / "angle.onnx"),
        optimize=False,
        verbose=False,
        input_names=["y", "x"],
        custom_translation_table={torch.ops.aten.atan2.default: _translate_arctangent},
    )
    given = dict(zip(("y", "x"), points.T.contiguous().numpy(), strict=True))
    (found,) = onnxruntime.InferenceSession(str(file)).run(None, given)
    np.testing.assert_allclose(found, np.arctan2(*points.T.numpy()), rtol=0, atol=1e-14)


def test_an_operation_that_is_not_known_is_refused_by_name() -> None:
    with pytest.raises(ExportError, match="model mine: its step uses torch's operation 'digamma'"):
        lower(lambda x: torch.special.digamma(x + 1), [("x", 2)], ["y"], "model mine")
    with pytest.raises(ExportError, match="cannot be recorded"):
        lower(lambda x: x if bool(x.sum() > 1) else -x, [("x", 2)], ["y"], "model mine")


OPERATIONS: dict[str, Callable[[torch.Tensor], torch.Tensor]] = {
    "table": lambda x: torch.arange(90.0, dtype=x.dtype).reshape(30, 3)[(5 * x[:, 0].abs()).long()],
    "short table": lambda x: torch.eye(3, dtype=x.dtype).index_select(0, x[0, :1].abs().long()),
    "gather": lambda x: x.gather(1, x[:, :1].abs().long() % 4),
    "largest": lambda x: torch.cat((x.max(1)[0], x.argmin(1).to(x.dtype), x.amax(1)))[None],
    "products": lambda x: torch.bmm(x.reshape(1, 2, 2), x.reshape(1, 2, 2)).reshape(1, 4) @ x.T,
    "moves": lambda x: torch.stack((x.flip(1), x.roll(1, 1)), 2).permute(0, 2, 1).reshape(1, -1),
    "rounding": lambda x: torch.cat((x.trunc(), x.floor(), x % 0.7, x.sign(), x.clamp(-1, 1)), 1),
    "powers": lambda x: x.abs() ** 1.5 + x**3 + x**2 / x.abs().sqrt() + torch.pow(2.0, x),
    "choice": lambda x: torch.where((x > 0) & ~(x > 1), x.exp(), x.square()).mean(1, True),
    "wide": lambda x: torch.tanh(x @ torch.linspace(-1, 1, 240, dtype=x.dtype).reshape(4, 60)),
}


@pytest.mark.parametrize("name", OPERATIONS)
def test_operations_are_those_of_torch_in_casadi_and_in_c(name: str, tmp_path: Path) -> None:
    given = torch.tensor([[0.3, -1.7, 2.6, 1.2]], dtype=torch.float64)
    wanted = OPERATIONS[name](given).reshape(-1).numpy()
    function = lower(OPERATIONS[name], [("x", 4)], ["y"], "a step")
    np.testing.assert_allclose(function(given[0].numpy()).full().ravel(), wanted, rtol=1e-12)
    source, header = render_c_files("f", [CFunction("step", "", function)], [], {}, "", "f.h")
    (tmp_path / "f.c").write_text(source)
    (tmp_path / "f.h").write_text(header)
    library = ctypes.CDLL(
        str(compile_shared_library([tmp_path / "f.c"], tmp_path / "f.so", ["-DF_DOUBLE"]))
    )
    out, x = np.zeros(len(wanted)), given[0].numpy()
    library.f_step(ctypes.c_void_p(x.ctypes.data), ctypes.c_void_p(out.ctypes.data))
    np.testing.assert_allclose(out, wanted, rtol=1e-12)


def test_a_changed_weight_and_a_wrong_rollout_are_found() -> None:
    made = exported("lstm")
    module = made.build_module(torch.float32)
    made.check_parity(ScriptedModel(module, torch.float32), "the module", torch.float32)
    other = exported("lstm")
    with torch.no_grad():
        other.model.head.network.networks[0].readout[0].bias[2] += 1e-3  # type: ignore[union-attr, index]
    told = r"model mine: the module differs .* allowed 1e-05"
    with pytest.raises(ExportError, match=told) as said:
        other.check_parity(ScriptedModel(module, torch.float32), "the module", torch.float32)
    assert "\n" not in str(said.value)

    class NotFinite(ScriptedModel):
        def rollout(self, *given: Any) -> Any:
            out: Any = super().rollout(*given)
            out[-1, 5] = np.nan
            return out

    with pytest.raises(ExportError, match="differs from the model"):
        made.check_parity(NotFinite(module, torch.float32), "the module", torch.float32)


def test_a_file_that_differs_from_its_model_does_not_stand(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is written is read back and compared before it takes its place."""
    wrong = torch.jit.script(exported("mlp_mirror").build_module(torch.float32))
    save = torch.jit.save
    monkeypatch.setattr(
        torchscript.torch.jit, "save", lambda _, *to, **extra: save(wrong, *to, **extra)
    )
    with pytest.raises(ExportError, match="model mine"):
        get_exporter("torchscript").export(exported("mlp"), tmp_path / "mine.pt")
    assert not (tmp_path / "mine.pt").exists()


def test_tracks_whose_inputs_jump_find_rounding_that_grows() -> None:
    """What rounds states to four decimals is refused; the model itself is not."""
    made = exported("plsr")

    class Exact(LoadedExport):
        step_of = made.build_step_module(torch.float32)

        def step(self, *given: Any) -> tuple[Any, ...]:
            raise NotImplementedError

        def step_rows(self, *given: Any) -> tuple[Any, ...]:
            with torch.no_grad():
                return tuple(part.numpy() for part in self.step_of(*map(torch.from_numpy, given)))

    class Rounding(Exact):
        def step_rows(self, *given: Any) -> tuple[Any, ...]:
            after, *rest = super().step_rows(*given)
            return (after.round(4), *rest)

    made.check_tracks(Exact(), "the file", torch.float32, 1e-5)
    with pytest.raises(RoundingError, match="the file differs from the model"):
        made.check_tracks(Rounding(), "the file", torch.float32, 1e-5)


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
DEEP = {"w": (0.1, 0.2, 0.3), "q": (0.01, 0.02, 0.03), "z": (0.1, 0.3, 0.9), "theta": ROLLS.phi}


@pytest.mark.parametrize(
    ("table", "signals"),
    [
        (TABLE, EXAMPLE_SIGNALS),
        pytest.param(ROLLS.model_copy(update=DEEP), SUBMERGED_SIGNALS, marks=pytest.mark.long),
        pytest.param(None, ROLLING_SIGNALS, marks=pytest.mark.long),
    ],
)
def test_half_widths_are_those_of_the_table_in_torchscript_and_in_c(
    tmp_path: Path, table: BandTable | None, signals: SignalsConfig
) -> None:
    spec = make_example_spec(None, signals).model_copy(update={"band": table})
    exported = ExportedVessel(spec, make_example_model(spec))
    file = tmp_path / "boat.c"
    card = get_exporter("torchscript").export(exported, tmp_path / "model.pt")
    loaded = torch.jit.load(str(tmp_path / "model.pt"))
    get_exporter("c").export(exported, file)
    library = ctypes.CDLL(
        str(compile_shared_library([file], tmp_path / "boat.so", ["-DBOAT_DOUBLE"]))
    )
    half = np.zeros(len(signals.dof.layout.band_channels))
    for k in (-3, 0, 1, 7, 10, 20, 29, 30, 60):
        library.boat_band(k, half.ctypes.data_as(ctypes.c_void_p))
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
    assert ("phi" in card["band"]) == signals.dof.has_roll
    with pytest.raises(ValueError, match="one half width for each of steps"):
        BandTable.model_validate(TABLE.model_dump() | {"u": (0.1,)})


RATIO = SymbolicConfig(
    terms=("u n_port^-1", "v", "n_port"), delay=DelayConfig(channels=("n_port",), longest=4)
)


def scripted(spec: ModelSpec, model: HybridDynamics) -> Any:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return torch.jit.script(GuardedVesselModule(model.float().eval(), spec).eval())


@functools.cache
def delayed() -> tuple[ModelSpec, HybridDynamics]:
    """A term that divides by revolutions of some steps ago."""
    spec = make_example_spec(RATIO)
    known = make_example_samples()
    model = spec.build().eval()
    spec.baseline.fit_preferred(model.baseline, known)
    turning = known.z[known.z[:, 3] > 1.0]
    head = model.head
    assert isinstance(head, SymbolicHead)
    head.calibrate(known)
    head.features.low[3] = turning[:, 3].min()
    head.line.steps.fill_(3.0)
    head.coefficients.fill_(0.01)
    return spec, model


def ensemble() -> tuple[ModelSpec, HybridDynamics]:
    pairs = [*make_example_models()[1:], delayed()]
    spec = pairs[0][0].model_copy(
        update={"role": "ensemble", "head": None, "members": tuple(spec for spec, _ in pairs)}
    )
    return spec, mean_of([model for _, model in pairs])


@pytest.mark.parametrize("make", [delayed, ensemble])
def test_delays_and_ensembles(make: Any) -> None:
    spec, model = make()
    module = scripted(spec, model)
    check_bad_inputs(module, spec, model, cases=100)
    # a memory or an input of another batch is refused
    x, w, s = torch.zeros(3, 6), torch.ones(3, 2), module.initial_state(3)
    for name, call, given in (
        ("s", "step", (x, w, s[:1])),
        ("w", "step", (x, w[:1], s)),
        ("x", "step", (x[:1, :5], w, s)),
        ("s", "rollout", (x, w[:, None], s[:2])),
        ("w_history", "warmup", (x[:, None], w[:, None].expand(-1, 2, -1))),
    ):
        with pytest.raises(torch.jit.Error, match=f"{name} has the shape .*, expected"):
            getattr(module, call)(*given)
    assert module.step(x.double(), w.double(), s.double())[0].dtype == torch.float32


def test_a_delay_line_begins_with_its_first_sample() -> None:
    """A ratio of zeros would be no number."""
    _, model = delayed()
    head = model.head.double()
    z = make_example_samples().z[200:206][None]
    z[..., 3] = torch.linspace(5.0, 6.0, 6)
    first, memory = head(z[:, 0], torch.zeros(1, head.n_state, dtype=torch.float64))
    settled = head.warmup(z[:, :1].expand(-1, 9, -1))
    assert torch.isfinite(first).all()
    torch.testing.assert_close(memory, settled)
    again, memory = head(z[:, 1], memory)
    torch.testing.assert_close(memory, head.warmup(z[:, :2]))
    torch.testing.assert_close(
        torch.stack((first, again), dim=1), head.teacher_forced_residuals(z[:, :2])
    )
    for _ in range(5):
        _, memory = head(z[:, 5], memory)
    torch.testing.assert_close(memory, head.warmup(z[:, 5:]))


FORMATS = REGISTERED.kind_names()


@pytest.mark.parametrize("name", FORMATS)
def test_a_number_that_is_not_finite_is_refused(name: str, tmp_path: Path) -> None:
    spec, model = built("plsr")
    with torch.no_grad():
        model.baseline.theta[0, 1] = torch.nan  # type: ignore[index, operator]
    file = tmp_path / f"boat{get_exporter(name).suffix}"
    with pytest.raises(ResidnetError) as caught:
        get_exporter(name).export(ExportedVessel(spec, model), file)
    assert "\n" not in str(caught.value)
    assert not list(tmp_path.iterdir())


@pytest.mark.exporters
@pytest.mark.parametrize("name", [name for name in FORMATS if name != "aoti"])
@pytest.mark.parametrize("variant", [*VARIANTS, "none"])
def test_a_format_writes_a_model_or_says_why_not(name: str, variant: str, tmp_path: Path) -> None:
    spec = spec_of(None)
    spec, model = (spec, spec.build()) if variant == "none" else built(variant)
    file = tmp_path / f"boat{get_exporter(name).suffix}"
    said = ""
    try:
        get_exporter(name).export(ExportedVessel(spec, model), file)
    except ResidnetError as error:
        said = str(error).splitlines()[-1]
        assert spec.name in said
    assert file.is_file() == (not said)
    assert bool(list(tmp_path.iterdir())) == (not said)


@pytest.fixture
def a_sine(short_parity: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Sweep each input once, instead of for as long as a memory drifts."""
    monkeypatch.setattr(vessel, "PARITY_STEPS", 350)


def swept(spec: ModelSpec, model: HybridDynamics) -> float:
    """Return the share of the training range that the inputs of the free run sweep at most."""
    _, w, _ = ExportedVessel(spec, model).run_reference(torch.float64)
    n = spec.signals.dof.n_dynamic
    low = torch.tensor(spec.low[n:])
    high = torch.tensor(spec.high[n:])
    return float(((w[0].amax(dim=0) - w[0].amin(dim=0)) / (high - low)).max())


@pytest.mark.usefixtures("a_sine")
def test_inputs_that_ask_for_too_much_together_sweep_less() -> None:
    """Inputs were logged one at a time; together they leave the states that logs hold."""
    spec, model = built("plsr")
    assert swept(spec, model) == pytest.approx(0.8, abs=0.01)
    n = spec.signals.dof.n_dynamic
    low, high = ((*b[:n], *(3.0 * value for value in b[n:])) for b in (spec.low, spec.high))
    wide = spec.model_copy(update={"low": low, "high": high})
    assert swept(wide, model) in (pytest.approx(0.4, abs=0.01), pytest.approx(0.2, abs=0.01))


@pytest.mark.usefixtures("a_sine")
def test_a_model_that_diverges_under_any_sweep_is_refused() -> None:
    spec, model = built("plsr")
    with torch.no_grad():
        model.baseline.theta[0].abs_()  # type: ignore[index, operator]
    with pytest.raises(ExportError, match=r"diverges .* accepted .* choose another model"):
        swept(spec, model)
