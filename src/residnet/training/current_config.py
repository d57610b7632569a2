"""Configuration of the estimation of ambient currents."""

from __future__ import annotations

from pydantic import Field

from residnet.core.config import Config, MetresPerSecond


class CurrentConfig(Config):
    """Estimation of a constant, unmeasured current for each log.

    The currents are estimated first. All later steps use the logs as motion through the water,
    without current. Test logs are converted too, with the currents that the coefficients of the
    fitted logs imply, so that test logs do not influence the fit.

    Attributes:
        baseline: name of the baseline whose regressors explain the accelerations in the estimation.
        spread: prior standard deviation of each component of a current; logs with little
            information get currents near zero.
        iterations: maximum number of iterations.
    """

    baseline: str = "baseline"
    spread: MetresPerSecond = Field(default=0.5, gt=0)
    iterations: int = Field(default=40, ge=1, le=10_000)
