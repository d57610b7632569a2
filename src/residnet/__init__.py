"""residnet: models of real vessels, physics first and learning for the rest."""

__version__ = "0.1.0"
