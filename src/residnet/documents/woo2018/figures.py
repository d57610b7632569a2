"""Figures 13 to 18 of Woo et al. 2018 (document 003), drawn from a finished run.

The document shows single runs: simplified steering models in a zigzag (13), surge in an
acceleration-deceleration test (14), sway and yaw rate in a zigzag and a 3-2-1-1 test (15), errors
of the speed models (16) and of the steering models (17) on training and unseen data, and a zigzag
with its track (18).
"""

from __future__ import annotations

from residnet.core.errors import UsageError
from residnet.documents.woo2018.panels import LOOK, PROTOCOL, bars, histories, track
from residnet.report.blocks import Figure
from residnet.report.figures.style import RC, save
from residnet.report.run_reader import RunFiles, StoredWindow

_CAPTION = "Unseen manoeuvres unless it says otherwise; simulated WAM-V with sensor noise."
_RATIOS = (
    "Left: root mean square errors with 95 % intervals over manoeuvres. Right: each unseen run's"
    " error over that of the linear model, with the median; simulated WAM-V with sensor noise."
)
KINDS = ("zigzag", "acceleration_deceleration", "three_two_one_one")
"""Kinds of manoeuvre that the figures show."""
_SIMPLE = ("nomoto", "nomoto_side_slip", "baseline")
LEARNED = ("lstm_printed", "lstm_rate", "lstm")
_COMPARED = ("baseline", *LEARNED)


def draw(files: RunFiles) -> list[Figure]:
    """Draw the six figures into `figures/woo2018` of a run folder.

    Raises:
        UsageError: where the run lacks a kind of manoeuvre or a model of the study.
    """
    from matplotlib import rc_context

    missing = [model for model in LOOK if model not in files.kinds]
    if missing:
        raise UsageError(
            f"{files.path}: study woo2018 needs the models {', '.join(LOOK)}; '{missing[0]}' is"
            " absent"
        )
    unseen = [window for window in files.windows("test") if window.protocol == PROTOCOL]
    zigzag, speed, steps = (_typical(files, unseen, kind) for kind in KINDS)
    of_speed = [window for window in unseen if window.manoeuvre == KINDS[1]]
    of_steering = [window for window in unseen if window.manoeuvre in (KINDS[0], KINDS[2])]
    turning = [(zigzag, "v"), (zigzag, "r"), (steps, "v"), (steps, "r")]
    with rc_context(RC):
        drawings = {
            13: (
                "Simplified steering models in a zigzag",
                _CAPTION,
                histories(turning[:2], _SIMPLE),
            ),
            14: (
                "Surge in an acceleration-deceleration test",
                _CAPTION,
                histories([(speed, "u")], _COMPARED),
            ),
            15: (
                "Sway and yaw rate in a zigzag and a 3-2-1-1 test",
                _CAPTION,
                histories(turning, _COMPARED),
            ),
            16: (
                "Errors of the speed models",
                _RATIOS,
                bars(files, of_speed, ("u",), "speed", _COMPARED),
            ),
            17: (
                "Errors of the steering models",
                _RATIOS,
                bars(files, of_steering, ("v", "r"), "steering", (*_SIMPLE, *LEARNED)),
            ),
            18: (
                "A zigzag: track, yaw rate and sway velocity",
                _CAPTION,
                track(zigzag, (*_SIMPLE, "lstm")),
            ),
        }
        figures = []
        for number, (words, caption, drawing) in drawings.items():
            path = files.path / "figures" / "woo2018" / f"{number}.png"
            title = f"Figure {number} of document 003: {words}"
            save(drawing, path, title, caption)
            figures.append(Figure(path, title, caption))
    return figures


def _typical(files: RunFiles, unseen: list[StoredWindow], kind: str) -> StoredWindow:
    """Return the unseen run of a kind with the median error of the LSTM trained in free run."""
    runs = [window for window in unseen if window.manoeuvre == kind]
    if not runs:
        raise UsageError(f"{files.path}: study woo2018 needs a test manoeuvre of kind {kind}")
    ranked = sorted(runs, key=lambda window: (float(window.rmse("lstm").sum()), window.log))
    return ranked[(len(ranked) - 1) // 2]
