"""Short drives: one street, one rig, several moments."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from pipeline.geometry.calibration import Calibration
from pipeline.simulation.rig import draw_rig
from pipeline.simulation.scenes.layouts import draw_scene
from pipeline.simulation.scenes.scene import Scene
from pipeline.simulation.synth import SyntheticFrame, SynthSettings, frame_rng, observe

FRAME_PERIOD = 0.1
# The built part of a street ends 150 m ahead: a drive stays well before it.
MAX_TRAVEL = 45.0
# Frame numbers of one sequence lie below this, so that no two sequences share a seed.
SEQUENCE_STRIDE = 10_000


def drive_scene(settings: SynthSettings, sequence: int) -> Scene:
    """The street of a sequence, with the recording car at a town's speed at most."""
    scene = draw_scene(frame_rng(settings, sequence, 4), settings.streets)
    return replace(scene, ego=replace(scene.ego, speed=min(scene.ego.speed, 12.0)))


def sequence_rig(settings: SynthSettings) -> tuple[Calibration, tuple[int, int]]:
    """Calibration and (height, width), one for all sequences of a data set, as one recording day has one."""
    return draw_rig(frame_rng(settings, 0, 5), settings.size)


def simulate_sequence(settings: SynthSettings, sequence: int, length: int) -> Iterator[SyntheticFrame]:
    """`length` frames of a drive at 10 Hz, one at a time; a very long drive is recorded at a higher rate.

    Always stereo. Ids count from 0 within the sequence.
    """
    scene = drive_scene(settings, sequence)
    calibration, size = sequence_rig(settings)
    period = min(FRAME_PERIOD, MAX_TRAVEL / max(scene.ego.speed, 0.1) / max(length, 1))
    both = replace(settings, stereo=True)
    for number in range(length):
        frame = observe(scene, number * period, calibration, size, both, (sequence + 1) * SEQUENCE_STRIDE + number)
        yield replace(frame, id=f"{number:010d}")
