"""Overrides of a config: `dotted.key=value` sets a value, `~dotted.key` takes a key away."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from residnet.core.config_errors import given
from residnet.core.config_yaml import KeyPath, parse
from residnet.core.errors import ConfigError
from residnet.core.names import nearest


@dataclass(frozen=True)
class Override:
    """An override as the user wrote it, and the key path that it set."""

    text: str
    path: KeyPath

    @property
    def where(self) -> str:
        """The override as error messages name it."""
        return f"override '{self.text}'"


def apply_override(data: dict[str, Any], text: str) -> Override:
    """Change `data` in place as one override says and return what was changed.

    Keys on the way that the file leaves out are made; `~key` takes a key away.

    Raises:
        ConfigError: where the text is no override, or names a key or item that cannot be there.
    """
    if text.startswith("~"):
        return _remove(data, text)
    key, equals, value_text = text.partition("=")
    keys = key.strip().split(".")
    if not equals or not all(keys):
        raise ConfigError(
            f"override '{text}': expected key=value, for example head.lstm.hidden_size=64"
        )
    where = f"override '{text}'"
    value, _ = parse(value_text, where, located=False)
    path: KeyPath = ()
    here: Any = data
    for i, name in enumerate(keys):
        element = _element(here, name, where, path)
        path += (element,)
        if i == len(keys) - 1:
            here[element] = value
        elif isinstance(here, dict) and here.get(name) is None:
            here[element] = {}
        here = here[element]
    return Override(text, path)


def _remove(data: dict[str, Any], text: str) -> Override:
    where = f"override '{text}'"
    keys = text[1:].strip().split(".")
    here: Any = data
    path: KeyPath = ()
    for i, name in enumerate(keys):
        if not isinstance(here, dict) or name not in here:
            at = ".".join(keys[: i + 1])
            raise ConfigError(
                f"{where}: there is no '{at}' to take"
                f" away{nearest(name, here) if isinstance(here, dict) and here else ''}"
            )
        path += (name,)
        if i == len(keys) - 1:
            del here[name]
            break
        here = here[name]
    return Override(text, path)


def _element(here: Any, name: str, where: str, path: KeyPath) -> str | int:
    """Return `name` as a key or an index of `here`."""
    at = ".".join(str(element) for element in path)
    if isinstance(here, dict):
        return name
    if not isinstance(here, list):
        raise ConfigError(f"{where}: {at}: has no key '{name}' {given(here)}")
    if not name.isdecimal() or int(name) >= len(here):
        raise ConfigError(
            f"{where}: {at}: a list of {len(here)} items has no item '{name}'; the first is 0"
        )
    return int(name)
