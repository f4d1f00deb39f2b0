"""The scores from which detections are shown: one per class, from the detector's card.

A single score made for cars hides every pedestrian, whose scores lie lower. A card holds for every class the lowest
score from which on 80 % of what is reported is right on held-out frames (`pipeline.pretrained.figures`).
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from detection.kitti_format import KittiObject
from pipeline.base.errors import UsageError
from pipeline.run_folder.config import Config
from pipeline.run_folder.own_methods import is_own, own_class
from pipeline.run_folder.weights import detection_weights, detector_name


@dataclass(frozen=True)
class ScoreThresholds:
    """by_class: class -> least score; others: of classes that are not named there (-inf: all are shown)."""

    by_class: Mapping[str, float] = field(default_factory=dict)
    others: float = -math.inf

    @classmethod
    def of_card(cls, card: Mapping[str, Any]) -> ScoreThresholds:
        """From `score_thresholds` of a card, or the one `score_threshold` of cards before version 0.2."""
        by_class, single = card.get("score_thresholds"), card.get("score_threshold")
        others = float(single) if isinstance(single, (int, float)) else -math.inf
        if not isinstance(by_class, Mapping):
            return cls({}, others)
        return cls({str(name): float(score) for name, score in by_class.items()}, others)

    @classmethod
    def of_run(cls, config: Config) -> ScoreThresholds:
        """Those of the run's detector; everything is shown where there is no card to say more."""
        try:
            name = detector_name(config)
            if is_own("detection", name):
                return cls.of_card(vars(own_class("detection", name, config.detection.options)))
            return cls.of_file(detection_weights(name, {})[-1])
        except (UsageError, OSError, ValueError):
            return cls()

    @classmethod
    def of_file(cls, card: Path) -> ScoreThresholds:
        """Those of a card's file. Raises OSError and ValueError when it cannot be read as one."""
        content = json.loads(card.read_text(encoding="utf-8"))
        if not isinstance(content, dict):
            raise ValueError(f"{card}: expected a card, got {type(content).__name__}")
        return cls.of_card(content)

    def of(self, name: str) -> float:
        """The least score of a class."""
        return self.by_class.get(name, self.others)

    def shows(self, item: KittiObject) -> bool:
        """Whether a detection is shown; labels, which have no score, are."""
        return item.score is None or item.score >= self.of(item.type)

    def text(self, names: Iterable[str]) -> str:
        """ "Car 0.65, Pedestrian 0.45" of these classes, "" when all of everything is shown."""
        return ", ".join(f"{name} {self.of(name):g}" for name in names if self.of(name) > -math.inf)
