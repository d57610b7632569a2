"""The symbolic head against the equations that made the data, and its writing against itself."""

from __future__ import annotations

import ctypes
import os
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import sympy
import torch
from made_equations import CUBIC_SHIPS, SPACE, draw, draw_ship
from made_odin import FORCE_TRUTH, JET_TRUTH, MSD_TRUTH, force_logs, jet_logs, msd_log, step_log
from made_samples import sampled

from residnet.core.errors import FitError
from residnet.core.names import ACCELERATION_NAMES
from residnet.core.samples import Samples
from residnet.heads.symbolic import SegmentedSamples, SymbolicHead, find_best_delay
from residnet.heads.symbolic_config import SymbolicConfig
from residnet.identification.records import FitNotes
from residnet.physics.symmetry import compute_term_parity
from residnet.preprocessing.derivatives import SavitzkyGolay
from residnet.report.sections.models import equation_remarks

FORCES = ("u", "v", "r", "tau_x", "tau_y", "tau_n")
JETS = ("u", "v", "r", "rpm", "nozzle")
FORCE: dict[str, Any] = {"candidates": {"input_degree": 2, "coupling": ["u", "v", "r"]}}
JET: dict[str, Any] = {
    "candidates": {
        "inputs": ["rpm"],
        "input_degree": 2,
        "coupling": ["u"],
        "coupling_degree": 2,
        "angles": ["nozzle"],
    },
}
GOLDEN = Path(os.environ.get("RESIDNET_GOLDEN", "/nowhere"), "g2_odin")
Log = dict[str, np.ndarray]


def samples(log: Log, names: tuple[str, ...], target: np.ndarray | None = None) -> Samples:
    """Samples of one log, with its exact accelerations unless others are given."""
    z = np.stack([log[name] for name in names], axis=1)
    y = np.stack([log[name] for name in ACCELERATION_NAMES], axis=1) if target is None else target
    return sampled(z, y, names, t=log["t"])


def fitted(config: dict[str, Any], data: Samples) -> tuple[SymbolicHead, dict[str, Any]]:
    head = SymbolicConfig.model_validate(config).build(data.names)
    head.calibrate(data)
    return head, head.fit_preferred(data)


def found(notes: dict[str, Any], axis: str) -> dict[str, float]:
    return {
        entry["term"]: entry["value"] for entry in notes["coefficients"] if entry["axis"] == axis
    }


@pytest.mark.long
@pytest.mark.parametrize("number", range(3))
def test_jet_equations_of_random_multisines(number: int) -> None:
    _, notes = fitted(JET, samples(jet_logs(number + 1)[number], JETS))
    for axis, terms in JET_TRUTH.items():
        assert found(notes, axis) == pytest.approx(terms, rel=1e-6)
        assert notes["equations"][axis]["exact"]
        assert not notes["equations"][axis]["cannot_tell_apart"]


@pytest.mark.skipif(not GOLDEN.is_dir(), reason="needs RESIDNET_GOLDEN")
@pytest.mark.parametrize("file", sorted(GOLDEN.glob("jetA*.csv.gz")), ids=lambda file: file.name)
def test_the_jets_equations_from_steps(file: Path) -> None:
    """Document 000 section 6.4: genetic programming did not find these from such inputs."""
    frame = pd.read_csv(file)
    log = {str(name): np.array(frame[name]) for name in frame}
    log |= {f"{name}_dot": log[f"d{name}"] for name in "uvr"}
    _, notes = fitted(JET, samples(log, JETS))
    for axis, terms in JET_TRUTH.items():
        assert notes["equations"][axis]["exact"]
        if not notes["equations"][axis]["same_as_simpler"]:
            assert found(notes, axis) == pytest.approx(terms, rel=0.01)


@pytest.mark.parametrize("seed", [3, 4])
def test_structure_of_random_equations_with_products_magnitudes_and_ratios(seed: int) -> None:
    """A tenth of a standard deviation of noise."""
    drawn = draw(seed)
    _, notes = fitted({"candidates": SPACE.model_dump()}, drawn.samples)
    for axis, terms in zip(ACCELERATION_NAMES, drawn.truth, strict=True):
        assert set(found(notes, axis)) == set(terms)


@pytest.mark.parametrize("ratios", [False, True])
def test_ships_are_known_without_settings(ratios: bool) -> None:
    drawn = draw_ship(1, ratios=ratios)
    _, notes = fitted({}, drawn.samples)
    for axis, terms in zip(ACCELERATION_NAMES, drawn.truth, strict=True):
        assert found(notes, axis) == pytest.approx(terms, rel=1e-6)


@pytest.mark.parametrize("terms", CUBIC_SHIPS)
def test_cubic_terms_are_candidates_by_default(
    terms: tuple[tuple[tuple[str, ...], ...], ...],
) -> None:
    drawn = draw_ship(2, noise=0.1, terms=terms)
    _, notes = fitted({}, drawn.samples)
    for axis, truth in zip(ACCELERATION_NAMES, drawn.truth, strict=True):
        assert set(found(notes, axis)) == set(truth)
        assert notes["equations"][axis]["lack_of_fit"] == {}


def test_lack_of_fit_is_reported_for_the_equations_whose_candidates_exclude_a_term() -> None:
    drawn = draw_ship(1, noise=0.1, terms=CUBIC_SHIPS[0])
    _, notes = fitted({"candidates": {"motion_degree": 2}}, drawn.samples)
    families = {axis: list(notes["equations"][axis]["lack_of_fit"]) for axis in ACCELERATION_NAMES}
    assert families == {"u_dot": ["u"], "v_dot": ["v"], "r_dot": ["r"]}
    remarks = " ".join(equation_remarks(FitNotes.model_validate(notes)))
    assert "which functions of v predict" in remarks


def test_two_levels_of_an_input_do_not_tell_its_square() -> None:
    """What the data cannot identify is said: of two motor speeds rpm^2 is a line through both."""
    log = jet_logs(1)[0]
    log["rpm"] = np.where(log["t"] % 20 < 10, 600.0, 1400.0)
    _, notes = fitted(JET, samples(log, JETS))
    for equation in notes["equations"].values():
        assert equation["same_as_simpler"]["rpm^2"] == pytest.approx(
            {"1": -840000.0, "rpm": 2000.0}
        )
        assert "rpm^2" not in equation["text"]


def test_a_channel_that_never_moves_is_said_to_be_unknown() -> None:
    log = force_logs(1)[0]
    still = ("v", "r", "tau_y", "tau_n", "v_dot", "r_dot")
    log |= {name: np.zeros_like(log[name]) for name in still}
    truth = {"tau_x": 2.026e-4, "u": -0.0101, "u |u|": -0.0492}
    log["u_dot"] = 2.026e-4 * log["tau_x"] - 0.0101 * log["u"] - 0.0492 * log["u"] * abs(log["u"])
    _, notes = fitted(FORCE, samples(log, FORCES))
    assert {"v", "r", "v |v|", "tau_n", "v r"} <= set(notes["unexcited"])
    assert found(notes, "u_dot") == pytest.approx(truth, rel=1e-6)
    assert notes["equations"]["v_dot"]["text"] == "v_dot = 0"


def measured(log: Log, noise: float, window: float, step: float) -> Samples:
    """Velocities with noise, differentiated; samples at both sides of an input's jump left out."""
    random = np.random.default_rng(0)
    noisy = [log[n] + noise * log[n].std() * random.normal(size=len(log["t"])) for n in "uvr"]
    inputs = np.stack([log[n] for n in FORCES[3:]], axis=1)
    jumps = np.flatnonzero(np.abs(np.diff(inputs, axis=0)).max(axis=1) > 300.0)
    bad = np.zeros(len(inputs), dtype=bool)
    bad[jumps] = bad[jumps + 1] = True
    pieces = np.where(bad, -1, np.cumsum(np.append(0, np.diff(bad.astype(int)) != 0)))
    nu = np.stack(noisy, axis=1)
    smooth, rate, good = SavitzkyGolay(window=window, order=2).derive(nu, step, pieces)
    z = np.concatenate((smooth, inputs), axis=1)[good]
    return sampled(z, rate[good], FORCES, t=log["t"][good])


def test_velocities_alone_by_the_weak_form() -> None:
    """1 % noise on velocities, forces in steps, jumps masked: 300 s at 25 Hz. The linear drag in
    surge, a tenth of its acceleration's noise, is the hardest.
    """
    data = measured(step_log(0, 300.0, 0.04), 0.01, 0.12, 0.04)
    _, weak = fitted({**FORCE, "estimator": {"kind": "weak", "window": "2 s"}}, data)
    for axis, terms in FORCE_TRUTH.items():
        got = found(weak, axis)
        assert set(got) == set(terms)
        for term in set(terms) - {"u"}:
            assert got[term] == pytest.approx(terms[term], rel=0.03)
    assert found(weak, "u_dot")["u"] == pytest.approx(-0.0101, rel=0.1)


def spring(log: Log, target: np.ndarray, input_name: str = "tau") -> Samples:
    """The mass-spring-damper as sway: its displacement stands for u, its velocity for v."""
    renamed = {"t": log["t"], "u": log["x"], "v": log["w"], "tau": log[input_name]}
    zero = np.zeros_like(target)
    return samples(renamed, ("u", "v", "tau"), np.stack((zero, target, zero), axis=1))


SPRING: dict[str, Any] = {
    "candidates": {"motions": ["u", "v"], "input_degree": 2, "coupling": ["u", "v"]}
}
SPRING_TRUTH = {"u": MSD_TRUTH["x"], "v": MSD_TRUTH["w"], "tau": MSD_TRUTH["tau"]}


def test_a_delay_is_found_inside_the_regression_and_remembered() -> None:
    log = msd_log(delay=0.5)
    config = {**SPRING, "delay": {"channels": ["tau"], "longest": 12}}
    head, notes = fitted(config, spring(log, log["w_dot"]))
    compiled = torch.jit.script(head.eval())
    assert notes["delay"]["steps"] == 5
    assert notes["delay"]["seconds"] == pytest.approx(0.5)
    assert found(notes, "v_dot") == pytest.approx(SPRING_TRUTH, rel=1e-9)
    assert "tau: 5 steps earlier" in notes["equations"]["v_dot"]["c"]
    assert head.n_state == 13  # and whether there was a sample
    # step by step from the memory of a measured past: the accelerations of the record
    data = spring(log, log["w_dot"])
    with torch.no_grad():
        s = head.warmup(data.z[None, :100])
        for k in range(100, 140):
            same, _ = compiled(data.z[k : k + 1], s)
            rho, s = head(data.z[k : k + 1], s)
            assert torch.equal(same, rho)
            torch.testing.assert_close(rho[0], data.target[k], rtol=0, atol=1e-12)
        late = head.teacher_forced_residuals(data.z[None])[0]
    torch.testing.assert_close(late[12:], data.target[12:], rtol=0, atol=1e-12)
    for seed in range(4):
        random = np.random.default_rng(seed)
        noisy = log | {
            n: log[n] + 0.1 * np.ptp(log[n]) * random.uniform(-1, 1, len(log["t"]))
            for n in ("x", "w", "tau", "w_dot")
        }
        assert fitted(config, spring(noisy, noisy["w_dot"]))[1]["delay"]["steps"] == 5


@pytest.mark.parametrize("shift", [0, 3, 8])
def test_errors_by_delay_are_those_of_refits_across_gaps(shift: int) -> None:
    random = np.random.default_rng(shift)
    count = 400
    u, tau = random.normal(size=(2, count)) * [[1.0], [500.0]]
    late = np.roll(tau, shift)
    y = -u + 1e-3 * late + 1e-7 * u**2 * late * np.abs(late) + 0.3 * random.normal(size=count)
    stretch = np.repeat([0, 1, 2], [150, 50, 200])
    # one term twice does no harm
    terms = ("u", "tau", "u^2 tau |tau|", "tau")
    index = np.array([1])
    past = SegmentedSamples(np.stack((u, tau), axis=1), y[:, None], stretch, 0.1)
    found, profile = find_best_delay(past, [terms], ("u", "tau"), index, 10)
    now = np.array([i for i in range(10, count) if stretch[i] == stretch[i - 10]])
    for steps in range(11):
        then = tau[now - steps]
        x = np.stack((u[now], then, u[now] ** 2 * then * np.abs(then)), axis=1)
        left = y[now] - x @ np.linalg.lstsq(x, y[now], rcond=None)[0]
        assert profile[steps] == pytest.approx(np.log(left @ left), abs=1e-9)
    assert found == shift
    with pytest.raises(FitError, match="delay: 0 samples have 300 preceding"):
        find_best_delay(past, [terms], ("u", "tau"), index, 300)


def test_a_symmetric_vessel_has_no_terms_that_a_mirror_forbids() -> None:
    """Document 001's published equations have such terms (correction M8), not physical ones. Here
    noise and a bias would put them in.
    """
    log = force_logs(1)[0]
    y = (
        np.stack([log[name] for name in ACCELERATION_NAMES], axis=1)
        + 0.02 * np.abs(log["v"])[:, None]
    )
    _, free = fitted(FORCE, samples(log, FORCES, y))
    _, held = fitted({**FORCE, "symmetric": True}, samples(log, FORCES, y))
    assert "|v|" in found(free, "v_dot")
    assert "|v|" in found(held, "u_dot")
    for axis in ("v_dot", "r_dot"):
        assert not any(compute_term_parity(term, FORCES) == 1 for term in found(held, axis))
    _, exact = fitted({**FORCE, "symmetric": True}, samples(log, FORCES))
    assert found(exact, "r_dot") == pytest.approx(FORCE_TRUTH["r_dot"], rel=1e-9)
    assert exact["equations"]["r_dot"]["candidates"] < held["terms"]


def test_free_runs_may_choose_shorter_equations_or_none() -> None:
    log = force_logs(1)[0]
    y = np.stack([log[name] for name in ACCELERATION_NAMES], axis=1)
    data = samples(
        log, FORCES, y + 0.3 * y.std(axis=0) * np.random.default_rng(0).normal(size=y.shape)
    )
    head = SymbolicConfig.model_validate({**FORCE, "choose": "free_run"}).build(FORCES)
    head.calibrate(data)
    solutions = head.fit_solutions(data)
    assert solutions[-1].hyperparameters == {"kept": [0, 0, 0]}
    assert float(solutions[-1].state["coefficients"].abs().max()) == 0
    states = [solution.state["coefficients"] for solution in solutions]
    assert all(not torch.equal(a, b) for i, a in enumerate(states) for b in states[:i])


WRITTEN = (
    "u", "v |v|", "1", "u^2 tau_x cos(r)", "sin(v)^2", "sqrt(u) r", "ssqrt(v)", "inv(tau_x)",
    "u^-2", "|r|^3",
)  # fmt: skip


def written() -> tuple[SymbolicHead, dict[str, Any], torch.Tensor]:
    z = torch.from_numpy(
        np.random.default_rng(0).uniform(0.4, 1.6, size=(400, 4)) * [1, -1, 1, 100]
    )
    names = ("u", "v", "r", "tau_x")
    blank = SymbolicConfig(terms=WRITTEN).build(names)
    weights = torch.from_numpy(
        np.random.default_rng(1).uniform(0.5, 2, size=(len(WRITTEN), 3))
        * np.random.default_rng(2).choice([-1, 1], (len(WRITTEN), 3))
    )
    y = blank.library(z) @ (weights / blank.library(z).std(0).clamp(min=1e-3)[:, None])
    head, notes = fitted({"terms": list(WRITTEN)}, sampled(z, y, names))
    assert notes["kept"] == [len(WRITTEN)] * 3
    return head, notes, z


@pytest.mark.skipif(shutil.which("gcc") is None, reason="needs gcc")
def test_c_code_and_sympy_text_equal_the_head(tmp_path: Path) -> None:
    head, notes, z = written()
    source = "#include <math.h>\n" + "".join(
        equation["c"] for equation in notes["equations"].values()
    )
    (tmp_path / "model.c").write_text(source)
    flags = "-std=c99 -Wall -Wextra -Werror -O2 -shared -fPIC model.c -o model.so -lm"
    subprocess.run(["gcc", *flags.split()], cwd=tmp_path, check=True)
    library = ctypes.CDLL(str(tmp_path / "model.so"))
    with torch.no_grad():
        rho = head(z, z[:, :0])[0]
    symbols = sympy.symbols("u v r tau_x", real=True)
    for axis, name in enumerate(ACCELERATION_NAMES):
        function = getattr(library, name)
        function.restype = ctypes.c_double
        function.argtypes = [ctypes.c_double] * 4
        np.testing.assert_allclose(
            [function(*row) for row in z.tolist()], rho[:, axis], rtol=1e-12, atol=1e-12
        )
        text = notes["equations"][name]["sympy"]
        right = sympy.sympify(text, locals={symbol.name: symbol for symbol in symbols})
        called = sympy.lambdify(symbols, right, "numpy")
        np.testing.assert_allclose(called(*z.numpy().T), rho[:, axis], rtol=1e-12, atol=1e-12)


def test_text_latex_and_parts_that_add_up_to_the_residual() -> None:
    data = samples(force_logs(1)[0], FORCES)
    head, notes = fitted(FORCE, data)
    written = notes["equations"]
    assert written["u_dot"]["text"] == "u_dot = -0.0101 u + 0.0002026 tau_x - 0.0492 u |u| + v r"
    latex = written["u_dot"]["latex"]
    assert latex.startswith(r"\dot{u} = ")
    for part in (r"0.0002026 \tau_{x}", r"- 0.0492 u \left|{u}\right|", r"- 0.0101 u", "r v"):
        assert part in latex
    assert r"4.78 \cdot 10^{-5} \tau_{n}" in written["r_dot"]["latex"]
    with torch.no_grad():
        rho = head.teacher_forced_residuals(data.z)
    torch.testing.assert_close(rho, data.target, rtol=0, atol=1e-9)
    for axis, name in enumerate(ACCELERATION_NAMES):
        parts = head.term_contributions(data.z, axis)
        assert found(notes, name) == pytest.approx(FORCE_TRUTH[name], rel=1e-6)
        assert set(parts) == set(FORCE_TRUTH[name])
        assert notes["equations"][name]["exact"]
        np.testing.assert_allclose(sum(parts.values()), rho[:, axis], atol=1e-12)
