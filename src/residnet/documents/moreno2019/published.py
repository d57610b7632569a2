"""Figures that document 001 (Moreno-Salinas et al. 2019) prints for its own ship and records."""

from __future__ import annotations

from types import MappingProxyType

MODELS = (
    *("baseline", "rbf_joint", "rbf_each", "p1_joint", "p1_each", "p2_joint", "p2_each"),
    "symbolic",
)
"""Models that the study shows; genetic programming (`gptips`) may stand beside them."""

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
        ("SOA-SR", "validation"): (0.4255, 0.3700, 0.1895),
        ("SOA-SR", "test"): (0.3403, 0.3302, 0.1788),
        ("SOA-LSSVM (Blanke model)", "validation"): (0.8835, 0.3166, 0.3963),
        ("SOA-LSSVM (Blanke model)", "test"): (0.7350, 0.2936, 0.4169),
    }
)
"""Root mean square errors of u, v, r in m/s, m/s, rad/s in free runs over whole records.

By model and split: training and validation from Table 2, test from Table 3.
"""

OTHERS = ("SOA-SR", "SOA-LSSVM (Blanke model)")
"""Models of other articles in Table 3, whose equations document 001 does not print."""

EQUATIONS = (
    "u_dot = 0.01779 delta + 0.005287 Delta - 0.01779 |v| - 0.001518 u^3"
    " - 0.7361 u r delta / Delta",
    "v_dot = 0.0776 r - 0.1217 v + 0.108 u r - 0.0776 u / Delta + 0.5737 r^2",
    "r_dot = 0.1862 delta |u| - 0.06615 delta |Delta| - 0.01165 v (v - 9.974) / Delta"
    " - 3.585 u r / Delta^2",
)
"""Equations by symbolic regression in their likeliest reading (corrections M6 to M8).

Delta is the voltage of the motor in V.
"""
