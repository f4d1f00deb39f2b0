"""The ledger key holds all that a stage uses: recorded, with every declared item taken away in turn, and changed."""

from __future__ import annotations

import ast
import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from pipeline.data.frame import Frame
from pipeline.pointcloud.presets import AugmentSettings
from pipeline.run_folder.config import Config
from pipeline.stages.declared import DeclaredFrame, UndeclaredError
from pipeline.stages.order import FRAME_STAGES
from pipeline.stages.stage import NOT_IN_KEYS, FrameStage
from tests.pipeline.stages.cases import CASES, ID, MASKS, Case, config_of, open_case, write_inputs
from tests.pipeline.stages.recording import key, uncovered, work
from tests.test_architecture import ROOT, modules


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_inputs(tmp_path_factory.mktemp("inputs"))


# --- what is used is declared


@pytest.mark.parametrize("name", CASES)
def test_the_key_covers_what_the_work_opens_and_reads(name: str, inputs: Path) -> None:
    case = open_case(name, inputs)
    assert uncovered(case.stage, case.frame, case.run) == []


def without(stage: FrameStage, kind: str, item: Any) -> FrameStage:
    """The stage with one item left out of its declaration; its work is the same."""

    def left(values: Callable[..., Any]) -> Callable[..., Any]:
        def fewer(self: FrameStage, *arguments: Any) -> Any:
            found = values(self, *arguments)
            if isinstance(found, dict):
                return {name: value for name, value in found.items() if name != item}
            return tuple(value for value in found if getattr(value, "name", value) != item)

        return fewer

    fewer = type("Fewer", (type(stage),), {kind: left(getattr(type(stage), kind))})
    made: FrameStage = fewer(*(getattr(stage, field.name) for field in dataclasses.fields(stage)))
    return made


def declared(case: Case) -> dict[str, list[Any]]:
    """Everything the stage of a case declares: method of the declaration -> items (files by their name)."""
    stage = case.stage
    return {
        "settings": list(stage.settings()),
        "parts": list(stage.parts(case.frame)),
        "reads": list(stage.reads()),
        "user_files": [path.name for path in stage.user_files(ID)],
        "weights": [path.name for path in stage.weights()],
    }


# Written out, so that an item that vanishes from a declaration fails here too.
DECLARED = {
    "complete": {
        "settings": {"model", "device", "backend", "options"},
        "parts": {"image", "calibration", "sparse_depth", "points", "image_size"},
        "weights": {"depth.safetensors", "depth.json"},
    },
    "augment": {
        "settings": {"cloud", "masks", "convention", "depth_from", "compare", "seed"},
        "parts": {"points", "calibration", "sparse_depth", "image", "image_size", "labels", "semantics"},
        "reads": {"depth", "twin"},
        "user_files": {f"{ID}.png", "mask.json"},
        "weights": {"masks.safetensors", "masks.json"},
    },
    "detect": {
        "settings": {"detector", "device", "raw_lidar", "seed", "options"},
        "parts": {"points", "calibration", "image_size"},
        "reads": {"cloud", "counts", "cloud_columns"},
        "weights": {"detector.safetensors", "detector.json"},
    },
}
ITEMS = [
    (stage, kind, item)
    for stage, kinds in DECLARED.items()
    for kind, items in sorted(kinds.items())
    for item in sorted(items)
]


def test_the_cases_declare_every_item_there_is(inputs: Path) -> None:
    found: dict[str, dict[str, set[Any]]] = {stage: {} for stage in FRAME_STAGES}
    for name, (stage, _) in CASES.items():
        for kind, items in declared(open_case(name, inputs)).items():
            if items:
                found[stage].setdefault(kind, set()).update(items)
    assert found == DECLARED


@pytest.mark.parametrize(("stage", "kind", "item"), ITEMS, ids=map("-".join, ITEMS))
def test_an_item_left_out_of_a_declaration_is_noticed(stage: str, kind: str, item: str, inputs: Path) -> None:
    for name in (name for name, (of, _) in CASES.items() if of == stage):
        case = open_case(name, inputs)
        if item in declared(case)[kind] and uncovered(without(case.stage, kind, item), case.frame, case.run):
            return
    pytest.fail(f"no case of {stage} notices that {item} is not among its {kind}")


def test_an_undeclared_part_cannot_be_read() -> None:
    frame = Frame("1", {"image": lambda: 1, "points": lambda: 2, "image_size": lambda: (2, 3)})
    seen = DeclaredFrame.of(frame, ("image_size", "sparse_depth"))
    assert seen.image_size == (2, 3)
    uses: tuple[Callable[[], Any], ...] = (
        lambda: seen.image,
        lambda: seen.has("points"),
        lambda: seen.files("points"),
        lambda: seen.sparse_depth,
    )
    for use in uses:
        with pytest.raises(UndeclaredError, match="and declares image_size, sparse_depth"):
            use()


def test_an_undeclared_file_of_the_run_is_neither_read_nor_written(inputs: Path) -> None:
    case = open_case("augment, depth from a folder", inputs)
    files = case.stage.declared_files(case.run, ID)
    with pytest.raises(UndeclaredError, match="reads depth"):
        files.read_completed()
    with pytest.raises(UndeclaredError, match="writes detections"):
        files.write_detections([])


# --- what is declared changes the key


@pytest.mark.parametrize("name", CASES)
def test_every_file_the_work_opens_changes_the_key(name: str, inputs: Path) -> None:
    case = open_case(name, inputs)
    files = work(case.stage, case.frame, case.run).files
    assert files
    case = open_case(name, inputs)
    taken_away = {case.run.output(output, ID) for output in case.stage.removes()}
    before = key(case.stage, case.frame, case.run)
    for path in files - taken_away:
        content = path.read_bytes()
        path.write_bytes(content + b" ")
        changed = key(case.stage, case.frame, case.run)
        path.write_bytes(content)
        assert changed != before, path
    assert key(case.stage, case.frame, case.run) == before


# Another value for every setting of the sections that shape a frame's results: section, key, value, stages it changes.
CHANGES: tuple[tuple[str | None, str, Any, set[str]], ...] = (
    (None, "seed", 7, {"augment", "detect"}),
    ("completion", "model", "{root}/weights/depth.safetensors", {"complete"}),
    ("completion", "backend", "onnxruntime", {"complete"}),
    ("completion", "device", "cuda", {"complete"}),
    ("completion", "options", {"scale": 2}, {"complete"}),
    ("augment", "preset", "L", {"augment", "detect"}),
    ("augment", "semantics", "truth", {"augment"}),
    ("augment", "convention", "kitti", {"augment"}),
    ("augment", "depth_from", "{root}/depth", {"augment"}),
    ("augment", "check_depth", False, {"augment"}),
    ("detection", "model", "small_lidar", {"detect"}),
    ("detection", "device", "cuda", {"detect"}),
    ("detection", "options", {"scale": 2}, {"detect"}),
)
SHAPES_NOTHING = {"data", "synth", "evaluation", "report", "train", "run", "limits", "made_with"}


def changed(config: Config, section: str | None, name: str, value: Any) -> Config:
    """`config` with one value replaced."""
    tree = config.model_dump()
    (tree if section is None else tree[section])[name] = value
    return Config.model_validate(tree)


def keys_of(config: Config, case: Case) -> dict[str, str]:
    """The key of every stage for the frame of a case."""
    return {name: key(stage.of(config), case.frame, case.run) for name, stage in FRAME_STAGES.items()}


@pytest.mark.parametrize(("section", "name", "value", "stages"), CHANGES, ids=[f"{c[0]}.{c[1]}" for c in CHANGES])
def test_a_changed_setting_changes_the_keys(
    section: str | None, name: str, value: Any, stages: set[str], inputs: Path
) -> None:
    case, config = open_case("augment, masks in files", inputs), masked(inputs)
    value = value.format(root=inputs) if isinstance(value, str) else value
    before, after = keys_of(config, case), keys_of(changed(config, section, name, value), case)
    assert {stage for stage in before if before[stage] != after[stage]} == stages


def masked(inputs: Path) -> Config:
    """A configuration in which every setting of the augment section counts."""
    return config_of({"augment": {"preset": "L_D_SF", **MASKS}}, inputs)


def test_every_setting_is_either_tried_or_shapes_no_frame() -> None:
    tried = {(section, name) for section, name, _, _ in CHANGES}
    for name, field in Config.model_fields.items():
        kind: Any = field.annotation
        if name in SHAPES_NOTHING:
            continue
        settings = [(name, of) for of in kind.model_fields] if hasattr(kind, "model_fields") else [(None, name)]
        assert set(settings) <= tried


@pytest.mark.parametrize("field", [field.name for field in dataclasses.fields(AugmentSettings)])
def test_every_field_of_a_preset_changes_the_key_of_augment(field: str, inputs: Path) -> None:
    other = {
        "lidar": False,
        "completed": False,
        "crop_lidar": False,
        "sigma": {"low": 0.3},
        "range_image": {"rows": 64},
        "grid": {"size": 0.3},
        "classes": [13],
        "semantic": {"threshold": 0.6},
        "semantic_lidar": True,
        "near_lidar": None,
        "columns": ["gap"],
        "max_points": 100,
    }
    case, config = open_case("augment, masks in files", inputs), masked(inputs)
    before, after = keys_of(config, case), keys_of(changed(config, "augment", field, other[field]), case)
    assert {stage for stage in before if before[stage] != after[stage]} == {"augment"}


@pytest.mark.parametrize("name", CASES)
def test_the_same_key_gives_the_same_bytes(name: str, inputs: Path) -> None:
    def done() -> tuple[str, dict[str, bytes]]:
        case = open_case(name, inputs)
        before = key(case.stage, case.frame, case.run)
        work(case.stage, case.frame, case.run)
        files = {output: case.run.output(output, ID) for output in case.stage.writes()}
        return before, {output: path.read_bytes() for output, path in files.items() if path.is_file()}

    first, second = done(), done()
    assert first == second
    assert first[1]


# --- the source


def run_time_imports(file: Path, known: dict[str, Path]) -> set[str]:
    """The modules of the project that a file imports wherever it stands but for types, with their packages."""
    tree = ast.parse(file.read_text(encoding="utf-8"))
    checks = [node for node in ast.walk(tree) if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"]
    for_types = {id(inner) for node in checks for statement in node.body for inner in ast.walk(statement)}
    found: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import) and id(node) not in for_types:
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and id(node) not in for_types:
            found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    packages = {".".join(name.split(".")[:depth]) for name in found & known.keys() for depth in range(1, 9)}
    return packages & known.keys()


def says_something(file: Path) -> bool:
    """True when a file has more than a docstring."""
    return any(not isinstance(node, ast.Expr) for node in ast.parse(file.read_text(encoding="utf-8")).body)


def import_closure(module: str) -> set[str]:
    """Files that running a module can import, by path; what stands in NOT_IN_KEYS is not followed."""
    known, files, left = modules(), set(), {module}
    seen = set(left)
    while left:
        file = known[left.pop()]
        place = file.relative_to(ROOT).as_posix()
        if place not in NOT_IN_KEYS:
            files |= {place} if says_something(file) else set()
            left |= run_time_imports(file, known) - seen
            seen |= left
    return files


@pytest.mark.parametrize("name", FRAME_STAGES)
def test_the_source_in_the_key_is_all_that_a_stage_imports(name: str) -> None:
    stage = FRAME_STAGES[name]
    imported = import_closure(stage.__module__)
    assert {file for file in imported if not any(Path(file).is_relative_to(place) for place in stage.code)} == set()
    # And nothing is named that is not there or that no work can reach.
    reached = {place: any(Path(file).is_relative_to(place) for file in imported) for place in stage.code}
    assert {place for place, used in reached.items() if not used} == set()


def test_what_is_in_no_key_exists_and_has_a_reason() -> None:
    assert all((ROOT / place).is_file() and reason for place, reason in NOT_IN_KEYS.items())
