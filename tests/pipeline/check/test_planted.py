"""Faults that used to get another's name, and the table of all planted ones in the docs."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.doctor_faults import BEGIN, END, PLANTED, examine

ROOT = Path(__file__).resolve().parents[3]
ONCE_MISTAKEN = (
    "cloud of one point",
    "cloud with its origin on the ground",
    "zero returns between the others",
    "image of half the size",
    "class 'dontcare'",
    "locations in the LiDAR frame",
    "camera turned by 180 degrees",
)


@pytest.mark.real_data
@pytest.mark.parametrize("what", ONCE_MISTAKEN)
def test_a_planted_fault_gets_its_own_name_and_no_other(kitti_object: Path, what: str) -> None:
    ((name, plant),) = [(name, plant) for described, name, plant in PLANTED if described == what]
    assert examine(kitti_object, plant) == (name,)


def test_the_page_has_the_table_of_every_planted_fault() -> None:
    page = (ROOT / "docs" / "doctor.md").read_text(encoding="utf-8")
    table = page.partition(BEGIN)[2].partition(END)[0]
    assert len(PLANTED) >= 60
    for what, name, _ in PLANTED:
        assert f"| {what} | `{name}` |  |" in table
    assert f"{len(PLANTED)} of {len(PLANTED)} planted faults" in table
