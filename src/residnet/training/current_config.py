"""Configuration of the estimation of ambient currents."""

from __future__ import annotations

from pydantic import Field

from residnet.core.config import Config, MetresPerSecond


class CurrentConfig(Config):
    """Settings for logs that each ran in a constant current which nobody measured.

    The currents are estimated first; what follows fits and chooses models on these logs as motion
    through the water, without current. Logs that are kept for tests are moved too: each by the
    current that the coefficients of the fitted logs see in it, so that nothing of them is fitted.

    Attributes:
        baseline: name of the baseline whose regressors explain the accelerations while the currents
            are estimated.
        spread: standard deviation that each component of a current is expected to have; keeps logs
            that say little near zero.
        iterations: at most.
    """

    baseline: str = "baseline"
    spread: MetresPerSecond = Field(default=0.5, gt=0)
    iterations: int = Field(default=40, ge=1, le=10_000)
