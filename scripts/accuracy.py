"""Writes the table "what accuracy to expect" into README.md and docs/index.md: python scripts/accuracy.py

The figures come from docs/results/real.json (real KITTI frames: run_pipeline --stage bench --suite real) and from the
cards of the bundled detectors (held-out synthetic frames). Run it whenever one of these has changed.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

from pipeline.run_folder.config import load_config  # noqa: E402
from pipeline.run_folder.weights import bundled_folder, detector_name  # noqa: E402

PAGES = ("README.md", "docs/index.md")
PLACE = re.compile(r"(<!-- accuracy[^>]*-->\n).*?(<!-- end -->)", re.DOTALL)


def main() -> int:
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    text = "\n".join(table(json.loads((ROOT / "docs" / "results" / "real.json").read_text())))
    for name in PAGES:
        page = ROOT / name
        page.write_text(replaced(page.read_text(encoding="utf-8"), text), encoding="utf-8")
    print(text)
    return 0


def replaced(page: str, text: str) -> str:
    """The page with the table between its two marks. Raises ValueError when they are not there."""
    if not PLACE.search(page):
        raise ValueError("expected the marks <!-- accuracy ... --> and <!-- end -->")
    return PLACE.sub(lambda found: f"{found[1]}{text}\n{found[2]}", page)


def table(real: dict[str, Any]) -> list[str]:
    """Lines of the Markdown table."""
    augmented, raw = load_config("kitti"), load_config("kitti", ["augment.preset=L"])
    names = detector_name(augmented), detector_name(raw)
    network = augmented.completion.model
    frames = f"{real['frames']} real KITTI frames"
    rows = ["| measured | on | bundled networks | for comparison |", "|---|---|---|---|"]
    for count in (32, 16):
        ours, linear = depth_row(real, network, count), depth_row(real, "classical", count)
        if ours and linear:
            rows.append(
                f"| depth from {count} of 64 LiDAR rows, mean error | {frames}, the other rows "
                f"| {ours['mae'] / 1000:.2f}\u00a0m | linear interpolation {linear['mae'] / 1000:.2f}\u00a0m |"
            )
            rows.append(
                "| at depth edges, share of pixels in the air between the surfaces | the same "
                f"| {ours['mixed']:.0f}\u00a0% | linear interpolation {linear['mixed']:.0f}\u00a0% |"
            )
    found = [car_row(real, name, 64) for name in names]
    if all(found):
        cells = [
            "{} of {}".format(*row["found"]["moderate"]) + f", precision {row['precision']:.2f}" for row in found if row
        ]
        where = f"{frames}, moderate, from above at IoU\u00a00.5"
        rows.append(f"| cars found | {where} | augmented {cells[0]}; raw LiDAR {cells[1]} | |")
    held = [held_out(name) for name in names]
    for kind, iou in (("Car", 0.7), ("Pedestrian", 0.5), ("Cyclist", 0.5)):
        values = [record["ap_r40"].get(f"{kind} 3d {iou}", [None, None])[1] for record in held]
        if None not in values:
            where = f"{held[0]['frames']} held-out synthetic frames, moderate, IoU\u00a0{iou}"
            rows.append(f"| {kind} 3D AP R40 | {where} | augmented {values[0]:.1f}; raw LiDAR {values[1]:.1f} | |")
    return rows


def depth_row(real: dict[str, Any], method: str, rows: int) -> dict[str, Any] | None:
    """The completion row of a method, if it was measured."""
    return next((row for row in real["completion"] if (row["method"], row["rows"]) == (method, rows)), None)


def car_row(real: dict[str, Any], detector: str, rows: int) -> dict[str, Any] | None:
    """Cars found from above at IoU 0.5, if that was measured."""
    for row in real.get("detection", []):
        if (row["detector"], row["rows"]) == (detector, rows):
            return next(
                item for item in row["reports"] if (item["class"], item["metric"], item["iou"]) == ("Car", "bev", 0.5)
            )
    return None


def held_out(detector: str) -> dict[str, Any]:
    """The figures on a detector's card."""
    card: dict[str, Any] = json.loads((bundled_folder("detection") / f"{detector}.json").read_text())["held_out"]
    return card


if __name__ == "__main__":
    sys.exit(main())
