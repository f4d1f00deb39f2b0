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
        '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 1160 640" '
        'font-family="system-ui, DejaVu Sans, sans-serif">',
        "<style>.t{font-size:16px;font-weight:600}.s{font-size:13px;fill:#1b2230}.l{font-size:12px;fill:#5c6675;"
        "text-anchor:middle}.a{stroke:#5c6675;stroke-width:1.8;fill:none}.h{font-size:14px;fill:#5c6675}</style>",
        '<defs><marker id="head" viewBox="0 0 10 10" refX="9" refY="5" markerWidth="7" markerHeight="7" orient="auto">'
        '<path d="M0 0L10 5L0 10z" fill="#5c6675"/></marker></defs>',
        f'<rect width="1160" height="640" fill="{PAPER}"/>',
        '<text x="30" y="34" class="h">hop 1: the command line</text>',
        '<text x="290" y="34" class="h">hop 2: the stages</text>',
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
            "pipeline/stages/",
            "complete · augment · detect:",
            "each read, call, write",
            "evaluate: scoring.py",
        ),
        arrow(230, 105, 290, 105),
        # complete
        box(600, 50, 250, 90, green, "completion.infer", "load_completer(name)", ".complete(sparse, image, K)"),
        box(910, 50, 220, 90, green, "completion/", "models/  twin_surface.py", "losses.py  metrics.py"),
        arrow(540, 90, 600, 90),
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
        arrow(540, 125, 600, 205),
        arrow(850, 215, 910, 215),
        # detect
        box(600, 290, 250, 90, orange, "detection.infer", "load_detector(name)", ".detect(PointFrame)"),
        box(910, 290, 220, 90, orange, "detection/", "models/  ops/  box_coding", "targets.py  losses.py"),
        arrow(500, 160, 600, 320),
        arrow(850, 335, 910, 335),
        # evaluate
        box(600, 410, 250, 90, orange, "detection.evaluation", "kitti_ap.evaluate(labels,", "detections)"),
        box(910, 410, 220, 90, orange, "detection/evaluation/", "overlaps  matching", "difficulty  curves"),
        arrow(440, 160, 600, 440),
        arrow(850, 455, 910, 455),
        # left column
        box(
            30,
            210,
            200,
            110,
            blue,
            "pipeline/runner/",
            "jobs, ledger, processes",
            "resume, shards, budget",
            "failures.json",
        ),
        box(290, 210, 160, 110, blue, "pipeline/data/", "one reader and", "writer per data set", "-> Frame"),
        box(30, 370, 200, 90, blue, "pipeline/run_folder/config.py", "the only YAML reader;", "unknown keys refused"),
        box(290, 370, 160, 90, blue, "pipeline/report/", "one HTML page,", "tables.md"),
        arrow(130, 160, 130, 210),
        arrow(365, 210, 365, 160),
        arrow(130, 370, 130, 320),
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
        parts.append(box(x, 540, 180, 84, SOFT, title, *lines))
        if index:
            stage = ("complete", "augment", "detect", "evaluate")[index - 1]
            parts.append(arrow(x - 45, 582, x, 582))
            parts.append(f'<text x="{x - 22}" y="536" class="l">{stage}</text>')
    parts.append('<text x="30" y="512" class="h">what lies on disk between the stages</text></svg>')
    return "\n".join(parts) + "\n"


if __name__ == "__main__":
    Path(__file__).with_name("architecture.svg").write_text(drawing(), encoding="utf-8")
