"""A config as YAML text with its comments: what was guessed and why stands above each key."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import yaml

Comments = Callable[[tuple[str, ...]], list[str]]
_WIDTH = 96


def commented(content: Mapping[str, Any], comments: Comments, head: Sequence[str]) -> str:
    """Return a mapping as YAML, with comments above its keys.

    Args:
        content: of the config.
        comments: path of a key -> lines about it.
        head: lines at the top.
    """
    lines = [line for text in head for line in _comment(text, 0)]
    for key, value in content.items():
        lines += _entry(key, value, (), comments)
    return "\n".join(lines) + "\n"


def _entry(key: str, value: Any, above: tuple[str, ...], comments: Comments) -> list[str]:
    path, indent = (*above, key), "  " * len(above)
    out = [line for text in comments(path) for line in _comment(text, len(above))]
    flow = _flow(value)
    short = len(indent) + len(key) + 2 + len(flow) <= _WIDTH
    nested = isinstance(value, Mapping) and value
    if nested and (not short or _deep(value) or _commented_below(value, path, comments)):
        out.append(f"{indent}{_flow(key)}:")
        for name, inner in value.items():
            out += _entry(str(name), inner, path, comments)
    elif isinstance(value, list) and value and not short:
        out.append(f"{indent}{_flow(key)}:")
        out += [f"{indent}  - {_flow(item)}" for item in value]
    else:
        out.append(f"{indent}{_flow(key)}: {flow}")
    return out


def _commented_below(value: Mapping[str, Any], path: tuple[str, ...], comments: Comments) -> bool:
    return any(
        comments((*path, str(key)))
        or (isinstance(inner, Mapping) and _commented_below(inner, (*path, str(key)), comments))
        for key, inner in value.items()
    )


def _deep(value: Mapping[str, Any]) -> bool:
    return any(isinstance(inner, Mapping) for inner in value.values())


def _flow(value: Any) -> str:
    text: str = yaml.safe_dump(
        value, default_flow_style=True, width=10**6, sort_keys=False, allow_unicode=True
    )
    return text.strip().removesuffix("...").strip()


def _comment(text: str, depth: int) -> list[str]:
    indent = "  " * depth
    lines = textwrap.wrap(" ".join(text.split()), _WIDTH - len(indent) - 2, break_long_words=False)
    return [f"{indent}# {line}" for line in lines]
