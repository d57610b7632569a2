"""Print the mean length of sentences and the share of those over 35 words, page by page.

python scripts/readability.py
"""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
MAX_WORDS = 35
"""Number of words above which a sentence is too long."""


def count_words(markdown: str) -> list[int]:
    """Return the number of words of each sentence of the prose, without code, tables and titles."""
    text = re.sub(r"```.*?```|<!--.*?-->", "", markdown, flags=re.DOTALL)
    text = re.sub(r"!?\[([^\]]*)\]\([^)]*\)", r"\1", text)
    word_counts = []
    for block in re.split(r"\n\s*\n|\n(?=\s*(?:[-*]|\d+\.) )", text):
        lines = [line for line in block.splitlines() if not re.match(r"\s*(?:\||#|!!!|:::)", line)]
        # a full stop within code or a number does not end a sentence
        for sentence in re.split(r"(?<=[.!?])\s+(?=[A-Z`\"(])|:\s*$", " ".join(lines)):
            count = len(re.findall(r"`[^`]*`|[\w'’-]+(?:[.,]\d+)?", sentence))
            word_counts += [count] if count > 2 else []
    return word_counts


def main() -> None:
    """Print a line for each page, and one for all."""
    pages = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
    counts = {page.relative_to(ROOT).as_posix(): count_words(page.read_text()) for page in pages}
    counts["all pages"] = [count for page in counts.values() for count in page]
    for name, word_counts in counts.items():
        if word_counts:
            long_share = 100 * sum(count > MAX_WORDS for count in word_counts) / len(word_counts)
            mean = sum(word_counts) / len(word_counts)
            print(
                f"{name:40s} {len(word_counts):5d} sentences, mean {mean:5.1f} words,"
                f" {long_share:4.1f} % over {MAX_WORDS}"
            )


if __name__ == "__main__":
    main()
