"""A submission for the KITTI object server: checked against its rules, then packed."""

from __future__ import annotations

import zipfile
from pathlib import Path

from auglidar_base.atomic import replacing
from detection.evaluation.objects import ALPHA, BBOX, SCORE
from detection.evaluation.protocol import KITTI_CLASSES
from detection.evaluation.reading import Problems, frame_names, read_table

TEST_FRAMES = 7518  # 000000 to 007517
_EVALUATED = ("car", "pedestrian", "cyclist")


def check_submission(folder: Path, frames: int = TEST_FRAMES, fill: bool = False) -> tuple[list[str], list[str]]:
    """What the server would refuse, and what it would take but the user may not want; one sentence each.

    frames  how many result files 000000.txt, 000001.txt, ... there must be
    fill    missing files are no error, as `write_archive` adds them empty
    """
    if not folder.is_dir():
        return [f"no such folder: {folder}"], []
    errors: list[str] = []
    expected = [f"{index:06d}" for index in range(frames)]
    present = set(frame_names(folder))
    missing = [name for name in expected if name not in present]
    unknown = sorted(present - set(expected))
    if missing and not fill:
        errors.append(
            f"{folder}: {len(missing)} of {frames} result files are missing, first {missing[0]}.txt; "
            "write an empty file where nothing was found, or let them be filled"
        )
    if unknown:
        errors.append(f"{folder}: {len(unknown)} files are not of the split, first {unknown[0]}.txt")
    problems = Problems(lenient=True)
    table = read_table(folder, [name for name in expected if name in present], scored=True, problems=problems)
    errors += [message for _, message in problems.found]
    warnings: list[str] = []
    names = {name.lower() for name in KITTI_CLASSES}
    strange = [name for name in table.types if name.lower() not in names]
    if strange:
        errors.append(f"{folder}: unknown type {strange[0]!r}; expected one of {', '.join(KITTI_CLASSES)}")
    if not any(name.lower() in _EVALUATED for name in table.types):
        errors.append(f"{folder}: no Car, Pedestrian or Cyclist is detected in any frame: nothing to evaluate")
    boxes = table.values[:, BBOX]
    for row in range(len(table)):
        x1, y1, x2, y2 = boxes[row]
        if x2 < x1 or y2 < y1:
            where = f"{table.frames[int(table.frame[row])]}.txt:{table.line[row]}"
            errors.append(f"{folder / where}: 2D box has x2 < x1 or y2 < y1: {x1:g} {y1:g} {x2:g} {y2:g}")
            break
    if len(table) and (table.values[:, ALPHA] == -10).any():
        count = int((table.values[:, ALPHA] == -10).sum())
        warnings.append(f"{count} detections have alpha -10: orientation (AOS) will not be evaluated for any class")
    if len(table) and (abs(table.height_2d) < 25).any():
        count = int((abs(table.height_2d) < 25).sum())
        warnings.append(f"{count} detections are lower than 25 px in the image and will be ignored in every metric")
    if len(table) > 1 and table.values[:, SCORE].min() == table.values[:, SCORE].max():
        warnings.append("all scores are equal: the precision-recall curve has a single point")
    return errors, warnings


def write_archive(folder: Path, archive: Path, frames: int = TEST_FRAMES) -> Path:
    """A zip with 000000.txt ... at its root (missing files empty); the same bytes for the same files.

    Appears by atomic rename. Check the folder with `check_submission` first.
    """
    with replacing(archive) as partial, zipfile.ZipFile(partial, "w", zipfile.ZIP_DEFLATED) as packed:
        for index in range(frames):
            path = folder / f"{index:06d}.txt"
            entry = zipfile.ZipInfo(path.name, date_time=(1980, 1, 1, 0, 0, 0))
            entry.compress_type = zipfile.ZIP_DEFLATED
            entry.external_attr = 0o644 << 16
            packed.writestr(entry, path.read_bytes() if path.exists() else b"")
    return archive
