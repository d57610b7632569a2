"""Questions, guesses and notes of a drafted config, and their output as YAML comments."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
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

    def replace_keys(self, new_key: Callable[[Key], Key | None]) -> None:
        """Replace the keys of guesses and notes; entries whose new key is None are dropped."""
        for entries in (self.guessed_values, self.notes):
            replaced = [(new_key(key), text) for key, text in entries]
            entries[:] = [(key, text) for key, text in replaced if key is not None]

    def discard_key(self, key: Key) -> None:
        """Discard the guesses and notes of a key, and its children, that the config lacks."""
        self.replace_keys(lambda entry: None if entry[: len(key)] == key else entry)

    def move_key(self, old_key: Key, new_key: Key) -> None:
        """Move the guesses and notes of a key and its children to another key."""
        depth = len(old_key)
        self.replace_keys(
            lambda entry: (*new_key, *entry[depth:]) if entry[:depth] == old_key else entry
        )

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
    # mappings and lists of scalars are written in flow style
    text = yaml.safe_dump(
        content, default_flow_style=None, width=_LINE_WIDTH, sort_keys=False, allow_unicode=True
    )
    comments_by_line: dict[int, list[str]] = {0: list(head_lines)}

    def collect_comments(node: yaml.Node | None, parent: Key) -> None:
        if isinstance(node, yaml.MappingNode):
            for key_node, value_node in node.value:
                key = (*parent, str(key_node.value))
                texts = comments_by_line.setdefault(key_node.start_mark.line, [])
                texts += comments(key)
                collect_comments(value_node, key)

    collect_comments(yaml.compose(text), ())
    lines = []
    for number, line in enumerate(text.splitlines()):
        indent = " " * (len(line) - len(line.lstrip()))
        for comment in comments_by_line.get(number, ()):
            lines += textwrap.wrap(
                " ".join(comment.split()),
                _LINE_WIDTH,
                initial_indent=f"{indent}# ",
                subsequent_indent=f"{indent}# ",
                break_long_words=False,
            )
        lines.append(line)
    return "\n".join([*lines, ""])
