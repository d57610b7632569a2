"""Write the list of commands in `docs/reference/command_line.md` from the command line itself.

`python scripts/ci/command_reference.py` replaces the text between the two marks of the page. With
`--check` nothing is written, and the exit code is 1 if the page is not current.
"""

from __future__ import annotations

import inspect
import re
import sys
from pathlib import Path
from typing import Any

from typer.main import get_command

from residnet.cli import app

PAGE = Path(__file__).resolve().parents[2] / "docs" / "reference" / "command_line.md"
START = "<!-- commands -->"
END = "<!-- end of commands -->"
COMMON = ("help", "quiet", "trust")
"""Parameters of nearly all commands, which the page describes once."""


def write_page() -> str:
    """Return the text of the page with the current list of commands."""
    group: Any = get_command(app)
    context = group.make_context("residnet", ["runs"], resilient_parsing=True)
    commands = {name: group.get_command(context, name) for name in group.list_commands(context)}
    overview = [
        "| command | function |",
        "| --- | --- |",
        *(
            f"| [`residnet {name}`](#residnet-{name}) | {_help_paragraphs(command)[0]} |"
            for name, command in commands.items()
        ),
    ]
    sections = [_write_section(name, command) for name, command in commands.items()]
    head, _, rest = PAGE.read_text(encoding="utf-8").partition(START)
    _, _, tail = rest.partition(END)
    blocks = [START, "\n".join(overview), *sections, END]
    return head + "\n\n".join(blocks) + tail


def _help_paragraphs(command: Any) -> list[str]:
    """Return the paragraphs of the help text of a command, each as one line."""
    return [" ".join(text.split()) for text in inspect.cleandoc(command.help or "").split("\n\n")]


def _write_section(name: str, command: Any) -> str:
    """Return the section of a command: its help text, and a table of its parameters."""
    parameters = [
        parameter
        for parameter in command.params
        if parameter.name not in COMMON and not getattr(parameter, "hidden", False)
    ]
    arguments = [parameter for parameter in parameters if parameter.param_type_name == "argument"]
    usage = " ".join(["residnet", name, *(_argument_name(row) for row in arguments)])
    rows = [
        f"| `{_parameter_name(parameter)}` | {_describe(parameter)} |" for parameter in parameters
    ]
    table = ["| argument or option | meaning |", "| --- | --- |", *rows]
    text = "\n\n".join(_help_paragraphs(command))
    return f"## residnet {name}\n\n`{usage} [OPTIONS]`\n\n{text}\n\n" + "\n".join(table)


def _argument_name(parameter: Any) -> str:
    return str(parameter.metavar or parameter.name.upper()).replace("|", "/")


def _parameter_name(parameter: Any) -> str:
    """Return an argument, or an option with its value, as it is typed."""
    if parameter.param_type_name == "argument":
        return _argument_name(parameter)
    names = ", ".join(parameter.opts)
    if parameter.is_flag:
        return names
    return f"{names} {parameter.metavar}".replace("|", "/")


def _describe(parameter: Any) -> str:
    """Return the help text of a parameter, with its default value."""
    text = " ".join((parameter.help or "").split()).replace("|", "\\|")
    # Markdown would read <name> as a tag
    text = re.sub(r"[\w/-]*<\w+>[\w/.-]*\w|[\w/-]*<\w+>", r"`\g<0>`", text)
    default = parameter.default
    has_default = default is not None and default != "" and not callable(default)
    if parameter.param_type_name == "argument" or getattr(parameter, "is_flag", False):
        return text
    # a help text that names its default does not repeat it
    if has_default and "default:" not in text and not re.match(r"\[?\]?$", str(default)):
        text = f"{text.removesuffix('.')}; default: {default}."
    return text


def main() -> int:
    """Write the page; with `--check` return 1 if it is not current."""
    text = write_page()
    if "--check" in sys.argv[1:]:
        return int(text != PAGE.read_text(encoding="utf-8"))
    PAGE.write_text(text, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
