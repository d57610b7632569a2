"""A page as a browser lays it out, at the width of a phone or a desk."""

from __future__ import annotations

import html
import json
import re
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path

_NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
_MEASURE = """
const frame = document.querySelector("iframe");
frame.onload = () => {
  const page = frame.contentDocument, root = page.documentElement;
  page.querySelectorAll("details").forEach(part => part.open = true);
  const broken = [];
  page.querySelectorAll("td, th, h1, h2, h3, p, li, summary, figcaption").forEach(box => {
    const walker = page.createTreeWalker(box, NodeFilter.SHOW_TEXT);
    while (walker.nextNode()) {
      const node = walker.currentNode;
      for (const word of node.data.matchAll(/[^\\s_/-]+/g)) {
        const range = page.createRange();
        range.setStart(node, word.index);
        range.setEnd(node, word.index + word[0].length);
        const tops = new Set([...range.getClientRects()].map(rect => Math.round(rect.top)));
        if (tops.size > 1) broken.push(word[0]);
      }
    }
  });
  const found = {scroll: root.scrollWidth, width: root.clientWidth, broken: broken};
  document.querySelector("pre").textContent = JSON.stringify(found);
};
frame.srcdoc = document.querySelector("template").innerHTML;
"""


@dataclass(frozen=True)
class Layout:
    """What a browser makes of a page.

    Attributes:
        overflow: by how many pixels the page is wider than its window.
        broken: words that do not stand in one line.
    """

    overflow: int
    broken: list[str]


def browser() -> str | None:
    """Return the path of a browser that can be run without a screen, None where there is none."""
    return next((path for name in _NAMES if (path := shutil.which(name))), None)


def layout(page: Path, width: int, scratch: Path) -> Layout:
    """Return how a page is laid out in a window of that width, with everything unfolded."""
    program = browser()
    assert program is not None
    wrapper = scratch / "wrapper.html"
    wrapper.write_text(
        f"<!DOCTYPE html><meta charset='utf-8'><iframe style='width:{width}px;height:3000px;"
        f"border:0'></iframe><pre></pre><template>{page.read_text()}</template>"
        f"<script>{_MEASURE}</script>"
    )
    command = [program, "--headless", "--no-sandbox", "--disable-gpu", "--virtual-time-budget=9000"]
    command += [f"--user-data-dir={scratch / 'profile'}", "--dump-dom", wrapper.as_uri()]
    dump = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True).stdout
    shown = re.search(r"<pre>(\{.*?\})</pre>", dump, re.DOTALL)
    assert shown is not None, "the browser did not measure the page"
    found = json.loads(html.unescape(shown[1]))
    return Layout(found["scroll"] - found["width"], found["broken"])
