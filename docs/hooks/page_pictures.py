"""Takes pictures of the first screens of pages, for the gallery; needs Chromium or Chrome.

python scripts/ci/short_configs.py --out build/runs
python docs/hooks/page_pictures.py build/runs/*/report.html

A picture is named after the folder of its page. One of another size stands alone:

python docs/hooks/page_pictures.py runs/quickstart/report.html --name fit_page

So does one section of a page, by the name of its place:

python docs/hooks/page_pictures.py build/runs/kvlcc2/report.html --section manoeuvring-booklet
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import tempfile
from pathlib import Path

from PIL import Image

PICTURES = Path(__file__).parents[1] / "pictures"
SIZE = (1120, 660)
_BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")


_FIRST = """<script>{
  const part = document.getElementById("%s");
  document.body.prepend(part);
  for (const folded of [part, ...part.querySelectorAll("details")]) folded.open = true;
}</script></body>"""


def take(page: Path, out: Path, section: str | None = None) -> None:
    """Write what a desk's screen shows of a page before anybody scrolls, in 128 colours.

    Args:
        page: report.html of a run.
        out: the picture.
        section: place that is put first and unfolded; None leaves the page as it is.
    """
    browser = next((found for name in _BROWSERS if (found := shutil.which(name))), None)
    if browser is None:
        raise SystemExit(f"install one of {', '.join(_BROWSERS)}")
    with tempfile.TemporaryDirectory() as scratch:
        raw = Path(scratch) / "raw.png"
        if section is not None:
            text = page.read_text(encoding="utf-8").replace("</body>", _FIRST % section)
            page = Path(scratch) / page.name
            page.write_text(text, encoding="utf-8")
        command = [browser, "--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars"]
        command += [f"--user-data-dir={scratch}/profile", "--virtual-time-budget=9000"]
        command += [f"--window-size={SIZE[0]},{SIZE[1]}", f"--screenshot={raw}"]
        subprocess.run(
            [*command, page.resolve().as_uri()], check=True, capture_output=True, timeout=120
        )
        with Image.open(raw) as picture:
            few = picture.convert("RGB").quantize(
                128, method=Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE
            )
            few.save(out, optimize=True)
    print(out)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("pages", nargs="+", type=Path, help="report.html of runs")
    parser.add_argument("--name", help="of the picture of one page")
    parser.add_argument("--section", help="of the page, to stand first")
    given = parser.parse_args()
    for page in given.pages:
        name = given.name or given.section or page.parent.name
        take(page, PICTURES / f"{name}.png", given.section)


if __name__ == "__main__":
    main()
