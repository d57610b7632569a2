"""Validation windows decide which members of an ensemble predict which velocities."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tiny import TINY
from tiny_fit import logs_of, settings_of

from residnet.baselines.regressors import RegressorBaseline
from residnet.dynamics.ensemble import MeanOfTrajectories
from residnet.dynamics.store import load_model, save_model
from residnet.evaluation.freerun import Candidate, run_free_runs
from residnet.evaluation.protocol import Window
from residnet.identification.fitter import FitStore, FittedModel, Fitter
from residnet.identification.member_evidence import (
    compute_p_value,
    group_windows,
    select_members,
)
from residnet.identification.records import FitNotes, MemberExclusion, describe_exclusions
from residnet.report.sections.models import describe_excluded_members

N_WINDOWS = 12
LENGTH = 50


def compute_rmse(errors: np.ndarray) -> np.ndarray:
    return np.sqrt((errors.reshape(N_WINDOWS, LENGTH, -1) ** 2).mean(axis=1))


def draw_errors(random: np.random.Generator, *sizes: float) -> np.ndarray:
    """Return errors [N, 3] of a member with independent offsets in each window."""
    offsets = random.standard_normal((N_WINDOWS, 1, 3)) * np.array(sizes)
    return np.broadcast_to(offsets, (N_WINDOWS, LENGTH, 3)).reshape(-1, 3)


def select(random: np.random.Generator, *members: np.ndarray, **options: Any) -> np.ndarray:
    """Return [M, 3] bool: the used members."""
    constant_velocity = draw_errors(random, 3.0, 3.0, 3.0)
    blocks = np.arange(N_WINDOWS) // 2
    return select_members(
        members, constant_velocity, compute_rmse, blocks, (0, 1, 2), **options
    ).is_used


def test_equal_members_are_retained() -> None:
    n_excluded = 0
    for seed in range(40):
        random = np.random.default_rng(seed)
        is_used = select(random, *(draw_errors(random, 1.0, 1.0, 1.0) for _ in range(3)))
        n_excluded += int((~is_used).sum())
    # 40 draws of 3 velocities, and tests at the level of 5 %
    assert n_excluded <= 12


def test_a_member_that_is_worse_in_sway_is_used_for_surge_and_yaw_only() -> None:
    random = np.random.default_rng(0)
    good = [draw_errors(random, 1.0, 1.0, 1.0) for _ in range(2)]
    worse = draw_errors(random, 1.0, 30.0, 1.0)
    for options in ({}, {"compares_members": False}):
        np.testing.assert_array_equal(
            select(random, *good, worse, **options), [[1, 1, 1], [1, 1, 1], [1, 0, 1]]
        )


def test_a_member_that_harms_the_mean_is_left_out_only_with_independent_evidence() -> None:
    random = np.random.default_rng(1)
    # better than constant velocity, but five times worse than the others
    bias = np.full((N_WINDOWS * LENGTH, 3), 2.0)
    members = (draw_errors(random, 0.4, 0.4, 0.4), draw_errors(random, 0.4, 0.4, 0.4), bias)
    constant_velocity = np.full((N_WINDOWS * LENGTH, 3), 3.0)
    blocks = np.arange(N_WINDOWS)
    selection = select_members(members, constant_velocity, compute_rmse, blocks, (0, 1, 2))
    np.testing.assert_array_equal(selection.is_used, [[1, 1, 1], [1, 1, 1], [0, 0, 0]])
    assert {exclusion.reference for exclusion in selection.exclusions} == {"the mean of the others"}
    np.testing.assert_allclose(selection.weights.sum(axis=0), 1.0)
    trained_on = select_members(
        members, constant_velocity, compute_rmse, blocks, (0, 1, 2), compares_members=False
    )
    assert trained_on.is_used.all()


def test_one_member_remains_for_each_velocity() -> None:
    random = np.random.default_rng(2)
    bad = [draw_errors(random, 30.0, 30.0, 30.0), draw_errors(random, 60.0, 60.0, 60.0)]
    np.testing.assert_array_equal(select(random, *bad), [[1, 1, 1], [0, 0, 0]])


def test_p_values_have_the_level_of_the_test() -> None:
    random = np.random.default_rng(3)
    blocks = np.repeat(np.arange(6), 3)
    p_values = []
    for _ in range(2000):
        # windows of a block are equal, so that only blocks count
        differences = np.repeat(random.standard_normal(6), 3)
        p_values.append(compute_p_value(differences, blocks))
    assert np.mean(np.array(p_values) < 0.05) == pytest.approx(0.05, abs=0.015)


def test_windows_of_few_logs_are_grouped_by_time() -> None:
    def make(log_index: int, start: int) -> Window:
        return Window(log_index, start, start + 40, start, np.zeros(3))

    windows = [make(0, 5), make(0, 15), make(0, 46), make(1, 5), make(1, 30)]
    assert group_windows(windows).tolist() == [0, 0, 1, 2, 2]
    windows = [make(log_index, start) for log_index in range(5) for start in (0, 100)]
    assert group_windows(windows).tolist() == [0, 0, 1, 1, 2, 2, 3, 3, 4, 4]


@pytest.fixture(scope="module")
def fitter() -> Fitter:
    windows = {"kind": "windows", "length": 3.0, "first": 2.0, "history": 1.0}
    settings = settings_of(
        baselines={
            "drifting": {"kind": "regressors", "terms": ["1", "u", "v", "r", "tau_x", "tau_n"]}
        },
        evaluation={**TINY["evaluation"], "protocols": {"T3": windows}, "selection": "T3"},
    )
    return Fitter(logs_of(settings), settings, FitStore())


@pytest.fixture(scope="module")
def members(fitter: Fitter) -> list[FittedModel]:
    """Two baselines, of which the second drifts to one side."""
    good = fitter.fit_baseline("baseline")
    drifting = fitter.fit_baseline("drifting")
    baseline = drifting.model.baseline
    assert isinstance(baseline, RegressorBaseline)
    with torch.no_grad():
        baseline.theta[1, 0] += 0.2
    return [good, drifting]


def test_an_ensemble_does_not_use_the_sway_of_a_member_that_drifts(
    fitter: Fitter,
    members: list[FittedModel],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    messages: list[str] = []
    monkeypatch.setattr("residnet.identification.fitter.log_message", messages.append)
    ensemble = fitter.build_trajectory_ensemble("ensemble", members)
    model = ensemble.model
    assert isinstance(model, MeanOfTrajectories)
    assert ensemble.spec.weights[0][1] == 1.0
    assert ensemble.spec.weights[1][1] == 0.0
    assert ensemble.notes["members"] == ["baseline", "drifting"]
    notes = FitNotes.model_validate(ensemble.notes)
    assert [(row.member, row.velocity) for row in notes.exclusions] == [("drifting", "v")]
    assert messages[-1].startswith("  ensemble: drifting is not used for sway v (p = ")

    # the stored model is the same, and its sway is that of the first member
    save_model(tmp_path / "ensemble", ensemble.spec, model)
    spec, loaded = load_model(tmp_path / "ensemble")
    assert spec.weights == ensemble.spec.weights
    scorer = fitter.score_on_validation
    # parameters are stored in float32, those of the members too
    stored_members = []
    for member in members:
        save_model(tmp_path / member.name, member.spec, member.model)
        stored_members.append(load_model(tmp_path / member.name)[1])
    candidates = [
        Candidate("baseline", "baseline", stored_members[0]),
        Candidate("drifting", "baseline", stored_members[1]),
        Candidate("from_members", "ensemble", model, members=("baseline", "drifting")),
        Candidate("from_steps", "ensemble", loaded),
    ]
    runs = run_free_runs(candidates, scorer.windows, scorer.logs, scorer.dt, scorer.velocity_limits)
    for first, mean, stepped in zip(
        runs["baseline"], runs["from_members"], runs["from_steps"], strict=True
    ):
        np.testing.assert_allclose(mean.states[:, 4], first.states[:, 4], atol=1e-9)
        np.testing.assert_allclose(mean.states[:, 3:], stepped.states[:, 3:], atol=1e-12)


def test_the_report_says_which_member_is_not_used_for_which_velocity() -> None:
    def exclude(member: str, velocity: str, reference: Any, p_value: float) -> MemberExclusion:
        return MemberExclusion(
            member=member, velocity=velocity, reference=reference, p_value=p_value
        )

    exclusions = (
        exclude("hull", "v", "constant velocity", 0.021),
        exclude("hull", "r", "constant velocity", 0.0004),
        exclude("hull_network", "u", "the mean of the others", 0.04),
    )
    sentences = [
        "hull is not used for sway v (p = 0.02) and yaw rate r (p = 0.0004): on validation logs"
        " constant velocity has a smaller error (paired t-test)",
        "hull_network is not used for surge u (p = 0.04): on validation logs the ensemble has a"
        " smaller error without it (paired t-test)",
    ]
    assert describe_exclusions(exclusions) == sentences
    notes = FitNotes(members=("hull", "hull_network"), exclusions=exclusions, left_out=("mlp",))
    assert describe_excluded_members(notes) == [
        *sentences,
        "mlp is not a member: it diverged on validation logs",
    ]
