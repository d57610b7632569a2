"""The field's words on a page: each is linked to what it means, at its first use in a section."""

from __future__ import annotations

import re
from collections.abc import Mapping
from importlib import resources
from typing import final

from markupsafe import Markup, escape

_ENTRY = re.compile(r"^(?P<terms>\S.*)\n:\s+(?P<text>.*)$", re.MULTILINE)
_CODE = re.compile(r"`([^`]*)`|\*([^*]*)\*")


def entries() -> Mapping[str, str]:
    """Return terms, several of one meaning with commas between, and what they mean."""
    file = resources.files("residnet.report") / "templates" / "glossary.md"
    found = _ENTRY.finditer(file.read_text(encoding="utf-8"))
    return {_plain(entry["terms"]): _plain(entry["text"]) for entry in found}


def _plain(text: str) -> str:
    return _CODE.sub(lambda found: found[1] or found[2], text)


@final
class Glossary:
    """The words of one page: links to them, and what they mean for its end."""

    def __init__(self) -> None:
        self._meant = entries()
        self._of = {word.lower(): key for key in self._meant for word in key.split(", ")}
        words = sorted(self._of, key=len, reverse=True)
        several = "|".join(re.escape(word).replace(r"\ ", r"[ \u00a0]") for word in words)
        self._words = re.compile(rf"(?<![\w/.-])(?:{several})(?=s?(?![\w/-]|\.\w))", re.IGNORECASE)
        self._here: set[str] = set()
        self._used: set[str] = set()

    def fresh(self) -> str:
        """Begin a section, whose words are linked anew; returns nothing to print."""
        self._here.clear()
        return ""

    def linked(self, text: Markup) -> Markup:
        """Return escaped text with links at the first use of each word in the section."""

        def link(found: re.Match[str]) -> str:
            key = self._of[found[0].lower().replace("\u00a0", " ")]
            if key in self._here:
                return found[0]
            self._here.add(key)
            self._used.add(key)
            meant = escape(self._meant[key])
            return f'<a class="term" href="#{name_of(key)}" title="{meant}">{found[0]}</a>'

        return Markup(self._words.sub(link, str(text)))

    def used(self) -> list[tuple[str, str, str]]:
        """Return name, terms and meaning of each word that was linked, in alphabetical order."""
        return [(name_of(key), key, self._meant[key]) for key in self._meant if key in self._used]


def name_of(key: str) -> str:
    """Return the name by which a word is linked."""
    return "word-" + re.sub(r"[^a-z0-9]+", "-", key.lower()).strip("-")
