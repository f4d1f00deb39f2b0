"""What answers at once: neither PyTorch nor Open3D is imported before something needs them."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

from detection.kitti_format import format_line
from tests.pipeline.tiny_kitti import tiny_frame, write_tiny_kitti

ROOT = Path(__file__).resolve().parents[2]
PROGRAM = """
import contextlib, io, json, sys
from pipeline.cli import main
seen = {}
for command in json.loads(sys.argv[1]):
    with contextlib.redirect_stdout(io.StringIO()) as shown:
        try:
            code = main(command.split())
        except SystemExit as end:
            code = end.code
    seen[command] = [code, bool(shown.getvalue()), sorted({"torch", "open3d", "onnxruntime"} & set(sys.modules))]
print(json.dumps(seen))
"""


def test_no_heavy_library_before_it_is_needed(tmp_path: Path) -> None:
    write_tiny_kitti(tmp_path / "KITTI", 1)
    (tmp_path / "RESULTS").mkdir()
    car = format_line(tiny_frame(0).labels[0])
    (tmp_path / "RESULTS" / "000000.txt").write_text(f"{car} 0.9\n")
    commands = [
        "--help",
        "--stage evaluate --labels KITTI/training/label_2 --detections RESULTS",
        "--stage check KITTI --workers 1",
        "--stage env",
        "--stage env --json",
        "--stage experiment --list",
        "--config configs/kitti.yaml --data KITTI --stage detect --dry-run",
    ]
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, json.dumps(commands)],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT), "NUMBA_DISABLE_JIT": "1"},
        capture_output=True,
        text=True,
        check=True,
    )
    for command, (code, shown, heavy) in json.loads(done.stdout).items():
        assert code == 0 or (code == 1 and "check" in command), f"{command}: {code}"
        assert shown, command
        assert heavy == [], f"{command} imports {heavy}"
