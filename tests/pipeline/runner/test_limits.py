"""What one frame may take: large files and frames are refused, the others go on; a cloud is not copied to be read."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from pipeline.cli import main
from pipeline.runner.limits import bounded_memory, is_out_of_memory
from tests.pipeline.runner.test_faults import cheap_run
from tests.pipeline.test_cli import ROOT

LINUX = pytest.mark.skipif(sys.platform != "linux", reason="RLIMIT_DATA counts memory on Linux only")


def test_a_frame_with_a_file_beyond_the_limit_is_refused_and_the_others_are_done(tmp_path: Path) -> None:
    command = [*cheap_run(tmp_path, 2), "--out", str(tmp_path / "run")]
    image = tmp_path / "kitti" / "training" / "calib" / "000001.txt"
    image.write_bytes(image.read_bytes() + b"\n" * 40_000)
    assert main([*command, "--set", "limits.file_mb=0.03"]) == 1
    (failure,) = json.loads((tmp_path / "run" / "failures.json").read_text())["failures"]
    assert (failure["frame"], failure["kind"]) == ("000001", "data")
    assert failure["expected"] == "a file of at most 0.03 MB (limits.file_mb)"
    assert main(command) == 0


@LINUX
def test_a_frame_that_takes_more_memory_than_allowed_is_refused(tmp_path: Path) -> None:
    command = [*cheap_run(tmp_path, 2), "--out", str(tmp_path / "run")]
    cloud = tmp_path / "kitti" / "training" / "velodyne" / "000001.bin"
    cloud.write_bytes(cloud.read_bytes() * 8000)  # 184 MB
    command = [word.replace("augment.preset=D", "augment.preset=L_D_F") for word in command]
    command += ["--set", "limits.memory_gb=0.1"]
    assert main(command) == 1
    (failure,) = json.loads((tmp_path / "run" / "failures.json").read_text())["failures"]
    assert (failure["frame"], failure["kind"]) == ("000001", "data")
    assert failure["found"] == "it takes more memory than there is"


@LINUX
def test_the_bound_ends_with_the_block() -> None:
    with bounded_memory(0.05):
        np.ones(1_000_000)
        with pytest.raises(MemoryError):
            np.ones(20_000_000)
    assert np.ones(20_000_000).sum() == 20_000_000


def test_what_libraries_say_is_told_from_other_faults() -> None:
    assert is_out_of_memory(RuntimeError("[enforce fail] DefaultCPUAllocator: not enough memory: you tried ..."))
    assert not is_out_of_memory(RuntimeError("shapes do not fit"))


PEAK = """
import resource, sys
from pathlib import Path
import numpy as np
from pipeline.data.cloud_files import read_points
from pipeline.data.images import read_image
from pipeline.geometry.project import project_points
from tests.pipeline.tiny_kitti import CALIBRATION

def peak():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024

project_points(np.ones((2, 4), np.float32), CALIBRATION, (40, 60))
before = peak()
points = read_points(Path(sys.argv[1]))
project_points(points, CALIBRATION, (40, 60))
print((peak() - before) / points.nbytes)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="ru_maxrss")
@pytest.mark.parametrize(("suffix", "most"), [(".bin", 1.6), (".ply", 2.6), (".pcd", 2.6)])
def test_a_cloud_is_read_and_projected_without_a_second_copy(tmp_path: Path, suffix: str, most: float) -> None:
    from pipeline.data.cloud_files import Cloud, pcd_bytes, ply_bytes

    values = np.random.default_rng(1).uniform(1, 50, (4_000_000, 4)).astype(np.float32)
    cloud = Cloud(values, ("x", "y", "z", "intensity"))
    path = tmp_path / f"cloud{suffix}"
    path.write_bytes({".bin": lambda c: values.tobytes(), ".ply": ply_bytes, ".pcd": pcd_bytes}[suffix](cloud))
    done = subprocess.run(
        [sys.executable, "-c", PEAK, str(path)], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert float(done.stdout) < most, done.stdout
