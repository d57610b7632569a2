"""Figures that document 003 (Woo et al. 2018) prints for its own vessel."""

from __future__ import annotations

from types import MappingProxyType

CHANGE_OF_ERROR: MappingProxyType[str, float] = MappingProxyType(
    {"u": -0.769, "v": -0.279, "r": -0.607}
)
"""Relative change of the prediction error from the linear model to the LSTM (section 4, Figures 16
and 17), by velocity.
"""
