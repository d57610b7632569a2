"""Names in a model's description stand in exported C: none of them becomes code."""

from __future__ import annotations

import json
from typing import Any

import pytest

from residnet.core.config import validate_config
from residnet.core.errors import ConfigError
from residnet.dynamics.store import ModelSpec
from residnet.export.c import escape_comment
from residnet.heads.linear import RidgeConfig
from residnet.testing.checks import make_example_spec

CODE = "__attribute__((constructor)) static void evil(void) { }"


@pytest.mark.parametrize("name", [f"n */ {CODE} //", f"n\n{CODE}", 'n"', "n\\", f"n */ {CODE} /*"])
def test_a_name_that_ends_a_comment_is_refused(name: str) -> None:
    """The exported C is compiled and run: this ran code of whoever had written model.json."""
    spec = make_example_spec(RidgeConfig(features=("u", "v", "r"), degree=1))
    content = spec.model_dump(mode="json", by_alias=True)
    channel = spec.signals.input_columns[0]

    def renamed(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: renamed(part) for key, part in value.items()}
        if isinstance(value, list):
            return [renamed(part) for part in value]
        return name if value == channel else value

    for forged in (renamed(content), {**content, "name": name}):
        assert json.dumps(forged) != json.dumps(content)
        with pytest.raises(ConfigError, match="rename it"):
            validate_config(forged, ModelSpec, "model.json")


def test_a_comment_ends_where_the_exporter_ends_it() -> None:
    assert "*/" not in escape_comment("a */ b /* c */")
