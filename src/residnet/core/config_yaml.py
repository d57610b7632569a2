"""Read and write YAML with the scalars of YAML 1.2, without duplicate keys, with line numbers.

PyYAML follows YAML 1.1, where `1e-3` is text, `off` is a boolean, `12:30` is 750 and `010` is 8.
Each of these would silently change a value of a run. Therefore scalars follow the YAML 1.2 core
schema, and keys are always text.
"""

from __future__ import annotations

import re
from collections.abc import Hashable, Sequence
from functools import lru_cache
from typing import Any

import yaml
from yaml.nodes import MappingNode, Node, ScalarNode, SequenceNode

from residnet.core.errors import ConfigError

KeyPath = tuple[str | int, ...]
"""Path to a value of a config: keys of mappings and indices of lists."""

# no config is near these limits, and a file far beyond them would occupy the parser for minutes
_MAX_VALUES = 200_000
"""Largest number of values in a file."""
_MAX_DEPTH = 60
"""Largest number of nested mappings and lists."""
_MAX_DIGITS = 400
"""Largest number of digits of a whole number."""
_TAG_PREFIX = "tag:yaml.org,2002:"
# the first match counts: a whole number is also a valid float
_SCALAR_TAGS: tuple[tuple[str, str, str], ...] = (
    ("null", r"^(?:~|null|Null|NULL|)$", "~nN\0"),
    ("bool", r"^(?:true|True|TRUE|false|False|FALSE)$", "tTfF"),
    ("int", r"^(?:[-+]?[0-9]+|0o[0-7]+|0x[0-9a-fA-F]+)$", "-+0123456789"),
    (
        "float",
        r"^(?:[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?"
        r"|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN))$",
        "-+.0123456789",
    ),
    ("merge", r"^<<$", "<"),
)
_RESOLVERS: dict[str, list[tuple[str, re.Pattern[str]]]] = {}
for _tag, _pattern, _first_characters in _SCALAR_TAGS:
    for _character in _first_characters:
        _RESOLVERS.setdefault("" if _character == "\0" else _character, []).append(
            (_TAG_PREFIX + _tag, re.compile(_pattern))
        )


class _DuplicateKeyError(yaml.constructor.ConstructorError):
    pass


class _ConfigLoader(yaml.SafeLoader):
    yaml_implicit_resolvers = _RESOLVERS

    def construct_mapping(self, node: Node, deep: bool = False) -> dict[Hashable, Any]:
        if not isinstance(node, MappingNode):
            raise yaml.constructor.ConstructorError(
                None, None, "expected a mapping", node.start_mark
            )
        # checked before merge keys are resolved, because a key may override a merged key
        lines: dict[str, int] = {}
        for key, _ in node.value:
            if not isinstance(key, ScalarNode):
                raise yaml.constructor.ConstructorError(
                    None, None, "a key must be plain text", key.start_mark
                )
            if key.value in lines and key.tag != _TAG_PREFIX + "merge":
                raise _DuplicateKeyError(
                    None,
                    None,
                    f"duplicate key '{key.value}', first on line {lines[key.value]}",
                    key.start_mark,
                )
            lines.setdefault(key.value, key.start_mark.line + 1)
        self.flatten_mapping(node)
        return {
            key.value: self.construct_object(value_node, deep=deep)
            for key, value_node in node.value
        }

    def fetch_flow_collection_start(self, TokenClass: type[Any]) -> None:
        self._require_max_depth(self.flow_level)
        super().fetch_flow_collection_start(TokenClass)

    def add_indent(self, column: int) -> bool:
        self._require_max_depth(len(self.indents))
        return bool(super().add_indent(column))

    def _require_max_depth(self, depth: int) -> None:
        # without the limit the scanner reads thousands of brackets, which takes minutes
        if depth > _MAX_DEPTH:
            raise yaml.scanner.ScannerError(
                None, None, f"nested more than {_MAX_DEPTH} levels deep", self.get_mark()
            )

    def construct_whole_number(self, node: ScalarNode) -> int:
        text = node.value
        if len(text) > _MAX_DIGITS:
            raise yaml.constructor.ConstructorError(
                None, None, f"a whole number of {len(text)} digits", node.start_mark
            )
        return int(text, 0) if text.startswith(("0x", "0o")) else int(text)


# other tags of YAML 1.1 (dates, sets, binary) are rejected, because no config field has such a
# type; the constructor under None rejects unknown tags
_ALLOWED_TAGS = (
    None,
    *(_TAG_PREFIX + name for name in ("null", "bool", "float", "str", "seq", "map")),
)
_ConfigLoader.yaml_constructors = {
    tag: construct
    for tag, construct in yaml.SafeLoader.yaml_constructors.items()
    if tag in _ALLOWED_TAGS
}
_ConfigLoader.add_constructor(_TAG_PREFIX + "int", _ConfigLoader.construct_whole_number)


class _ConfigDumper(yaml.SafeDumper):
    # the resolvers of the loader, so that text such as '1e-3' is quoted and loads as text
    yaml_implicit_resolvers = _RESOLVERS

    def ignore_aliases(self, data: Any) -> bool:
        return True

    def represent_python_list(self, data: Sequence[Any]) -> Node:
        # a list of scalars is written on one line, [a, b]; nested values have a line each
        is_flat = not any(isinstance(item, (dict, list)) for item in data)
        return self.represent_sequence(_TAG_PREFIX + "seq", data, flow_style=is_flat)


_ConfigDumper.add_representer(list, _ConfigDumper.represent_python_list)


def parse_yaml(text: str, source: str, *, show_location: bool = True) -> tuple[Any, Node | None]:
    """Parse one YAML document.

    Args:
        text: the document.
        source: file or override for error messages.
        show_location: whether errors give the line and column.

    Returns:
        The value, which consists of dicts with text keys, lists and scalars, and the tree of
        nodes. Both are None if the text holds no document.

    Raises:
        ConfigError: if the text is not YAML, repeats a key or refers to itself.
    """
    value, node = _parse_document(text, source, show_location)
    return _copy_without_aliases(value), node


@lru_cache(maxsize=64)
def _parse_document(text: str, source: str, show_location: bool) -> tuple[Any, Node | None]:
    """Parse one YAML document and cache the result.

    The cache serves vessel files, which the check of a config reads several times. The cached value
    is shared, so that the caller must copy it before changing it.
    """
    try:
        # inside the try block, because the constructor rejects characters that YAML forbids
        loader = _ConfigLoader(text)
        node = loader.get_single_node()
        if node is None:
            return None, None
        value_counts: dict[int, int] = {}

        def count_values(node: Node) -> int:
            if id(node) not in value_counts:
                # a node that is visited again before its count is known contains itself
                value_counts[id(node)] = _MAX_VALUES + 1
                children = (
                    [child for pair in node.value for child in pair]
                    if isinstance(node, MappingNode)
                    else node.value
                    if isinstance(node, SequenceNode)
                    else []
                )
                value_counts[id(node)] = 1 + sum(map(count_values, children))
            return value_counts[id(node)]

        if count_values(node) > _MAX_VALUES:
            raise ConfigError(
                f"{source}: has more than {_MAX_VALUES} values, or refers to itself; replace its"
                " aliases by values",
                "config.too_large",
            )
        return loader.construct_document(node), node
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark
        problem = error.problem or error.context or "cannot be read"
        if isinstance(error, _DuplicateKeyError) and mark is not None:
            raise ConfigError(
                f"{source}{f':{mark.line + 1}' if show_location else ''}: {problem}",
                "config.duplicate_key",
            ) from error
        location = (
            "" if mark is None or not show_location else f":{mark.line + 1}:{mark.column + 1}"
        )
        raise ConfigError(
            f"{source}{location}: not YAML: {' '.join(problem.split())}", "config.not_yaml"
        ) from error
    except (yaml.YAMLError, ValueError) as error:
        raise ConfigError(
            f"{source}: not YAML: {' '.join(str(error).split())}", "config.not_yaml"
        ) from error
    except RecursionError as error:
        raise ConfigError(
            f"{source}: nested too deeply, or refers to itself", "config.too_large"
        ) from error


def _copy_without_aliases(value: Any) -> Any:
    # with an alias two keys share one object; an override of one key must not change the other
    if isinstance(value, dict):
        return {key: _copy_without_aliases(item) for key, item in value.items()}
    return [_copy_without_aliases(item) for item in value] if isinstance(value, list) else value


def find_line(root: Node, path: KeyPath) -> int:
    """Return the line (from 1) of the key at `path`, or of its nearest ancestor in the document."""
    node = root
    line = root.start_mark.line
    for path_element in path:
        child: Node | None = None
        if isinstance(node, MappingNode):
            for key, value in node.value:
                if key.value == str(path_element):
                    child = value
                    line = key.start_mark.line
        elif (
            isinstance(node, SequenceNode)
            and isinstance(path_element, int)
            and path_element < len(node.value)
        ):
            child = node.value[path_element]
            line = child.start_mark.line
        if child is None:
            break
        node = child
    return line + 1


def dump_yaml(data: Any) -> str:
    """Return plain values as YAML text with keys in order and lists of scalars on one line."""
    return yaml.dump(data, Dumper=_ConfigDumper, sort_keys=False, allow_unicode=True, width=120)
