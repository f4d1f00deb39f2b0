"""YAML files: plain values once per key, or one line that names file and place."""

from __future__ import annotations

from pathlib import Path

import pytest

from pipeline.base.errors import UsageError
from pipeline.base.yaml_files import MAX_BYTES, parse_yaml, read_yaml


def bomb(levels: int, width: int) -> str:
    """Aliases of aliases: width ** levels values from a few hundred characters."""
    lines = [f"l0: &l0 [{', '.join('x' * width)}]"]
    lines += [f"l{n}: &l{n} [{', '.join([f'*l{n - 1}'] * width)}]" for n in range(1, levels)]
    return "\n".join(lines) + "\n"


def test_plain_values_anchors_and_merges_are_read(tmp_path: Path) -> None:
    path = tmp_path / "a.yaml"
    path.write_text("a: &d {x: 1, y: [2, 0.5, null, true]}\nb: {<<: *d, x: -3}\nc: 0x10\n")
    base = {"x": 1, "y": [2, 0.5, None, True]}
    assert read_yaml(path) == {"a": base, "b": {**base, "x": -3}, "c": 16}
    path.write_text("# nothing\n")
    assert read_yaml(path) == {}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("seed: 1\ndata:\n  name: a\n  root: b\n  name: c\n", "f.yaml: key 'name' stands twice, in line 3 and line 5"),
        ("seed: 1\nseed: 1\n", "f.yaml: key 'seed' stands twice, in line 1 and line 2"),
        ("a: {x: 1, y: 2, x: 3}", "f.yaml: key 'x' stands twice, in line 1 and line 1"),
        ("a: &d {x: 1}\nb:\n  <<: *d\n  <<: *d\n", "f.yaml: key '<<' stands twice, in line 3 and line 4"),
        ("a: 1\n2: 3\n", "f.yaml: line 2: expected a name as key, got 2"),
        ("a: 1\nb: " + "9" * 5000, "f.yaml: line 2: a whole number of 5000 digits"),
        ("a: [1, 9223372036854775808]", "f.yaml: line 1: the number 9223372036854775808 is too large"),
        ("a: 0xfffffffffffffffff", "f.yaml: line 1: the number 295147905179352825855 is too large"),
        (bomb(12, 9), "f.yaml: line 5: more than 20000 values with aliases written out"),
        ("a: &a [1, *a]", "f.yaml: line 1: an alias stands inside what it names"),
        ("[" * 5000, "f.yaml: not valid YAML: maximum recursion depth"),
        ("a: 2001-99-99", "f.yaml: not valid YAML: month must be"),
        ("a: \x00", "f.yaml: not valid YAML: unacceptable character"),
        ("a: !!python/object/apply:os.system [x]", "f.yaml: not valid YAML: could not determine a constructor"),
    ],
)
def test_what_no_configuration_needs_is_refused_in_one_line(text: str, message: str) -> None:
    with pytest.raises(UsageError) as refused:
        parse_yaml(text, "f.yaml")
    assert str(refused.value).startswith(message)
    assert "\n" not in str(refused.value)


def test_large_files_and_other_bytes_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.yaml"
    path.write_bytes(b"a: \xff\n")
    with pytest.raises(UsageError, match=r"a\.yaml: not valid YAML: .*0xff"):
        read_yaml(path)
    path.write_text("#" * (MAX_BYTES + 1))
    with pytest.raises(UsageError, match=r"a\.yaml: expected a configuration file, got 1\.0 MB"):
        read_yaml(path)
    with pytest.raises(UsageError, match="cannot be read: No such file"):
        read_yaml(tmp_path / "none.yaml")
