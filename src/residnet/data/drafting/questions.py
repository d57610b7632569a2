"""What a draft cannot know: questions with a reason and a default, and the marks they leave."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import final

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
        """Move the marks of one key to another."""
        self.guesses = [(new if key == old else key, text) for key, text in self.guesses]
        self.notes = [(new if key == old else key, text) for key, text in self.notes]

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
