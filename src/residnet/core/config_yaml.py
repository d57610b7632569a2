"""YAML as configs use it: YAML 1.2 scalars, no duplicate keys, and the line of every key.

PyYAML follows YAML 1.1, where `1e-3` is text, `off` is a boolean, `12:30` is 750 and `010` is 8.
Each of these would silently put a wrong value into a run, so scalars are read by the YAML 1.2 core
schema, and keys are always text.
"""

from __future__ import annotations

import re
from collections.abc import Hashable, Sequence
from typing import Any

import yaml
from yaml.nodes import MappingNode, Node, ScalarNode, SequenceNode

from residnet.core.errors import ConfigError

KeyPath = tuple[str | int, ...]
"""Where a value stands in a config: keys of mappings and indices of lists."""

_MOST_VALUES, _DEEPEST, _LONGEST_NUMBER = 200_000, 60, 400
"""Values, levels and digits, chosen by hand: no config has so many, and far more take minutes."""
_PREFIX = "tag:yaml.org,2002:"
# in the order in which they are tried: a whole number is also a valid float
_SCALARS: tuple[tuple[str, str, str], ...] = (
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
for _tag, _pattern, _first in _SCALARS:
    for _char in _first:
        _RESOLVERS.setdefault("" if _char == "\0" else _char, []).append(
            (_PREFIX + _tag, re.compile(_pattern))
        )


class _DuplicateKey(yaml.constructor.ConstructorError):
    pass


class _Loader(yaml.SafeLoader):
    yaml_implicit_resolvers = _RESOLVERS

    def construct_mapping(self, node: Node, deep: bool = False) -> dict[Hashable, Any]:
        if not isinstance(node, MappingNode):
            raise yaml.constructor.ConstructorError(
                None, None, "expected a mapping", node.start_mark
            )
        # before merge keys are resolved: a key that overrides a merged one is what merging is for
        lines: dict[str, int] = {}
        for key, _ in node.value:
            if not isinstance(key, ScalarNode):
                raise yaml.constructor.ConstructorError(
                    None, None, "a key must be plain text", key.start_mark
                )
            if key.value in lines and key.tag != _PREFIX + "merge":
                raise _DuplicateKey(
                    None,
                    None,
                    f"duplicate key '{key.value}', first on line {lines[key.value]}",
                    key.start_mark,
                )
            lines.setdefault(key.value, key.start_mark.line + 1)
        self.flatten_mapping(node)
        return {key.value: self.construct_object(value, deep=deep) for key, value in node.value}

    def fetch_flow_collection_start(self, TokenClass: type[Any]) -> None:
        self._require_flat(self.flow_level)
        super().fetch_flow_collection_start(TokenClass)

    def add_indent(self, column: int) -> bool:
        self._require_flat(len(self.indents))
        return bool(super().add_indent(column))

    def _require_flat(self, depth: int) -> None:
        # the scanner would first look to the end of thousands of brackets, which takes minutes
        if depth > _DEEPEST:
            raise yaml.scanner.ScannerError(
                None, None, f"nested more than {_DEEPEST} levels deep", self.get_mark()
            )

    def construct_whole_number(self, node: ScalarNode) -> int:
        text = node.value
        if len(text) > _LONGEST_NUMBER:
            raise yaml.constructor.ConstructorError(
                None, None, f"a whole number of {len(text)} digits", node.start_mark
            )
        return int(text, 0) if text.startswith(("0x", "0o")) else int(text)


# other tags of YAML 1.1 (dates, sets, binary) are refused rather than turned into objects that no
# config has; None refuses the unknown ones
_KNOWN = (None, *(_PREFIX + name for name in ("null", "bool", "float", "str", "seq", "map")))
_Loader.yaml_constructors = {
    tag: construct for tag, construct in yaml.SafeLoader.yaml_constructors.items() if tag in _KNOWN
}
_Loader.add_constructor(_PREFIX + "int", _Loader.construct_whole_number)


class _Dumper(yaml.SafeDumper):
    # the loader's resolvers, so that text such as '1e-3' is quoted and comes back as text
    yaml_implicit_resolvers = _RESOLVERS

    def ignore_aliases(self, data: Any) -> bool:
        return True

    def represent_short_list(self, data: Sequence[Any]) -> Node:
        flat = not any(isinstance(item, (dict, list)) for item in data)
        return self.represent_sequence(_PREFIX + "seq", data, flow_style=flat)


_Dumper.add_representer(list, _Dumper.represent_short_list)


def parse(text: str, where: str, *, located: bool = True) -> tuple[Any, Node | None]:
    """Return the plain value and the node tree of one YAML document.

    The value consists of dicts with text keys, lists and scalars; both are None where the text
    holds no document.

    Args:
        where: file or override that errors name.
        located: whether errors give the line and column.

    Raises:
        ConfigError: where the text is not YAML, repeats a key or refers to itself.
    """
    try:
        # inside try: the constructor already rejects characters that YAML does not allow
        loader = _Loader(text)
        node = loader.get_single_node()
        if node is None:
            return None, None
        sizes: dict[int, int] = {}

        def size(node: Node) -> int:
            if id(node) not in sizes:
                sizes[id(node)] = _MOST_VALUES + 1  # met again meanwhile: it stands within itself
                children = (
                    [part for pair in node.value for part in pair]
                    if isinstance(node, MappingNode)
                    else node.value
                    if isinstance(node, SequenceNode)
                    else []
                )
                sizes[id(node)] = 1 + sum(map(size, children))
            return sizes[id(node)]

        if size(node) > _MOST_VALUES:
            raise ConfigError(
                f"{where}: stands for more than {_MOST_VALUES} values, or refers to itself; write"
                " out what its aliases mean"
            )
        return _unshared(loader.construct_document(node)), node
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark
        problem = error.problem or error.context or "cannot be read"
        if isinstance(error, _DuplicateKey) and mark is not None:
            raise ConfigError(
                f"{where}{f':{mark.line + 1}' if located else ''}: {problem}"
            ) from error
        place = "" if mark is None or not located else f":{mark.line + 1}:{mark.column + 1}"
        raise ConfigError(f"{where}{place}: not YAML: {' '.join(problem.split())}") from error
    except (yaml.YAMLError, ValueError) as error:
        raise ConfigError(f"{where}: not YAML: {' '.join(str(error).split())}") from error
    except RecursionError as error:
        raise ConfigError(f"{where}: nested too deeply, or refers to itself") from error


def _unshared(value: Any) -> Any:
    # an alias makes two keys share one object; an override of one of them must not change the other
    if isinstance(value, dict):
        return {key: _unshared(item) for key, item in value.items()}
    return [_unshared(item) for item in value] if isinstance(value, list) else value


def line_of(root: Node, path: KeyPath) -> int:
    """Return the line (from 1) of the key at `path`, or of its nearest ancestor in the document."""
    node, line = root, root.start_mark.line
    for element in path:
        child: Node | None = None
        if isinstance(node, MappingNode):
            for key, value in node.value:
                if key.value == str(element):
                    child, line = value, key.start_mark.line
        elif (
            isinstance(node, SequenceNode)
            and isinstance(element, int)
            and element < len(node.value)
        ):
            child = node.value[element]
            line = child.start_mark.line
        if child is None:
            break
        node = child
    return line + 1


def dump(data: Any) -> str:
    """Write plain values as YAML text; keys keep their order, lists of scalars take one line."""
    return yaml.dump(data, Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=120)
