"""The bundled completion network beside a classical completion and beside itself trained by a squared loss."""

from __future__ import annotations

from pipeline.experiments.tables import Claim, Column, Recipe, Row, Table

# LiDAR rows at which every completer is scored.
ROWS = (64, 16)
COLUMNS = (
    Column("mae_mm", "MAE", "mm"),
    Column("rmse_mm", "RMSE", "mm"),
    Column("tmae_mm", "tMAE", "mm"),
    Column("mixed_percent", "mixed", "%"),
    Column("edge_tmae_mm", "edge tMAE", "mm"),
)
CLASSICAL, SHIPPED_SMALL, SHIPPED_LARGE = "classical", "selection_small", "selection_large"
SMALL, SMALL_L2 = "small width, likelihood", "small width, L2"
LARGE, LARGE_L2 = "larger width, likelihood", "larger width, L2"


def trained(loss: str, width: int, start: str = "") -> Recipe:
    """A training of the bundled network, from random weights or grown from `start`."""
    return Recipe("selection", {"loss": loss, "width": width, "start": start})


RECIPES = {
    CLASSICAL: Recipe("completer", {"completer": CLASSICAL}),
    SHIPPED_SMALL: Recipe("completer", {"completer": SHIPPED_SMALL}),
    SHIPPED_LARGE: Recipe("completer", {"completer": SHIPPED_LARGE}),
    SMALL: trained("mixture", 24),
    SMALL_L2: trained("l2", 24),
    LARGE: trained("mixture", 32, SHIPPED_SMALL),
    LARGE_L2: trained("l2", 32, SHIPPED_SMALL),
}
PRIMARY_METRICS = {"mae_mm": "MAE", "tmae_mm": "tMAE", "mixed_percent": "mixed depth"}
# (what is claimed, better, worse)
ORDERS = (
    ("the larger network beats the classical completion", LARGE, CLASSICAL),
    ("the larger network beats its L2 twin", LARGE, LARGE_L2),
    ("the small network beats its L2 twin", SMALL, SMALL_L2),
)


def _label(rows: int, name: str) -> str:
    return f"{rows} rows, {name}"


TABLE = Table(
    "bundled",
    "table",
    "The bundled completion network, a classical completion, and L2",
    "is it the loss that makes edges sharp?",
    COLUMNS,
    tuple(Row(_label(rows, name), recipe=recipe, view=str(rows)) for rows in ROWS for name, recipe in RECIPES.items()),
    tuple(
        Claim(f"{rows} rows: {text} in {title}", column, (_label(rows, better),), (_label(rows, worse),))
        for rows in ROWS
        for text, better, worse in ORDERS
        for column, title in PRIMARY_METRICS.items()
    ),
    notes=(
        "not in the thesis: its claim about twin surfaces, on the network that ships",
        "likelihood: the loss of the bundled network, whose quantiles are the twin surfaces; L2: the same network, "
        "trained on and read by its expected depth",
        "the larger width is grown from `selection_small`, trained by likelihood, and goes on by either loss",
        "truth is the exact depth where a full scan measures, to 80 m",
    ),
    needs="synthetic world",
)
