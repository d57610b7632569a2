"""Windows that no change explains count for less; what a change explains counts in full."""

from __future__ import annotations

import numpy as np

from residnet.identification.monitoring import weighed

WINDOWS, CHANGES, VALUES = 6, 3, 40
BELIEF = np.diag([1.0, 1.0, 1.0])


def told(error: np.ndarray, effects: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    sums = weighed([(error, effects)], [np.eye(VALUES)], BELIEF)
    return sums.score, sums.information


def test_a_window_that_no_change_explains_counts_by_what_it_leaves() -> None:
    random = np.random.default_rng(0)
    effects = 3.0 * random.normal(size=(WINDOWS, CHANGES, VALUES))
    noise = 0.5 * random.normal(size=(WINDOWS, VALUES))
    _, usual = told(noise, effects)
    # a large change is explained, whatever its size: windows count as before
    _, changed = told(noise + 2.0 * effects[:, 1], effects)
    np.testing.assert_allclose(changed, usual)
    # one window goes its own way, ten times beyond what clean logs scatter
    strange = noise.copy()
    strange[2] += 10.0 * random.normal(size=VALUES)
    score, information = told(strange, effects)
    left = usual - information
    own = effects[2] @ effects[2].T
    np.testing.assert_allclose(left / own, np.mean(left / own), rtol=1e-6)
    assert 0.97 < np.mean(left / own) < 1.0
    # by itself it would have moved the scores of all others
    others = told(np.delete(noise, 2, 0), np.delete(effects, 2, 0))[0]
    whole = np.einsum("bqn,bn->q", effects, strange)
    assert np.abs(score - others).max() < 0.1 * np.abs(whole - others).max()
