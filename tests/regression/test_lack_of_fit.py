"""Lack of fit: functions of the channels that no candidate term explains."""

from __future__ import annotations

import numpy as np
import pytest

from residnet.regression.lack_of_fit import estimate_lack_of_fit, probe_families

NAMES = ("u", "v", "n")


def draw_channels(seed: int, count: int = 3000) -> np.ndarray:
    """Return smooth channels [count, 3] with correlation over some 20 samples."""
    random = np.random.default_rng(seed)
    kernel = np.hanning(40)
    noise = random.normal(size=(count + 39, 3))
    smooth = np.stack([np.convolve(noise[:, j], kernel, mode="valid") for j in range(3)], axis=1)
    return smooth / smooth.std(axis=0)


@pytest.mark.parametrize("seed", range(4))
def test_correlated_noise_has_no_lack_of_fit(seed: int) -> None:
    features = draw_channels(seed)
    x = np.concatenate((features, features**2), axis=1)
    # noise as smooth as the channels: an F test of all samples would reject it
    y = x.sum(axis=1) + draw_channels(seed + 100)[:, 0]
    assert estimate_lack_of_fit(x, y, *probe_families(features, NAMES)) == {}


@pytest.mark.parametrize(
    ("missing", "family"),
    [
        (lambda z: z[:, 0] ** 3, "u"),
        (lambda z: z[:, 1] * z[:, 2], "v, n"),
        (lambda z: np.abs(z[:, 2]), "n"),
    ],
)
def test_the_family_of_a_missing_term_is_reported(missing, family: str) -> None:
    features = draw_channels(5)
    x = np.concatenate((features, features**2), axis=1)
    term = missing(features)
    noise = np.random.default_rng(6).normal(size=len(x))
    y = x.sum(axis=1) + term / term.std() + 0.5 * noise
    families = probe_families(features, NAMES)
    shares = estimate_lack_of_fit(x, y, *families)
    assert list(shares) == [family]
    assert 0.1 < shares[family] < 1.0
    # with the term among the candidates nothing remains but noise
    complete = np.concatenate((x, term[:, None]), axis=1)
    assert estimate_lack_of_fit(complete, y, *families) == {}


def test_an_exact_fit_and_too_few_samples_have_no_result() -> None:
    features = draw_channels(7)
    families, probes = probe_families(features, NAMES)
    assert estimate_lack_of_fit(features, features @ np.ones(3), families, probes) == {}
    cubes = features[:, 0] ** 3
    short = [columns[:80] for columns in probes]
    assert estimate_lack_of_fit(features[:80], cubes[:80], families, short) == {}


def test_constant_channels_have_no_probes() -> None:
    features = draw_channels(8)
    features[:, 1] = 2.0
    families, _ = probe_families(features, NAMES)
    assert families == [("u",), ("n",), ("u", "n")]
