"""Prints the mean length of sentences and the share of those over 35 words, page by page.

python scripts/readability.py [--git REVISION] [PAGE...]   all pages where none is named
"""

from __future__ import annotations

import argparse
import re
import subprocess
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
LONG = 35
"""Words of a sentence that is too long to be read once."""


def sentences(markdown: str) -> list[int]:
    """Return the words of each sentence of a page's prose: no code, tables, titles, comments."""
    text = re.sub(r"```.*?```|<!--.*?-->", "", markdown, flags=re.DOTALL)
    text = re.sub(r"!?\[([^\]]*)\]\([^)]*\)", r"\1", text)
    out = []
    for block in re.split(r"\n\s*\n|\n(?=\s*(?:[-*]|\d+\.) )", text):
        lines = [line for line in block.splitlines() if not re.match(r"\s*(?:\||#|!!!|:::)", line)]
        # a full stop within code or a number ends nothing
        for sentence in re.split(r"(?<=[.!?])\s+(?=[A-Z`\"(])|:\s*$", " ".join(lines)):
            count = len(re.findall(r"`[^`]*`|[\w'’-]+(?:[.,]\d+)?", sentence))
            out += [count] if count > 2 else []
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("pages", nargs="*", type=Path)
    parser.add_argument("--git", help="a revision in place of the files as they stand")
    given = parser.parse_args()
    pages = given.pages or [
        ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))
    ]  # fmt: skip
    every: list[int] = []
    for page in pages:
        name = page.resolve().relative_to(ROOT).as_posix()
        if given.git:
            command = ["git", "-C", str(ROOT), "show", f"{given.git}:{name}"]
            done = subprocess.run(command, capture_output=True, text=True, check=False)
            counts = sentences(done.stdout)
        else:
            counts = sentences(page.read_text(encoding="utf-8"))
        every += counts
        if counts:
            show(name, counts)
    show("all pages", every)


def show(name: str, counts: list[int]) -> None:
    long = sum(count > LONG for count in counts)
    print(
        f"{name:40s} {len(counts):5d} sentences, mean {sum(counts) / len(counts):5.1f} words,"
        f" {100 * long / len(counts):4.1f} % over {LONG}"
    )


if __name__ == "__main__":
    main()
