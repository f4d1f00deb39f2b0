"""A run as an .rrd recording for Rerun (https://rerun.io; extra `viewer`)."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from auglidar_base.atomic import replacing
from pipeline.base.errors import UsageError
from pipeline.report.recordings.scene import BOX_COLOURS, Scene

APPLICATION = "auglidar"


def write_rrd(path: Path, scenes: Iterable[Scene], name: str) -> Path:
    """Writes the recording: world/cloud, world/truth, world/found, camera/image, camera/depth, camera/sigma.

    name  what the viewer calls the recording. Raises UsageError when rerun-sdk is not installed.
    """
    try:
        import rerun as rr
    except ImportError:
        raise UsageError("report.format rrd needs rerun-sdk: pip install 'auglidar[viewer]'") from None
    # The same run gives the same recording id, so that a newer file replaces the older one in the viewer.
    with replacing(path) as temporary, rr.RecordingStream(APPLICATION, recording_id=name) as recording:
        recording.save(temporary)
        recording.log("world", rr.ViewCoordinates.FLU, static=True)
        for index, scene in enumerate(scenes):
            recording.set_time("frame", sequence=index)
            recording.set_time("time", duration=scene.time)
            _log(recording, scene)
        recording.flush()
        recording.disconnect()
    return path


def _log(recording: object, scene: Scene) -> None:
    import rerun as rr

    log = recording.log  # type: ignore[attr-defined]
    log("world/cloud", rr.Points3D(scene.cloud[:, :3], colors=scene.colours, radii=0.03))
    for kind, boxes in scene.boxes.items():
        log(
            f"world/{kind}",
            rr.Boxes3D(
                centers=[box.centre for box in boxes],
                sizes=[box.size for box in boxes],
                quaternions=[rr.Quaternion(xyzw=box.quaternion) for box in boxes],
                labels=[box.text for box in boxes],
                colors=[BOX_COLOURS[kind]] * len(boxes),
            ),
        )
    for name, image in scene.images.items():
        log(f"camera/{name}", rr.Image(image).compress(jpeg_quality=85))
    log("id", rr.TextLog(scene.id))
