"""The standard recipe: a portfolio of models whose settings follow from logs and protocols."""

from __future__ import annotations

from residnet.identification.standard.facts import Facts
from residnet.identification.standard.portfolio import PARTS, TIED, portfolio

__all__ = ["PARTS", "TIED", "Facts", "portfolio"]
