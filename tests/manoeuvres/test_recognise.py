import math

import numpy as np
import pytest

from residnet.core.errors import DataError
from residnet.core.log import Log
from residnet.manoeuvres.indices import steered_zigzag

STEP = 0.1


def zigzag_log(
    angle: float,
    heading: float,
    side: float,
    offset: float = 0.0,
    noise: float = 0.0,
    seconds: float = 120.0,
) -> Log:
    """Nomoto's ship (K = .15, T = 8 s) steered in a zigzag from 4 s on, its rudder resting at
    `offset` before and turning about it by 15 deg/s.
    """
    t = np.arange(0, seconds, STEP)
    psi, r, delta, towards = 0.0, 0.0, offset, side
    out = np.zeros((t.size, 2))
    for k, now in enumerate(t):
        out[k] = psi, delta
        if towards * psi >= heading:
            towards = -towards
        wanted = towards * angle + offset if now >= 4.0 else offset
        delta += float(
            np.clip(wanted - delta, -math.radians(15.0) * STEP, math.radians(15.0) * STEP)
        )
        r += STEP * (0.15 * (delta - offset) - r) / 8.0
        psi += STEP * r
    measured = out[:, 1] + noise * np.random.default_rng(0).standard_normal(t.size)
    return Log("zz", t + 3.0, {"psi": out[:, 0] + 0.7, "delta": measured})


@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize(
    ("angle", "heading", "offset"), [(10, 10, 0), (20, 5, 0.8), (30, 20, -1.0), (5, 1, 0)]
)
def test_what_was_steered_is_read_off(
    side: float, angle: float, heading: float, offset: float
) -> None:
    log = zigzag_log(math.radians(angle), math.radians(heading), side, math.radians(offset))
    found = steered_zigzag(log, "delta")
    assert found.side == side
    assert math.degrees(found.angle) == pytest.approx(angle, abs=0.02)
    assert found.start == pytest.approx(4.0, abs=0.15)
    # the order falls on the first sample beyond the heading
    assert math.degrees(found.heading) == pytest.approx(heading, abs=0.4)


def test_noise_on_the_rudder_does_not_make_orders() -> None:
    found = steered_zigzag(
        zigzag_log(math.radians(20), math.radians(20), 1.0, noise=math.radians(0.01)), "delta"
    )
    assert math.degrees(found.heading) == pytest.approx(20, abs=0.5)


def test_other_manoeuvres_are_refused() -> None:
    t = np.arange(0, 60, STEP)
    turn = Log("turn", t, {"psi": 0.05 * t, "delta": np.where(t < 5, 0.0, 0.3)})
    with pytest.raises(DataError, match="turn: the rudder is reversed"):
        steered_zigzag(turn, "delta")
    log = zigzag_log(math.radians(20), math.radians(20), 1.0)
    against = log.replace(channels={"psi": -log["psi"], "delta": log["delta"]})
    with pytest.raises(DataError, match="sign of delta"):
        steered_zigzag(against, "delta")


@pytest.mark.parametrize("every", [1, 2, 3])
def test_where_the_rudder_left_does_not_hang_on_the_grid(every: int) -> None:
    """The order of the closed form: the rudder of the made zigzag leaves at the very sample that is
    the first beyond the heading.
    """
    log = zigzag_log(math.radians(20), math.radians(10), 1.0)
    t, psi, delta = log.t, log["psi"] - log["psi"][0], log["delta"]
    turns = [
        k
        for k in range(60, t.size - 1)
        if abs(delta[k]) == pytest.approx(math.radians(20))
        and abs(delta[k + 1]) < abs(delta[k]) - 1e-6
    ]
    expected = float(np.mean(np.abs(psi[turns])))
    assert len(turns) > 2
    coarse = log.replace(
        t=t[::every], channels={name: log[name][::every] for name in ("psi", "delta")}
    )
    assert math.degrees(steered_zigzag(coarse, "delta").leaves) == pytest.approx(
        math.degrees(expected), abs=0.03
    )
    rates = np.abs(np.gradient(psi, t))[turns]
    assert steered_zigzag(coarse, "delta").turning == pytest.approx(float(rates.mean()), rel=0.02)
    if every == 1:
        assert steered_zigzag(coarse, "delta").leaves > steered_zigzag(coarse, "delta").heading
