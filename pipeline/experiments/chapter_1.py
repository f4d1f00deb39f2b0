"""Chapter 1 of the thesis: what depth, an image, and both together are worth."""

from __future__ import annotations

from itertools import pairwise

from pipeline.experiments.chapter_2_3 import errors, training
from pipeline.experiments.tables import Claim, Row, Table

ROWS = (64, 32, 16, 8)


def _depth_only(rows: int) -> str:
    return f"depth only, {rows}R"


def _both(rows: int) -> str:
    return f"image and depth, {rows}R"


FIGURE_1_1 = Table(
    "1.1",
    "figure",
    "Completion by LiDAR rows from depth only, from the image only (0 rows), and from both",
    "how much does each sensor add?",
    errors(),
    (
        Row("image only, 0R", recipe=training("resnet18", "l2", rows=0)),
        *(Row(_depth_only(rows), recipe=training("resnet18", "l2", rows=rows, colour=False)) for rows in ROWS),
        *(Row(_both(rows), recipe=training("resnet18", "l2", rows=rows)) for rows in ROWS),
    ),
    claims=(
        Claim("image and few rows beat the image alone", "rmse_mm", (_both(8),), ("image only, 0R",)),
        *(Claim(f"{rows}R: the image helps", "rmse_mm", (_both(rows),), (_depth_only(rows),)) for rows in ROWS),
        *(Claim(f"{more}R beats {less}R", "rmse_mm", (_both(more),), (_both(less),)) for more, less in pairwise(ROWS)),
    ),
    notes=(
        "the figure prints curves, no numbers; its depths end at 85 m",
        "Ma's network with 18 layers; depth only is trained and tested with black images",
    ),
    needs="synthetic world, or KITTI depth completion",
)

TABLES: tuple[Table, ...] = (FIGURE_1_1,)
