"""Draws docs/images/architecture.svg: python docs/images/make_architecture.py"""

from __future__ import annotations

from pathlib import Path

ROOMS = {"pipeline": "#0b6bcb", "completion": "#00805c", "detection": "#c05000"}
TEXT, SOFT, PAPER = "#1b2230", "#5c6675", "#ffffff"


def box(x: float, y: float, w: float, h: float, colour: str, title: str, *lines: str) -> str:
    """A titled box with lines of small text."""
    parts = [
        f'<rect x="{x}" y="{y}" width="{w}" height="{h}" rx="8" fill="{PAPER}" stroke="{colour}" stroke-width="2"/>'
    ]
    parts.append(f'<text x="{x + 12}" y="{y + 24}" class="t" fill="{colour}">{title}</text>')
    parts += [f'<text x="{x + 12}" y="{y + 45 + 18 * i}" class="s">{line}</text>' for i, line in enumerate(lines)]
    return "".join(parts)


def arrow(x1: float, y1: float, x2: float, y2: float, label: str = "", above: bool = True) -> str:
    """An arrow with a label at its middle."""
    line = f'<path d="M{x1} {y1}L{x2} {y2}" class="a" marker-end="url(#head)"/>'
    if not label:
        return line
    x, y = (x1 + x2) / 2, (y1 + y2) / 2 + (-8 if above else 18)
    return line + f'<text x="{x}" y="{y}" class="l">{label}</text>'


def drawing() -> str:
    """The SVG text."""
    blue, green, orange = ROOMS["pipeline"], ROOMS["completion"], ROOMS["detection"]
    parts = [
        '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 1160 720" '
        'font-family="system-ui, DejaVu Sans, sans-serif">',
        "<style>.t{font-size:16px;font-weight:600}.s{font-size:13px;fill:#1b2230}.l{font-size:12px;fill:#5c6675;"
        "text-anchor:middle}.a{stroke:#5c6675;stroke-width:1.8;fill:none}.h{font-size:14px;fill:#5c6675}</style>",
        '<defs><marker id="head" viewBox="0 0 10 10" refX="9" refY="5" markerWidth="7" markerHeight="7" orient="auto">'
        '<path d="M0 0L10 5L0 10z" fill="#5c6675"/></marker></defs>',
        f'<rect width="1160" height="720" fill="{PAPER}"/>',
        '<text x="30" y="34" class="h">hop 1: the command line</text>',
        '<text x="290" y="34" class="h">hop 2: runner and stages</text>',
        '<text x="600" y="34" class="h">hop 3: one public function per stage</text>',
        '<text x="910" y="34" class="h">hop 4: the arithmetic</text>',
        box(
            30, 50, 200, 110, blue, "pipeline/cli.py", "options and help", "-> run.py: config,", "data, stages, report"
        ),
        box(
            290,
            50,
            250,
            110,
            blue,
            "pipeline/runner/",
            "worker: every frame",
            "not up to date; ledger,",
            "resume, shards, budget",
        ),
        box(
            290,
            200,
            250,
            130,
            blue,
            "pipeline/stages/",
            "complete · augment · detect:",
            "what each reads, takes, writes;",
            "open() -> one frame's work",
            "evaluate: scoring/",
        ),
        arrow(230, 105, 290, 105),
        arrow(415, 160, 415, 200),
        # complete
        box(600, 50, 250, 90, green, "completion.infer", "load_completer(name)", ".complete(sparse, image, K)"),
        box(910, 50, 220, 90, green, "completion/", "executors  cpu/  models/", "twin_surface  losses"),
        arrow(540, 225, 600, 110),
        arrow(850, 95, 910, 95),
        # augment
        box(600, 170, 250, 90, blue, "pipeline.pointcloud", "augment_frame(completed,", "points, calibration, ...)"),
        box(
            910,
            170,
            220,
            90,
            blue,
            "pipeline/pointcloud/",
            "sigma_filter  grid_sampling",
            "semantic_mask  radius_gather",
        ),
        arrow(540, 250, 600, 220),
        arrow(850, 215, 910, 215),
        # detect
        box(600, 290, 250, 90, orange, "detection.infer", "load_detector(name)", ".detect(PointFrame)"),
        box(910, 290, 220, 90, orange, "detection/", "models/  ops/  box_coding", "targets.py  losses.py"),
        arrow(540, 285, 600, 330),
        arrow(850, 335, 910, 335),
        # evaluate
        box(600, 400, 250, 90, orange, "detection.evaluation", "kitti_ap.evaluate(labels,", "detections)"),
        box(910, 400, 220, 90, orange, "detection/evaluation/", "overlaps  matching", "difficulty  curves"),
        arrow(540, 312, 600, 430),
        arrow(850, 445, 910, 445),
        # what the stages rest on
        box(
            30,
            200,
            200,
            130,
            blue,
            "pipeline/run_folder/",
            "config.py: the only",
            "YAML reader, unknown",
            "keys refused; the files",
            "of a run",
        ),
        box(30, 370, 200, 90, blue, "pipeline/data/", "one reader and writer", "per data set -> Frame"),
        box(290, 370, 250, 90, blue, "pipeline/geometry/", "what matrices mean, who is", "seen, rings, projection"),
        arrow(230, 265, 290, 265),
        arrow(205, 370, 290, 325),
        arrow(415, 370, 415, 330),
        f'<rect x="30" y="506" width="1100" height="34" rx="8" fill="{PAPER}" stroke="{SOFT}" stroke-width="2"/>',
        f'<text x="42" y="528" class="t" fill="{SOFT}">auglidar_base</text>',
        '<text x="180" y="528" class="s">what all rooms need and none may take from another: atomic files, inert '
        "readers, child processes, seeds, devices, errors</text>",
    ]
    flow = [
        ("frame", "image, LiDAR,", "calibration, labels"),
        ("depth/  twin/", "completed depth,", "two surfaces, sigma"),
        ("cloud/", "augmented LiDAR,", "x y z intensity source"),
        ("detections/", "KITTI result", "lines"),
        ("report/", "metrics.json, tables.md,", "index.html"),
    ]
    for index, (title, *lines) in enumerate(flow):
        x = 30 + 225 * index
        parts.append(box(x, 616, 180, 84, SOFT, title, *lines))
        if index:
            stage = ("complete", "augment", "detect", "evaluate")[index - 1]
            parts.append(arrow(x - 45, 658, x, 658))
            parts.append(f'<text x="{x - 22}" y="602" class="l">{stage}</text>')
    parts.append('<text x="30" y="574" class="h">what lies on disk between the stages</text></svg>')
    return "\n".join(parts) + "\n"


if __name__ == "__main__":
    Path(__file__).with_name("architecture.svg").write_text(drawing(), encoding="utf-8")
