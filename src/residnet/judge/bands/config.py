"""Settings of the bands of free runs."""

from __future__ import annotations

from pydantic import Field

from residnet.core.config import Config, Seconds


class BandsConfig(Config):
    """Settings of the bands of free runs.

    A band is calibrated on logs that its model was not fitted on: on the training logs, fold by
    fold, by models that leave the fold out, and on the validation logs by the model itself. Only
    what is fitted in closed form is fitted again; a refit through rollouts takes one step of
    Gauss-Newton for each fold.

    Attributes:
        level: share of the samples that the bands are to hold.
        folds: number of groups that the training logs are left out by.
        every: time between the starts of the runs that calibrate protocols of windows, in s.
        seed: of the division into folds.
    """

    level: float = Field(default=0.9, gt=0.5, lt=1)
    folds: int = Field(default=5, ge=2)
    every: Seconds = Field(default=10.0, gt=0)
    seed: int = Field(default=0, ge=0)
