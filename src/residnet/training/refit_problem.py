"""What a refit through rollouts minimises: windows, weights, prior and beliefs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from residnet.baselines.base import ParametricBaseline
from residnet.core.errors import FitError
from residnet.core.layout import VELOCITIES
from residnet.core.samples import Samples
from residnet.data.windows import WindowStore
from residnet.dynamics.hybrid import HybridDynamics
from residnet.training.refit_config import RefitConfig

_OWN = 1e-8
"""Weight of a parameter's own start, as a share of the information that the samples would hold if
all others were known; it says where a parameter stays that the data leave open.
"""


@dataclass(frozen=True)
class Problem:
    """Windows x0 [B, 6], w [B, T, m], measured nu [B, T, 3], weights [B, T, 3] (0 or 1/scale);
    numbers of the free parameters [P]; precision [P, P] about where least squares put them, the
    part of it that each parameter has for itself, whatever the data say, and that point [P];
    pull to the mirror symmetry [P, P]; beliefs, mean and precision [P]; which parameters stay at
    zero [P]; count of independent errors per channel; log of each window [B]; speed at which
    offsets are what they are said to be.
    """

    x0: Tensor
    w: Tensor
    nu: Tensor
    weight: Tensor
    active: Tensor
    precision: Tensor
    own: Tensor
    start: Tensor
    pull: Tensor
    believed: Tensor
    belief: Tensor
    still: Tensor
    count: float
    robust: float
    log: Tensor
    speed: float

    def at_rest(self, numbers: Sequence[int]) -> Problem:
        """Return the problem with further free parameters, by their numbers, that stay at zero."""
        still = self.still.clone()
        still[list(numbers)] = True
        return replace(self, still=still)

    def with_only(self, numbers: Sequence[int]) -> Problem:
        """Return the problem in which these free parameters stay at zero, and no others."""
        return replace(self, still=torch.zeros_like(self.still)).at_rest(numbers)

    def over(self, steps: int) -> Problem:
        """Return the problem whose free runs are so many steps long."""
        return replace(
            self, w=self.w[:, :steps], nu=self.nu[:, :steps], weight=self.weight[:, :steps]
        )

    def share(self, level: Tensor) -> Tensor:
        """Return half of what one unit of minus the logarithm of a probability costs.

        The cost is `level`.

        With c the mean square error of three channels of so many independent errors each, that
        logarithm grows by 3 N / 2c for each unit of c, and the cost sqrt(c + robust^2) by 1 / (2
        cost).
        """
        return (level.square() - self.robust**2).clamp(min=1e-12) / (6.0 * self.count * level)


def free_run_starts(store: WindowStore, config: RefitConfig, dt: float) -> Tensor:
    """Return the rows at which the free runs of a refit start.

    Args:
        store: training windows.
        config: settings.
        dt: step in s.

    Raises:
        FitError: where no log is long enough.
    """
    steps, every = round(config.horizon / dt), max(round(config.every / dt), 1)
    starts = store.starts(steps + 1)
    starts = starts[store.depth[starts] % every == 0]
    if starts.numel() == 0:
        raise FitError(
            f"no training log holds a free run of {config.horizon:g} s for the refit; shorten"
            " `horizon`"
        )
    return starts


def problem_of(
    model: HybridDynamics,
    baseline: ParametricBaseline,
    samples: Samples,
    store: WindowStore,
    config: RefitConfig,
    scales: Tensor,
) -> Problem:
    """Return the problem that least squares leave to a refit; nothing stays at zero as yet."""
    steps = round(config.horizon / model.dt)
    starts = free_run_starts(store, config, model.dt)
    take = store.take
    nu = take(store.y, starts + 1, steps)[..., VELOCITIES]
    usable = take(store.usable, starts + 1, steps).to(scales.dtype).unsqueeze(-1)
    # r comes from a gyro, which a frozen position does not disturb
    weight = torch.cat((usable, usable, torch.ones_like(usable)), dim=-1) / scales
    active = baseline.free_indices()
    covered = (starts[:, None] + torch.arange(1, steps + 1)).unique().numel()
    believed, belief = baseline.prior()
    information = baseline.information(samples)
    own = torch.diag(_OWN * information.diagonal())
    return Problem(
        store.y[starts],
        take(store.w, starts, steps),
        nu,
        weight,
        active,
        config.prior * information + own,
        own,
        baseline.theta.detach().flatten()[active].clone(),
        config.asymmetric * baseline.asymmetry(samples),
        believed,
        belief,
        torch.zeros(active.numel(), dtype=torch.bool),
        max(covered * model.dt / config.correlation, 1.0),
        config.robust,
        store.log[starts],
        float(nu[:, :, :2].square().sum(2).mean().sqrt()),
    )
