"""Write the reference of every config key while the site is built (run by mkdocs-gen-files)."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import mkdocs_gen_files
from mkdocs.plugins import get_plugin_logger
from pydantic import BaseModel

sys.path.insert(0, str(Path(__file__).parent))

from config_keys import (
    Key,
    format_selector,
    iterate_keys,
    list_config_classes,
    list_undocumented_keys,
    read_summary,
)

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


def get_page(config: type[BaseModel]) -> str:
    """Return the name of the page with the section of a class."""
    package = config.__module__.split(".")[1]
    return package if package in PAGES else "tasks"


def insert_links(text: str, page: str, classes: dict[str, type[BaseModel]]) -> str:
    """Return Markdown in which each `{module.Name}` is a link to the section of that class."""

    def link(match: re.Match[str]) -> str:
        config = classes[match[1]]
        target = get_page(config)
        title = (format_selector(config) or config.__name__).replace("kind: ", "")
        target_file = "" if target == page else f"{target}.md"
        return f"[`{title}`]({target_file}#{make_anchor(config)})"

    return re.sub(r"\{(residnet[\w.]*)\}", link, text)


def make_anchor(config: type[BaseModel]) -> str:
    """Return the anchor of the section of a class."""
    return "-".join((*config.__module__.split(".")[2:], config.__name__)).lower()


def format_row(key: Key, page: str, classes: dict[str, type[BaseModel]]) -> str:
    """Return one line of a class's table."""
    cells = (
        f"`{key.name}`",
        insert_links(key.type, page, classes),
        insert_links(key.default, page, classes) or "required",
        (key.text or "")[:1].upper() + (key.text or "")[1:],
    )
    return "| " + " | ".join(cell.replace("|", "\\|").replace("\n", " ") for cell in cells) + " |"


def format_section(config: type[BaseModel], page: str, classes: dict[str, type[BaseModel]]) -> str:
    """Return the section of one class."""
    selector = format_selector(config)
    title = f"`{selector}`" if selector else config.__name__
    lines = [f"## {title} {{ #{make_anchor(config)} }}", "", read_summary(config), ""]
    table = [format_row(key, page, classes) for key in iterate_keys(config)]
    if table:
        head = ["| key | value | default | meaning |", "| --- | --- | --- | --- |"]
        lines += [*head, *table, ""]
    else:
        lines += ["It has no keys of its own.", ""]
    return "\n".join([*lines, f"Python class: `{config.__module__}.{config.__name__}`.", ""])


def write_pages() -> None:
    """Write one page per package; a key without documentation is a warning, an error if strict."""
    for name in list_undocumented_keys():
        _LOG.warning("undocumented config key; add it under 'Attributes:' of its class: %s", name)
    classes = {
        f"{config.__module__}.{config.__qualname__}": config for config in list_config_classes()
    }
    for page, (title, text) in PAGES.items():
        page_classes = [config for config in classes.values() if get_page(config) == page]
        if page_classes:
            sections = [format_section(config, page, classes) for config in page_classes]
            with mkdocs_gen_files.open(f"{FOLDER}/{page}.md", "w") as file:
                file.write("\n".join([f"# {title}", "", text, "", *sections]))


write_pages()
