"""Steps per second of a plant, side by side with the ways that vessel simulators usually step one,
in one process on one thread.

    python scripts/bench/plants.py [--steps 200] [--step 0.05] [--repeats 3] [--vessels
    wam_v_cal,wam_v_vrx]

For each batch of trajectories (1, 64, 1024), thousands of trajectory steps per second of

    residnet         Rollout of PlantDynamics with all exogenous inputs (RK4)
    calm             the same without exogenous inputs, which the plain model does not have either
    traced           the same, its step recorded as TorchScript
    solve_ivp        scipy.integrate.solve_ivp, RK45 with its default tolerances, max_step = step,
    held inputs, a trajectory at a time own RK4          the plain model stepped by its own RK4
    loop, a trajectory at a time own Euler        likewise by explicit Euler

The plain model is the same vessel in NumPy as textbooks write it: matrices M, C(nu), D(nu), R(psi)
built at every call. Trajectories of the three that go one by one are timed on a few of them, since
their time grows with the number. All of them end at the same place, which is checked. Times are of
the processor, on one thread, so that other programs disturb them less. The ratios are what matters:
every repetition measures all candidates in turn, and the best of each counts.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable
from functools import partial

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
import torch
from scipy.integrate import solve_ivp

from residnet.core.errors import UsageError
from residnet.dynamics.base import Dynamics
from residnet.dynamics.rollout import Rollout
from residnet.dynamics.simulated import PlantDynamics, TracedPlantDynamics
from residnet.physics.actuators import DifferentialThrustConfig
from residnet.physics.fossen import FossenConfig
from residnet.physics.vessel import load_vessel

BATCHES = (1, 64, 1024)
ONE_BY_ONE = 3
"""Trajectories that the candidates without batches are timed on."""


class PlainVessel:
    """A vessel with two thrusters, its equations in NumPy."""

    def __init__(self, vessel: FossenConfig) -> None:
        body, added, self.damping = vessel.rigid_body, vessel.added_mass, vessel.damping
        if not isinstance(vessel.actuators, DifferentialThrustConfig):
            raise UsageError(
                f"{vessel.name}: the plain model knows two thrusters (differential_thrust) only"
            )
        self.act = vessel.actuators
        m, arm = body.m.value, body.m.value * body.x_G.value
        self.m11, self.m22, self.m33 = (
            m - added.X_udot.value,
            m - added.Y_vdot.value,
            body.I_z.value - added.N_rdot.value,
        )
        self.m23, self.m32 = arm - added.Y_rdot.value, arm - added.N_vdot.value
        self.inverse = np.linalg.inv(
            np.array([[self.m11, 0, 0], [0, self.m22, self.m23], [0, self.m32, self.m33]])
        )

    def coefficient(self, axis: str, term: str) -> float:
        row = getattr(self.damping, axis)
        return row[term].value if term in row else 0.0

    def prepared(self) -> PlainVessel:
        get = self.coefficient
        self.x = get("X", "u"), get("X", "u|u|")
        self.y = get("Y", "v"), get("Y", "|u|v"), get("Y", "v|v|")
        self.n = get("N", "|u|v"), get("N", "r"), get("N", "r|r|")
        return self

    def thrust(self, n: float) -> float:
        if n > 0:
            c = self.act.forward
            return max(c[0] + c[1] * n + c[2] * n * n, 0.0)
        if n < 0:
            c = self.act.reverse
            return min(c[0] + c[1] * n + c[2] * n * n, 0.0)
        return 0.0

    def rate(self, t: float, s: np.ndarray, port: float, stbd: float) -> np.ndarray:
        """Derivative of (x, y, psi, u, v, r) at held revolutions."""
        psi, nu = s[2], s[3:6]
        u, v, r = nu
        left, right = self.thrust(port), self.thrust(stbd)
        tau = np.array([left + right, 0.0, 0.5 * self.act.spacing * (left - right)])
        a = self.m22 * v + 0.5 * (self.m23 + self.m32) * r
        coriolis = np.array([[0.0, 0.0, -a], [0.0, 0.0, self.m11 * u], [a, -self.m11 * u, 0.0]])
        drag = np.array(
            [
                [self.x[0] + self.x[1] * abs(u), 0.0, 0.0],
                [0.0, self.y[0] + self.y[1] * abs(u) + self.y[2] * abs(v), 0.0],
                [0.0, self.n[0] * abs(u), self.n[1] + self.n[2] * abs(r)],
            ]
        )
        rotation = np.array(
            [[np.cos(psi), -np.sin(psi), 0.0], [np.sin(psi), np.cos(psi), 0.0], [0.0, 0.0, 1.0]]
        )
        nu_dot = self.inverse @ (tau - coriolis @ nu - drag @ nu)
        return np.concatenate((rotation @ nu, nu_dot))


def by_solve_ivp(plain: PlainVessel, x: np.ndarray, n: np.ndarray, dt: float) -> np.ndarray:
    """End of a trajectory under revolutions n [T, 2], held over each step."""
    last = len(n) - 1

    def rate(t: float, s: np.ndarray) -> np.ndarray:
        k = min(int(t / dt), last)
        return plain.rate(t, s, n[k, 0], n[k, 1])

    return solve_ivp(rate, (0.0, dt * len(n)), x, max_step=dt).y[:, -1]


def by_own_rk4(plain: PlainVessel, x: np.ndarray, n: np.ndarray, dt: float) -> np.ndarray:
    for k, (port, stbd) in enumerate(n):
        t = k * dt
        k1 = plain.rate(t, x, port, stbd)
        k2 = plain.rate(t + dt / 2, x + dt / 2 * k1, port, stbd)
        k3 = plain.rate(t + dt / 2, x + dt / 2 * k2, port, stbd)
        k4 = plain.rate(t + dt, x + dt * k3, port, stbd)
        x = x + dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return x


def by_own_euler(plain: PlainVessel, x: np.ndarray, n: np.ndarray, dt: float) -> np.ndarray:
    for k, (port, stbd) in enumerate(n):
        x = x + dt * plain.rate(k * dt, x, port, stbd)
    return x


def rolled(model: Dynamics, x: torch.Tensor, w: torch.Tensor) -> torch.Tensor:
    with torch.no_grad():
        return Rollout(model)(x, w, x[:, :0])[0]


def one_by_one(
    single: Callable[..., np.ndarray], plain: PlainVessel, x: np.ndarray, n: np.ndarray, dt: float
) -> list[np.ndarray]:
    return [single(plain, x, revolutions, dt) for revolutions in n]


def seconds(call: Callable[[], object]) -> float:
    started = time.process_time()
    call()
    return time.process_time() - started


def measure(name: str, steps: int, dt: float, repeats: int) -> None:
    """Print the table of one vessel."""
    vessel = load_vessel(name)
    if not isinstance(vessel, FossenConfig):
        raise UsageError(f"{name}: the plain model is a 3-DOF vessel of kind fossen")
    plain = PlainVessel(vessel).prepared()
    full, calm = vessel.build(), vessel.build().in_calm_water()
    models = {
        "residnet": PlantDynamics(full, dt),
        "calm": PlantDynamics(calm, dt),
        "traced": TracedPlantDynamics(calm, dt),
    }
    steer = torch.linspace(-0.5, 0.5, max(BATCHES), dtype=torch.float64)
    turning = torch.sign(
        torch.sin(2 * torch.pi * torch.arange(steps, dtype=torch.float64) * dt / 8.0 + 1e-9)
    )
    demand = full.demand(
        torch.full((max(BATCHES), steps), 0.6, dtype=torch.float64), steer[:, None] * turning
    )
    x = torch.zeros(max(BATCHES), 8, dtype=torch.float64)
    x[:, 3] = 1.0
    # the plain model has no shafts: it plays back the revolutions that the plant's shafts had
    n = rolled(models["calm"], x, demand)[:, :-1, 6:8].numpy()
    w = {
        "residnet": torch.cat(
            (demand, torch.zeros(*demand.shape[:2], len(full.inputs) - 2, dtype=torch.float64)),
            dim=-1,
        )
    }
    w |= {"calm": demand, "traced": demand}
    singles = {"solve_ivp": by_solve_ivp, "own RK4": by_own_rk4, "own Euler": by_own_euler}
    start = x[0, :6].numpy()
    ends = {
        kind: rolled(model, x[:2], w[kind][:2])[0, -1, :6].numpy() for kind, model in models.items()
    }
    ends |= {kind: single(plain, start, n[0], dt) for kind, single in singles.items()}
    for kind, allowed in (
        ("calm", 1e-9),
        ("traced", 1e-9),
        ("own RK4", 1e-9),
        ("solve_ivp", 0.05),
        ("own Euler", 0.5),
    ):
        difference = float(np.abs(ends[kind] - ends["residnet"]).max())
        if difference > allowed:
            raise SystemExit(
                f"{name}: {kind} ends {difference:.2g} away from residnet (allowed {allowed:g}):"
                " not the same model"
            )
    print(
        f"{name}, {steps} steps of {dt:g} s; thousand trajectory steps per second, and times"
        " solve_ivp"
    )
    print(f"{'batch':>6} " + " ".join(f"{kind:>18}" for kind in (*models, *singles)))
    for batch in BATCHES:
        some = min(batch, ONE_BY_ONE)
        calls: dict[str, tuple[Callable[[], object], int]] = {}
        for kind, model in models.items():
            calls[kind] = partial(rolled, model, x[:batch], w[kind][:batch]), batch
        for kind, single in singles.items():
            calls[kind] = partial(one_by_one, single, plain, start, n[:some], dt), some
        best = dict.fromkeys(calls, float("inf"))
        for _ in range(repeats):
            for kind, (call, trajectories) in calls.items():
                best[kind] = min(best[kind], seconds(call) / trajectories)
        rate = {kind: steps / spent / 1e3 for kind, spent in best.items()}
        print(
            f"{batch:>6} "
            + " ".join(
                f"{value:9.2f} ({value / rate['solve_ivp']:5.1f}x)" for value in rate.values()
            )
        )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--step", type=float, default=0.05, help="seconds")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--vessels", default="wam_v_cal,wam_v_vrx")
    given = parser.parse_args()
    torch.set_num_threads(1)
    for name in given.vessels.split(","):
        measure(name, given.steps, given.step, given.repeats)


if __name__ == "__main__":
    main()
