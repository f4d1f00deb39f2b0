"""KITTI lines as text: golden strings, round trips, and the name of what is wrong."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from detection.kitti_format import KittiObject, boxes_of, format_line, parse_line, parse_lines

LABEL = "Car 0.88 3 -0.69 0.00 192.37 402.31 374.00 1.60 1.57 3.23 -2.70 1.74 3.68 -1.29"
RESULT = (
    "Car -1 -1 -0.6900 0.0000 192.3700 402.3100 374.0000 1.6000 1.5700 3.2300 -2.7000 1.7400 3.6800 -1.2900 0.750000"
)


def test_a_label_line_by_hand() -> None:
    item = parse_line(LABEL, scored=False)
    assert (item.type, item.truncated, item.occluded, item.score) == ("Car", 0.88, 3, None)
    assert item.bbox == (0.0, 192.37, 402.31, 374.0)
    assert item.size == (1.6, 1.57, 3.23)
    assert item.location == (-2.7, 1.74, 3.68)
    assert item.height_2d == pytest.approx(181.63)
    assert format_line(item) == LABEL


def test_a_result_line_by_hand() -> None:
    assert format_line(parse_line(RESULT, scored=True)) == RESULT
    np.testing.assert_array_equal(boxes_of([parse_line(RESULT)]).values, [[-2.7, 1.74, 3.68, 1.6, 1.57, 3.23, -1.29]])


@pytest.mark.parametrize(
    ("line", "scored", "message"),
    [
        (LABEL, True, "expected 16 columns, got 15; a result line needs a score in column 16"),
        (LABEL.rsplit(" ", 1)[0], False, "expected 15 columns, got 14"),
        ("Car 0.0", None, "expected 15 or 16 columns, got 2"),
        (LABEL.replace("1.74", "high"), None, "column 'y' is not a number: 'high'"),
        (LABEL.replace("-1.29", "nan"), None, "column 'ry' is nan; expected a finite number"),
        (RESULT.replace("0.750000", "inf"), None, "column 'score' is inf"),
    ],
)
def test_the_wrong_column_is_named(line: str, scored: bool | None, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        parse_line(line, where="a.txt:1", scored=scored)


def test_the_line_number_is_named_and_blank_lines_are_skipped() -> None:
    assert len(parse_lines(f"\n{LABEL}\n\n{LABEL}\n")) == 2
    with pytest.raises(ValueError, match=r"000007\.txt:3: expected"):
        parse_lines(f"{LABEL}\n\nCar\n", where="000007.txt")


NUMBER = st.floats(-500, 500).map(lambda value: round(value, 2))


@given(st.tuples(*[NUMBER] * 12), st.sampled_from(["Car", "Pedestrian", "DontCare"]), st.integers(-1, 3))
def test_labels_of_two_decimals_survive(numbers: tuple[float, ...], kind: str, occluded: int) -> None:
    alpha, x1, y1, x2, y2, h, w, l, x, y, z, ry = numbers
    item = KittiObject(kind, 0.25, occluded, alpha, (x1, y1, x2, y2), (h, w, l), (x, y, z), ry)
    assert parse_line(format_line(item), scored=False) == item


@pytest.mark.real_data
def test_real_labels_are_written_as_they_were(kitti_object: Path) -> None:
    for path in sorted((kitti_object / "training" / "label_2").glob("*.txt")):
        lines = path.read_text().splitlines()
        # The devkit writes DontCare with whole numbers; every other line comes back letter for letter.
        solid = [line for line in lines if not line.startswith("DontCare")]
        assert [format_line(item) for item in parse_lines(path.read_text()) if item.type != "DontCare"] == solid
