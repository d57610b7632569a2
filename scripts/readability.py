"""Prints the mean length of sentences and the share of those over 35 words, page by page.

python scripts/readability.py
"""

from __future__ import annotations

import re
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
    """Print a line for each page, and one for all."""
    pages = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
    counts = {page.relative_to(ROOT).as_posix(): sentences(page.read_text()) for page in pages}
    counts["all pages"] = [count for page in counts.values() for count in page]
    for name, found in counts.items():
        if found:
            long = 100 * sum(count > LONG for count in found) / len(found)
            mean = sum(found) / len(found)
            print(
                f"{name:40s} {len(found):5d} sentences, mean {mean:5.1f} words,"
                f" {long:4.1f} % over {LONG}"
            )


if __name__ == "__main__":
    main()
