"""The contracts that residnet offers to other packages, run over every part of its own."""

from __future__ import annotations

import random
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import written_logs
import written_recorders
from torch import Tensor

from residnet.baselines import BaselineConfig
from residnet.baselines.regressors_config import RegressorsConfig
from residnet.core.config import validate_config
from residnet.core.errors import ConfigError, ResidnetError, UsageError
from residnet.core.layout import VELOCITIES, DegreesOfFreedom
from residnet.core.log import Log
from residnet.core.names import CHANNEL_UNITS
from residnet.core.registry import find_vessel_files, load_kinds
from residnet.dynamics.store import ModelSpec, load_model, save_model
from residnet.engine.compiled import CompiledRollout
from residnet.engine.rollout import Rollout, trace_rollout
from residnet.export import EXPORT_FORMATS, get_exporter, vessel
from residnet.export.vessel import ExportedVessel
from residnet.heads import HeadConfig
from residnet.heads.base import Features
from residnet.heads.linear import RidgeConfig
from residnet.io.readers import ReaderConfig
from residnet.manoeuvres import ManoeuvreConfig
from residnet.physics.signals_config import SignalsConfig
from residnet.testing import (
    check_baseline,
    check_exporter,
    check_head,
    check_manoeuvre,
    check_reader,
    check_vessel,
    make_example_samples,
)
from residnet.testing.checks import (
    EXAMPLE_SIGNALS,
    EXAMPLE_TIME_STEP,
    ROLLING_SIGNALS,
    SUBMERGED_SIGNALS,
    make_example_model,
    make_example_spec,
)

RUDDER = SignalsConfig(inputs=("n", "delta"))
# what a baseline cannot do without, and whose trials it is identified from
BASELINES: dict[str, tuple[dict[str, Any], str]] = {
    "believed": ({"vessel": "wam_v_cal"}, "wam_v_cal"),
    "equations": ({"u": {"u": -0.4, "tau_x": 0.003}, "r": {"r": -1.0}}, "wam_v_cal"),
    "linear_steady": (
        {"settled": 10, "speed": ["random_steps"], "steering": ["zigzag"]},
        "wam_v_cal",
    ),
    "regressors": ({"terms": ["u", "v", "r", "tau_x", "tau_n"]}, "wam_v_cal"),
    "mmg": (
        {
            "hull": {"length": 6, "beam": 2, "draught": 0.4, "mass": 1500, "x_G": 0},
            "propeller": {"diameter": 0.3, "x": -0.48, "thrust": [0.29, -0.28, -0.14]},
            "rudder": {"area": 0.1, "aspect": 1.5, "race": 0.6},
        },
        "example_rudder_boat",
    ),
    "semi_empirical": (
        {
            "hull": {"length": 6, "beam": 2, "draught": 0.4, "mass": 1500, "x_G": 0},
            "propeller": {"diameter": 0.3, "x": -0.48, "thrust": [0.29, -0.28, -0.14]},
            "rudder": {"area": 0.1, "aspect": 1.5, "race": 0.6, "curve": "soeding"},
        },
        "example_rudder_boat",
    ),
    "nomoto": ({}, "example_rudder_boat"),
    "nomoto_sideslip": ({}, "example_rudder_boat"),
}
# what makes a kind quick enough for a contract
HEADS: dict[str, dict[str, Any]] = {
    "genetic": {"evolution": {"population": 60, "generations": 3}, "final": {"max_terms": 6}},
    "symbolic": {"search": {"max_terms": 6}},
    "kernel": {
        "folds": 2,
        "penalties": [0.1],
        "kernel": {"kind": "rbf", "exact": 100, "landmarks": 60},
    },
    "plsr": {"folds": 2, "max_order": 6},
    "mlp": {"hidden": [8]},
    "lstm": {"hidden_size": 6},
    "recurrent": {"hidden_size": 6},
    "sklearn": {"pipeline": [{"sklearn.ensemble.HistGradientBoostingRegressor": {"max_iter": 9}}]},
}
# settings with which a head goes ways that it does not go without
HEAD_VARIANTS: dict[str, dict[str, Any]] = {
    "softsign": {"kind": "lstm", "hidden_size": 6, "activation": "softsign", "readout": 4},
    "per axis": {"kind": "lstm", "hidden_size": 4, "per_axis": True, "mirror": True},
    "of inputs": {"kind": "lstm", "readout": 4, "memory": ["tau_x", "tau_n"], "mirror": True},
    "of motion": {"kind": "lstm", "hidden_size": 5, "readout": 4, "memory": ["v", "r"]},
    "mirrored": {"kind": "mlp", "hidden": [8, 6], "mirror": True, "activation": "silu"},
    "late": {
        "kind": "symbolic",
        "search": {"max_terms": 4},
        "delay": {"channels": ["n_port", "n_stbd"], "longest": 4},
    },
    "terms": {"kind": "kernel", "folds": 2, "penalties": [0.1], "terms": ["n_port|n_port|"]},
    "encoder": {"kind": "recurrent", "hidden_size": 5, "encoder": "measurements"},
    "lstm encoder": {
        "kind": "recurrent",
        "cell": "lstm",
        "hidden_size": 5,
        "encoder": "measurements",
    },
}
MANOEUVRES: dict[str, dict[str, Any]] = {
    "constant": {"drive": 0.6, "steer": 0.2},
    "zigzag": {"drive": 0.6, "steer": 0.4, "heading": "15 deg", "start": 2},
    "turning_circle": {"drive": 0.6, "steer": 0.4, "start": 2},
    "acceleration_deceleration": {"times": [0, 8], "levels": [0.7, 0.2]},
    "three_two_one_one": {"drive": 0.5, "steer": 0.3, "start": 2, "unit": 2},
    "random_steps": {"drive": 0.5, "band": [0.05, 0.3], "steer_amplitude": 0.3},
    "multi_sine": {"drive": 0.5, "band": [0.05, 0.3], "steer_amplitude": 0.3},
    "spiral": {"drive": 0.5, "start": 2, "steady": {"window": 1.5, "tolerance": 0.05}},
    "stopping": {"drive": 0.6, "start": 8},
    "helix": {"drive": 0.6, "steer": 0.3, "dive": 0.2, "start": 2},
    "vertical_zigzag": {"drive": 0.6, "dive": 0.3, "depth": 1, "start": 2},
    "depth_step": {"drive": 0.6, "depth": 2, "start": 2},
    "waypoints": {"drive": 0.7, "points": [[8, 0], [8, 10]], "acceptance": 2, "lookahead": 4},
    "four_corner": {
        "duration": 60,
        "control": {
            "proportional": [200, 200, 800],
            "integral": [5, 5, 30],
            "derivative": [1500, 1500, 4000],
        },
    },
}
# of those that need a vessel with three forces of its own, or one that dives
VESSELS = {"four_corner": "milliampere"} | dict.fromkeys(
    ("helix", "vertical_zigzag", "depth_step"), "remus_100"
)


def _canonical(log: Log, folder: Path) -> Path:
    log.save(folder / f"{log.name}.parquet")
    return folder / f"{log.name}.parquet"


def head_of(kind: str, **settings: Any) -> Any:
    if kind == "genetic":
        pytest.importorskip("deap", reason="genetic programming needs the extra gp")
    return validate_config({"kind": kind, **HEADS.get(kind, {}), **settings}, HeadConfig, "here")


# a search for terms takes seven seconds among the channels of six degrees of freedom, and needs no
# code of its own there
@pytest.mark.parametrize(
    ("kind", "signals"),
    [
        pytest.param(
            kind,
            signals,
            id=f"{kind}-{name}",
            marks=[pytest.mark.long]
            if name == "six" and kind in ("genetic", "symbolic", "sklearn")
            else [],
        )
        for kind in load_kinds(HeadConfig)
        for name, signals in (("planar", EXAMPLE_SIGNALS), ("six", SUBMERGED_SIGNALS))
    ],
)
def test_head(kind: str, signals: SignalsConfig) -> None:
    check_head(head_of(kind), signals)


@pytest.mark.parametrize("kind", HEAD_VARIANTS)
def test_head_with_settings_of_its_own(kind: str) -> None:
    check_head(validate_config(HEAD_VARIANTS[kind], HeadConfig, "here"))


@pytest.mark.parametrize("kind", load_kinds(HeadConfig))
def test_features_choose_what_a_head_sees(kind: str) -> None:
    model = make_example_model(make_example_spec(head_of(kind, features=["u", "v", "r"])))
    z = make_example_samples().z[30:78].reshape(4, 12, -1)
    changed = z.clone()
    changed[..., 3:] += 1000.0
    with torch.no_grad():
        head = model.head.double()
        assert torch.equal(head.teacher_forced_residuals(z), head.teacher_forced_residuals(changed))
    with pytest.raises(ConfigError, match=r"'tau_z' is not a channel.*; did you mean 'tau_y'"):
        head_of(kind, features=["u", "tau_z"]).build(model.signals.names)


@pytest.mark.parametrize("kind", ["mlp", "ridge", "recurrent", "sklearn"])
def test_a_model_stored_in_single_precision_keeps_its_answers(kind: str, tmp_path: Path) -> None:
    """Training leaves float32 weights; they come back as they were."""
    spec = make_example_spec(head_of(kind))
    model = make_example_model(spec).float()
    save_model(tmp_path / "mine", spec, model)
    again = load_model(tmp_path / "mine")[1].float().eval()
    torch.testing.assert_close(again.state_dict(), model.state_dict(), rtol=0, atol=0)
    x, w, s = torch.randn(4, 6), torch.randn(4, 2) * 20, torch.randn(4, model.n_state)
    with torch.no_grad():
        for one, other in zip(model.step(x, w, s), again.step(x, w, s), strict=True):
            assert torch.equal(one, other)


# single precision changes only the type of the generated statements: a trained head and one with a
# closed-form solution are checked here, the others among the long tests
@pytest.mark.parametrize(
    ("kind", "dtype"),
    [
        pytest.param(
            kind,
            dtype,
            id=f"{kind}-{dtype}".replace("torch.", ""),
            marks=[pytest.mark.long]
            if dtype == torch.float32 and kind not in ("mlp", "plsr")
            else [],
        )
        for kind in sorted({*load_kinds(HeadConfig)} - {"sklearn"})
        for dtype in (torch.float64, torch.float32)
    ],
)
def test_a_head_flies_in_c_as_it_does_in_torch(kind: str, dtype: torch.dtype) -> None:
    config = head_of(kind)
    model = make_example_model(make_example_spec(config)).eval()
    z = make_example_samples().z
    model.has_position = False
    z = z[torch.arange(3)[:, None] * 100 + torch.arange(100)]
    given = (
        torch.cat((torch.zeros_like(z[:, 0, :3]), z[:, 0, :3]), dim=1),
        z[..., 3 : 3 + model.signals.n_inputs].repeat(1, 2, 1),
        0.1 * torch.rand(3, model.n_state).double(),
    )
    trained = [p for p in model.head.parameters() if p.requires_grad]
    with torch.no_grad():
        exact: Sequence[Tensor] = Rollout(model.double())(*(part.double() for part in given))
    share = 1e-9 if dtype == torch.float64 else 1e-5
    x, w, s = (part.to(dtype) for part in given)
    slow = Rollout(model.to(dtype))
    fast = CompiledRollout(slow, x, w, s)
    with torch.no_grad():
        found = fast(x, w, s)
        wanted = exact if dtype == torch.float64 else slow(x, w, s)
    for one, other, true in zip(found, wanted, exact, strict=True):
        assert one.shape == other.shape
        # of what each channel reaches; a heading of many turns is rounded in torch as in C
        size, rounded = (
            part.flatten(0, -2).abs().amax(0) for part in (true, other.double() - true)
        )
        assert bool(((one - true).abs() <= share * (size + 1e-3) + 2.0 * rounded).all())
    if trained:
        w = w[:, :40]
        slopes = []
        for run in (fast, slow):
            start = (x.clone().requires_grad_(), s.clone().requires_grad_())
            states, _, after = run(start[0], w, start[1])
            cost = states[..., 3:].square().mean() + after.square().sum()
            slopes.append(torch.autograd.grad(cost, (*trained, *start), allow_unused=True))
        for one, other in zip(*slopes, strict=True):
            if other is not None and other.numel():
                largest = float(other.abs().max())
                assert float((one - other).abs().max()) <= 100 * share * largest


@pytest.mark.parametrize("kind", load_kinds(BaselineConfig))
def test_baseline(kind: str) -> None:
    settings, vessel = BASELINES.get(kind, ({}, "wam_v_cal"))
    config = validate_config({"kind": kind, **settings}, BaselineConfig, "here")
    boat = vessel == "example_rudder_boat"
    check_baseline(config, make_example_samples(vessel, RUDDER) if boat else None)


@pytest.mark.parametrize(
    ("signals", "refusal"),
    [
        (ROLLING_SIGNALS, "does not support roll"),
        (SUBMERGED_SIGNALS, "does not support depth and pitch"),
    ],
    ids=["roll", "six"],
)
@pytest.mark.parametrize("kind", load_kinds(BaselineConfig))
def test_baseline_beyond_the_plane(kind: str, signals: SignalsConfig, refusal: str) -> None:
    """It keeps its contract, or says why not."""
    config = validate_config(
        {"kind": kind, **BASELINES.get(kind, ({}, ""))[0]}, BaselineConfig, "here"
    )
    if kind in ("regressors", "still"):
        config = RegressorsConfig() if kind == "regressors" else config
        check_baseline(config, make_example_samples(signals=signals))
        return
    with pytest.raises(ResidnetError, match=refusal):
        config.build(signals.build().names)


@pytest.mark.parametrize("signals", [ROLLING_SIGNALS, SUBMERGED_SIGNALS], ids=["roll", "six"])
def test_zero_goes_on_level(signals: SignalsConfig) -> None:
    content = make_example_spec(None, signals).model_dump(mode="json", by_alias=True)
    content |= {"role": "constant_velocity", "baseline": {"kind": "still"}}
    model = ModelSpec.model_validate(content).build().double()
    live = signals.dof
    x = torch.zeros(1, len(live.state_names), dtype=torch.float64)
    x[0, 3:] = torch.tensor([1.5, *[0.1] * (live.n_dynamic - 1)])
    w = torch.zeros(1, len(signals.input_columns), dtype=torch.float64)
    after, _ = model.step(x, w, model.initial_state(1).double())
    torch.testing.assert_close(after[:, 3:], x[:, 3:], rtol=0, atol=0)
    assert not live.is_six_dof or float(after[0, 2]) == pytest.approx(0.1 * EXAMPLE_TIME_STEP)


@pytest.mark.parametrize("kind", load_kinds(ManoeuvreConfig))
def test_manoeuvre(kind: str, tmp_path: Path) -> None:
    settings = dict(MANOEUVRES.get(kind, {}))
    if kind == "replay":
        t = np.arange(0.0, 20.0, 0.1)
        channels = {name: np.zeros(t.size) for name in ("x", "y", "psi", "u", "v", "r")}
        channels |= {"cmd_port": 20 + 5 * np.sin(t), "cmd_stbd": 15 * np.cos(t)}
        Log("flown", t, channels).save(tmp_path / "flown.parquet")
        settings = {"log": str(tmp_path / "flown.parquet")}
    manoeuvre = validate_config({"kind": kind, **settings}, ManoeuvreConfig, "here")
    check_manoeuvre(manoeuvre, VESSELS.get(kind, "wam_v_cal"))


READERS: dict[str, tuple[Callable[[Log, Path], Path], str]] = {
    "csv": (written_logs.csv, ""),
    "parquet": (written_logs.parquet, ""),
    "json_lines": (written_logs.json_lines, ""),
    "excel": (written_logs.excel, "openpyxl"),
    "csv_topics": (written_logs.topics, "rosbags"),
    "rosbag": (written_logs.bag2_mcap, "rosbags"),
    "mat": (written_logs.mat5, ""),
    "hdf5": (written_logs.hdf5, "h5py"),
    "nmea": (written_recorders.nmea, "pynmea2"),
    "nmea2000": (written_recorders.nmea2000, "nmea2000"),
    "mavlink": (written_recorders.tlog, "pymavlink"),
    "moos": (written_recorders.moos, ""),
    "ulog": (written_recorders.ulog, "pyulog"),
    "ardupilot": (written_recorders.ardupilot, "pymavlink"),
    "canonical": (_canonical, ""),
    "joined": (written_logs.two_files, ""),
    "auto": (written_logs.bag2_mcap, "rosbags"),
}


@pytest.mark.parametrize("kind", load_kinds(ReaderConfig))
def test_reader(kind: str, tmp_path: Path) -> None:
    write, needs = READERS[kind]
    if needs:
        pytest.importorskip(needs)
    log = written_logs.trial(20.0)
    settings: dict[str, Any] = {}
    if kind in ("csv", "parquet", "excel", "json_lines"):
        channels = {name: {"column": name, "unit": CHANNEL_UNITS[name]} for name in log.channels}
        settings = {"time": {"column": "t"}, "channels": channels}
    if kind == "joined":
        settings = {"parts": written_logs.PARTS, "shift": {"cmd": 0.0}}
    read = check_reader(
        validate_config({"kind": kind, **settings}, ReaderConfig, "here"), write(log, tmp_path)
    )
    # MOOS tells no velocities of the body: they follow from the pose when logs are prepared
    least = {"y", "psi"} if kind == "moos" else {"u", "psi"}
    assert set(log.channels) & set(read.channels) >= least


def formats(*quick: str) -> list[Any]:
    """Every format, those that need compilers or other packages at length."""
    slow = pytest.mark.exporters
    return [
        pytest.param(one, marks=() if one in quick else slow) for one in EXPORT_FORMATS.kind_names()
    ]


@pytest.fixture(autouse=True)
def _short_parity(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(vessel, "PARITY_STEPS", 60)


@pytest.mark.parametrize("name", formats("torchscript", "feed_forward", "parameters"))
def test_export_format(name: str) -> None:
    check_exporter(get_exporter(name))


LAYOUTS = {"drawn": None, "roll": ROLLING_SIGNALS, "six": SUBMERGED_SIGNALS}


# the layout with roll also has states beyond the plane, and is compiled in half of the time
@pytest.mark.parametrize(
    "layout",
    [pytest.param(name, marks=[pytest.mark.long] if name == "six" else []) for name in LAYOUTS],
)
@pytest.mark.parametrize("name", formats("torchscript", "c", "parameters"))
def test_a_format_holds_what_its_layout_names(name: str, layout: str, tmp_path: Path) -> None:
    signals = LAYOUTS[layout] or _drawn(name)
    spec = make_example_spec(RidgeConfig(), signals)
    file = tmp_path / f"model{get_exporter(name).suffix}"
    exported = ExportedVessel(spec, make_example_model(spec))
    if name == "feed_forward":
        with pytest.raises(UsageError, match="fit a"):
            get_exporter(name).export(exported, file)
        return
    card = get_exporter(name).export(exported, file)
    if name == "parameters":
        # without three forces only coefficients of the accelerations are identifiable
        assert [*card["accelerations"]] == [f"{velocity}_dot" for velocity in signals.velocities]
        assert card["not_identifiable"]
        return
    assert [state["name"] for state in card["states"]] == [*signals.dof.state_names]
    assert card["velocities"] == list(signals.velocities)


@pytest.mark.parametrize("name", find_vessel_files())
def test_vessel(name: str) -> None:
    check_vessel(name)


# velocities of a vessel of which only some were recorded
PARTIAL = [("u",), ("v",), ("r",), ("u", "v"), ("u", "r"), ("v", "r")]


def _drawn(kind: str) -> SignalsConfig:
    """Return signals of some velocities, others for each kind."""
    chosen = random.Random(kind).choice(PARTIAL)
    return EXAMPLE_SIGNALS.model_copy(update={"velocities": chosen})


@pytest.mark.parametrize("kind", load_kinds(HeadConfig))
def test_a_head_leaves_dead_velocities_at_zero(kind: str) -> None:
    signals = _drawn(kind)
    model = make_example_model(make_example_spec(head_of(kind), signals))
    inner = getattr(model, "members", [model])[0].head
    seen = [part for part in inner.modules() if isinstance(part, Features)]
    assert seen
    assert not set(signals.dof.fixed_states) & {name for part in seen for name in part.names}
    x = torch.zeros(2, 6, dtype=torch.float64)
    w = 20.0 * torch.rand(2, 30, 2, generator=torch.Generator().manual_seed(1)).double()
    run = trace_rollout(Rollout(model.double()), 10_000)
    nu = run(x, w, model.initial_state(2).double())[0][:, -1, VELOCITIES]
    alive = signals.dof.equation_mask() > 0
    assert bool((nu[:, ~alive] == 0.0).all())
    assert bool((nu[:, alive] != 0.0).all())


@pytest.mark.parametrize("kind", load_kinds(BaselineConfig))
def test_a_baseline_has_no_terms_of_dead_velocities(kind: str) -> None:
    settings, name = BASELINES.get(kind, ({}, "wam_v_cal"))
    config = validate_config({"kind": kind, **settings}, BaselineConfig, "here")
    boat = name == "example_rudder_boat"
    for velocities in (("u",), ("r",), ("u", "r")):
        signals = (RUDDER if boat else EXAMPLE_SIGNALS).model_copy(
            update={"velocities": velocities}
        )
        if kind not in ("equations", "nomoto", "regressors", "still"):
            with pytest.raises(ConfigError, match=r"signals\.velocities"):
                config.build(signals.build().names)
            continue
        baseline = config.build(signals.build().names)
        table = config.fit_preferred(baseline, make_example_samples(name, signals))
        dead = {*signals.dof.fixed_states, *(f"{one}_dot" for one in signals.dof.fixed_states)}
        assert not any({entry.axis, entry.term} & dead for entry in table)
        assert kind in ("equations", "still") or {entry.axis for entry in table} == {
            f"{one}_dot" for one in velocities
        }


@pytest.mark.parametrize("velocities", PARTIAL)
def test_what_logs_tell(velocities: tuple[str, ...]) -> None:
    def told(*names: str) -> DegreesOfFreedom:
        return DegreesOfFreedom.from_channels({name: np.arange(99.0) for name in names})

    live = told(*velocities, "x", "p")
    assert live.velocities == velocities
    assert told(*velocities, "x", "y", "psi").is_complete
    assert told(*({*velocities, "psi"} - {"r"})).has_heading
    assert live.description.endswith("drift") == ({*velocities} == {"u", "r"})
    assert {*live.fixed_states, *live.velocities} == {"u", "v", "r"}
    assert np.flatnonzero(live.equation_mask()).tolist() == live.active_indices
