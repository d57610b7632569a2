"""Questions, guesses and notes of a drafted config, and their output as YAML comments."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, final

import yaml

from residnet.core.errors import DataError

Key = tuple[str, ...]
"""Path of a key in the drafted config, for example `("data", "reader", "channels", "r")`."""
READER_KEY = ("data", "reader")
"""Key of the reader in a config."""
CHANNELS_KEY = (*READER_KEY, "channels")
"""Key of the channel map in a config."""
INPUTS_KEY = ("signals", "inputs")
"""Key of the inputs in a config."""


@dataclass(frozen=True)
class Question:
    """Question to the user about a setting that the files do not determine.

    Attributes:
        key: key of the config.
        text: the question.
        default: answer without a user.
        reason: reason for the default.
        options: possible answers; empty if any answer is possible.
    """

    key: Key
    text: str
    default: str
    reason: str
    options: tuple[str, ...] = ()


UNMAPPED_COLUMNS = "columns without a channel"
UNMAPPED_FIELDS = "fields without a channel"
TEXT_COLUMNS = "columns of text"
"""Starts of the notes that list columns and fields which the draft does not use."""
_LINE_WIDTH = 96
"""Largest width of lines in a drafted config, in characters."""
CommentLookup = Callable[[tuple[str, ...]], list[str]]
"""Function from the path of a key to its comment lines."""
AnswerCallback = Callable[[Question], str]


@final
class DraftNotes:
    """Guesses and notes on the keys of a drafted config.

    Args:
        answer: function that asks the user; None takes every default.
        answers: answers that the user has given in advance, by key.

    Attributes:
        guessed_values: key and reason of each value that may be wrong.
        notes: key and text of each fact from the files.
    """

    def __init__(
        self, answer: AnswerCallback | None = None, answers: Mapping[Key, str] | None = None
    ) -> None:
        self._answer_question = answer
        self._answers = dict(answers or {})
        self._used_answers = set[Key]()
        self.guessed_values: list[tuple[Key, str]] = []
        self.notes: list[tuple[Key, str]] = []

    def ask_question(
        self, key: Key, text: str, default: str, reason: str, options: tuple[str, ...] = ()
    ) -> str:
        """Ask the user; without a user return the default and note it as a guess.

        Args:
            key: key of the config.
            text: the question.
            default: answer without a user.
            reason: reason for the default.
            options: possible answers; empty if any answer is possible.
        """
        if self._answer_question is None:
            self.add_guess(key, reason)
            return default
        user_answer = self._answer_question(Question(key, text, default, reason, options))
        if user_answer == default:
            self.add_note(key, f"confirmed: {reason}")
        else:
            self.add_note(key, f"answered '{user_answer}' instead of '{default}'")
        return user_answer

    def has_answer(self, key: Key) -> bool:
        """Return whether the user has given the answer in advance."""
        return key in self._answers

    def unused_answers(self) -> list[Key]:
        """Return the keys of answers that were given in advance and that no question asked for."""
        return [key for key in self._answers if key not in self._used_answers]

    def require_answer(self, key: Key, text: str, refusal: DataError) -> str:
        """Return the user's answer to a question without a default.

        Args:
            key: key of the config.
            text: the question.
            refusal: error if nobody answers.

        Raises:
            DataError: if nobody answers.
        """
        self._used_answers.add(key)
        answer = self._answers.get(key, "")
        if not answer and self._answer_question is not None:
            answer = self._answer_question(Question(key, text, "", "", ()))
        if not answer.strip():
            raise refusal
        self.add_note(key, f"answered '{answer}'")
        return answer

    def add_guess(self, key: Key, reason: str) -> None:
        """Record that a value may be wrong, with the reason for it."""
        self.guessed_values.append((key, reason))

    def add_note(self, key: Key, text: str) -> None:
        """Record a fact from the files."""
        self.notes.append((key, text))

    def extend(self, other_notes: DraftNotes) -> None:
        """Append the guesses and notes of another draft."""
        self.guessed_values += other_notes.guessed_values
        self.notes += other_notes.notes

    def discard_key(self, key: Key) -> None:
        """Discard the guesses and notes of a key, and its children, that the config lacks."""
        depth = len(key)
        self.guessed_values = [item for item in self.guessed_values if item[0][:depth] != key]
        self.notes = [item for item in self.notes if item[0][:depth] != key]

    def move_key(self, old_key: Key, new_key: Key) -> None:
        """Move the guesses and notes of a key and its children to another key."""
        depth = len(old_key)
        self.guessed_values, self.notes = (
            [
                ((*new_key, *key[depth:]) if key[:depth] == old_key else key, text)
                for key, text in entries
            ]
            for entries in (self.guessed_values, self.notes)
        )

    def rename_keys(self, parent: Key, names: Mapping[str, str]) -> None:
        """Rename the children of a key in guesses and notes, and drop entries of other children.

        Args:
            parent: key of a mapping.
            names: child -> new name.
        """

        def rename_entries(entries: list[tuple[Key, str]]) -> list[tuple[Key, str]]:
            renamed = []
            for key, text in entries:
                if len(key) > len(parent) and key[: len(parent)] == parent:
                    if key[len(parent)] not in names:
                        continue
                    key = (*parent, names[key[len(parent)]], *key[len(parent) + 1 :])
                renamed.append((key, text))
            return renamed

        self.guessed_values = rename_entries(self.guessed_values)
        self.notes = rename_entries(self.notes)

    def comments_at(self, key: Key) -> list[str]:
        """Return the comments on a key of the config, guesses first."""
        return [f"guess: {text}" for noted_key, text in self.guessed_values if noted_key == key] + [
            text for noted_key, text in self.notes if noted_key == key
        ]


def dump_commented_yaml(
    content: Mapping[str, Any], comments: CommentLookup, head_lines: Sequence[str] = ()
) -> str:
    """Format a mapping as YAML with comments above its keys.

    Args:
        content: the mapping.
        comments: function from the path of a key to its comment lines.
        head_lines: comment lines at the top.
    """
    lines = [line for text in head_lines for line in _wrap_comment(text, "")]
    return "\n".join([*lines, *_format_entries(content, (), comments)]) + "\n"


def _format_entries(
    content: Mapping[str, Any], parent_path: tuple[str, ...], comments: CommentLookup
) -> list[str]:
    """Return the YAML lines of a mapping; short values are written in flow style on one line."""
    lines = []
    indent = "  " * len(parent_path)
    for key, value in content.items():
        path = (*parent_path, str(key))
        lines += [line for text in comments(path) for line in _wrap_comment(text, indent)]
        nested_lines = (
            _format_entries(value, path, comments) if isinstance(value, Mapping) and value else []
        )
        if nested_lines and any(
            isinstance(nested_value, Mapping) for nested_value in value.values()
        ):
            # never on one line, whose text takes most of the time of a draft's text
            lines += [f"{indent}{_format_flow(key)}:", *nested_lines]
            continue
        flow_text = _format_flow(value)
        fits_on_line = len(indent) + len(str(key)) + 2 + len(flow_text) <= _LINE_WIDTH
        has_comments = any(line.lstrip().startswith("#") for line in nested_lines)
        if nested_lines and (has_comments or not fits_on_line):
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
    return _format_text_flow(value) if type(value) is str else _format_any_flow(value)


@lru_cache(maxsize=4096)
def _format_text_flow(text: str) -> str:
    """Format a text; keys occur again and again."""
    return _format_any_flow(text)


def _format_any_flow(value: Any) -> str:
    text: str = yaml.safe_dump(
        value, default_flow_style=True, width=10**6, sort_keys=False, allow_unicode=True
    )
    return text.strip().removesuffix("...").strip()


def _wrap_comment(text: str, indent: str) -> list[str]:
    lines = textwrap.wrap(
        " ".join(text.split()), _LINE_WIDTH - len(indent) - 2, break_long_words=False
    )
    return [f"{indent}# {line}" for line in lines]
