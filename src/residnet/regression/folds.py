"""Number of folds of a cross-validation that never splits a manoeuvre."""

from __future__ import annotations

from residnet.core.errors import FitError

DEFAULT_FOLDS = 5
"""Number of folds if the config names none."""


def count_default_folds(n_groups: int) -> int | None:
    """Return `DEFAULT_FOLDS`, or the number of groups if it is lower; None for a single group."""
    return min(DEFAULT_FOLDS, n_groups) if n_groups > 1 else None


def require_folds(n_groups: int, n_folds: int | None) -> None:
    """Check that there are enough groups for the folds.

    Args:
        n_groups: number of groups of samples.
        n_folds: number of folds; None for a fold per group.

    Raises:
        FitError: if there are fewer groups than folds, or fewer than two.
    """
    if n_folds is None and n_groups < 2:
        raise FitError(
            "cross-validation needs at least two runs or segments, but the data have one; give more"
            " runs, or a fixed order or penalty"
        )
    if n_folds is not None and n_groups < n_folds:
        raise FitError(
            f"{n_folds} folds need at least {n_folds} manoeuvres, but the training data have"
            f" {n_groups}; lower `folds`"
        )
