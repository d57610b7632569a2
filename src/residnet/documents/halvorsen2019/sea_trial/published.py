"""Figures that document 000 (Halvorsen 2019) prints for the standard model of Odin."""

from __future__ import annotations

from types import MappingProxyType

FITTED_PARAMETERS: MappingProxyType[str, float] = MappingProxyType(
    {
        "I_z": 1.57e6,
        "X_udot": -4.47e4,
        "Y_vdot": -7.18e4,
        "Y_rdot": -0.256,
        "N_vdot": -1.28e6,
        "N_rdot": -2.67e6,
        "X_u": -239.71,
        "Y_v": -1.32e4,
        "Y_r": -2.38e5,
        "N_r": -194.30,
        "X_|u|u": -9.0,
        "Y_|v|v": -3.45e4,
        "N_|r|r": -1.58e5,
    }
)
"""Parameters after the fit in SI units (appendix C.2); N_v is not printed (correction H20)."""

START_PARAMETERS: MappingProxyType[str, float] = MappingProxyType(
    {
        "I_z": 2.09e4,
        "X_udot": 0.0,
        "Y_vdot": 0.0,
        "Y_rdot": 0.0,
        "N_vdot": 0.0,
        "N_rdot": 0.0,
        "X_u": -50.0,
        "Y_v": -200.0,
        "Y_r": 0.0,
        "N_v": -1281.0,
        "N_r": -1281.0,
        "X_|u|u": -243.0,
        "Y_|v|v": -2000.0,
        "N_|r|r": -2975.44,
    }
)
"""Parameters before the fit in SI units (appendix C.2); N_v, N_|r|r by corrections H20, H2."""
