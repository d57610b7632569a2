"""Writes the reference of every config key while the site is built (run by mkdocs-gen-files)."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import mkdocs_gen_files
from mkdocs.plugins import get_plugin_logger
from pydantic import BaseModel

sys.path.insert(0, str(Path(__file__).parent))

from config_keys import Key, config_classes, keys, selector, summary, undocumented

_LOG = get_plugin_logger("config_pages")
FOLDER = "reference/config"
PAGES = {
    "tasks": ("Tasks", "A run is one YAML file. Its key `task` selects the kind of run."),
    "studies": ("Studies of the five documents", "These tasks repeat published experiments."),
    "io": ("Readers of logs", "These classes describe files of logs and their channels."),
    "preprocessing": ("Preparation", "These classes describe the preparation of logs for a fit."),
    "baselines": ("Baselines", "A baseline is the known part of a model."),
    "heads": ("Residual heads", "A head learns the residual of the baseline."),
    "training": ("Training and refit", "These classes describe the estimation of parameters."),
    "evaluation": ("Evaluation", "These classes describe the evaluation of models in free runs."),
    "autopilot": ("Control", "These classes describe controllers, guidance and courses."),
    "manoeuvres": ("Manoeuvres", "These classes describe simulated manoeuvres."),
    "physics": ("Vessels and their environment", "These classes describe vessel files."),
}


def page_of(config: type[BaseModel]) -> str:
    """Return the name of the page that a class stands on."""
    package = config.__module__.split(".")[1]
    return package if package in PAGES else "tasks"


def linked(text: str, page: str, classes: dict[str, type[BaseModel]]) -> str:
    """Return Markdown in which each `{module.Name}` is a link to the section of that class."""

    def link(match: re.Match[str]) -> str:
        config = classes[match[1]]
        target = page_of(config)
        title = (selector(config) or config.__name__).replace("kind: ", "")
        where = "" if target == page else f"{target}.md"
        return f"[`{title}`]({where}#{anchor(config)})"

    return re.sub(r"\{(residnet[\w.]*)\}", link, text)


def anchor(config: type[BaseModel]) -> str:
    """Return the anchor of the section of a class."""
    return "-".join((*config.__module__.split(".")[2:], config.__name__)).lower()


def row(key: Key, page: str, classes: dict[str, type[BaseModel]]) -> str:
    """Return one line of a class's table."""
    cells = (
        f"`{key.name}`",
        linked(key.type, page, classes),
        linked(key.default, page, classes) or "required",
        (key.text or "")[:1].upper() + (key.text or "")[1:],
    )
    return "| " + " | ".join(cell.replace("|", "\\|").replace("\n", " ") for cell in cells) + " |"


def section(config: type[BaseModel], page: str, classes: dict[str, type[BaseModel]]) -> str:
    """Return the section of one class."""
    title = f"`{chosen}`" if (chosen := selector(config)) else config.__name__
    lines = [f"## {title} {{ #{anchor(config)} }}", "", summary(config), ""]
    table = [row(key, page, classes) for key in keys(config)]
    if table:
        head = ["| key | value | default | meaning |", "| --- | --- | --- | --- |"]
        lines += [*head, *table, ""]
    else:
        lines += ["It has no keys of its own.", ""]
    return "\n".join([*lines, f"Python class: `{config.__module__}.{config.__name__}`.", ""])


def write() -> None:
    """Write one page per package; a key without documentation is a warning, an error if strict."""
    for name in undocumented():
        _LOG.warning("undocumented config key; add it under 'Attributes:' of its class: %s", name)
    classes = {f"{config.__module__}.{config.__qualname__}": config for config in config_classes()}
    for page, (title, text) in PAGES.items():
        here = [config for config in classes.values() if page_of(config) == page]
        if here:
            sections = [section(config, page, classes) for config in here]
            with mkdocs_gen_files.open(f"{FOLDER}/{page}.md", "w") as file:
                file.write("\n".join([f"# {title}", "", text, "", *sections]))


write()
