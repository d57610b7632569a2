"""Config keys and kinds that had another name once: an old one is refused with the new one named.

Keys of the table are ends of dotted key paths, `*` for any one key; a kind that was renamed has
`=<old kind>` behind the path of its discriminator. Values are what to write instead.
"""

from __future__ import annotations

from fnmatch import fnmatchcase

RENAMED: dict[str, str] = {
    "recurrent": "policies",
    "policies.*.hidden": "units",
    "policies.*.observer": "start",
    "policies.*.imitate": "start",
    "policies.*.training.horizon": "duration",
    "policies.*.training.margin": "steady.overshoot",
    "policies.*.training.overshoot": "exact",
    "policies.*.training.sharp": "conditions.stated.band",
    "policies.*.training.slowest": "conditions.stated.time",
    "policies.*.training.smoothness": "calm",
    "spread": "conditions.stated",
    "test.bias_error": "conditions.stated",
    "test.overshoot": "conditions.stated.overshoot_weight",
    "tuning_points": "conditions.evolution",
}
"""For example `"free_run.lead": "warmup"`, `"baseline.kind=fossen": "hull"`."""


GONE: dict[str, str] = {
    "refit.*.folds": "the prior is fixed by the length of the logs",
    "refit_baseline": "refit the baseline before its networks, by `refit`",
    "begin_with": "a network begins from its baseline alone",
    "swaps": "the search keeps a beam of sets and trims them",
    "separate": "models of single phases are always fitted besides",
    "standard.bounds": "parameters are free, as in the document",
    "identify": "the first half identifies, as in the document",
}
"""Keys that nothing took the place of, and what holds instead."""


def renamed(path: tuple[str | int, ...], value: str | None = None) -> str:
    """Return `; it is 'new' now` for an old key or value, `; it is gone: ...`, or nothing."""
    written = ".".join(map(str, path)) + ("" if value is None else f"={value}")
    for old, new in RENAMED.items():
        if fnmatchcase(f".{written}", f"*.{old}"):
            return f"; it is '{new}' now"
    for old, instead in GONE.items():
        if fnmatchcase(f".{written}", f"*.{old}"):
            return f"; it is gone: {instead}"
    return ""
