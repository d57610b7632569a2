"""The printed equations of document 001 on their own ground, and on the records of the tanker.

    python scripts/bench/moreno_equations.py

They are read as the corrections M6 to M8 have them. The document prints neither the voltages of
its motor nor the logs, so that the first table runs them at voltages from 1 to 10 V until they are
steady: speed and rate of turn at 0, 10 and 20 deg of rudder to either side, in ship's lengths of
4.389 m. The second runs them along the random manoeuvres of the model tanker Esso Osaka with the
propeller's revolutions as voltage, by the factor of least error among seven before the runs
diverge; it needs ${RESIDNET_DATA}/esso_osaka.
"""

from __future__ import annotations

import os

import bench
import numpy as np
import torch
from torch import Tensor

from residnet.baselines.given_config import EquationsConfig
from residnet.dynamics.hybrid import HybridDynamics
from residnet.engine.rollout import Rollout
from residnet.heads.base import ZeroHead
from residnet.physics.signals_config import SignalsConfig
from residnet.tasks.registry import load_task

CONFIG = bench.CONFIGS / "studies" / "moreno2019" / "moreno2019.yaml"
LENGTH = 4.389
INPUTS = ("volts", "delta")
EQUATIONS = EquationsConfig(
    u={
        "delta": 0.01779,
        "volts": 0.005287,
        "|v|": -0.01779,
        "u^3": -0.001518,
        "u r delta volts^-1": -0.7361,
    },
    v={"r": 0.0776, "v": -0.1217, "u r": 0.108, "u volts^-1": -0.0776, "r^2": 0.5737},
    r={
        "delta |u|": 0.1862,
        "delta |volts|": -0.06615,
        "v^2 volts^-1": -0.01165,
        "v volts^-1": 0.01165 * 9.974,
        "u r volts^-2": -3.585,
    },
    source="document 001, section 4, corrections M6 to M8",
)
FACTORS = (0.03, 0.1, 0.2, 0.3, 0.5, 0.7, 1.0)
"""Volts for each revolution in a second of the tanker's propeller."""
FASTEST = 10.0
"""Velocity in m/s or rad/s beyond which a run has diverged."""


def run(x0: Tensor, w: Tensor, step: float) -> Tensor:
    """Return the velocities [B, T + 1, 3] of free runs from x0 [B, 6] under inputs w [B, T, 2]."""
    signals = SignalsConfig(inputs=INPUTS).build()
    model = HybridDynamics(signals, EQUATIONS.build(signals.names), ZeroHead(), step).double()
    with torch.no_grad():
        return Rollout(model)(x0, w, x0[:, :0])[0][..., 3:6]


def steady() -> None:
    """Print speed and turning over the voltage."""
    rudders = (0.0, 10.0, -10.0, 20.0, -20.0)
    print("volts  speed m/s | rate of turn deg/s (steady diameter, lengths) at each rudder, deg")
    print("       straight  | " + "".join(f"{rudder:>16g}" for rudder in rudders))
    voltages = torch.arange(1, 11, dtype=torch.float64)
    angles = torch.tensor(np.radians(rudders))
    w = torch.cartesian_prod(voltages, angles)
    x0 = torch.zeros(len(w), 6, dtype=torch.float64)
    x0[:, 3] = (0.005287 * w[:, 0] / 0.001518) ** (1 / 3)
    ends = run(x0, w[:, None].expand(-1, 6000, -1), 0.1)[:, -1].reshape(10, len(rudders), 3)
    for volts, end in zip(voltages.tolist(), ends, strict=True):
        cells = []
        for u, v, r in end.tolist():
            diameter = 2 * np.hypot(u, v) / abs(r) / LENGTH
            bounded = np.isfinite(diameter) and max(abs(u), abs(v)) < FASTEST
            text = f"{np.degrees(r):.2f} ({diameter:.0f})" if bounded else "diverges"
            cells.append(f"{text:>16s}")
        print(f"{volts:5g}  {np.hypot(*end[0, :2].tolist()):9.2f} | {''.join(cells)}")


def tanker() -> None:
    """Print how much of each record of the tanker passes before the equations diverge."""
    records: list[tuple[str, Tensor]] = []
    for part, logs in load_task(CONFIG).logs().items():
        for log in logs:
            grid = np.arange(log.t[0], log.t[-1], 0.2)
            values = [np.interp(grid, log.t, log[name]) for name in ("u", "v", "r", "n", "delta")]
            records.append((part, torch.from_numpy(np.stack(values, axis=1))))
    # all records with all factors in one batch, short ones padded
    longest = max(len(values) for _, values in records)
    padded = torch.stack(
        [torch.cat((v, v[-1:].expand(longest - len(v), -1))) for _, v in records]
    ).repeat(len(FACTORS), 1, 1)
    factors = torch.tensor(FACTORS, dtype=torch.float64).repeat_interleave(len(records))
    w = torch.stack((factors[:, None] * padded[:, :-1, 3], padded[:, :-1, 4]), dim=-1)
    x0 = torch.cat((torch.zeros(len(w), 3, dtype=torch.float64), padded[:, 0, :3]), dim=-1)
    runs = run(x0, w, 0.2)
    shares = torch.zeros(len(w))
    errors = torch.full((len(w),), torch.nan)
    for row, ran in enumerate(runs):
        part, values = records[row % len(records)]
        wild = ~(ran[: len(values)].abs() < FASTEST).all(dim=-1)
        until = int(wild.float().argmax()) if bool(wild.any()) else len(values)
        shares[row] = until / len(values)
        if part == "train":
            errors[row] = (ran[:until] - values[:until, :3]).square().mean().sqrt()
    best = int(errors.reshape(len(FACTORS), -1).nanmean(1).argmin())
    passed = shares.reshape(len(FACTORS), -1)[best]
    print(
        f"tanker: with {FACTORS[best]:g} V s a run diverges in {int((passed < 1).sum())} of"
        f" {len(passed)} records, after {100 * float(passed.min()):.0f} to"
        f" {100 * float(passed.max()):.0f} % of them: the propeller stops and reverses, and the"
        " equations divide by the voltage"
    )


if __name__ == "__main__":
    bench.options(__doc__)
    steady()
    if "RESIDNET_DATA" in os.environ:
        tanker()
    else:
        print("tanker: not run, RESIDNET_DATA names no folder")
