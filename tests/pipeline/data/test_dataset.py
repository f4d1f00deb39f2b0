"""Dataset: order, look-up and selection."""

from __future__ import annotations

from pathlib import Path

import pytest

from pipeline.base.errors import DataError, UsageError
from pipeline.data.dataset import Dataset
from pipeline.data.frame import Frame


@pytest.fixture
def dataset() -> Dataset:
    return Dataset(("a/1", "a/2", "b/1", "b/2"), lambda frame_id: Frame(frame_id, {}), "test", "ROOT")


def test_frames_come_in_order(dataset: Dataset) -> None:
    assert [frame.id for frame in dataset] == list(dataset.ids)
    assert dataset["b/1"].id == "b/1"
    assert dataset[-1].id == "b/2"
    assert "a/2" in dataset
    assert len(dataset) == 4


@pytest.mark.parametrize(
    ("frames", "ids"),
    [
        ("1:3", ("a/2", "b/1")),
        (":1", ("a/1",)),
        ("-1:", ("b/2",)),
        (range(0, 4, 2), ("a/1", "b/1")),
        (slice(2, None), ("b/1", "b/2")),
        ("b/2,a/1", ("b/2", "a/1")),
        ("*/1", ("a/1", "b/1")),
        (["a/2"], ("a/2",)),
    ],
)
def test_selection(dataset: Dataset, frames: object, ids: tuple[str, ...]) -> None:
    assert dataset.select(frames).ids == ids  # type: ignore[arg-type]


def test_split_files(dataset: Dataset, tmp_path: Path) -> None:
    path = tmp_path / "val.txt"
    path.write_text("# validation\nb/2\n\na/1\n")
    assert dataset.select(path).ids == ("b/2", "a/1")
    assert dataset.select(str(path)).ids == ("b/2", "a/1")


def test_what_is_not_there_is_named(dataset: Dataset, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"1 of 2 frames .* c/9"):
        dataset.select("a/1,c/9")
    with pytest.raises(UsageError, match="split file not found"):
        dataset.select(tmp_path / "absent.txt")
    with pytest.raises(UsageError, match="position 4"):
        dataset.select(range(5))
    with pytest.raises(DataError, match=r"expected one of 4 frames .* got c/9"):
        _ = dataset["c/9"]
    with pytest.raises(DataError, match="repeated"):
        Dataset(("x", "x"), dataset.open)
