"""Configuration of the refit of a baseline through rollouts."""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import Field

from residnet.core.config import Config, Seconds
from residnet.core.errors import FitError
from residnet.preprocessing.window_index import WindowIndex


class RefitConfig(Config):
    """Settings of the Gauss-Newton refit of a baseline's parameters.

    Attributes:
        horizon: length of the free runs in s.
        every: time between the starts of successive free runs in s.
        prior: weight of the least-squares solution, as a share of its own information.
        asymmetric: weight of the prior that shrinks terms towards zero if port-starboard symmetry
            excludes them; 0 for no such prior.
        robust: error, in units of the scales, above which the loss of a window is linear instead
            of quadratic.
        correlation: correlation time of free-run errors in s. The duration of the logs divided by
            this time is the number of independent errors, which determines the standard errors
            and the weight of the data relative to the prior of the baseline.
        iterations: maximum number of iterations for each estimate of the initial states.
        starts: initial states of free runs. `measured`: the measured states, as in the metrics.
            In a lightly damped vessel their noise persists and biases damping upwards.
            `estimated`: estimated jointly with the parameters, with the measurement noise as
            prior; gives less biased coefficients.
    """

    horizon: Seconds = Field(default=20.0, gt=0)
    every: Seconds = Field(default=10.0, gt=0)
    prior: float = Field(default=1e-2, ge=0)
    asymmetric: float = Field(default=0.0, ge=0)
    robust: float = Field(default=0.05, gt=0)
    correlation: Seconds = Field(default=10.0, gt=0)
    iterations: int = Field(default=10, ge=1, le=10_000)
    starts: Literal["measured", "estimated"] = "measured"

    def with_prior(self, prior: float) -> RefitConfig:
        return self.model_copy(update={"prior": prior})

    def find_free_run_starts(self, index: WindowIndex, dt: float) -> np.ndarray:
        """Return the rows at which free runs start, for a time step of dt seconds.

        Raises:
            FitError: if no log is long enough.
        """
        n_steps = round(self.horizon / dt)
        steps_between_starts = max(round(self.every / dt), 1)
        rows = index.find_starts(n_steps + 1)
        starts: np.ndarray = rows[index.n_elapsed[rows] % steps_between_starts == 0]
        if starts.size == 0:
            raise FitError(
                f"no training log holds a free run of {self.horizon:g} s for the refit; shorten"
                " `horizon`"
            )
        return starts
