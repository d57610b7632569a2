"""A page as a browser lays it out, at the width of a phone or a desk."""

from __future__ import annotations

import html
import json
import re
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path
from typing import Any

_NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
_MEASURE = """
const deepest = (root, name) => {
  for (const part of root.querySelectorAll("*")) {
    if (part.localName === name) return part;
    const inside = part.shadowRoot && deepest(part.shadowRoot, name);
    if (inside) return inside;
  }
  return null;
};
const inked = canvas => {
  const data = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data;
  let count = 0;
  for (let i = 3; i < data.length; i += 4) count += data[i] > 0;
  return count > 200;
};
const use = async (page, pause) => {
  const root = [".note", "div"].map(part => page.querySelector(
    `main > section:not(.opening) .explorer:has(${part})`)).find(found => found) || null;
  if (root === null) return {};
  const model = name => page.defaultView.Bokeh.documents.map(
    one => one.get_model_by_name(name)).find(found => found);
  const plot = model(root.id + "-1") || model(root.id + "-0");
  const range = plot.x_range;
  const width = () => range.end - range.start, begin = width();
  const press = async text => {
    const button = [...root.querySelectorAll("button")].find(b => b.textContent === text);
    button.focus();
    const focused = page.activeElement === button;
    button.click();
    await pause();
    return focused;
  };
  const focused = await press("Zoom in"), near = width();
  await press("Reset");
  const again = width(), box = root.querySelector("input");
  box.click();
  const hidden = plot.renderers.find(curve => curve.name === box.value).visible === false;
  const list = root.querySelector("select"), note = () => root.querySelector(".note").textContent;
  if (list === null || root.querySelector(".note") === null)
    return {focused: focused, zoomed: near / begin, reset: again / begin, hidden: hidden};
  const first = note();
  list.value = String(list.length - 1);
  list.dispatchEvent(new Event("change"));
  await pause();
  return {focused: focused, zoomed: near / begin, reset: again / begin, hidden: hidden,
          chosen: note() !== first};
};
const opening = page => {
  const ends = box => box === null ? null : box.getBoundingClientRect().bottom;
  const places = name => [...page.querySelectorAll(name)].map(ends);
  const told = [...page.querySelectorAll(".verdict p, .opening th, .opening td, .opening p")];
  return {verdict: ends(page.querySelector(".verdict p")),
          told: told.map(box => [box.innerText, ends(box)]),
          pictures: places(".opening .panel, .opening figure:not(.still)"),
          rows: places(".opening tbody tr"),
          words: page.body.innerText.split(/\\s+/).length};
};
const frame = document.querySelector("iframe");
const drawn = root => root.classList.contains("drawn");
frame.onload = async () => {
  const page = frame.contentDocument, root = page.documentElement;
  const pause = () => new Promise(done => setTimeout(done, 50));
  while (![...page.querySelectorAll(".live .opening .explorer")].every(drawn)) await pause();
  await pause();
  const first = opening(page);
  page.querySelectorAll("details").forEach(part => part.open = true);
  while (![...page.querySelectorAll(".live .explorer")].every(drawn)) await pause();
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
  let smallest = 99;
  const place = page.querySelector("main") || page.body;
  const walker = page.createTreeWalker(place, NodeFilter.SHOW_TEXT);
  while (walker.nextNode()) {
    const box = walker.currentNode.parentElement;
    if (walker.currentNode.data.trim() && box.getClientRects().length) {
      /* texts of a drawing are scaled with it */
      const matrix = box.getScreenCTM ? box.getScreenCTM() : null;
      const scale = matrix ? Math.hypot(matrix.a, matrix.b) : 1;
      smallest = Math.min(
        smallest, scale * parseFloat(page.defaultView.getComputedStyle(box).fontSize));
    }
  }
  const panels = [...page.querySelectorAll(".panel")].map(panel => {
    const canvas = deepest(panel, "canvas");
    return canvas !== null && canvas.width > 0 && inked(canvas);
  });
  const found = {scroll: root.scrollWidth, width: root.clientWidth, broken: broken,
                 smallest: smallest, panels: panels, first: first, used: await use(page, pause)};
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
        smallest: size of the smallest text in pixels.
        panels: for each panel of an interactive figure, whether something is drawn in it.
        first: lower edges in pixels of the verdict's first sentence, of the pictures and of the
            rows of the first screen, texts of the first screen with their lower edges, and how many
            words the page shows before anything is unfolded.
        used: what became of pressing the first interactive figure's controls; empty without one.
    """

    overflow: int
    broken: list[str]
    smallest: float
    panels: list[bool]
    first: dict[str, Any]
    used: dict[str, Any]


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
    return Layout(
        found["scroll"] - found["width"],
        found["broken"],
        found["smallest"],
        found["panels"],
        found["first"],
        found["used"],
    )
