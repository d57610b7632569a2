"""One place runs models along logs: closed forms, training, residuals, goodness see the same."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from tiny import TINY
from tiny_fit import logs_of, settings_of

from residnet.data.prepare import channels, samples
from residnet.data.windows import WindowStore
from residnet.identification.fit import fit
from residnet.identification.identified import (
    Identified,
    goodness_rows,
    residual_table,
    teacher_forced,
    term_table,
)
from residnet.identification.prepared import PreparedSplits

SETTINGS = settings_of(
    prepare={**TINY["prepare"], "hold": "mean"},
    baseline={"kind": "regressors", "terms": ["u", "v", "r", "tau_x", "tau_n"]},
    heads={"ridge": {"kind": "ridge"}},
)


@pytest.fixture(scope="module")
def logs() -> PreparedSplits:
    return logs_of(SETTINGS)


@pytest.fixture(scope="module")
def identified(logs: PreparedSplits) -> Identified:
    return fit(logs, SETTINGS)


def test_inputs_move_on_within_a_step(logs: PreparedSplits) -> None:
    """Else the tests below could not tell one rule from the other."""
    log = logs["test"][0]
    assert np.abs(log.w - log.recorded).max() > 1.0


def test_accelerations_are_those_of_the_models_rate_at_the_sample(
    logs: PreparedSplits, identified: Identified
) -> None:
    log, model = logs["test"][0], identified["ridge"].model.double()
    at = int(np.flatnonzero(log.good)[50])
    x, w = torch.from_numpy(log.smooth[at : at + 1]), torch.from_numpy(log.recorded[at : at + 1])
    z = channels(log, model.signals)[at : at + 1]
    torch.testing.assert_close(z, model.channels(x, w), rtol=1e-12, atol=1e-12)
    rate = model.rate(x, model.signals.prepare(w), model.head(z, model.initial_state(1))[0])
    predicted = teacher_forced(model, log).predicted[at]
    np.testing.assert_allclose(predicted, rate[0, 3:].detach().numpy(), rtol=1e-9)


def test_training_sees_the_channels_of_the_closed_forms(logs: PreparedSplits) -> None:
    signals = SETTINGS.signals.build()
    store = WindowStore.gather(logs["train"], torch.float64)
    z = signals(store.smooth, signals.prepare(store.recorded))[store.good]
    torch.testing.assert_close(z, samples(logs["train"], signals).z, rtol=1e-12, atol=1e-12)


def test_least_squares_leaves_nothing_along_its_regressors_by_the_same_rule(
    logs: PreparedSplits, identified: Identified
) -> None:
    """Where the fit saw other inputs, its residual would correlate with the regressors."""
    baseline = identified["baseline"].model
    rows, left = [], []
    for log in logs["train"]:
        run = teacher_forced(baseline, log)
        rows.append(run.z[log.good])
        left.append((log.nu_dot - run.predicted)[log.good])
    z, error = torch.cat(rows), np.concatenate(left)
    names = baseline.signals.names
    for name in ("u", "v", "r", "tau_x", "tau_n"):
        column = z[:, names.index(name)].numpy()
        for axis in range(3):
            share = column @ error[:, axis]
            share /= np.linalg.norm(column) * np.linalg.norm(error[:, axis])
            assert abs(share) < 1e-6, (name, axis)
    known = samples(logs["train"], baseline.signals)
    assert torch.equal(known.z, z)


def test_residuals_terms_and_goodness_agree(logs: PreparedSplits, identified: Identified) -> None:
    table = residual_table(identified.values(), logs["test"], most=10**9)
    rows = {
        (row["model"], row["axis"]): row
        for row in goodness_rows(identified.values(), logs, 0.1)["test"]
    }
    for axis, part in table.groupby("axis"):
        rmse = float(np.sqrt(((part["target"] - part["predicted"]) ** 2).mean()))
        assert rmse == pytest.approx(rows["ridge", axis]["rmse"], rel=1e-9)
    assert term_table(identified.values(), logs["test"]).empty
