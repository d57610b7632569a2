"""Figures that document 003 (Woo et al. 2018) prints for its own vessel."""

from __future__ import annotations

from types import MappingProxyType

MODELS = ("baseline", "nomoto", "nomoto_side_slip", "lstm_printed", "lstm_rate", "lstm")
"""Models that the study shows."""

CHANGE_OF_ERROR: MappingProxyType[str, float] = MappingProxyType(
    {"u": -0.769, "v": -0.279, "r": -0.607}
)
"""Relative change of the prediction error from the linear model to the LSTM (section 4, Figures 16
and 17), by velocity.
"""

STEADY: MappingProxyType[str, tuple[float, float]] = MappingProxyType(
    {"u": (0.0021, 0.5182), "v": (2.23e-4, -0.007), "r": (0.0330, 1.287)}
)
"""Phi and bias of the steady states (32), in m/s, m/s and deg/s per N, N m and N m.

Table 1 as corrected (W12, W13): (34) needs .0330 and 1.287 where .341 and .657 are printed.
"""
