"""Pictures of pages to look at, and what a browser finds wrong: python scripts/look.py PAGE|FOLDER... [--out DIR]

Every HTML page is opened in headless Chromium at desktop and phone width, light and dark, and saved as
DIR/FOLDER_PAGE_desktop_light_1.png and so on (tall pages in slices). Printed are console errors, pages wider than the
window, pictures that are missing or have no alternative text, text with too little contrast, and links that lead
nowhere. After `make docs`: python scripts/look.py site; a run: python scripts/look.py runs/demo/report/index.html
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import unquote, urlsplit

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

from scripts.chromium import Chromium, ChromiumError, Page  # noqa: E402

# Widths, and heights of a slice (what a viewer shows without shrinking the text away), CSS pixels.
WIDTH = {"desktop": 1280, "phone": 390}
SLICE = {"desktop": 1600, "phone": 1700}


@dataclass(frozen=True)
class View:
    """One way to look at a page."""

    device: str
    colours: str

    def __str__(self) -> str:
        return f"{self.device}_{self.colours}"


VIEWS = tuple(View(device, colours) for device in ("desktop", "phone") for colours in ("light", "dark"))


@dataclass
class Seen:
    """What was found on the pages.

    problems  text -> the views it was seen in
    links     page -> addresses it links to
    anchors   page -> names that can be linked to
    """

    problems: dict[str, list[str]] = field(default_factory=dict)
    links: dict[Path, list[str]] = field(default_factory=dict)
    anchors: dict[Path, set[str]] = field(default_factory=dict)

    def lines(self) -> list[str]:
        """One line per problem."""
        return [f"{problem} ({', '.join(views)})" for problem, views in self.problems.items()] + self.dead_links()

    def dead_links(self) -> list[str]:
        """Links to files that are not there, or to a place that a page seen here lacks."""
        dead = set()
        for page, addresses in self.links.items():
            for address in addresses:
                parts = urlsplit(address)
                if parts.scheme != "file":
                    continue
                path, anchor = Path(unquote(parts.path)), unquote(parts.fragment).split("/")[0]
                if not path.is_file() or (anchor and anchor not in self.anchors.get(path, {anchor})):
                    dead.add(f"{page.name}: link to {path.name}{'#' + anchor if anchor else ''} leads nowhere")
        return sorted(dead)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pages", nargs="+", type=Path, metavar="PAGE|FOLDER", help="HTML files, or folders of them")
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "look", metavar="DIR", help="default: build/look")
    parser.add_argument("--no-pictures", action="store_true", help="only print what is wrong")
    args = parser.parse_args()
    files = [page for given in args.pages for page in (sorted(given.rglob("*.html")) if given.is_dir() else [given])]
    out = None if args.no_pictures else args.out
    try:
        problems = look_at([page.resolve() for page in files], out).lines()
    except ChromiumError as error:
        print(f"look: {error}", file=sys.stderr)
        return 2
    print(
        "\n".join(
            [*problems, f"{len(files)} pages, {len(problems)} problems" + (f", pictures in {out}" if out else "")]
        )
    )
    return 1 if problems else 0


def look_at(pages: list[Path], out: Path | None) -> Seen:
    """Opens all pages in all views; with `out`, saves pictures."""
    script = (ROOT / "scripts" / "look.js").read_text(encoding="utf-8")
    seen = Seen()
    for view in VIEWS:
        with Chromium() as browser:  # a new one for every view: pages remember the colours that were chosen
            for path in pages:
                page = browser.open(
                    path.as_uri(), WIDTH[view.device], phone=view.device == "phone", dark=view.colours == "dark"
                )
                found = page.run(script)
                for problem in [*page.errors, *found["problems"]]:
                    seen.problems.setdefault(f"{path.name}: {problem}", []).append(str(view))
                seen.links[path], seen.anchors[path] = found["links"], set(found["anchors"])
                if out is not None:
                    save(page, view, out / f"{path.parent.name}_{path.stem}_{view}")
                page.close()
    return seen


def save(page: Page, view: View, start: Path) -> None:
    """The page as slices START_1.png, START_2.png, ..."""
    height, step = page.height(), SLICE[view.device]
    for number, top in enumerate(range(0, height, step), 1):
        place = (0, top, page.width, min(step, height - top))
        page.picture(start.with_name(f"{start.name}_{number}.png"), area=place)


if __name__ == "__main__":
    sys.exit(main())
