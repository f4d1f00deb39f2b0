"""Pictures of the report for README and docs, by headless Chromium: python docs/images/make_screenshots.py [RUN]

RUN is the folder of a run with a report; without it, runs/pictures is made first (six synthetic frames, two minutes).
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

from PIL import Image

FOLDER = Path(__file__).resolve().parent
sys.path.insert(0, str(FOLDER.parents[1]))

from scripts.chromium import Chromium, Page  # noqa: E402

QUALITY = 82
# Leaves what the picture is about: one frame without maps and notes.
ONE_FRAME = ".maps, .side .waterfall, .cloud .note, article h4 { display: none } article { padding-bottom: 12px }"


def main() -> int:
    run = Path(sys.argv[1]) if len(sys.argv) > 1 else made_run()
    address = (run / "report" / "index.html").resolve().as_uri()
    with Chromium() as browser:
        page = browser.open(address, 1280, 820)
        bottom = page.run("document.querySelector('section:has(.curves)').getBoundingClientRect().bottom + scrollY")
        save(page, "report_summary", None, height=round(bottom) + 16)
        open_cloud(page, 2)
        save(page, "report_maps", "article:nth-of-type(2) .maps")
        page.run(f"document.head.insertAdjacentHTML('beforeend', '<style>{ONE_FRAME}</style>')")
        save(page, "report_frame", "article:nth-of-type(2)")
    print("\n".join(page.errors) or "no console errors")
    return 1 if page.errors else 0


def made_run() -> Path:
    """A small demo run."""
    from pipeline.cli import main as run_pipeline

    run = Path("runs/pictures")
    if run_pipeline(["--set", "synth.frames=6", "--out", str(run)]):
        raise SystemExit(f"{run}: the demo run failed; see above")
    return run


def open_cloud(page: Page, number: int) -> None:
    """Draws the cloud of the n-th frame, coloured by source."""
    page.run(f"AugCloud.open(document.querySelector('article:nth-of-type({number}) .cloud')) && 0")
    page.settle(1)


def save(page: Page, name: str, selector: str | None, height: int | None = None) -> None:
    """docs/images/NAME.webp, no higher than `height` CSS pixels."""
    with tempfile.TemporaryDirectory() as folder:
        shot = page.picture(Path(folder) / "shot.png", selector)
        with Image.open(shot) as picture:
            rows = picture.height if height is None else min(picture.height, height)
            target = FOLDER / f"{name}.webp"
            picture.convert("RGB").crop((0, 0, picture.width, rows)).save(target, quality=QUALITY, method=6)
    print(f"{target.name}: {target.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    sys.exit(main())
