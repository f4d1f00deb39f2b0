"""What is asked of an evaluation: classes, metrics, limits and rules, and the rows of results that follow."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal, get_args

from auglidar_base.errors import SettingsError
from detection.evaluation.difficulty import AnyHeight, DifficultyRule, difficulty_named

Metric = Literal["2d", "aos", "bev", "3d"]
IouSet = Literal["strict", "loose", "both"]
Flavor = Literal["cpp", "python"]
RangeRule = Literal["clocs", "border"]
RangeAxis = Literal["z", "radius"]
RecallPoints = Literal[40, 11]
MinHeight = Literal["kitti", "none"]

METRICS: tuple[Metric, ...] = get_args(Metric)
KITTI_CLASSES = ("Car", "Van", "Truck", "Pedestrian", "Person_sitting", "Cyclist", "Tram", "Misc")

# A neighbouring class is ignored: finding it is neither right nor wrong.
NEIGHBOURS = {"car": "Van", "pedestrian": "Person_sitting"}

Range = tuple[float, float | None]
EVERYWHERE: Range = (0.0, None)


@dataclass(frozen=True)
class Target:
    """One row of results: a class, a metric, the least IoU of a match, and a range in metres [lo, hi)."""

    cls: str
    metric: str
    iou: float
    range: Range = EVERYWHERE

    @property
    def overlap(self) -> str:
        """The overlap that decides a match: AOS is matched in the image."""
        return "2d" if self.metric == "aos" else self.metric


def min_overlap(cls: str, metric: str, iou_set: str) -> float:
    """Least IoU of the strict (Car 0.7, others 0.5) or loose set (bev and 3d: 0.5 and 0.25; image as strict)."""
    is_car = cls.lower() == "car"
    if iou_set == "loose" and metric in ("bev", "3d"):
        return 0.5 if is_car else 0.25
    return 0.7 if is_car else 0.5


@dataclass(frozen=True)
class EvaluationProtocol:
    """What counts and how: the same choices for `kitti_ap.evaluate`, the command line and the YAML of a run.

    classes     names to evaluate; upper and lower case alike
    metrics     some of "2d", "aos", "bev", "3d"
    recall      40 or 11 recall points
    iou_set     limits of BEV and 3D: "strict" (Car 0.7, others 0.5), "loose" (0.5 and 0.25) or "both"
    ious        class -> IoUs that replace the sets for that class, as {"Car": [0.3, 0.5, 0.7]}
    flavor      "cpp": the official devkit; "python": the widely used port (a label exactly 40 or 25 px high is ignored,
                DontCare is written so and known in the image only, AOS is judged by the first detection)
    ranges      pairs (lo, hi) in metres, lo <= distance < hi, hi None = no limit; (0, None) = everything
    range_rule  "clocs": labels outside are ignored, detections outside dropped; "border": a detection outside that
                overlaps a label inside still counts, and others outside are ignored
    range_axis  "z": depth along the optical axis; "radius": distance on the ground
    difficulty  "kitti", "vkitti2" (columns truncated and occluded hold ratios 0..1), "vkitti2:and:bands:ignore" and
                the like (see Vkitti2Difficulty), or a DifficultyRule
    min_height  "kitti": objects lower in the image than the difficulty asks are ignored; "none": every height counts,
                also without 2D boxes (0 or -1), which is not KITTI's ranking

    Sequences of any kind are taken and kept as tuples. Raises ValueError for what cannot be asked.
    """

    classes: tuple[str, ...] = ("Car", "Pedestrian", "Cyclist")
    metrics: tuple[Metric, ...] = METRICS
    recall: RecallPoints = 40
    iou_set: IouSet = "both"
    ious: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    flavor: Flavor = "cpp"
    ranges: tuple[Range, ...] = (EVERYWHERE,)
    range_rule: RangeRule = "clocs"
    range_axis: RangeAxis = "z"
    difficulty: str | DifficultyRule = "kitti"
    min_height: MinHeight = "kitti"

    def __post_init__(self) -> None:
        if isinstance(self.classes, str) or not self.classes:
            raise SettingsError(f"classes: expected a list of class names, got {self.classes!r}")
        ranges = tuple((low, high) for low, high in self.ranges)
        ious = {name: tuple(float(value) for value in values) for name, values in self.ious.items()}
        plain = {"classes": tuple(self.classes), "metrics": tuple(self.metrics), "ranges": ranges, "ious": ious}
        for name, value in plain.items():
            object.__setattr__(self, name, value)
        self._check_choices()
        self._check_limits()

    def _check_choices(self) -> None:
        choices = {"recall": RecallPoints, "flavor": Flavor, "range_rule": RangeRule, "range_axis": RangeAxis}
        choices["min_height"] = MinHeight
        for name, allowed in choices.items():
            if getattr(self, name) not in get_args(allowed):
                expected = " or ".join(str(choice) for choice in get_args(allowed))
                raise SettingsError(f"{name}: expected {expected}, got {getattr(self, name)!r}")
        if self.iou_set not in get_args(IouSet):
            raise SettingsError(f"IoU set: expected one of {', '.join(get_args(IouSet))}, got {self.iou_set!r}")
        wrong = [metric for metric in self.metrics if metric not in METRICS]
        if wrong or not self.metrics:
            raise SettingsError(f"metric: expected some of {', '.join(METRICS)}, got {wrong[0] if wrong else 'none'!r}")
        _ = self.rule  # a misspelt one is refused here

    def _check_limits(self) -> None:
        if any(name.lower() == "dontcare" for name in self.classes):
            raise SettingsError("classes: DontCare marks areas and cannot be evaluated")
        for name, values in self.ious.items():
            if name.lower() not in {cls.lower() for cls in self.classes}:
                raise SettingsError(f"IoU of {name}: that class is not evaluated ({', '.join(self.classes)} are)")
            for value in values:
                if not 0 <= value < 1:
                    raise SettingsError(f"IoU of {name}: expected 0 <= IoU < 1 (a match needs more), got {value}")
        for low, high in self.ranges:
            if high is not None and not low < high:
                raise SettingsError(f"range: expected LO < HI in metres, got {low} {high}")

    @property
    def rule(self) -> DifficultyRule:
        """The rule that `difficulty` names."""
        named = isinstance(self.difficulty, str)
        rule = difficulty_named(str(self.difficulty), self.flavor) if named else self.difficulty
        assert not isinstance(rule, str)
        return rule if self.min_height == "kitti" else AnyHeight(rule)

    @property
    def targets(self) -> tuple[Target, ...]:
        """Every row asked for, each once (image rows of the strict and loose set are the same)."""
        sets = ("strict", "loose") if self.iou_set == "both" else (self.iou_set,)
        own = {name.lower(): values for name, values in self.ious.items()}
        rows = [
            Target(cls, metric, min_overlap(cls, metric, limit) if isinstance(limit, str) else limit, bounds)
            for bounds in self.ranges
            for cls in self.classes
            for limit in own.get(cls.lower(), sets)
            for metric in self.metrics
        ]
        return tuple(dict.fromkeys(rows))
