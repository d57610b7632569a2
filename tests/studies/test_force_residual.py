"""Force residuals on measured logs: a log with a known answer must give it, one without must be
said to have none.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
import yaml
from tiny import write_yaml

import residnet
from residnet.core.config import load_config
from residnet.core.errors import ConfigError, DataError, FitError, UsageError
from residnet.physics.force_terms import FERRY_TERMS
from residnet.studies.jervan2020.force_logs import compare_accelerations
from residnet.studies.jervan2020.measured.config import ForceResidualConfig
from residnet.studies.jervan2020.measured.execute import (
    ForceResidualExecutor,
    is_significantly_better,
    read_logs,
    run_force_study,
)

CONFIG = Path(residnet.__file__).parents[2] / "configs" / "studies" / "jervan2020" / "measured.yaml"
STEP = 0.1
OFFSET = 0.05
RIDGE: dict[str, Any] = {"fit": {"kind": "ridge"}}


def motion(seed: int, seconds: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """t [T], nu and nu_dot [T, 3]: sums of slow sines, different for every seed."""
    random = np.random.default_rng(seed)
    t = STEP * np.arange(round(seconds / STEP))
    omega = random.uniform(0.1, 0.5, (3, 6))
    phase = random.uniform(0, 2 * np.pi, (3, 6))
    size = np.array([0.3, 0.15, 0.05])[:, None, None] / np.sqrt(6) * 1.4
    angle = omega[..., None] * t + phase[..., None]
    nu = size * np.sin(angle)
    nu_dot = size * omega[..., None] * np.cos(angle)
    return t, nu.sum(1).T, nu_dot.sum(1).T


def log(
    folder: Path,
    name: str = "one",
    *,
    missing: float = 1.0,
    seed: int = 0,
    seconds: float = 300.0,
    noise: float = 2.0,
    **spoil: Any,
) -> None:
    """A csv like the measured ones: tau = F_believed + missing (500 u_dot + 80 v|v| on surge and
    sway) + noise.
    """
    hull = load_config(CONFIG, [f"data.root={folder}"], ForceResidualConfig).believed_hull()
    t, nu, nu_dot = motion(seed, seconds)
    with torch.no_grad():
        force = hull.required_force(torch.from_numpy(nu_dot), torch.from_numpy(nu)).numpy()
    random = np.random.default_rng(seed + 100)
    u, v, r = nu.T
    extra = np.stack((500 * nu_dot[:, 0], 300 * v * np.abs(v), 400 * nu_dot[:, 2]), axis=1)
    force = force + missing * extra + noise * random.standard_normal(force.shape)
    psi = np.cumsum(r) * STEP
    north = np.cumsum(u * np.cos(psi) - v * np.sin(psi)) * STEP
    east = np.cumsum(u * np.sin(psi) + v * np.cos(psi)) * STEP
    columns: dict[str, Any] = {"t": t, "north": north, "east": east, "psi": psi}
    columns |= {"u": u, "v": v, "r": r}
    columns |= {"udot": nu_dot[:, 0] + OFFSET, "vdot": nu_dot[:, 1], "rdot": nu_dot[:, 2]}
    for axis, letter in enumerate("xyn"):
        columns[f"tau_{letter}_est"] = columns[f"tau_{letter}_cmd"] = force[:, axis]
    folder.mkdir(exist_ok=True)
    pd.DataFrame({**columns, **spoil}).to_csv(folder / f"{name}.csv", index=False)


def config(folder: Path, *overrides: str, **models: dict[str, Any]) -> ForceResidualConfig:
    content = yaml.safe_load(CONFIG.read_text())
    content["models"] = models or {"ridge": RIDGE}
    content["data"]["root"] = str(folder)
    file = write_yaml(folder / "config.yaml", content)
    found: ForceResidualConfig = load_config(file, list(overrides), ForceResidualConfig)
    return found


def studied(settings: ForceResidualConfig) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the rows by model, and all results."""
    results, _ = run_force_study(settings)
    return {row["model"]: row for row in results["rows"]}, results


def test_what_the_hull_lacks_is_found_and_said(tmp_path: Path) -> None:
    log(tmp_path)
    settings = config(tmp_path, plsr={"fit": {"kind": "plsr"}}, ridge=RIDGE)
    results, figures = run_force_study(settings)
    rows = {row["model"]: row for row in results["rows"]}
    for name in ("ridge", "plsr"):
        assert is_significantly_better(rows[name], "believed") == [True] * 4
        assert is_significantly_better(rows[name], "zero")[3]
    # noise of 2 N is all that is left
    assert all(2.0 < value < 8.0 for value in rows["ridge"]["mse"])
    coefficients = dict(zip(FERRY_TERMS, results["models"]["ridge"]["coefficients"], strict=True))
    assert coefficients["u_dot"][0] == pytest.approx(500, rel=0.05)
    assert coefficients["r_dot"][2] == pytest.approx(400, rel=0.05)
    assert "in the mean over the axes: plsr and ridge." in " ".join(
        ForceResidualExecutor(settings).summarize(results)
    )
    titles = [
        section.title
        for section in ForceResidualExecutor(settings).build_sections(results, tmp_path / "run")
    ]
    # the first picture has no title
    assert titles[:3] == ["", "Data and cross-validation", "Commanded and actual force"]
    assert "Residual of the actual force" in titles
    assert {figure.name for figure in figures} >= {"scores", "forces_one", "residual_one"}


# 3 s; test_what_the_hull_lacks_is_found_and_said covers the verdict
@pytest.mark.long
def test_a_residual_of_noise_is_said_to_be_none(tmp_path: Path) -> None:
    log(tmp_path, missing=0.0, noise=20.0)
    settings = config(tmp_path, ols={"fit": {"kind": "ols"}}, surface={"fit": {"kind": "surface"}})
    rows, results = studied(settings)
    assert [*rows] == ["zero", "believed", "ols", "surface"]
    assert not any(
        any(is_significantly_better(rows[name], "believed")) for name in ("ols", "surface")
    )
    assert is_significantly_better(rows["believed"], "zero")[3]
    said = ForceResidualExecutor(settings).summarize(results)
    assert "None of the 2 regressions is better" in " ".join(said)
    assert "Recommended: the believed model alone in surge, sway and yaw." in said


@pytest.mark.long
def test_a_believed_model_that_is_worse_than_no_force_is_no_yardstick(tmp_path: Path) -> None:
    """The forces are noise, the believed hull predicts others: regressions beat it, not zero."""
    random = np.random.default_rng(7)
    names = [f"tau_{letter}_{kind}" for letter in "xyn" for kind in ("est", "cmd")]
    noise: dict[str, Any] = {name: random.normal(0.0, 5.0, 3000) for name in names}
    log(tmp_path, missing=0.0, **noise)
    settings = config(tmp_path)
    rows, results = studied(settings)
    assert rows["ridge"]["reference"] == ["zero"] * 3
    assert is_significantly_better(rows["ridge"], "believed") == [True] * 4
    assert not any(is_significantly_better(rows["ridge"], "reference"))
    assert rows["believed"]["minus_zero"]["ci95"][3][0] > 0
    said = " ".join(ForceResidualExecutor(settings).summarize(results))
    for words in (
        "worse than no force in surge, sway and yaw",
        "None of the 1 regressions is better than the better of no force",
        "Recommended: no force at all in surge, sway and yaw.",
    ):
        assert words in said


def test_folds_are_stretches_of_one_log_with_a_gap_and_whole_logs_of_three(tmp_path: Path) -> None:
    log(tmp_path)
    measured = read_logs(config(tmp_path))
    # the sensor that is off is calibrated
    surge, sway = (measured.acceleration_comparison[name] for name in ("surge", "sway"))
    assert surge["offset"] == pytest.approx(OFFSET, abs=1e-4)
    assert surge["offset_ci95"][0] <= OFFSET <= surge["offset_ci95"][1] + 1e-6
    assert sway["offset"] == pytest.approx(0.0, abs=1e-4)
    record, test = measured.split_fold(2, 5.0)
    assert measured.fold_unit == "stretches"
    near = torch.nn.functional.max_pool1d(test.double()[None, None], 101, 1, 50)[0, 0] > 0
    assert not bool((near & record.is_training).any())
    assert int((~near & ~record.is_training).sum()) == int((~measured.usable & ~near).sum())
    for number, name in enumerate(("two", "three")):
        log(tmp_path, name, seed=number + 1, seconds=100.0)
    measured = read_logs(config(tmp_path))
    record, test = measured.split_fold(0, 5.0)
    assert (measured.names, measured.fold_unit) == (("one", "three", "two"), "logs")
    first = slice(record.run_lengths[0])
    assert bool(test[first].any())
    assert not bool(test[record.run_lengths[0] :].any())
    assert not bool(record.is_training[first].any())
    # no segment reaches across logs
    ends = torch.tensor(record.run_lengths).cumsum(0)[:-1]
    assert bool((record.fold[ends] != record.fold[ends - 1]).all())
    log(tmp_path, "copy")
    with pytest.raises(DataError, match="identical rows"):
        read_logs(config(tmp_path))


def test_outliers_and_gaps_are_left_out(tmp_path: Path) -> None:
    u, v, _ = motion(0, 300.0)[1].T.copy()
    u[700] += 3.0
    v[1500:1600] = np.nan
    log(tmp_path, u=u, v=v)
    measured = read_logs(config(tmp_path))
    assert not bool(measured.usable[700])
    assert not bool(measured.usable[1500:1600].any())
    assert measured.masked_shares["one"]["outlier"] > 0
    assert bool(torch.isfinite(measured.record.command).all())
    assert all(value < 8.0 for value in studied(config(tmp_path))[0]["ridge"]["mse"])


def test_lag_of_the_thrusters_is_told_by_the_actual_forces(tmp_path: Path) -> None:
    log(tmp_path, missing=0.0, noise=0.0)
    table = pd.read_csv(tmp_path / "one.csv")
    for letter in "xyn":
        table[f"tau_{letter}_est"] = table[f"tau_{letter}_cmd"].shift(5, fill_value=0.0)
    table.to_csv(tmp_path / "one.csv", index=False)
    forces = studied(config(tmp_path))[1]["forces"]
    lag = forces["lag"]
    # half a second, as a delay and what the second-order lag adds to it
    assert lag["delay"] + 2 * lag["damping"] / lag["frequency"] == pytest.approx(0.5, abs=0.05)
    assert all(forces[axis]["explained_with_lag"] > 0.99 for axis in ("surge", "sway", "yaw"))


@pytest.mark.long
def test_a_model_that_is_not_determined_is_set_aside_and_said(tmp_path: Path) -> None:
    log(tmp_path, psi=np.zeros(3000))
    settings = config(tmp_path, ridge=RIDGE, earth={**RIDGE, "earth": True})
    _, results = studied(settings)
    assert list(results["models"]) == ["ridge"]
    said = "model earth: a constant force in earth axes is not identifiable"
    assert results["failed"]["earth"].startswith(said)
    titles = [
        section.title
        for section in ForceResidualExecutor(settings).build_sections(results, tmp_path / "run")
    ]
    assert "Not determined by these logs" in titles


STILL = {"seconds": 120.0, "v": np.zeros(1200)}
REFUSED: list[tuple[dict[str, Any], tuple[str, ...], str]] = [
    (STILL, (), "model ridge: basis function 'v_dot' is constant"),
    ({"tau_x_est": np.full(3000, np.nan)}, (), "holds no number"),
    ({}, ("channels.actual=[acting_tau, a, b]",), "no channel 'acting_tau'"),
    ({}, ("data.logs=[none_*.csv]",), "matches no file"),
]


@pytest.mark.parametrize(("spoil", "overrides", "said"), REFUSED)
def test_data_that_determine_nothing_are_clear_errors(
    spoil: dict[str, Any], overrides: tuple[str, ...], said: str, tmp_path: Path
) -> None:
    log(tmp_path, **spoil)
    with pytest.raises((ConfigError, DataError, FitError, UsageError), match=said):
        run_force_study(config(tmp_path, *overrides))


def test_comparison_of_accelerations_without_segments_has_no_interval() -> None:
    a = torch.randn(50, 3, dtype=torch.float64)
    found = compare_accelerations(a, a + 1, torch.zeros(50))["yaw"]
    assert found.pop("offset_ci95") is None
    expected = {"offset": 1.0, "rms_without_offset": 0.0, "correlation": 1.0}
    assert found == pytest.approx(expected | {"rms": float(a[:, 2].std())}, abs=1e-9)
