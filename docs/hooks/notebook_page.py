"""Run the example notebooks and write them as pages while the site is built."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

import mkdocs_gen_files
import nbformat
from nbconvert.exporters import MarkdownExporter
from nbconvert.preprocessors import ExecutePreprocessor

EXAMPLES = Path(__file__).parents[2] / "examples"
NAMES = ("from_python", "own_head")


def write_page(name: str) -> None:
    """Write the page of a notebook and its figures; a cell that fails ends the build."""
    page = f"tutorials/{name}"
    notebook = nbformat.read(EXAMPLES / f"{name}.ipynb", as_version=4)
    with tempfile.TemporaryDirectory() as folder:
        os.environ["PYTHONPATH"] = os.pathsep.join(
            [str(EXAMPLES.parent / "src"), os.environ.get("PYTHONPATH", "")]
        )
        ExecutePreprocessor(timeout=600).preprocess(notebook, {"metadata": {"path": folder}})
    text, resources = MarkdownExporter().from_notebook_node(
        notebook, resources={"output_files_dir": Path(page).name}
    )
    with mkdocs_gen_files.open(f"{page}.md", "w") as file:
        file.write(text)
    for figure_name, data in resources["outputs"].items():
        with mkdocs_gen_files.open(f"{Path(page).parent}/{figure_name}", "wb") as figure:
            figure.write(data)


for notebook_name in NAMES:
    write_page(notebook_name)
