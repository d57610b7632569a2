"""Manoeuvre and time of the samples of a fit, without their values."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from residnet.core.errors import FitError


@dataclass(frozen=True)
class SampleOrigins:
    """Manoeuvre and time of N samples, from which the check of a config counts manoeuvres.

    Attributes:
        group: index of the manoeuvre of each sample [N], ascending.
        t: time since the start of the manoeuvre [N] in s.
        kinds: kind of each manoeuvre.
    """

    group: np.ndarray
    t: np.ndarray
    kinds: tuple[str, ...]

    def __len__(self) -> int:
        return int(self.group.size)

    @property
    def n_groups(self) -> int:
        """Number of manoeuvres with a sample."""
        return int(np.unique(self.group).size)

    def select_manoeuvres(self, kinds: Collection[str]) -> SampleOrigins:
        """Return the samples of manoeuvres of given kinds; all if `kinds` is empty."""
        if not kinds:
            return self
        is_selected = np.array([kind in kinds for kind in self.kinds], dtype=bool)
        return self.select(is_selected[self.group])

    def require_manoeuvres(self, kinds: Sequence[str]) -> None:
        """Check that there are samples of some kinds of manoeuvre; any sample if `kinds` is empty.

        Raises:
            FitError: if no sample is of these kinds.
        """
        if len(self.select_manoeuvres(kinds)) == 0:
            raise FitError(
                f"no sample is of the manoeuvres {list(kinds)} of the baseline; kinds in the data:"
                f" {sorted(set(self.kinds))}"
            )

    def select(self, mask: np.ndarray) -> SampleOrigins:
        """Return the samples at which `mask` [N] is True."""
        return replace(self, group=self.group[mask], t=self.t[mask])
