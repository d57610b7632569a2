"""The choice of one model among fitted ones: the simplest that is as good as the best.

Models are compared by the ratio of their errors, block by block: the logarithms of errors are
averaged. In a mean of the errors themselves one bad stretch outweighs all others, and its standard
error grows with it, so that few logs would tell nothing.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from residnet.core.format import number
from residnet.data.prepare import Prepared
from residnet.judge.freerun import Errors, FreeRun
from residnet.judge.metrics import MANY_LOGS, WANTED_BLOCKS

SCHEMA = "residnet.selection/2"
FAMILIES = ("zero", "baseline", "refitted baseline", "closed-form head", "network", "ensemble")
"""What a model is, the simplest first."""

_ALIKE = {"logs": 1.0, "stretches": 0.5}
"""Standard errors within which models are alike. Stretches of a few logs resemble each other."""
_SMALL = 0.1
"""Share of the least mean error below which the error of a block hardly counts."""


@dataclass(frozen=True)
class Contender:
    """A model with what decides whether it is chosen.

    Attributes:
        name: of the model.
        family: one of `FAMILIES`.
        parameters: number of its fitted parameters.
        error: its mean NRMSE over the validation windows.
        scores: what each block of the validation data contributes to the mean logarithm of its
            error, [B]; see `log_errors`.
        diverged: number of its validation windows that diverged, over all protocols.
        faults: sentences on what makes it unsound, divergences among them; empty for a sound model.
    """

    name: str
    family: str
    parameters: int
    error: float
    scores: np.ndarray
    diverged: int = 0
    faults: tuple[str, ...] = ()

    @property
    def score(self) -> float:
        """The mean logarithm of its error over the blocks."""
        return float(self.scores.sum())

    @property
    def sound(self) -> bool:
        """Whether nothing speaks against its use."""
        return not self.faults

    @property
    def simplicity(self) -> tuple[int, int]:
        """The place in the order of models: family, then the number of parameters."""
        return FAMILIES.index(self.family), self.parameters


@dataclass(frozen=True)
class Blocks:
    """The blocks of the validation data over which errors are paired.

    Attributes:
        weights: share of each block in the mean over windows, [B]; their sum is 1.
        of: `logs` where a block is all windows of a log, else `stretches` of logs.
    """

    weights: np.ndarray
    of: str

    @property
    def count(self) -> int:
        """Number of blocks."""
        return len(self.weights)

    @property
    def alike(self) -> float:
        """Number of standard errors within which two models are alike."""
        return _ALIKE[self.of]

    def standard_error(self, one: np.ndarray, other: np.ndarray) -> float:
        """Return the standard error of the difference of two means.

        A single block adds nothing, since it does not tell of the spread.

        Args:
            one: what each block contributes to the first mean, [B].
            other: the same of the second, [B].
        """
        if self.count < 2:
            return 0.0
        apart = one - other
        rest = apart - self.weights * apart.sum()
        return math.sqrt(self.count / (self.count - 1) * float(rest @ rest))


def difference(one: Contender, other: Contender, blocks: Blocks) -> tuple[float, float]:
    """Return the mean logarithm of the ratio of two models' errors, and its standard error.

    Both are shares: 0.1 is about 10 %.
    """
    apart = float((one.scores - other.scores).sum())
    return apart, blocks.standard_error(one.scores, other.scores)


@dataclass(frozen=True)
class Selection:
    """The chosen models, and why.

    Attributes:
        selected: name of the chosen single model.
        selected_ensemble: name of the best ensemble; None where there is none.
        reason: one sentence on why the single model was chosen.
        contenders: all models, in the order that they were given.
        blocks: over which errors were paired.
        leading: name of a mean that is reported first whatever was chosen; None for none.
    """

    selected: str
    selected_ensemble: str | None
    reason: str
    contenders: tuple[Contender, ...]
    blocks: Blocks
    leading: str | None = None

    @property
    def predictor(self) -> str:
        """Name of the model that is reported first and exported where none is named."""
        return self.selected if self.leading is None else self.leading

    def content(self) -> dict[str, Any]:
        """Return the contents of selection.json."""
        lead = next(entry for entry in self.contenders if entry.name == self.selected)
        return {
            "schema": SCHEMA,
            "selected": self.selected,
            "selected_ensemble": self.selected_ensemble,
            "predictor": self.predictor,
            "reason": self.reason,
            "blocks": {"of": self.blocks.of, "count": self.blocks.count},
            "models": [
                {
                    "model": entry.name,
                    "family": entry.family,
                    "parameters": entry.parameters,
                    "nrmse_mean": entry.error,
                    "ratio": math.exp(difference(entry, lead, self.blocks)[0]),
                    "standard_error": difference(entry, lead, self.blocks)[1],
                    "diverged": entry.diverged,
                    "sound": entry.sound,
                    "faults": list(entry.faults),
                }
                for entry in self.contenders
            ],
        }


def choose(contenders: Iterable[Contender], blocks: Blocks) -> Selection:
    """Choose a single model and an ensemble.

    Among the models that never diverged, those are alike whose error is within one standard error
    of the least (Breiman and others 1984, Classification and Regression Trees, section 3.4.3;
    paired here, since all models run over the same windows). Of fewer than five logs half a
    standard error is taken: their stretches resemble each other, and a whole one took lines for
    hulls. Of those that are alike a sound one comes before an unsound one, and then the simplest
    is chosen: what speaks against a model costs it as much error as the logs can tell, no more.

    Args:
        contenders: `zero` and at least one other.
    """
    everyone = tuple(contenders)
    chosen, reason = _simplest([one for one in everyone if one.family != "ensemble"], blocks)
    ensembles = [one for one in everyone if one.family == "ensemble"]
    best = min(ensembles, key=lambda one: (one.diverged, one.score), default=None)
    return Selection(chosen.name, None if best is None else best.name, reason, everyone, blocks)


def _simplest(single: Sequence[Contender], blocks: Blocks) -> tuple[Contender, str]:
    """Return the simplest of the models that are as good as the best, the sound first, and why."""
    steady = [one for one in single if not one.diverged]
    best = min(steady, key=lambda one: one.score)
    said = "one standard error" if blocks.alike == 1.0 else "half a standard error"
    for chosen in sorted(steady, key=lambda one: (not one.sound, *one.simplicity, one.score)):
        apart, spread = difference(chosen, best, blocks)
        if apart <= (within := blocks.alike * spread):
            break
    error = f"mean validation error {number(chosen.error)}"
    if chosen.family == "zero":
        reason = f"No model beats zero, which predicts nothing, by more than {said}"
    elif chosen is best:
        reason = f"{chosen.name} errs least ({error})"
        if any(one.simplicity < best.simplicity for one in steady):
            reason += f", and no {'simpler' if best.sound else 'sound'} one comes within {said}"
    else:
        kind = "simplest sound" if chosen.sound else "simplest"
        reason = (
            f"{chosen.name} is the {kind} model within {said} ({number(100.0 * within, 2)} %) of"
            f" the best one, {best.name} ({error} and {number(best.error)})"
        )
    lost = [one for one in single if one.score < chosen.score and one.diverged]
    if lost:
        named = ", ".join(f"{one.name} ({one.faults[0]})" for one in lost)
        reason += f"; passed over: {named}"
    if not chosen.sound:
        reason += f"; against it speaks: {'; '.join(chosen.faults)}"
    return chosen, reason + "."


def blocks_of(run: FreeRun) -> tuple[Blocks, list[np.ndarray]]:
    """Return the blocks of validation windows, and the number of the block of each sample.

    From five logs on a block is a log, so that what is chosen holds for other logs. Fewer logs are
    cut into contiguous stretches of equal length, about eight in all.

    Returns:
        The blocks, and for each window [L] of block numbers.
    """
    numbers = np.array([window.log for window in run.windows])
    lengths = np.array([window.stop - window.start for window in run.windows])
    logs = np.unique(numbers)
    labels: list[np.ndarray] = [np.zeros(length, dtype=int) for length in lengths]
    pieces = 1 if len(logs) >= MANY_LOGS else math.ceil(WANTED_BLOCKS / len(logs))
    for place, log in enumerate(logs.tolist()):
        rows = np.flatnonzero(numbers == log)
        count = min(pieces, int(lengths[rows].sum()))
        cut = np.array_split(np.arange(lengths[rows].sum()), count)
        flat = np.concatenate([np.full(len(part), i) for i, part in enumerate(cut)])
        for row, part in zip(rows, np.split(flat, np.cumsum(lengths[rows])[:-1]), strict=True):
            labels[row] = place * pieces + part
    # a log of fewer samples than pieces leaves numbers out
    found, flat = np.unique(np.concatenate(labels), return_inverse=True)
    labels = np.split(flat, np.cumsum(lengths)[:-1])
    weights = np.zeros(len(found))
    for label in labels:
        weights += np.bincount(label, minlength=len(found)) / (len(label) * len(labels))
    return Blocks(weights, "logs" if pieces == 1 else "stretches"), labels


def shares(
    run: FreeRun,
    model: str,
    logs: Sequence[Prepared],
    scales: Mapping[str, float],
    labels: Sequence[np.ndarray],
    count: int,
) -> np.ndarray:
    """Return what each block contributes to a model's mean NRMSE, [count].

    A window's root mean square error is shared out in proportion to the squares, so that the sum
    is the mean NRMSE of the rows of metrics.json.

    Args:
        run: free runs over the windows.
        labels: number of the block of each sample of each window.
    """
    found = Errors.of(run.windows, run.predictions[model], logs)
    divisor = found.rmse * np.add.reduceat(found.scored, found.begins, dtype=float)
    live = [logs[0].live.moving.index(name) for name in scales]
    divisor = np.where(divisor > 0, divisor, 1.0).take(live, axis=1)
    divisor = divisor * np.array(list(scales.values()))
    errors = found.velocities.take(live, axis=1)
    sample = (errors**2 / np.repeat(divisor, found.counts, axis=0)).sum(1)
    share = sample / (divisor.shape[1] * len(run.windows))
    return np.bincount(np.concatenate(labels), share, count)


def log_errors(shares: Mapping[str, np.ndarray], weights: np.ndarray) -> dict[str, np.ndarray]:
    """Return what each block contributes to the mean logarithm of a model's error, [B] by model.

    A tenth of the least mean error is added to each error, so that no block counts much where all
    models are nearly right.

    Args:
        shares: what each block contributes to the mean NRMSE, [B] by model.
        weights: of the blocks, [B].
    """
    least = min((float(one.sum()) for one in shares.values()), default=0.0)
    small = max(_SMALL * least, float(np.finfo(float).tiny))
    return {name: weights * np.log(one / weights + small) for name, one in shares.items()}
