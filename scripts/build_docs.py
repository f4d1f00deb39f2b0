"""Builds the documentation as a static site that opens without a server or a network: python scripts/build_docs.py

docs/*.md, the notebooks, CONTRIBUTING.md, CHANGELOG.md, RELEASING.md and an API reference made from the docstrings go
to build/docs, with llms.txt, a list of the pages for programs that read them (llmstxt.org);
Zensical (extra `docs`) turns them into site/. `--sources-only` stops before Zensical.
"""

from __future__ import annotations

import argparse
import inspect
import json
import re
import shutil
import subprocess
import sys
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
SOURCES = ROOT / "build" / "docs"
# The modules a user imports; each page of the reference holds those of one room.
API: dict[str, tuple[str, ...]] = {
    "completion": (
        "completion.types", "completion.infer", "completion.checkpoints", "completion.metrics", "completion.losses",
        "completion.twin_surface", "completion.depth_coefficients", "completion.analysis", "completion.train",
    ),
    "detection": (
        "detection.types", "detection.boxes", "detection.kitti_format", "detection.infer", "detection.checkpoints",
        "detection.ops", "detection.evaluation.kitti_ap", "detection.train",
    ),
    "pipeline": (
        "pipeline.data", "pipeline.data.frame", "pipeline.geometry.calibration", "pipeline.geometry.project",
        "pipeline.data.depth_png", "pipeline.pointcloud.augment", "pipeline.pointcloud.presets",
        "pipeline.pointcloud.sigma_filter", "pipeline.pointcloud.grid_sampling", "pipeline.pointcloud.radius_gather",
        "pipeline.pointcloud.pseudo_sigma", "pipeline.simulation.synth", "pipeline.simulation.noise",
        "pipeline.run_folder.config",
    ),
}  # fmt: skip
# Room for 95 characters of code at 1280 pixels; options do not break at their hyphens (class `whole`); long lines of
# docstrings and commands wrap, clear of the copy button; pictures drawn for paper stand on white in dark colours too.
STYLE = """\
.md-grid { max-width: 72rem; }
@media screen and (min-width: 76.25em) {
  .md-sidebar--primary { width: 10.8rem; }
  .md-sidebar--secondary { width: 9.3rem; }
  [dir="ltr"] .md-sidebar--primary:not([hidden]) ~ .md-content { margin-left: 0.6rem; }
}
.md-typeset pre > code { font-size: 0.8em; }
.language-text code, .language-sh code, .language-bash code {
  white-space: pre-wrap; overflow-wrap: anywhere; padding-right: 2.8em;
}
.md-typeset code.whole { white-space: nowrap; }
.md-typeset img { background: white; border-radius: 4px; }
.md-typeset img[src$="webp"] { border: 1px solid var(--md-default-fg-color--lightest); }
.md-typeset table code { word-break: normal; overflow-wrap: break-word; }
.md-typeset table:not([class]) th, .md-typeset table:not([class]) td { padding: 0.6em 0.8em; min-width: 0; }
.md-nav--primary .md-nav__item .md-nav__link--active { color: var(--md-typeset-a-color); }
@media (max-width: 40em) {
  .md-typeset table:not([class]) th, .md-typeset table:not([class]) td { padding: 0.4em 0.5em; }
  .md-typeset table code.whole { white-space: normal; }
}
"""
# Inline code up to this length stays on one line.
WHOLE = 24
OUTSIDE = {
    "../CONTRIBUTING.md": "contributing.md",
    "../CHANGELOG.md": "changelog.md",
    "../benchmarks/RESULTS.md": "benchmarks.md",
}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sources-only", action="store_true", help="write build/docs and stop")
    args = parser.parse_args()
    write_sources(SOURCES)
    if args.sources_only:
        return 0
    try:
        import zensical  # noqa: F401
    except ImportError:
        print("build_docs: Zensical is missing; install it with: pip install -e '.[docs]'", file=sys.stderr)
        return 2
    zensical_program = Path(sys.executable).with_name("zensical")
    done = subprocess.run([zensical_program, "build", "--clean", "--strict"], cwd=ROOT, check=False)
    if done.returncode == 0:
        (ROOT / "site" / "404.html").unlink(missing_ok=True)  # for servers; its style has an absolute address
        print(f"open {ROOT / 'site' / 'index.html'}")
    return done.returncode


def write_sources(out: Path) -> None:
    """Everything Zensical reads, freshly into `out`."""
    shutil.rmtree(out, ignore_errors=True)
    shutil.copytree(ROOT / "docs", out, ignore=shutil.ignore_patterns("*.py", "synthetic_statistics.md"))
    (out / "site.css").write_text(STYLE, encoding="utf-8")
    shutil.copy(ROOT / "scripts" / "iframe-worker.js", out)
    for name in ("CONTRIBUTING", "CHANGELOG", "RELEASING"):
        text = (ROOT / f"{name}.md").read_text(encoding="utf-8")
        text = text.replace("(docs/", "(").replace("(RELEASING.md)", "(releasing.md)")
        (out / f"{name.lower()}.md").write_text(text, encoding="utf-8")
    results = (ROOT / "benchmarks" / "RESULTS.md").read_text(encoding="utf-8")
    head, tables = results.split("\n## ", 1)
    tables = re.sub(r"^(?![|#`!\s-])(.+)$", r"\1  ", tables, flags=re.MULTILINE)  # what was printed keeps its lines
    (out / "benchmarks.md").write_text(f"{head}\n## {tables}", encoding="utf-8")
    shutil.copy(ROOT / "benchmarks" / "RESULTS.png", out)
    (out / "notebooks").mkdir()
    for notebook in sorted((ROOT / "notebooks").glob("*.ipynb")):
        (out / "notebooks" / f"{notebook.stem}.md").write_text(notebook_page(notebook), encoding="utf-8")
    (out / "api").mkdir()
    for room, modules in API.items():
        (out / "api" / f"{room}.md").write_text(api_page(room, modules), encoding="utf-8")
    for page in out.glob("*.md"):
        page.write_text(inside_links(page.read_text(encoding="utf-8")), encoding="utf-8")
    (out / "llms.txt").write_text(list_of_pages(out), encoding="utf-8")
    for page in out.rglob("*.md"):
        page.write_text(opening_pictures(whole_options(page.read_text(encoding="utf-8"))), encoding="utf-8")


def list_of_pages(out: Path) -> str:
    """llms.txt: the project's title and first sentence, then the menu with every page's title and first sentence."""
    menu = (ROOT / "zensical.toml").read_text(encoding="utf-8")
    front = (out / "index.md").read_text(encoding="utf-8")
    lines = [f"# {title_of(front)}", "", f"> {first_sentence(front)}"]
    for entry_name, page in re.findall(r'\{ "([^"]+)" = (?:"([^"]+)"|\[)', menu):
        if not page:
            lines += ["", f"## {entry_name}", ""]
        elif page != "index.md":
            text = (out / page).read_text(encoding="utf-8")
            if lines[-1].startswith(">"):
                lines.append("")
            lines.append(f"- [{title_of(text)}]({page.removesuffix('.md')}.html): {first_sentence(text)}")
    return "\n".join(lines) + "\n"


def title_of(page: str) -> str:
    """The text of the first heading."""
    return re.search(r"^# (.+)$", page, re.MULTILINE)[1].strip()  # type: ignore[index]


def first_sentence(page: str) -> str:
    """The first sentence of prose of a page, in one line and without links; "" when there is none."""
    text = re.sub(r"^```.*?^```|<!--.*?-->", "", page, flags=re.MULTILINE | re.DOTALL)
    prose = [part for part in text.split("\n\n") if re.match(r"[\w`*(\[]", part.strip())]
    if not prose:
        return ""
    line = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", " ".join(prose[0].split()))
    sentence = re.match(r".+?(?:[.?](?= [A-Z`\[*])|[.:?]$)", line)
    return re.sub(":$", ".", sentence[0]) if sentence else line


def inside_links(text: str) -> str:
    """Links to files beside docs/ as links inside the site; other files of the repository lose their link."""
    for outside, inside in OUTSIDE.items():
        text = text.replace(f"({outside})", f"({inside})")
    text = re.sub(r"\(\.\./notebooks/([\w-]+)\.ipynb\)", r"(notebooks/\1.md)", text)
    return re.sub(r"\[([^\]]*)\]\(\.\./[^)]*\)", lambda found: code(found[1]) if "/" in found[1] else found[1], text)


def code(text: str) -> str:
    """Text as inline code."""
    return f"`{text.strip('`')}`"


def whole_options(text: str) -> str:
    """Short inline code with a hyphen gets the class that keeps it on one line; fenced blocks stay as they are."""
    pieces = re.split(r"(^```.*?^```)", text, flags=re.MULTILINE | re.DOTALL)
    short = re.compile(rf"(?<!`)(`(?=[^`\n]*-)[^`\n]{{1,{WHOLE}}}`)(?!`)")

    def line_by_line(piece: str) -> str:
        return "\n".join(
            re.sub(r"`([^`\n]+)`", breakable, line) if line.startswith("|") else short.sub(r"\1{ .whole }", line)
            for line in piece.split("\n")
        )

    return "".join(piece if piece.startswith("```") else line_by_line(piece) for piece in pieces)


def breakable(code: re.Match[str]) -> str:
    """Inline code of a table as HTML that a narrow column may break after _ / . = and commas."""
    text = code[1].replace("\\|", "|")
    kind = ' class="whole"' if "-" in text and len(text) <= WHOLE else ""
    pieces = re.split(r"(?<=[_/.=,])(?=\w)", text) if len(text) > 10 else [text]
    safe = ("".join(f"&#{ord(c)};" if c in "<>&|*_[]~^" else c for c in piece) for piece in pieces)
    return f"<code{kind}>{'<wbr>'.join(safe)}</code>"


def opening_pictures(text: str) -> str:
    """Pictures that stand alone open in full size: their small print is too small on a phone."""
    return re.sub(r"^(!\[[^\]]*\]\(([^)\s]+)\))$", r"[\1](\2)", text, flags=re.MULTILINE)


def notebook_page(notebook: Path) -> str:
    """A stored notebook with its outputs as Markdown; pictures are embedded."""
    parts = []
    for cell in json.loads(notebook.read_text(encoding="utf-8"))["cells"]:
        source = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            parts.append(source)
            continue
        parts.append(f"```python\n{source}\n```")
        parts += [shown for output in cell["outputs"] if (shown := output_text(output))]
    return "\n\n".join(parts) + "\n"


def output_text(output: dict[str, Any]) -> str:
    """One output of a cell as Markdown."""
    data = output.get("data", {})
    if "image/png" in data:
        picture = "".join(data["image/png"]).replace("\n", "")
        return f'<img alt="output of the cell above" src="data:image/png;base64,{picture}">'
    text = "".join(output.get("text", data.get("text/plain", ""))).rstrip()
    return f"```text\n{text}\n```" if text else ""


def api_page(room: str, modules: tuple[str, ...]) -> str:
    """The reference of one room: signature and docstring of every public class and function."""
    about = f"The public classes and functions of `{room}`, made from the docstrings."
    parts = [f"# API: {room}", f"{about} Depth and coordinates are metres unless said otherwise."]
    for name in modules:
        module = import_module(name)
        parts += [f"## `{name}`", as_text(inspect.getdoc(module) or "")]
        for title, item in public_names(module):
            parts += entry(title, item)
    return "\n\n".join(part for part in parts if part) + "\n"


def public_names(module: ModuleType) -> list[tuple[str, Any]]:
    """Public classes and functions that the module defines, or names in `__all__`."""
    exported = getattr(module, "__all__", None)
    names = list(exported) if exported is not None else [name for name in vars(module) if not name.startswith("_")]
    found = []
    for name in names:
        item = getattr(module, name)
        own = exported is not None or getattr(item, "__module__", None) == module.__name__
        if own and (inspect.isclass(item) or callable(item)):
            found.append((name, item))
    return found


def entry(title: str, item: Any) -> list[str]:
    """Heading, signature and docstring; of a class also its public methods."""
    parts = [f"### `{title}`", f"```python\n{signature(title, item)}\n```", as_text(own_doc(item))]
    if not inspect.isclass(item):
        return parts
    for name, member in vars(item).items():
        target = member.fget if isinstance(member, property) else getattr(member, "__func__", member)
        if name.startswith("_") or not inspect.isfunction(target):
            continue
        text = own_doc(target)
        if text:
            shown = name if isinstance(member, property) else signature(name, target)
            parts.append(f"```python\n{title}.{shown}\n```\n\n{as_text(text)}")
    return parts


def own_doc(item: Any) -> str:
    """The docstring; nothing for the one that a dataclass makes of its fields."""
    text = inspect.getdoc(item) or ""
    return "" if text.startswith(f"{getattr(item, '__name__', '')}(") else text


def signature(name: str, item: Any) -> str:
    """`name(parameters) -> result`, one parameter a line when long."""
    try:
        found = inspect.signature(item)
    except (TypeError, ValueError):
        return name
    result = found.return_annotation
    ends = "" if inspect.isclass(item) or result is inspect.Signature.empty else f" -> {result}"
    text = f"{name}({', '.join(map(str, found.parameters.values()))}){ends}"
    if len(text) > 90:
        lines = "".join(f"    {parameter},\n" for parameter in found.parameters.values())
        text = f"{name}(\n{lines}){ends}"
    return re.sub(r"(: |-> )'([^']*)'", r"\1\2", text)  # annotations are stored as text


def as_text(docstring: str) -> str:
    """A docstring as Markdown: prose as paragraphs, and columns of names and meanings as they stand in the source."""
    return "\n\n".join(map(paragraph, docstring.split("\n\n"))) if docstring else ""


def paragraph(text: str) -> str:
    """One paragraph of a docstring. Two spaces inside a line, or an indented first line, mean columns or code."""
    if re.search(r"\S {2,}\S", text) or text.startswith(" ") or " = " in text.splitlines()[0]:
        return f"```text\n{text}\n```"
    pieces = re.split(r"(`[^`]*`)", " ".join(text.split()))
    return "".join(p if p.startswith("`") else plain(p) for p in pieces)


def plain(text: str) -> str:
    """Text in which Markdown finds nothing."""
    return re.sub(r"([*_\[\]])", r"\\\1", text).replace("<", "&lt;")


if __name__ == "__main__":
    sys.exit(main())
