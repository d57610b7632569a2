"""Figures that document 001 (Moreno-Salinas et al. 2019) prints for its own ship and records."""

from __future__ import annotations

from types import MappingProxyType

RMSE: MappingProxyType[tuple[str, str], tuple[float, float, float]] = MappingProxyType(
    {
        ("rbf_joint", "train"): (0.0777, 0.0739, 0.0137),
        ("rbf_joint", "validation"): (0.1784, 0.1372, 0.0391),
        ("p1_joint", "train"): (0.1059, 0.0793, 0.0209),
        ("p1_joint", "validation"): (0.1653, 0.1050, 0.0154),
        ("p2_joint", "train"): (0.0773, 0.0765, 0.0146),
        ("p2_joint", "validation"): (0.1645, 0.1148, 0.0181),
        ("p2_joint", "test"): (0.2249, 0.2211, 0.0654),
        ("gptips", "train"): (0.2614, 0.2422, 0.1085),
        ("gptips", "validation"): (0.3482, 0.2861, 0.1150),
        ("gptips", "test"): (0.3279, 0.3153, 0.1077),
    }
)
"""Root mean square errors of u, v, r in m/s, m/s, rad/s in free runs over whole records.

By model and split: training and validation from Table 2, test from Table 3.
"""
