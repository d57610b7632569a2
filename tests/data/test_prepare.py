"""Inputs over a step, and windows at the beginnings of logs."""

import numpy as np
import pytest
import torch

from residnet.core.errors import DataError
from residnet.core.log import Log
from residnet.core.names import STATE
from residnet.data.prepare import PrepareConfig, Prepared, prepare
from residnet.data.windows import WindowStore

STEP = 0.1


def made(hold: str, *, broken: bool = False) -> Prepared:
    """Six seconds of a steady vessel whose input is t^2, with a break at sample 30 where asked."""
    t = STEP * np.arange(60)
    channels = {name: np.zeros(60) for name in STATE} | {"n": t**2}
    if broken:
        channels["u"][30] = np.nan
    config = PrepareConfig.model_validate({"grid": {"step": STEP}, "derivative": {"kind": "savitzky_golay", "window": 0.5, "order": 2}, "hold": hold})
    return prepare(Log("made", t, channels, manoeuvre="made"), "train", ("n",), config)


def test_an_input_is_held_from_the_sample_unless_told_otherwise() -> None:
    log = made("start")
    assert np.array_equal(log.w, log.recorded)
    assert np.allclose(log.w[:, 0], (STEP * np.arange(60)) ** 2)


@pytest.mark.parametrize("broken", [False, True])
def test_a_mean_over_the_step_ends_with_the_piece(broken: bool) -> None:
    log = made("mean", broken=broken)
    for k in range(60):
        if log.piece[k] < 0:
            continue
        goes_on = k + 1 < 60 and log.piece[k + 1] == log.piece[k]
        expected = (log.recorded[k] + log.recorded[k + 1]) / 2 if goes_on else log.recorded[k]
        assert log.w[k] == pytest.approx(expected)


def test_windows_begin_where_told() -> None:
    logs = [made("start"), made("start", broken=True)]
    store = WindowStore.gather(logs)
    rows = store.beginnings(20, 5)
    assert torch.equal(rows, torch.tensor([5, 65, 96]))
    assert torch.equal(store.depth[rows], torch.full((3,), 5))
    with pytest.raises(DataError, match="beginning"):
        store.beginnings(60, 5)
