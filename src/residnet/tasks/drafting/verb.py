"""What `residnet new` does: draft, write, and say what to look at."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from residnet.core.errors import UsageError
from residnet.data.drafting.questions import Answer
from residnet.tasks.drafting.draft import drafted

_SHOWN = 12


def new_config(
    logs: Sequence[Path],
    out: Path,
    answer: Answer | None,
    *,
    overwrite: bool,
    standard: bool = False,
) -> list[str]:
    """Write a config for logs; returns what the terminal shows.

    Args:
        logs: files, folders and bags.
        out: file to write.
        answer: asks the user; None takes every default.
        overwrite: replace the file.
        standard: propose the standard recipe.

    Raises:
        UsageError: where the file exists already, or a path does not.
        DataError: where no log can be used.
    """
    if out.suffix not in (".yaml", ".yml"):
        raise UsageError(f"--out {out}: a config is a YAML file; name it {out}.yaml")
    if out.exists() and not overwrite:
        raise UsageError(f"--out {out}: exists; give --overwrite, or another name")
    name = re.sub(r"[^A-Za-z0-9_.-]+", "_", out.stem).strip("_.-") or "my_boat"
    draft = drafted(logs, out.parent, name, answer, standard=standard)
    file = draft.save(out)
    lines = [f"{key}: {why}" for key, why in draft.guesses[:_SHOWN]]
    if len(draft.guesses) > _SHOWN:
        lines.append(f"and {len(draft.guesses) - _SHOWN} more, marked in the file")
    count = len(draft.guesses)
    head = f"{count} values are guesses, each marked in the file:" if lines else ""
    head = "one value is a guess, marked in the file:" if count == 1 else head
    return [*([head] if head else []), *lines, f"config: {file}", f"next: residnet run {file}"]
