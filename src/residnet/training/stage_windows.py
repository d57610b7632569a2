"""The windows that the stages of a training draw their batches from; no Lightning here."""

from __future__ import annotations

from residnet.data.windows import WindowBatches, WindowStore
from residnet.training.config import TrainingConfig


def stages(config: TrainingConfig, dt: float) -> list[tuple[int, int]]:
    """Return length in samples and batch of each stage's windows; stage 0 is one-step."""
    return [(round(config.one_step.window / dt), config.one_step.batch)] + [
        (round(stage.horizon / dt) + 1, stage.batch) for stage in config.multi_step
    ]


def stage_windows(
    config: TrainingConfig, store: WindowStore, dt: float
) -> list[list[WindowBatches]]:
    """Return where the windows of each stage's batches come from.

    They come from anywhere, and then from the beginnings of stretches, where the config asks for
    them.

    Args:
        config: of the training.
        store: the training logs.
        dt: step in s.

    Raises:
        DataError: where no log is long enough for a stage.
    """
    return [
        _windows(config, store, dt, stage, length, batch)
        for stage, (length, batch) in enumerate(stages(config, dt))
    ]


def _windows(
    config: TrainingConfig, store: WindowStore, dt: float, stage: int, length: int, batch: int
) -> list[WindowBatches]:
    beginnings, steps = config.beginnings, config.steps
    if stage == 0 and config.one_step.epochs == 0:
        return []
    if beginnings is None:
        return [WindowBatches(store.starts(length), batch, steps)]
    few = min(max(round(beginnings.share * batch), 1), batch - 1)
    begins = store.beginnings(length, 0 if stage == 0 else max(round(beginnings.initial / dt), 1))
    return [
        WindowBatches(store.starts(length), batch - few, steps),
        WindowBatches(begins, few, steps),
    ]
