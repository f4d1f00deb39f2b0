"""Figures for papers and recordings for viewers of a small run."""

from __future__ import annotations

import base64
import json
import re
import subprocess
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.base.paths import RunFolder
from pipeline.data import open_dataset
from pipeline.report import panels
from pipeline.report.figures import write_figures
from pipeline.report.matches import judge
from pipeline.report.recordings.scene import BOX_COLOURS, Scene, SceneBox, scenes
from pipeline.run_folder.config import load_config


def drawn(run: RunFolder, kind: str) -> list[Path]:
    config = load_config(run.config, [f"report.format={kind}"])
    dataset = open_dataset("kitti_object", str(config.data.root))
    return write_figures(config, run, dataset, dataset.ids, judge(config, run, dataset, dataset.ids))


@pytest.mark.slow
def test_figures_as_pdf_have_their_fonts(run: RunFolder) -> None:
    paths = drawn(run, "pdf")
    # No precision-recall curve: the cars are too small to count.
    assert [path.stem for path in paths] == ["completion", "sigma_filter", "sampling", "noise", "detections"]
    for path in paths:
        data = path.read_bytes()
        assert data.startswith(b"%PDF")
        assert b"/FontFile2" in data  # TrueType, embedded
        assert b"/Type3" not in data
        assert b"/CreationDate" not in data  # the same run gives the same bytes


def test_windows_lie_in_the_image(run: RunFolder) -> None:
    frame = open_dataset("kitti_object", run.root.parent / "kitti")[1]
    height, width = frame.image_size
    windows = panels.zoom_windows(frame, 2)
    assert len(windows) == 2
    for left, top, right, bottom in windows:
        assert 0 <= left < right <= width
        assert 0 <= top < bottom <= height


def test_the_same_place_is_drawn_at_the_same_place() -> None:
    place, depth = panels._seen_from(np.array([[10.0, 0, 0], [10.0, -3, 0]]), (10.0, 0.0, 0.0), 20.0)
    np.testing.assert_allclose(place[0], 0, atol=1e-12)
    np.testing.assert_allclose(depth, 20)
    assert place[1, 0] == pytest.approx(3 / 20)  # 3 m to the right at 20 m


@pytest.fixture
def recorded(run: RunFolder) -> list[Scene]:
    dataset = open_dataset("kitti_object", run.root.parent / "kitti")
    return list(scenes(run, dataset, dataset.ids))


def test_boxes_of_a_scene_are_in_the_lidar_frame(recorded: list[Scene]) -> None:
    # The car of tiny_kitti: bottom centre 8.5 m before the camera, 1.62 m below it, 1.5 m high, ry = 0: along -y.
    box = recorded[0].boxes["truth"][0]
    np.testing.assert_allclose(box.centre, (8.5 + 0.27, 0.0, -1.62 + 0.75 - 0.08), atol=1e-6)
    np.testing.assert_allclose(box.size, (1.6, 4.0, 1.5), atol=1e-6)
    assert np.sin(box.heading) == pytest.approx(-1)
    assert recorded[0].boxes["found"][0].text == "Car 1.00"
    assert SceneBox((0, 0, 0), (1, 1, 1), np.pi, "").quaternion == pytest.approx((0, 0, 1, 0))


def test_an_mcap_file_reads_back(recorded: list[Scene], tmp_path: Path) -> None:
    reading = pytest.importorskip("mcap.reader", reason="mcap (extra viewer) is not installed")
    from pipeline.report.recordings.mcap_file import TOPICS, write_mcap

    path = write_mcap(tmp_path / "run.mcap", recorded, "run")
    with open(path, "rb") as file:
        messages = list(reading.make_reader(file).iter_messages())
    counts = Counter(channel.topic for _, channel, _ in messages)
    assert counts == dict.fromkeys(TOPICS, 3)
    assert {channel.topic: schema.name for schema, channel, _ in messages} == TOPICS
    cloud = next(json.loads(message.data) for _, channel, message in messages if channel.topic == "/cloud")
    rows = np.frombuffer(base64.b64decode(cloud["data"]), np.uint8).reshape(-1, cloud["point_stride"])
    np.testing.assert_array_equal(np.ascontiguousarray(rows[:, :16]).view("<f4"), recorded[0].cloud[:, :4])
    np.testing.assert_array_equal(rows[:, 16:19], recorded[0].colours)
    assert [field["offset"] for field in cloud["fields"]] == [0, 4, 8, 12, 16, 17, 18, 19]
    schema = next(json.loads(schema.data) for schema, channel, _ in messages if channel.topic == "/cloud")
    assert schema["properties"]["data"]["contentEncoding"] == "base64"
    assert [message.log_time for _, channel, message in messages if channel.topic == "/cloud"] == [0, 10**8, 2 * 10**8]


def test_messages_are_foxgloves_own(recorded: list[Scene]) -> None:
    """Parsed by Foxglove's published definitions, which refuse a field they do not know."""
    pytest.importorskip("foxglove_schemas_protobuf", reason="foxglove-schemas-protobuf is not installed")
    from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
    from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
    from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
    from google.protobuf.json_format import ParseDict

    from pipeline.report.recordings.mcap_file import messages

    def spelled(value: Any) -> Any:
        """Times as protobuf's JSON has them."""
        if isinstance(value, list):
            return [spelled(item) for item in value]
        if not isinstance(value, dict):
            return value
        if set(value) == {"sec", "nsec"}:
            return f"1970-01-01T00:00:0{value['sec']}.{value['nsec']:09d}Z"
        lifetime = {"lifetime": f"{value['lifetime']['nsec'] / 1e9}s"} if "lifetime" in value else {}
        return {key: spelled(item) for key, item in value.items()} | lifetime

    parsed = {topic: spelled(message) for topic, message in messages(recorded[1])}
    cloud = ParseDict(parsed["/cloud"], PointCloud())
    assert cloud.timestamp.nanos == 10**8
    assert len(cloud.data) == cloud.point_stride * len(recorded[1].cloud)
    assert [field.name for field in cloud.fields][:4] == ["x", "y", "z", "intensity"]
    assert {field.type for field in cloud.fields} == {1, 7}  # UINT8 and FLOAT32 of PackedElementField
    (entity,) = ParseDict(parsed["/boxes/truth"], SceneUpdate()).entities
    assert len(entity.cubes) == len(entity.texts) == len(recorded[1].boxes["truth"])
    image = ParseDict(parsed["/camera/image"], CompressedImage())
    assert (image.format, image.data[:2]) == ("jpeg", b"\xff\xd8")


def test_messages_hold_the_fields_of_their_schemas(recorded: list[Scene]) -> None:
    from pipeline.report.recordings.mcap_file import TOPICS, messages
    from pipeline.report.recordings.schemas import SCHEMAS

    for topic, message in messages(recorded[0]):
        assert set(message) == set(SCHEMAS[TOPICS[topic]]["properties"])
    assert set(BOX_COLOURS) == {"truth", "found"}


def test_an_rrd_file_is_written(recorded: list[Scene], tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason="rerun-sdk (extra viewer) is not installed")
    from pipeline.report.recordings.rerun_file import write_rrd

    path = write_rrd(tmp_path / "run.rrd", recorded, "run")
    data = path.read_bytes()
    assert data[:4] == b"RRF2"
    assert re.search(rb"world/cloud|/world/cloud", data)
    assert [item.name for item in tmp_path.glob("*.rrd")] == ["run.rrd"]
    command = [sys.executable, "-m", "rerun", "rrd"]
    subprocess.run([*command, "verify", str(path)], capture_output=True, check=True, timeout=60)
    stats = subprocess.run([*command, "stats", str(path)], capture_output=True, text=True, check=True, timeout=60)
    for entity in ("world/cloud", "world/truth", "world/found", "camera/image", "camera/depth", "camera/sigma"):
        assert f"\n/{entity}: " in stats.stdout
