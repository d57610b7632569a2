"""The scatter of clean scores: what logs differ in is no alarm, and the right cause comes first."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from residnet.identification.monitoring import Groups, scattered, wider

CAUSES = 3
ALIKE = np.array([[1.0, 0.8, 0.0], [0.8, 1.0, 0.0], [0.0, 0.0, 1.0]])
"""Information about causes of which two look much the same."""


def groups(
    random: np.random.Generator,
    logs: int,
    each: int,
    change: np.ndarray,
    apart: float,
    shared: float = 0.0,
) -> Groups:
    """Groups whose information varies a hundredfold, logs and groups of sizes of their own."""
    log = np.arange(logs).repeat(each)
    information = ALIKE * 10.0 ** random.uniform(0, 2, (logs * each, 1, 1))
    size = change + (shared * random.normal(size=(logs, CAUSES)))[log]
    size = size + apart * random.normal(size=(len(log), CAUSES))
    noise = np.linalg.cholesky(information) @ random.normal(size=(len(log), CAUSES, 1))
    return Groups(log, (information @ size[..., None] + noise)[..., 0], information)


def joined(*parts: Groups) -> Groups:
    each = zip(*(vars(part).values() for part in parts), strict=True)
    return Groups(*(np.concatenate(one) for one in each))


def test_much_information_about_a_wrong_model_is_no_alarm() -> None:
    random = np.random.default_rng(0)
    scatter = scattered(groups(random, 60, 1, np.zeros(CAUSES), 0.5))
    scores = []
    for _ in range(400):
        size, error, _ = scatter.together(groups(random, 5, 1, np.zeros(CAUSES), 0.5))
        scores.append(size / error)
    assert 0.75 < np.std(scores) < 1.2
    # without what logs differ in, five vigorous logs would seem to know better
    assert (scatter.apart > 0.05).all()


def test_groups_of_one_log_share_what_is_their_own() -> None:
    random = np.random.default_rng(1)
    scatter = scattered(groups(random, 40, 5, np.zeros(CAUSES), 0.1, shared=0.5))
    assert (scatter.shared > 0.5 * scatter.apart).all()
    scores = []
    for _ in range(300):
        size, error, _ = scatter.together(groups(random, 1, 5, np.zeros(CAUSES), 0.1, shared=0.5))
        scores.append(size / error)
    assert 0.8 < np.std(scores) < 1.25
    free = scattered(groups(random, 40, 5, np.zeros(CAUSES), 0.5))
    assert (free.shared < 0.3 * free.apart).all()
    # where no clean log tells, a single log counts once
    alone = scattered(groups(random, 40, 1, np.zeros(CAUSES), 0.5))
    np.testing.assert_array_equal(alone.shared, alone.apart)


def test_what_lasts_for_a_stretch_makes_its_scores_lie_wider() -> None:
    """Logs left out tell it: pairs of groups of a long log share less than those of a stretch."""
    random = np.random.default_rng(3)

    def sailed(logs: int, legs: int) -> Groups:
        parts = [
            groups(random, 1, 5, np.zeros(CAUSES), 0.05, shared=0.5) for _ in range(logs * legs)
        ]
        return replace(joined(*parts), log=np.arange(logs).repeat(5 * legs))

    held = joined(*(sailed(2, 4) for _ in range(5)))
    fold = np.arange(5).repeat(40)
    scatter = scattered(held)
    scores = []
    for _ in range(300):
        size, error, _ = scatter.together(sailed(1, 1))
        scores.append(size / error)
    factor = wider(held, fold, 5)
    assert np.std(scores) > 1.3
    assert 0.75 < np.std(scores) / factor < 1.25
    free = joined(*(groups(random, 8, 1, np.zeros(CAUSES), 0.5) for _ in range(5)))
    assert wider(free, np.arange(5).repeat(8), 5) < 1.2


def test_all_scores_together_name_the_cause() -> None:
    random = np.random.default_rng(2)
    scatter = scattered(groups(random, 60, 1, np.zeros(CAUSES), 0.1))
    for cause in range(CAUSES):
        right = 0
        for _ in range(50):
            change = np.where(np.arange(CAUSES) == cause, 1.5, 0.0)
            found = groups(random, 5, 1, change, 0.1)
            size, error, _ = scatter.together(found)
            right += int(np.abs(size / error).argmax()) == cause
            assert abs(size[cause] - 1.5) < 5 * error[cause]
        assert right >= 45


def test_one_log_at_odds_with_the_others_does_not_speak_for_all() -> None:
    random = np.random.default_rng(5)
    scatter = scattered(groups(random, 60, 1, np.zeros(CAUSES), 0.1))
    changed, strange = [], []
    for _ in range(50):
        known = groups(random, 5, 1, np.zeros(CAUSES), 0.1)
        # a manoeuvre that no clean log held asks for ten standard deviations alone
        known.score[-1] += 10.0 * np.sqrt(scatter.variance(known.own))[-1]
        size, error, _ = scatter.together(known)
        strange.append(np.abs(size / error).max())
        size, error, _ = scatter.together(groups(random, 5, 1, np.array([0.0, 0.0, 2.0]), 0.1))
        changed.append(size[2] / error[2])
        assert abs(size[2] - 2.0) < 5 * error[2]
    assert np.median(strange) < 4.0
    assert np.median(changed) > 6.0


def test_a_cause_is_no_likelier_because_clean_logs_were_surer_of_it() -> None:
    random = np.random.default_rng(4)
    scatter = scattered(groups(random, 60, 1, np.zeros(CAUSES), 0.3))
    # clean logs leave open what the mean size of the right cause is, and so its score is smaller
    vague = replace(scatter, known=np.array([1.0, 0.0, 0.0]))
    first = 0
    for _ in range(50):
        found = groups(random, 5, 1, np.array([1.5, 0.0, 0.0]), 0.3)
        size, error, explains = vague.together(found)
        assert abs(size[0]) / error[0] < abs(size[1]) / error[1]
        first += int(np.argmax(explains) == 0)
    assert first > 40
