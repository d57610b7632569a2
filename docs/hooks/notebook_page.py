"""Runs the example notebook and writes it as a page while the site is built."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

import mkdocs_gen_files
import nbformat
from nbconvert.exporters import MarkdownExporter
from nbconvert.preprocessors import ExecutePreprocessor

NOTEBOOK = Path(__file__).parents[2] / "examples" / "from_python.ipynb"
PAGE = "tutorials/from_python"


def write() -> None:
    """Write the page and its figures; a cell that fails ends the build."""
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    with tempfile.TemporaryDirectory() as folder:
        os.environ["PYTHONPATH"] = os.pathsep.join(
            [str(NOTEBOOK.parents[1] / "src"), os.environ.get("PYTHONPATH", "")]
        )
        ExecutePreprocessor(timeout=600).preprocess(notebook, {"metadata": {"path": folder}})
    text, resources = MarkdownExporter().from_notebook_node(
        notebook, resources={"output_files_dir": Path(PAGE).name}
    )
    with mkdocs_gen_files.open(f"{PAGE}.md", "w") as file:
        file.write(text)
    for name, data in resources["outputs"].items():
        with mkdocs_gen_files.open(f"{Path(PAGE).parent}/{name}", "wb") as figure:
            figure.write(data)


write()
