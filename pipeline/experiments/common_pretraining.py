"""The detector that every row of a table begins with, at budgets too short to learn boxes from nothing.

It is trained on clouds of all kinds in equal shares, so that no row begins nearer to its own kind than another; columns
that tell kinds of points apart are not among its inputs and start at zero in the rows that have them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from pipeline.base.settings import with_changes
from pipeline.experiments.chapter_5_exact import ALL, exact_input
from pipeline.experiments.inputs import InputRecipe

if TYPE_CHECKING:
    from detection.kitti_format import KittiObject
    from detection.train import LabelledFrames
    from detection.types import PointFrame
    from pipeline.data import Frame

# Raw, completed, augmented and exact depth; 64 rows and 16.
_KINDS: tuple[Mapping[str, Any], ...] = (
    {"preset": "L"},
    {"preset": "L", "rows": 16},
    {"preset": "D"},
    {"preset": "D", "rows": 16},
    {"preset": "D_SF"},
    {"preset": "L_D_SF"},
    {"preset": "L_D_SF", "rows": 16},
    exact_input("64R"),
    exact_input(ALL, "semantic"),
)


def start_inputs(frame: Frame) -> list[InputRecipe]:
    """Kinds of clouds the common pretraining is trained on, as far as a data set with such frames offers them."""
    recipes = (with_changes(InputRecipe(), kind, "start") for kind in _KINDS)
    return [recipe for recipe in recipes if recipe.is_possible(frame)]


@dataclass(frozen=True)
class Mixture:
    """Every frame in every kind of cloud: kind after kind, so that a draw of one is a draw of a kind and a frame."""

    sources: Sequence[LabelledFrames]

    def __len__(self) -> int:
        return sum(len(source) for source in self.sources)

    def __getitem__(self, index: int, /) -> tuple[PointFrame, list[KittiObject]]:
        for source in self.sources:
            if index < len(source):
                return source[index]
            index -= len(source)
        raise IndexError(f"expected an index below {len(self)}")
