"""A config from logs alone, as `residnet new` writes it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from residnet.api.values import PathGiven, hearing, path
from residnet.core.errors import UsageError
from residnet.core.names import nearest
from residnet.core.progress import ProgressCallback
from residnet.data.drafting.questions import Question
from residnet.tasks.drafting.draft import Draft, drafted

RECIPES = ("standard",)
"""Recipes by name."""


def draft(
    logs: PathGiven | Sequence[PathGiven],
    *,
    name: str = "my_boat",
    folder: PathGiven = ".",
    answer: Callable[[Question], str] | None = None,
    recipe: str | None = None,
    progress: ProgressCallback | None = None,
) -> Draft:
    """Draft a complete config of a fit from logs of any format.

    Channels, units, frames, inputs, splits, protocols, scales and models are proposed by names,
    headers, values and physics. What the logs do not tell is a guess, and marked as one.

    Args:
        logs: files, folders and bags: one, or a list of these.
        name: of the run.
        folder: where the config will lie; its paths start from there.
        answer: is given each question that the logs leave open, and returns its answer; None takes
            the defaults.
        recipe: `standard` proposes the standard recipe, which fits a portfolio of models and takes
            minutes more than the few models that are proposed by default.
        progress: is told how far the reading is.

    Returns:
        The draft: `config` for `residnet.run`, `guesses` as pairs of key and reason, `text` as
        YAML with comments, and `save(file)`.

    Raises:
        UsageError: where a path does not exist, or nothing in the logs drives the vessel.
        DataError: where no log can be used.

    Example:
        draft = residnet.draft("trials/"); draft.save("my_boat.yaml"); residnet.run("my_boat.yaml")
    """
    given = list(logs) if isinstance(logs, list | tuple) else [logs]
    if not given:
        raise UsageError("draft: no log is given; name files, folders or bags")
    if recipe not in (None, *RECIPES):
        raise UsageError(f"draft: no recipe '{recipe}'{nearest(str(recipe), RECIPES)}")
    with hearing(progress):
        paths = [path(one, "draft") for one in given]
        return drafted(paths, Path(folder), name, answer, standard=recipe is not None)
