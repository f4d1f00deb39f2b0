"""Short runs of every fuzzing target, and the inputs that were found once. Long runs: `python -m tests.fuzz`."""

from __future__ import annotations

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.fuzz.targets import TARGETS, card_with, try_file

EXAMPLES = 60
# Long enough for a busy machine; a reader that hangs or takes gigabytes is over it.
DEADLINE_MS = 5000


@pytest.mark.parametrize("name", TARGETS)
def test_a_damaged_file_is_taken_or_refused_and_nothing_else(name: str) -> None:
    @settings(
        max_examples=EXAMPLES,
        deadline=DEADLINE_MS,
        database=None,
        derandomize=True,
        suppress_health_check=list(HealthCheck),
    )
    @given(st.data())
    def tried(data: st.DataObject) -> None:
        try_file(name, data.draw(TARGETS[name].files()))

    try_file(name, b"")  # starts the process of a reader that has one, and imports what it needs
    tried()


@pytest.mark.parametrize(
    ("place", "value"),
    [(("sha256",), None), (("training",), 3), (("model", "arguments"), None), (("model", "arguments", "width"), 10**6)],
)
def test_cards_that_were_found_once(place: tuple[str, ...], value: object) -> None:
    assert not try_file("checkpoint", card_with(place, value))


@pytest.mark.parametrize(
    ("name", "data"),
    [
        ("torch_pickle", b"\x80\x02X\x00"),
        ("ply", b"ply\nformat\nelement vertex 1\nproperty float x\nend_header\n"),
        ("ply", b"ply\nformat ascii 1.0\nelement vertex many\nproperty float x\nend_header\n"),
        ("ply", b"ply\nformat binary_little_endian 1.0\nelement vertex -1\nproperty float x\nend_header\n1234"),
        ("pcd", b"FIELDS x y z\nSIZE 3 3 3\nTYPE F F F\nPOINTS 1\nDATA binary\n123456789"),
        ("pcd", b"FIELDS x y z\nSIZE 4\nTYPE F\nPOINTS 1\nDATA binary\n123456789012"),
    ],
)
def test_headers_that_were_found_once(name: str, data: bytes) -> None:
    assert not try_file(name, data)
