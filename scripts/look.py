"""Pictures of pages for looking at them, and what a browser finds wrong: python scripts/look.py PAGE|FOLDER... [--out DIR]

Every HTML page is opened in headless Chromium at desktop and phone width, light and dark, and saved as
DIR/PAGE_desktop_light_1.png and so on (tall pages in slices). Printed are console errors, pages wider than the window,
pictures that are missing or have no alternative text, text with too little contrast, and links that lead nowhere.
After `make docs`: python scripts/look.py site; of a run: python scripts/look.py runs/demo/report/index.html
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import unquote, urlsplit

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

from scripts.chromium import Chromium, ChromiumError, Page  # noqa: E402

# Height of a slice, CSS pixels: what a viewer shows without shrinking the text away.
SLICE = {"desktop": 1600, "phone": 1700}
WIDTH = {"desktop": 1280, "phone": 390}

# Text of a page with less contrast than WCAG AA asks (4.5, large text 3), each once, with its colours.
CONTRAST = """(() => {
  const rgba = (text) => { const n = text.match(/[\\d.]+/g).map(Number);
    return text.startsWith('color(srgb') ? [...n.slice(0, 3).map((v) => 255 * v), n[3] ?? 1] : [n[0], n[1], n[2], n[3] ?? 1]; };
  const over = (a, b) => [0, 1, 2].map((i) => a[i] * a[3] + b[i] * (1 - a[3])).concat(1);
  const behind = (e) => { const found = [];
    for (; e; e = e.parentElement) { const c = rgba(getComputedStyle(e).backgroundColor); found.push(c); if (c[3] === 1) break; }
    return found.reverse().reduce((below, c) => over(c, below), [255, 255, 255, 1]); };
  const light = (c) => { const [r, g, b] = c.map((v) => (v /= 255) <= 0.03928 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4);
    return 0.2126 * r + 0.7152 * g + 0.0722 * b; };
  const told = new Map(), walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  for (let node; (node = walker.nextNode());) {
    const e = node.parentElement, style = getComputedStyle(e);
    if (!node.data.trim() || !e.checkVisibility({ opacityProperty: true, visibilityProperty: true }) || e.closest('svg')) continue;
    if (['SCRIPT', 'STYLE', 'NOSCRIPT'].includes(e.tagName) || e.getBoundingClientRect().width < 2) continue;
    const back = behind(e), front = over(rgba(style.color), back), [a, b] = [light(front), light(back)].sort((x, y) => y - x);
    const ratio = (a + 0.05) / (b + 0.05), large = parseFloat(style.fontSize) >= 24 || (parseFloat(style.fontSize) >= 18.6 && style.fontWeight >= 700);
    if (ratio >= (large ? 3 : 4.5)) continue;
    const key = `${e.tagName.toLowerCase()}.${e.className} contrast ${ratio.toFixed(1)}`;
    if (!told.has(key)) told.set(key, node.data.trim().slice(0, 30));
  }
  return [...told].map(([key, text]) => `${key}: "${text}"`);
})()"""
PICTURES = """[...document.images].filter((i) => i.checkVisibility()).flatMap((i) => [
  ...(i.naturalWidth ? [] : ['picture missing: ' + i.src.slice(0, 90)]),
  ...(i.hasAttribute('alt') ? [] : ['picture without alternative text: ' + i.src.slice(0, 60)])])"""
# Elements that reach beyond the window without lying in something that scrolls.
WIDE = """(() => {
  const edge = document.documentElement.clientWidth + 1, scrolls = (e) => { for (e = e.parentElement; e && e !== document.body; e = e.parentElement)
      if (getComputedStyle(e).overflowX !== 'visible') return true; return false; };
  const shown = (e) => { const r = e.getBoundingClientRect(); return r.width && r.right > edge && r.left < edge && e.checkVisibility() && !scrolls(e); };
  const found = [...document.body.querySelectorAll('*')].filter(shown).map((e) => e.tagName.toLowerCase() + '.' + e.className);
  return document.documentElement.scrollWidth > edge ? ['wider than the window: ' + [...new Set(found)].slice(0, 4).join(', ')] : [];
})()"""
LINKS = "[...document.querySelectorAll('a[href]')].map((a) => a.href)"
TARGETS = "[...document.querySelectorAll('[id], a[name]')].flatMap((e) => [e.id, e.getAttribute('name')]).filter(Boolean)"


@dataclass(frozen=True)
class View:
    """One way to look at a page."""

    device: str
    colours: str

    def __str__(self) -> str:
        return f"{self.device}_{self.colours}"


VIEWS = tuple(View(device, colours) for device in ("desktop", "phone") for colours in ("light", "dark"))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pages", nargs="+", type=Path, metavar="PAGE|FOLDER", help="HTML files, or folders of them")
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "look", metavar="DIR", help="default: build/look")
    parser.add_argument("--no-pictures", action="store_true", help="only print what is wrong")
    args = parser.parse_args()
    files = [page for given in args.pages for page in (sorted(given.rglob("*.html")) if given.is_dir() else [given])]
    pages = [page.resolve() for page in files]
    out = None if args.no_pictures else args.out
    try:
        problems = look_at(pages, out)
    except ChromiumError as error:
        print(f"look: {error}", file=sys.stderr)
        return 2
    print("\n".join(problems))
    print(f"{len(pages)} pages, {len(problems)} problems" + (f", pictures in {out}" if out else ""))
    return 1 if problems else 0


def look_at(pages: list[Path], out: Path | None) -> list[str]:
    """Opens all pages in all views; the problems found, each once per page."""
    problems: dict[str, list[str]] = {}
    links: dict[Path, list[str]] = {}
    targets: dict[Path, set[str]] = {}
    for view in VIEWS:
        with Chromium() as browser:  # a new one for every view: pages remember the colours that were chosen
            for path in pages:
                page = browser.open(
                    path.as_uri(), WIDTH[view.device], phone=view.device == "phone", dark=view.colours == "dark"
                )
                for problem in found_on(page):
                    problems.setdefault(f"{path.name}: {problem}", []).append(str(view))
                if out is not None:
                    save(page, view, out, f"{path.parent.name}_{path.stem}")
                links[path], targets[path] = page.run(LINKS), set(page.run(TARGETS))
                page.close()
    lines = [f"{problem} ({', '.join(views)})" for problem, views in problems.items()]
    return lines + dead_links(links, targets)


def found_on(page: Page) -> list[str]:
    """What is wrong with an open page."""
    return [*page.errors, *page.run(WIDE), *page.run(PICTURES), *page.run(CONTRAST)]


def dead_links(links: dict[Path, list[str]], targets: dict[Path, set[str]]) -> list[str]:
    """Links to files that are not there, or to a place that a page seen here lacks."""
    dead = set()
    for page, addresses in links.items():
        for address in addresses:
            parts = urlsplit(address)
            path = Path(unquote(parts.path))
            if parts.scheme != "file":
                continue
            anchor = unquote(parts.fragment).split("/")[0]
            if not path.is_file() or (anchor and path in targets and anchor not in targets[path]):
                dead.add(f"{page.name}: link to {path.name}{'#' + anchor if anchor else ''} leads nowhere")
    return sorted(dead)


def save(page: Page, view: View, out: Path, name: str) -> None:
    """The page as slices."""
    height, step = page.height(), SLICE[view.device]
    for number, top in enumerate(range(0, height, step), 1):
        page.picture(out / f"{name}_{view}_{number}.png", area=(0, top, page.width, min(step, height - top)))


if __name__ == "__main__":
    sys.exit(main())
