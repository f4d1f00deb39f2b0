"""The one place that reads YAML: configuration files, `--set` overrides, and the resolved copy beside the results.

Sections named after a library (`synth`, `augment`, `train`) pass their other keys on to that library's own settings;
`pipeline.base.settings.with_changes` checks them there, so that no name is written down twice.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import yaml
from pydantic import BaseModel, ConfigDict, Field, PlainSerializer, PlainValidator, ValidationError, model_validator

from detection.evaluation.protocol import EvaluationProtocol
from pipeline.base.errors import UsageError
from pipeline.base.settings import nearest_name, plain, renamed, with_changes
from pipeline.base.yaml_files import parse_yaml, read_yaml


class Section(BaseModel):
    """A section whose keys are all listed here."""

    model_config = ConfigDict(extra="forbid", frozen=True, validate_default=True)


class LibrarySection(BaseModel):
    """A section whose other keys belong to a library's settings and are checked there."""

    model_config = ConfigDict(extra="allow", frozen=True, validate_default=True)

    @property
    def library(self) -> dict[str, Any]:
        """The keys for the library."""
        return dict(self.__pydantic_extra__ or {})


class DataConfig(Section):
    """Where frames come from."""

    name: str = Field(
        default="synthetic",
        description="kitti_object, kitti_depth, kitti_raw, vkitti2, nyuv2, folder; synthetic: made by the synth stage",
    )
    root: str | None = Field(default=None, description="folder of the data set; synthetic data defaults to OUT/data")
    frames: str | None = Field(default=None, description="a:b (positions), a split file, or ids separated by commas")
    columns: int | None = Field(
        default=None, ge=3, le=64, description="float32 columns of .bin clouds, x y z intensity first; 4 when not given"
    )
    keep_empty: bool = Field(
        default=False, description="keep points of PLY and PCD clouds without a return (0 0 0), and refuse NaN"
    )


class SynthConfig(LibrarySection):
    """Synthetic scenes; other keys: `pipeline.simulation.synth.SynthSettings`."""


class CompletionConfig(Section):
    """Depth completion."""

    model: str = Field(
        default="classical", description="bundled weights by name, a checkpoint file, 'classical', or module:Class"
    )
    options: dict[str, Any] = Field(default={}, description="keyword arguments of a module:Class")
    backend: str = Field(default="torch", description="what computes it: torch, numba, onnxruntime, openvino or auto")
    device: str = Field(default="cpu", description="where torch computes it: cpu, cuda or mps")


class AugmentConfig(LibrarySection):
    """The point-cloud stage; other keys change fields of the preset (`pipeline.pointcloud.presets`)."""

    preset: str = Field(default="L_D_F", description="L, D, D_F, D_SF, L_D_SF, L_D_SF_mask, ...")
    semantics: str | None = Field(
        default=None, description="object masks: truth, boxes, files:FOLDER, network[:WEIGHTS], onnx:FILE, hf:FOLDER"
    )
    convention: str | None = Field(default=None, description="label convention of masks in files or of an ONNX model")
    depth_from: str | None = Field(
        default=None, description="folder of uint16 depth PNGs (ID.png) used instead of completion"
    )
    check_depth: bool = Field(default=True, description="refuse maps of depth_from that do not fit the frame's LiDAR")


class DetectionConfig(Section):
    """The 3D detector."""

    model: str = Field(default="auto", description="weights by name or file, 'auto' (by preset), or module:Class")
    options: dict[str, Any] = Field(default={}, description="keyword arguments of a module:Class")
    device: str = Field(default="cpu", description="where it is computed: cpu or cuda")


def _protocol(value: object) -> EvaluationProtocol:
    """The evaluation section as the library's own dataclass."""
    if isinstance(value, EvaluationProtocol):
        return value
    if not isinstance(value, Mapping):
        raise ValueError("expected keys with values")
    return with_changes(EvaluationProtocol(), value, "evaluation")


class ReportConfig(Section):
    """The HTML report."""

    frames: int = Field(default=20, ge=1, le=500, description="frames shown in detail on one page")
    pages: int = Field(default=10, ge=0, le=1000, description="further pages for a run of more frames; all, in order")
    compare: str | None = Field(default=None, description="folder of another run over the same frames")
    format: Literal["html", "png", "pdf", "svg", "rrd", "mcap"] = Field(
        default="html", description="further output beside the page: figures, or recordings for Rerun and Foxglove"
    )


class TrainConfig(LibrarySection):
    """Training; other keys: the `TrainSettings` of the network's library."""

    network: Literal["completion", "detection", "segmentation"] = Field(
        default="completion", description="what is trained: completion, detection or segmentation"
    )
    truth: Literal["depth", "held_out_rings", "both"] = Field(
        default="depth",
        description="what completion learns from: the data set's true depth, the rings of the scan that beam_strides "
        "keeps back (points, calibration and pictures are enough), or both, three crops of four by rings",
    )
    beam_strides: tuple[int, ...] = Field(
        default=(),
        description="every n-th LiDAR ring, e.g. [1, 2, 4, 8]: completion draws n for every crop, detection sees every "
        "frame once with each n; none: the frame's sparse map, the run's clouds",
    )
    rehearse: str | None = Field(
        default=None,
        description="completion: folder of frames with true depth in KITTI's layout (`--stage synth` makes one), from "
        "which one sample in three comes, so that the network does not forget them",
    )
    photographs: str | None = Field(
        default=None,
        description="completion, synthetic frames: folder of photographs that surfaces are covered with anew for every "
        "other crop, so that the network compares instead of knowing our renderer",
    )
    relief: float = Field(
        default=0.0,
        description="completion, synthetic frames: share of crops whose ground and crowns are made uneven",
    )
    calibration_jitter: float = Field(
        default=0.0,
        description="with beam_strides: standard deviation, degrees, of a random rotation between LiDAR and camera",
    )

    @model_validator(mode="before")
    @classmethod
    def _names_of_today(cls, tree: Any) -> Any:
        return renamed(tree, {"row_steps": "beam_strides"}, "train") if isinstance(tree, Mapping) else tree


class RunConfig(Section):
    """How the work is done; nothing here changes a result."""

    workers: int = Field(default=0, ge=0, le=1024, description="processes; 0 = one per core")
    keep_free_gb: float = Field(default=0.5, ge=0, description="stop before the disk has less than this left")
    max_gb: float | None = Field(default=None, gt=0, description="stop when this run's files exceed this")
    keep_going: bool = Field(default=True, description="process the other frames when one fails")


class LimitsConfig(Section):
    """What one frame may take; beyond it the frame is refused and the others go on. Nothing here changes a result."""

    file_mb: float = Field(default=512, gt=0, le=512, description="largest file of a frame that is read")
    memory_gb: float | None = Field(
        default=None, gt=0, description="memory that the work on one frame may take beside the program (Linux)"
    )


class Config(Section):
    """A whole run."""

    seed: int = Field(default=1, ge=0, lt=2**31, description="of everything random in the run")
    data: DataConfig = DataConfig()
    synth: SynthConfig = SynthConfig()
    completion: CompletionConfig = CompletionConfig()
    augment: AugmentConfig = AugmentConfig()
    detection: DetectionConfig = DetectionConfig()
    evaluation: Annotated[EvaluationProtocol, PlainValidator(_protocol), PlainSerializer(plain)] = EvaluationProtocol()
    report: ReportConfig = ReportConfig()
    train: TrainConfig = TrainConfig()
    run: RunConfig = RunConfig()
    limits: LimitsConfig = LimitsConfig()
    made_with: dict[str, str | None] | None = Field(
        default=None, description="versions and git commit, written by the program"
    )


def load_config(source: str | Path | None, overrides: Iterable[str] = ()) -> Config:
    """The configuration of a file with `key.sub=value` overrides applied.

    source  a YAML file; None for the built-in demo. `configs/NAME.yaml` and `NAME` (also `weights/NAME`, ...) find the
            built-in file of that name when there is no such file: an installed package has them without a checkout
    Overriding the preset or network of a run's own config.yaml takes its numbers with it.
    Raises UsageError naming the unknown key (with the nearest known one) or the value that does not fit.
    """
    path = config_path(source)
    tree = read_yaml(path)
    texts = tuple(overrides)
    if tree.get("made_with"):
        for text in texts:
            _give_way(tree, text)
    for text in texts:
        _override(tree, text)
    return parse_config(tree, str(path))


def parse_config(tree: Mapping[str, Any], where: str) -> Config:
    """A checked Config from plain values; `where` names the file in messages."""
    try:
        return Config.model_validate(tree)
    except ValidationError as error:
        raise UsageError(f"{where}: {_explain(error)}") from None
    except UsageError as error:
        raise UsageError(f"{where}: {error}") from None


def config_path(source: str | Path | None) -> Path:
    """The file meant by `source`; see `load_config`."""
    if source is None:
        return built_in_folder() / "synthetic.yaml"
    path = Path(source)
    if path.is_file():
        return path
    folder = built_in_folder()
    below = path.relative_to("configs") if path.is_relative_to("configs") else path
    built_in = folder / (below if below.suffix == ".yaml" else f"{below}.yaml")
    if not path.is_absolute() and ".." not in below.parts and built_in.is_file():
        return built_in
    names = ", ".join(sorted(str(file.relative_to(folder)).removesuffix(".yaml") for file in folder.rglob("*.yaml")))
    raise UsageError(f"no such configuration file: {path} (built in: {names})")


def built_in_folder() -> Path:
    """The folder of the files that come with the program: configs/ of the checkout, pipeline/configs once installed."""
    package = Path(__file__).resolve().parent.parent
    installed = package / "configs"
    return installed if installed.is_dir() else package.parent / "configs"


def _give_way(tree: dict[str, Any], text: str) -> None:
    """Removes from a run's own configuration, where every field is listed, those of a choice that `text` replaces."""
    name, _, value = text.partition("=")
    section, _, key = name.strip().partition(".")
    given = tree.get(section)
    if not isinstance(given, dict) or given.get(key) == value.strip():
        return
    if name.strip() == "augment.preset":
        tree[section] = {field: given[field] for field in given if field in AugmentConfig.model_fields}
    elif name.strip() == "train.network":
        tree[section] = {field: given[field] for field in given if field in TrainConfig.model_fields}
    elif name.strip() == "train.model.architecture":
        tree[section] = {field: given[field] for field in given if field not in ("model", "loss")}


def _override(tree: dict[str, Any], text: str) -> None:
    """Sets one `key.sub=value` in the tree; the value is typed as YAML types it (1, 0.5, true, null, [a, b], text)."""
    name, equals, value = text.partition("=")
    keys = name.strip().split(".")
    if not equals or not all(keys):
        raise UsageError(f"--set {text}: expected key.sub=value, for example synth.frames=40")
    for key in keys[:-1]:
        inner = tree.get(key)
        if inner is None:
            inner = tree[key] = {}
        if not isinstance(inner, dict):
            raise UsageError(f"--set {text}: {key} is a value, not a section")
        tree = inner
    tree[keys[-1]] = parse_yaml(value, f"--set {text}")


def _explain(error: ValidationError) -> str:
    """The first problem of a validation, with the nearest name for an unknown key."""
    problem = error.errors()[0]
    place = [str(part) for part in problem["loc"]]
    name = ".".join(place)
    if problem["type"] == "extra_forbidden":
        section: type[BaseModel] = Config
        for part in place[:-1]:
            section = section.model_fields[part].annotation  # type: ignore[assignment]
        return f"unknown key {name}; {nearest_name(place[-1], section.model_fields)}"
    message = problem["msg"][:1].lower() + problem["msg"][1:]
    return f"{name}: {message}, got {problem['input']!r}"


def dump_config(config: Config) -> str:
    """YAML text of the resolved configuration; `load_config` reads it back."""
    return yaml.safe_dump(config.model_dump(mode="json"), sort_keys=False, allow_unicode=True)
