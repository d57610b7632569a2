"""Task `fit`: from logs to models that are judged in free run."""

from residnet.tasks.fit.task import FitConfig

__all__ = ["FitConfig"]
