"""Rotating multi-beam LiDAR: where its beams go and what comes back.

The HDL-64E has two blocks of 32 lasers (nominally +2 to -8.33 degrees in steps of 1/3 and -8.83 to -24.33 in steps of
1/2, Velodyne HDL-64E manual) and turns at 10 Hz with a firing every 0.17 degrees. Seen from the origin of KITTI's files
the rings of the object frames lie at +2.2 to -7.8 and -8.4 to -23.7 degrees (medians per ring), which is used
here. KITTI's files list ring after ring
from the top, each counter-clockwise from the forward direction, up to 80 m.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.simulation.tracing import Tracer

AZIMUTH_STEP = 0.17
MIN_RANGE, MAX_RANGE = 1.45, 80.0
# What the recording car hides from the HDL-64E, as measured in KITTI's object frames: (first and last azimuth, lowest
# and highest elevation), degrees, left of forward. The tail with the roof rack, a mast on the right, the bonnet, and
# the rack's corners. The image (within 41 degrees of forward, above -14) sees none of it.
KITTI_CAR = (
    (154.0, 202.0, -90.0, -18.1),
    (281.0, 300.0, -21.4, -16.1),
    (-10.0, 10.0, -90.0, -20.5),
    (10.0, 22.0, -90.0, -22.4),
    (128.0, 142.0, -90.0, -21.4),
    (226.0, 238.0, -90.0, -22.0),
)


@dataclass(frozen=True)
class Sensor:
    """Beam pattern and noise.

    elevations   (B,) degrees, top first
    azimuth_step degrees between firings
    range_noise  standard deviation of one range in metres; ring_bias: of the error a laser keeps for a whole scan
    loss         probability that a good pulse is lost
    hidden       sectors that the carrying car hides, as KITTI_CAR
    """

    elevations: NDArray[np.float64]
    azimuth_step: float = AZIMUTH_STEP
    range_noise: float = 0.016
    ring_bias: float = 0.012
    loss: float = 0.01
    hidden: tuple[tuple[float, float, float, float], ...] = ()


def _hdl64e() -> NDArray[np.float64]:
    nominal = np.concatenate([np.linspace(2.2, -7.78, 32), np.linspace(-8.38, -23.7, 32)])
    # Lasers sit up to a few hundredths of a degree off their nominal angle; the order never changes.
    return np.asarray(nominal + 0.05 * np.sin(2.39996 * np.arange(64)))


def sensor(rows: int) -> Sensor:
    """The sensor with 64 (HDL-64E), 32 (HDL-32E), 16 (VLP-16) or 8 rows. Raises ValueError for other counts."""
    patterns = {
        64: _hdl64e(),
        32: np.linspace(10.67, -30.67, 32),
        16: np.linspace(15.0, -15.0, 16),
        8: np.linspace(3.2, -19.2, 8),
    }
    if rows not in patterns:
        raise ValueError(f"rows: expected one of {sorted(patterns)}, got {rows}")
    return Sensor(patterns[rows], hidden=KITTI_CAR if rows == 64 else ())


def beam_directions(sensor: Sensor, rng: np.random.Generator) -> tuple[NDArray[np.float64], tuple[int, int]]:
    """((B*A, 3) unit directions in the LiDAR frame, (B, A)); rings start left of forward, each at its own phase."""
    count = int(360.0 / sensor.azimuth_step)
    rings = len(sensor.elevations)
    phase = rng.uniform(0.02, 0.98, rings) * sensor.azimuth_step
    azimuth = np.radians(phase[:, None] + np.arange(count) * sensor.azimuth_step)
    elevation = np.radians(sensor.elevations)[:, None]
    directions = np.stack(
        [
            np.cos(elevation) * np.cos(azimuth),
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation) * np.ones_like(azimuth),
        ],
        axis=-1,
    )
    return directions.reshape(-1, 3), (rings, count)


def scan(
    tracer: Tracer, sensor: Sensor, T_world_velo: NDArray[np.float64], rng: np.random.Generator
) -> NDArray[np.float32]:
    """(N, 4) float32 x y z intensity in the LiDAR frame, ring after ring from the top.

    Pulses pass through glass with its transmission, are lost by distance, incidence and material, mix at edges, and
    carry range noise.
    """
    directions, grid = beam_directions(sensor, rng)
    reach, reflectance, cosine, polished = _first_returns(
        tracer, directions @ T_world_velo[:3, :3].T, T_world_velo[:3, 3], rng
    )
    true_reach, reach = reach, _mixed(reach.reshape(grid), rng).ravel()
    returned = _detected(_power(true_reach, reflectance, cosine, polished), rng) & (
        rng.random(len(reach)) > sensor.loss
    )
    ring = np.repeat(np.arange(grid[0]), grid[1])
    reach = reach + rng.normal(0, sensor.ring_bias, grid[0])[ring] + rng.normal(0, sensor.range_noise, len(reach))
    returned &= np.isfinite(reach) & (reach > MIN_RANGE) & (reach < MAX_RANGE) & ~_hidden(directions, sensor)
    points = directions[returned] * reach[returned, None]
    echo = intensity(reflectance[returned], cosine[returned], reach[returned], rng)
    # KITTI's files hold millimetres and hundredths.
    return np.column_stack([np.round(points, 3), echo]).astype(np.float32)


def _hidden(directions: NDArray[np.float64], sensor: Sensor) -> NDArray[np.bool_]:
    """(N,) whether the carrying car is in the way of each of (N, 3) unit directions."""
    azimuth = np.degrees(np.arctan2(directions[:, 1], directions[:, 0]))
    elevation = np.degrees(np.arcsin(directions[:, 2]))
    hidden = np.zeros(len(directions), dtype=bool)
    for first, last, lowest, highest in sensor.hidden:
        hidden |= ((azimuth - first) % 360 <= last - first) & (elevation >= lowest) & (elevation <= highest)
    return hidden


def _first_returns(
    tracer: Tracer, rays: NDArray[np.float64], origin: NDArray[np.float64], rng: np.random.Generator
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
    """(range in metres or inf, reflectance, cosine of incidence, polished) per ray; up to four panes are passed."""
    table = tracer.table
    total = np.zeros(len(rays))
    reflectance, cosine = np.zeros(len(rays)), np.zeros(len(rays))
    active = np.arange(len(rays))
    through = np.ones(len(rays))
    reach = np.full(len(rays), np.inf)
    polished = np.zeros(len(rays), dtype=bool)
    for _ in range(5):
        start = origin + rays[active] * total[active, None]
        hits = tracer.cast(start, rays[active])
        hit = hits.primitive >= 0
        active, primitive, normal = active[hit], hits.primitive[hit], hits.normal[hit]
        total[active] += hits.reach[hit]
        surface = tracer.surface_of(primitive)
        angle = np.abs(np.einsum("ij,ij->i", normal, rays[active]))
        passed = rng.random(len(active)) < table.transmission[surface] * np.minimum(1.0, 2.0 * angle)
        stopped = active[~passed]
        reach[stopped] = total[stopped]
        reflectance[stopped] = table.reflectance[surface[~passed]] * through[stopped]
        cosine[stopped] = angle[~passed]
        polished[stopped] = table.gloss[surface[~passed]] > 0.15
        lost = stopped[rng.random(len(stopped)) < table.dropout[surface[~passed]]]
        reach[lost] = np.inf
        active = active[passed]
        through[active] *= 0.75
        total[active] += 2e-3
        if not len(active):
            break
    return reach, reflectance, cosine, polished


def _power(
    reach: NDArray[np.float64],
    reflectance: NDArray[np.float64],
    cosine: NDArray[np.float64],
    polished: NDArray[np.bool_],
) -> NDArray[np.float64]:
    """Received power relative to a 10 % target facing the sensor at 50 m (the HDL-64E's stated range for it).

    Polished paint falls faster than Lambert's cosine, as its mirror part is lost; rough ground returns far more at
    grazing angles
    (KITTI's roads answer beyond 50 m, at cosines of 0.03).
    """
    distance = np.where(np.isfinite(reach), np.maximum(reach, 1.0), np.inf)
    return np.asarray(reflectance * np.where(polished, 0.6 * cosine**1.3, cosine**0.3) / 0.1 * (50.0 / distance) ** 2)


def _detected(power: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.bool_]:
    """A pulse is detected with a probability that falls from 1 to 0 around relative power 0.35."""
    with np.errstate(divide="ignore"):
        chance = 1 / (1 + np.exp(-np.clip(3.0 * np.log(power / 0.35), -50, 50)))
    return np.asarray(rng.random(len(power)) < chance)


def _mixed(reach: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
    """Beams that touch two surfaces less than 4 m apart now and then report a range in between."""
    mixed = reach.copy()
    with np.errstate(invalid="ignore"):
        step = np.abs(reach - np.roll(reach, -1, axis=1))
    edge = np.isfinite(step) & (step > 0.4) & (step < 4.0) & (rng.random(reach.shape) < 0.08)
    share = rng.random(reach.shape)
    mixed[edge] = (share * reach + (1 - share) * np.roll(reach, -1, axis=1))[edge]
    return mixed


def intensity(
    reflectance: NDArray[np.float64], cosine: NDArray[np.float64], reach: NDArray[np.float64], rng: np.random.Generator
) -> NDArray[np.float64]:
    """KITTI-like intensity in [0, 0.99], steps of 0.01: reflectance falling weakly with angle and distance."""
    fall = cosine**0.15 * np.clip(1.15 - reach / 110.0, 0.3, 1.0)
    speckle = rng.normal(1.0, 0.14, len(reach))
    echo = np.round(np.clip(1.12 * reflectance * fall * speckle - 0.01, 0, 0.99), 2)
    # Dark things answer 0 in KITTI's files, and so do a few of all others.
    echo[(rng.random(len(reach)) < 0.05) | (echo < 0.05)] = 0.0
    return np.asarray(echo)
