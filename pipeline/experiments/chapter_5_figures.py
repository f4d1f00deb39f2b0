"""Figures 5.4, 5.6, 5.7 and 5.8 of the thesis with the numbers behind them."""

from __future__ import annotations

from typing import Any

from pipeline.experiments.chapter_5 import AP_COLUMNS, D_F, L_D_SF, NEEDS, NOTES, TWISE_NOTE, D, L
from pipeline.experiments.cloud_study import GAPS, LOWS
from pipeline.experiments.tables import HIGHER, LOWER, Claim, Column, Recipe, Row, Table

FPS_INPUTS = {"L": "raw LiDAR", "D": "dense depth", "D_F": "filtered depth", "L_D_SF": "augmented LiDAR"}
FPS_VIEWS = {"all": "in the cloud", "fps_4096": "of the 4096 by FPS", "fps_64": "of the 64 at the last level"}
SHARES = (
    Column("noise", "noise", "%"),
    Column("inbet", "between surfaces", "%"),
    Column("background", "background", "%"),
    Column("useless", "noise or background", "%"),
)


def cloud_recipe(preset: str, study: str = "points", **changes: Any) -> Recipe:
    """A study of the test clouds of a preset."""
    return Recipe("cloud", {"input": {"preset": preset, **changes}, "rows": 64, "study": study})


def fps_label(preset: str, view: str) -> str:
    """Row label of Fig. 5.4."""
    return f"{FPS_INPUTS[preset]}, {FPS_VIEWS[view]}"


def _more_in(text: str, column: str, preset: str) -> Claim:
    """Lower in the cloud than among the points that FPS picks."""
    return Claim(text, column, (fps_label(preset, "all"),), (fps_label(preset, "fps_4096"),))


FIGURE_5_4 = Table(
    "5.4",
    "figure",
    "What furthest point sampling picks",
    "does FPS promote outliers and background?",
    SHARES,
    tuple(Row(fps_label(p, view), recipe=cloud_recipe(p), view=view) for p in FPS_INPUTS for view in FPS_VIEWS),
    (
        _more_in("FPS promotes noise (dense depth)", "noise", "D"),
        _more_in("FPS promotes points between surfaces (dense depth)", "inbet", "D"),
        _more_in("FPS promotes background (dense depth)", "background", "D"),
        _more_in("FPS promotes background (raw LiDAR)", "background", "L"),
    ),
    notes=(
        "shares of the points whose truth is known, mean over test frames; a random draw has the cloud's own share",
        "noise: more than 0.1 m + 2 % of the depth off (`pipeline/pointcloud/taxonomy.py`); background: not on a "
        "vehicle or person",
        TWISE_NOTE,
    ),
    drawing="fps",
    needs="synthetic world, or Virtual KITTI 2 with --data",
)


def sigma_view(low: float, gap: float) -> str:
    """Name of a pair of thresholds in the numbers of a run."""
    return f"{low:g}-{1 - low:g}, {gap:g} m"


FIGURE_5_6 = Table(
    "5.6",
    "figure",
    "The region that the sigma filter drops",
    "are 0.2 < sigma < 0.8 and 3 m good thresholds?",
    (
        Column("removed", "points between surfaces removed", "%", HIGHER),
        Column("lost", "clean points lost", "%", LOWER, 2),
    ),
    tuple(
        Row(sigma_view(low, gap), recipe=cloud_recipe("D", "sigma"), view=sigma_view(low, gap))
        for low, gap in ((0.2, 3.0), (0.2, 1.0), (0.2, 6.0), (0.1, 3.0), (0.1, 1.0), (0.01, 0.25), (0.4, 3.0))
    ),
    notes=("the first row has the thesis' thresholds", TWISE_NOTE),
    drawing="sigma",
    needs="synthetic world, or Virtual KITTI 2 with --data",
)

FIGURE_5_7 = Table(
    "5.7",
    "figure",
    "Points after each step",
    "how many points are left, and which?",
    (
        Column("points", "points", "", "", 0),
        Column("all/noise", "noise", "%"),
        Column("all/object", "on objects, no noise", "%", HIGHER),
    ),
    (
        Row("(a) dense depth", (315_000, None, None), cloud_recipe("D")),
        Row("(b) sigma filter", (200_000, None, None), cloud_recipe("D_F")),
        Row("(c) grid sampling, 0.2 m", (35_000, None, None), cloud_recipe("D_F", changes={"grid": {"size": 0.2}})),
        Row("(d) mask and 0.3 m around", (15_000, None, None), cloud_recipe("D_SF")),
    ),
    notes=(
        "points of the whole cloud; shares are of the points inside the detectors' area whose truth is known",
        TWISE_NOTE,
    ),
    drawing="counts",
    needs="synthetic world, or Virtual KITTI 2 with --data",
)

FIGURE_5_8 = Table(
    "5.8",
    "figure",
    "Detections from above with different inputs",
    "what do the inputs look like to a detector?",
    AP_COLUMNS,
    (
        Row("sparse depth", recipe=L),
        Row("dense depth", recipe=D),
        Row("sigma filter", recipe=D_F),
        Row("augmented LiDAR", recipe=L_D_SF),
    ),
    notes=(*NOTES, "the picture shows the test frame with most labelled cars, first seed, scores above 0.3"),
    drawing="bev",
    needs=NEEDS,
)

TABLES: tuple[Table, ...] = (FIGURE_5_4, FIGURE_5_6, FIGURE_5_7, FIGURE_5_8)
THRESHOLDS = (LOWS, GAPS)
