"""The files of a run: `RunFolder` is the only place that knows their names."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from pipeline.base.errors import UsageError


def safe_id(frame_id: str) -> str:
    """`frame_id` when it is usable as a relative path below a folder of the run; it may hold "/" (Virtual KITTI 2).

    Raises UsageError for an absolute path, "..", a backslash or a control character: an id from a data set must not
    lead out of the run's folder.
    """
    parts = PurePosixPath(frame_id).parts
    unsafe = not parts or frame_id.startswith("/") or ".." in parts or "\\" in frame_id or not frame_id.isprintable()
    if unsafe or frame_id != "/".join(parts):
        raise UsageError(f"frame id {frame_id!r} cannot be used as a file name")
    return frame_id


@dataclass(frozen=True)
class RunFolder:
    """Names of the files of a run (docs/architecture.md lists the formats)."""

    root: Path

    def output(self, name: str, frame_id: str) -> Path:
        """A file of a frame by the name of its method: depth, twin, cloud, cloud_columns, counts, detections."""
        path: Path = getattr(self, name)(frame_id)
        return path

    def depth(self, frame_id: str) -> Path:
        """Completed depth: uint16 PNG, metres x 256."""
        return self.root / "depth" / f"{safe_id(frame_id)}.png"

    def twin(self, frame_id: str) -> Path:
        """Two surfaces: npz of foreground, background (uint16, metres x 256) and sigma (uint8, x 255)."""
        return self.root / "twin" / f"{safe_id(frame_id)}.npz"

    def cloud(self, frame_id: str) -> Path:
        """Augmented LiDAR: float32 N x 5, x y z intensity source."""
        return self.root / "cloud" / f"{safe_id(frame_id)}.bin"

    def cloud_columns(self, frame_id: str) -> Path:
        """Further per-point columns of the augmented cloud (npz), when the preset asks for some."""
        return self.root / "cloud" / f"{safe_id(frame_id)}.columns.npz"

    def counts(self, frame_id: str) -> Path:
        """Points before and after every step of the augmentation (JSON)."""
        return self.root / "cloud" / f"{safe_id(frame_id)}.json"

    def detections(self, frame_id: str) -> Path:
        """KITTI result lines."""
        return self.root / "detections" / f"{safe_id(frame_id)}.txt"

    @property
    def config(self) -> Path:
        """Resolved configuration with versions."""
        return self.root / "config.yaml"

    @property
    def metrics(self) -> Path:
        """AP and depth errors (JSON)."""
        return self.root / "metrics.json"

    @property
    def tables(self) -> Path:
        """The same as Markdown tables."""
        return self.root / "tables.md"

    @property
    def report(self) -> Path:
        """The report, one self-contained page."""
        return self.root / "report" / "index.html"

    @property
    def failures(self) -> Path:
        """Frames that could not be processed (JSON); absent when there are none."""
        return self.root / "failures.json"

    @property
    def weights(self) -> Path:
        """Networks trained by this run."""
        return self.root / "weights"

    def ledger(self, shard: tuple[int, int] | None = None) -> Path:
        """The ledger this process writes: one file per shard (i, n)."""
        return self.root / ("ledger.sqlite" if shard is None else f"ledger-{shard[0]}-of-{shard[1]}.sqlite")

    def ledgers(self) -> list[Path]:
        """All ledgers of the run, whoever wrote them."""
        return sorted(self.root.glob("ledger*.sqlite"))
