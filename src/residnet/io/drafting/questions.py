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


_LINE_WIDTH = 96
"""Columns of a drafted config."""
CommentLookup = Callable[[tuple[str, ...]], list[str]]
"""Path of a key -> lines about it."""
AnswerCallback = Callable[[Question], str]


@final
class DraftNotes:
    """The marks of a draft: what was guessed, what was found out, and what was left out.

    Args:
        answer: asks somebody; None takes every default.
    """

    def __init__(self, answer: AnswerCallback | None = None) -> None:
        self._answer_question = answer
        self.guessed_values: list[tuple[Key, str]] = []
        self.notes: list[tuple[Key, str]] = []

    def ask_question(
        self, key: Key, text: str, default: str, reason: str, options: tuple[str, ...] = ()
    ) -> str:
        """Return the answer to a question; the default, marked as a guess, where nobody answers."""
        if self._answer_question is None:
            self.add_guess(key, reason)
            return default
        user_answer = self._answer_question(Question(key, text, default, reason, options))
        if user_answer == default:
            self.add_note(key, f"confirmed: {reason}")
        else:
            self.add_note(key, f"answered '{user_answer}' in place of '{default}'")
        return user_answer

    def add_guess(self, key: Key, reason: str) -> None:
        """Mark a value that may be wrong."""
        self.guessed_values.append((key, reason))

    def add_note(self, key: Key, text: str) -> None:
        """Write down what the files show."""
        self.notes.append((key, text))

    def extend(self, other_notes: DraftNotes) -> None:
        """Add the marks of another draft."""
        self.guessed_values += other_notes.guessed_values
        self.notes += other_notes.notes

    def move_key(self, old_key: Key, new_key: Key) -> None:
        """Move the marks of one key, and of those below it, to another."""
        depth = len(old_key)
        self.guessed_values, self.notes = (
            [
                ((*new_key, *key[depth:]) if key[:depth] == old_key else key, text)
                for key, text in entries
            ]
            for entries in (self.guessed_values, self.notes)
        )

    def rename_keys(self, parent: Key, names: Mapping[str, str]) -> None:
        """Move what stands at keys below another one to new names; others there are forgotten."""

        def rename_entries(entries: list[tuple[Key, str]]) -> list[tuple[Key, str]]:
            renamed = []
            for key, text in entries:
                if len(key) > len(parent) and key[: len(parent)] == parent:
                    if key[len(parent)] not in names:
                        continue
                    key = (*parent, names[key[len(parent)]], *key[len(parent) + 1 :])
                renamed.append((key, text))
            return renamed

        self.guessed_values, self.notes = (
            rename_entries(self.guessed_values),
            rename_entries(self.notes),
        )

    def comments_at(self, key: Key) -> list[str]:
        """Return the comments that stand at a key of the config, guesses first."""
        return [f"guess: {text}" for noted_key, text in self.guessed_values if noted_key == key] + [
            text for noted_key, text in self.notes if noted_key == key
        ]


def dump_commented_yaml(
    content: Mapping[str, Any], comments: CommentLookup, head_lines: Sequence[str] = ()
) -> str:
    """Return a mapping as YAML, with comments above its keys.

    Args:
        comments: path of a key -> lines about it.
        head_lines: lines at the top.
    """
    lines = [line for text in head_lines for line in _wrap_comment(text, "")]
    return "\n".join([*lines, *_format_entries(content, (), comments)]) + "\n"


def _format_entries(
    content: Mapping[str, Any], parent_path: tuple[str, ...], comments: CommentLookup
) -> list[str]:
    lines, indent = [], "  " * len(parent_path)
    for key, value in content.items():
        path, flow_text = (*parent_path, str(key)), _format_flow(value)
        lines += [line for text in comments(path) for line in _wrap_comment(text, indent)]
        fits_on_line = len(indent) + len(str(key)) + 2 + len(flow_text) <= _LINE_WIDTH
        if isinstance(value, Mapping) and value:
            nested_lines = _format_entries(value, path, comments)
            is_nested = any(isinstance(nested_value, Mapping) for nested_value in value.values())
            if (
                not fits_on_line
                or is_nested
                or any(line.lstrip().startswith("#") for line in nested_lines)
            ):
                lines += [f"{indent}{_format_flow(key)}:", *nested_lines]
                continue
        if isinstance(value, list) and value and not fits_on_line:
            lines += [
                f"{indent}{_format_flow(key)}:",
                *(f"{indent}  - {_format_flow(item)}" for item in value),
            ]
        else:
            lines.append(f"{indent}{_format_flow(key)}: {flow_text}")
    return lines


def _format_flow(value: Any) -> str:
    text: str = yaml.safe_dump(
        value, default_flow_style=True, width=10**6, sort_keys=False, allow_unicode=True
    )
    return text.strip().removesuffix("...").strip()


def _wrap_comment(text: str, indent: str) -> list[str]:
    lines = textwrap.wrap(
        " ".join(text.split()), _LINE_WIDTH - len(indent) - 2, break_long_words=False
    )
    return [f"{indent}# {line}" for line in lines]
