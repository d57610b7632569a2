"""What a draft cannot know: questions with a reason and a default, and the marks they leave."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, final

import yaml

Key = tuple[str, ...]
"""Path of a key in the drafted config, for example `("data", "reader", "channels", "r")`."""


@dataclass(frozen=True)
class Question:
    """One thing that files do not say.

    Attributes:
        key: of the config that the answer decides.
        text: the question.
        default: the answer that is taken where nobody answers.
        reason: why this is the default.
        options: answers that there are; empty where anything goes.
    """

    key: Key
    text: str
    default: str
    reason: str
    options: tuple[str, ...] = ()


_WIDTH = 96
"""Columns of a drafted config."""
Comments = Callable[[tuple[str, ...]], list[str]]
"""Path of a key -> lines about it."""
Answer = Callable[[Question], str]


@final
class Marks:
    """The marks of a draft: what was guessed, what was found out, and what was left out.

    Args:
        answer: asks somebody; None takes every default.
    """

    def __init__(self, answer: Answer | None = None) -> None:
        self._answer = answer
        self.guesses: list[tuple[Key, str]] = []
        self.notes: list[tuple[Key, str]] = []

    def ask(
        self, key: Key, text: str, default: str, reason: str, options: tuple[str, ...] = ()
    ) -> str:
        """Return the answer to a question; the default, marked as a guess, where nobody answers."""
        if self._answer is None:
            self.guess(key, reason)
            return default
        given = self._answer(Question(key, text, default, reason, options))
        if given == default:
            self.note(key, f"confirmed: {reason}")
        else:
            self.note(key, f"answered '{given}' in place of '{default}'")
        return given

    def guess(self, key: Key, reason: str) -> None:
        """Mark a value that may be wrong."""
        self.guesses.append((key, reason))

    def note(self, key: Key, text: str) -> None:
        """Write down what the files show."""
        self.notes.append((key, text))

    def extend(self, other: Marks) -> None:
        """Add the marks of another draft."""
        self.guesses += other.guesses
        self.notes += other.notes

    def move(self, old: Key, new: Key) -> None:
        """Move the marks of one key, and of those below it, to another."""
        deep = len(old)
        self.guesses, self.notes = (
            [((*new, *key[deep:]) if key[:deep] == old else key, text) for key, text in marks]
            for marks in (self.guesses, self.notes)
        )

    def rename(self, below: Key, names: Mapping[str, str]) -> None:
        """Move what stands at keys below another one to new names; others there are forgotten."""

        def moved(marks: list[tuple[Key, str]]) -> list[tuple[Key, str]]:
            out = []
            for key, text in marks:
                if len(key) > len(below) and key[: len(below)] == below:
                    if key[len(below)] not in names:
                        continue
                    key = (*below, names[key[len(below)]], *key[len(below) + 1 :])
                out.append((key, text))
            return out

        self.guesses, self.notes = moved(self.guesses), moved(self.notes)

    def comments(self, key: Key) -> list[str]:
        """Return the comments that stand at a key of the config, guesses first."""
        return [f"guess: {text}" for at, text in self.guesses if at == key] + [
            text for at, text in self.notes if at == key
        ]


def commented(content: Mapping[str, Any], comments: Comments, head: Sequence[str] = ()) -> str:
    """Return a mapping as YAML, with comments above its keys.

    Args:
        comments: path of a key -> lines about it.
        head: lines at the top.
    """
    lines = [line for text in head for line in _comment(text, "")]
    return "\n".join([*lines, *_entries(content, (), comments)]) + "\n"


def _entries(content: Mapping[str, Any], above: tuple[str, ...], comments: Comments) -> list[str]:
    out, indent = [], "  " * len(above)
    for key, value in content.items():
        path, flow = (*above, str(key)), _flow(value)
        out += [line for text in comments(path) for line in _comment(text, indent)]
        short = len(indent) + len(str(key)) + 2 + len(flow) <= _WIDTH
        if isinstance(value, Mapping) and value:
            below = _entries(value, path, comments)
            deep = any(isinstance(inner, Mapping) for inner in value.values())
            if not short or deep or any(line.lstrip().startswith("#") for line in below):
                out += [f"{indent}{_flow(key)}:", *below]
                continue
        if isinstance(value, list) and value and not short:
            out += [f"{indent}{_flow(key)}:", *(f"{indent}  - {_flow(item)}" for item in value)]
        else:
            out.append(f"{indent}{_flow(key)}: {flow}")
    return out


def _flow(value: Any) -> str:
    text: str = yaml.safe_dump(
        value, default_flow_style=True, width=10**6, sort_keys=False, allow_unicode=True
    )
    return text.strip().removesuffix("...").strip()


def _comment(text: str, indent: str) -> list[str]:
    lines = textwrap.wrap(" ".join(text.split()), _WIDTH - len(indent) - 2, break_long_words=False)
    return [f"{indent}# {line}" for line in lines]
