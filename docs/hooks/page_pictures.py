"""Take pictures of the first screens of pages, for the gallery; needs Chromium or Chrome.

python scripts/ci/short_configs.py --out build/runs
python docs/hooks/page_pictures.py build/runs/*/report.html

A picture has the name of the folder of its page, or another one:

python docs/hooks/page_pictures.py runs/quickstart/report.html --name fit_page

A single section of a page, by its anchor:

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


_MOVE_SECTION_SCRIPT = """<script>{
  const part = document.getElementById("%s");
  document.body.prepend(part);
  for (const folded of [part, ...part.querySelectorAll("details")]) folded.open = true;
}</script></body>"""


def write_screenshot(page: Path, out: Path, section: str | None = None) -> None:
    """Write the first screen of a page on a desktop computer as a picture in 128 colours.

    Args:
        page: report.html of a run.
        out: the picture.
        section: anchor of a section that is moved to the top and unfolded; None for no change.
    """
    browser = next(filter(None, map(shutil.which, _BROWSERS)), None)
    if browser is None:
        raise SystemExit(f"install one of {', '.join(_BROWSERS)}")
    with tempfile.TemporaryDirectory() as scratch:
        raw = Path(scratch) / "raw.png"
        if section is not None:
            text = page.read_text(encoding="utf-8").replace(
                "</body>", _MOVE_SECTION_SCRIPT % section
            )
            page = Path(scratch) / page.name
            page.write_text(text, encoding="utf-8")
        command = [browser, "--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars"]
        command += [f"--user-data-dir={scratch}/profile", "--virtual-time-budget=9000"]
        command += [f"--window-size={SIZE[0]},{SIZE[1]}", f"--screenshot={raw}"]
        subprocess.run(
            [*command, page.resolve().as_uri()], check=True, capture_output=True, timeout=120
        )
        with Image.open(raw) as picture:
            reduced_picture = picture.convert("RGB").quantize(
                128, method=Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE
            )
            reduced_picture.save(out, optimize=True)
    print(out)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("pages", nargs="+", type=Path, help="report.html of runs")
    parser.add_argument("--name", help="name of the picture of one page")
    parser.add_argument("--section", help="anchor of the section to show")
    arguments = parser.parse_args()
    for page in arguments.pages:
        name = arguments.name or arguments.section or page.parent.name
        write_screenshot(page, PICTURES / f"{name}.png", arguments.section)


if __name__ == "__main__":
    main()
