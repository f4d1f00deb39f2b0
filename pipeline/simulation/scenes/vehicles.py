"""Parametric vehicles: a lofted body with cabin, glass, wheels, lamps, plates and seats.

A body is a row of cross-sections along the length. Its roof line, belt line, plan taper and tumblehome come from a
`BodyShape`; the same loft makes a two-seater of 2.5 m and a delivery van. Sizes are drawn round each body's own mean so
that cars together have KITTI's means (h 1.53, w 1.63, l 3.88 m; Lang et al. 2019, Table of anchors).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pipeline.simulation.scenes import surfaces as S
from pipeline.simulation.scenes.mesh import Part, box, fitted, grid_faces, tube
from pipeline.simulation.scenes.surfaces import Surface, Texture


@dataclass(frozen=True)
class BodyShape:
    """Proportions of a vehicle: x as a share of the length from the nose, z as a share of the height.

    label         KITTI type
    length .. height   mean size in metres
    weight        how often it is drawn
    nose, cowl    height at the bonnet's front and at the foot of the windscreen
    x_cowl, x_roof, x_tail, x_deck   foot and top of the windscreen, end of the roof, foot of the rear screen
    deck          height at the foot of the rear screen
    belt          height of the window sill
    tumblehome    half width of the roof as a share of the body's
    windowed_to   share of the length up to which there are side windows
    """

    label: str
    length: float
    width: float
    height: float
    weight: float
    nose: float
    cowl: float
    x_cowl: float
    x_roof: float
    x_tail: float
    x_deck: float
    deck: float
    belt: float
    tumblehome: float
    windowed_to: float
    clearance: float = 0.12
    pillars: tuple[float, ...] = (0.52, 0.75)


BODIES: dict[str, BodyShape] = {
    "two_seater": BodyShape("Car", 2.60, 1.53, 1.54, 0.5,
        0.52, 0.62, 0.14, 0.36, 0.86, 0.97, 0.60, 0.60, 0.78, 0.80, pillars=(0.62,)),
    "city": BodyShape("Car", 3.45, 1.60, 1.49, 1.7,
        0.50, 0.63, 0.22, 0.42, 0.88, 0.98, 0.62, 0.61, 0.76, 0.93, pillars=(0.60,)),
    "hatchback_3": BodyShape("Car", 3.75, 1.63, 1.44, 2.0,
        0.49, 0.63, 0.27, 0.46, 0.86, 0.975, 0.63, 0.61, 0.74, 0.92, pillars=(0.62,)),
    "hatchback_5": BodyShape("Car", 4.02, 1.70, 1.48, 2.2,
        0.50, 0.63, 0.26, 0.45, 0.87, 0.975, 0.64, 0.62, 0.75, 0.94),
    "compact_mpv": BodyShape("Car", 4.10, 1.70, 1.62, 1.0,
        0.52, 0.64, 0.20, 0.40, 0.90, 0.985, 0.60, 0.59, 0.77, 0.95),
    "sedan": BodyShape("Car", 4.45, 1.73, 1.43, 1.3,
        0.49, 0.63, 0.29, 0.46, 0.72, 0.86, 0.66, 0.62, 0.73, 0.83, pillars=(0.54,)),
    "limousine": BodyShape("Car", 4.95, 1.86, 1.47, 0.5,
        0.50, 0.63, 0.30, 0.46, 0.72, 0.86, 0.65, 0.62, 0.73, 0.83, pillars=(0.54,)),
    "estate": BodyShape("Car", 4.50, 1.72, 1.47, 1.2,
        0.49, 0.62, 0.27, 0.43, 0.92, 0.985, 0.61, 0.61, 0.75, 0.96, pillars=(0.50, 0.71)),
    "suv": BodyShape("Car", 4.40, 1.80, 1.70, 0.9,
        0.55, 0.65, 0.25, 0.42, 0.90, 0.98, 0.63, 0.62, 0.78, 0.95, clearance=0.15),
    "off_roader": BodyShape("Car", 4.20, 1.78, 1.82, 0.4,
        0.56, 0.63, 0.30, 0.37, 0.965, 0.985, 0.61, 0.60, 0.88, 0.96, clearance=0.18),
    "coupe": BodyShape("Car", 4.25, 1.74, 1.36, 0.6,
        0.49, 0.63, 0.33, 0.50, 0.66, 0.90, 0.66, 0.63, 0.70, 0.80, pillars=(0.60,)),
    "roadster": BodyShape("Car", 3.95, 1.69, 1.28, 0.4,
        0.52, 0.66, 0.36, 0.50, 0.64, 0.78, 0.68, 0.65, 0.72, 0.72, pillars=()),
    "pick_up": BodyShape("Car", 5.10, 1.80, 1.74, 0.3,
        0.55, 0.63, 0.26, 0.38, 0.57, 0.61, 0.60, 0.60, 0.80, 0.60, clearance=0.17, pillars=(0.46,)),
    "compact_van": BodyShape("Van", 4.35, 1.84, 1.86, 0.45,
        0.47, 0.58, 0.20, 0.36, 0.96, 0.99, 0.55, 0.56, 0.84, 0.50, pillars=()),
    "minibus": BodyShape("Van", 4.90, 1.93, 1.98, 0.4,
        0.46, 0.56, 0.12, 0.27, 0.965, 0.99, 0.54, 0.54, 0.85, 0.96, pillars=(0.38, 0.66)),
    "panel_van": BodyShape("Van", 5.50, 2.02, 2.40, 0.35,
        0.40, 0.50, 0.12, 0.26, 0.975, 0.995, 0.48, 0.48, 0.88, 0.36, pillars=()),
}  # fmt: skip

# Linear albedo of paints and how often they are seen on KITTI's streets.
_PAINTS: tuple[tuple[S.Colour, float, float], ...] = (
    ((0.012, 0.012, 0.014), 0.22, 0.028),  # black
    ((0.33, 0.34, 0.35), 0.22, 0.30),  # silver
    ((0.11, 0.115, 0.12), 0.13, 0.10),  # grey
    ((0.66, 0.66, 0.65), 0.14, 0.62),  # white
    ((0.022, 0.045, 0.14), 0.10, 0.08),  # dark blue
    ((0.05, 0.13, 0.33), 0.04, 0.25),  # light blue
    ((0.32, 0.018, 0.016), 0.08, 0.42),  # red
    ((0.016, 0.06, 0.035), 0.03, 0.12),  # green
    ((0.33, 0.26, 0.15), 0.02, 0.42),  # beige
    ((0.48, 0.30, 0.02), 0.02, 0.5),  # yellow
)


def paint(rng: np.random.Generator) -> Surface:
    """A car paint in a common colour."""
    chances = np.array([chance for _, chance, _ in _PAINTS])
    colour, _, reflectance = _PAINTS[rng.choice(len(_PAINTS), p=chances / chances.sum())]
    gloss = float(rng.uniform(0.25, 0.55))
    return Surface(Texture.PAINT, S.vary(rng, colour, 0.2), S.CAR, reflectance, dropout=0.07, gloss=gloss, smooth=True)


def _stations(shape: BodyShape) -> NDArray[np.float64]:
    """Places of the cross-sections along the length, dense where the outline bends and at the door pillars."""
    roof = np.linspace(shape.x_roof, shape.x_tail, 5)[1:-1]
    bonnet = np.linspace(0.05, shape.x_cowl, 4)[:-1]
    pillars = [p + side for p in shape.pillars for side in (-0.011, 0.011)]
    screens = [shape.x_cowl, shape.x_cowl * 0.5 + shape.x_roof * 0.5, shape.x_roof, shape.x_tail]
    screens += [0.5 * (shape.x_tail + shape.x_deck), shape.x_deck, shape.windowed_to]
    places = np.array([0, 0.012, *bonnet, *screens, *roof, *pillars, 0.955, 0.988, 1.0])
    return np.unique(np.round(places[(places >= 0) & (places <= 1)], 4))


def _roof_line(shape: BodyShape, x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Height of the outline's top at each station."""
    middle = 0.5 * (shape.x_roof + shape.x_tail)
    knots = [0.0, 0.012, 0.06, shape.x_cowl, shape.x_roof, middle, shape.x_tail, shape.x_deck, 0.99, 1.0]
    heights = [shape.nose - 0.10, shape.nose - 0.03, shape.nose, shape.cowl, 0.965, 1.0, 0.965, shape.deck]
    heights += [min(shape.deck, shape.deck - 0.02), shape.deck - 0.10]
    order = np.argsort(knots, kind="stable")
    return np.interp(x, np.array(knots)[order], np.array(heights)[order])


def _sections(shape: BodyShape, x: NDArray[np.float64]) -> NDArray[np.float64]:
    """(stations, 17, 3) vertices in units of length, width and height; y from right over the roof to left."""
    top = _roof_line(shape, x)
    plan = np.interp(x, [0, 0.03, 0.14, 0.85, 0.97, 1], [0.74, 0.88, 1.0, 1.0, 0.92, 0.82])
    ground = np.interp(x, [0, 0.10, 0.9, 1], [1.5, 1.0, 1.0, 1.7]) * shape.clearance
    shoulder = np.minimum(shape.belt, top - 0.03)
    above = np.maximum(top - shoulder, 0.0)
    lean = (1 - shape.tumblehome) / (1 - shape.belt)

    def half(rise: NDArray[np.float64]) -> NDArray[np.float64]:
        return 0.96 - lean * rise

    side = [
        (np.zeros_like(x), ground),
        (np.full_like(x, 0.88), ground),
        (np.full_like(x, 0.985), ground + 0.3 * (shoulder - ground)),
        (np.ones_like(x), ground + 0.68 * (shoulder - ground)),
        (np.full_like(x, 0.96), shoulder),
        (half(0.10 * above), shoulder + 0.10 * above),
        (half(0.84 * above), shoulder + 0.84 * above),
        (half(0.96 * above) - 0.05, shoulder + 0.965 * above),
        (np.zeros_like(x), top),
    ]
    right = np.stack([np.stack([0.5 - x, -0.5 * plan * y, z], -1) for y, z in side], axis=1)
    left = right[:, -2::-1] * np.array([1, -1, 1])
    return np.concatenate([right, left], axis=1)


def _material_of(shape: BodyShape, x: NDArray[np.float64], body: Surface) -> list[list[Surface]]:
    """Surface of each loft cell: glass for screens and side windows, dark plastic below, paint elsewhere."""
    cabin = (_roof_line(shape, x) - shape.belt) / (1 - shape.belt)
    rows: list[list[Surface]] = []
    for i in range(len(x) - 1):
        middle = 0.5 * (x[i] + x[i + 1])
        windscreen = shape.x_cowl <= middle <= shape.x_roof
        rear_screen = (
            shape.x_tail <= middle <= shape.x_deck and shape.x_deck - shape.x_tail > 0.008 and shape.windowed_to > 0.55
        )
        pillar = any(abs(middle - p) < 0.012 for p in shape.pillars)
        side = min(cabin[i], cabin[i + 1]) > 0.25 and middle < shape.windowed_to and not pillar
        cells = [S.PLASTIC_DARK, body, body, body, body]
        cells.append(S.GLASS_CAR if side and middle > shape.x_cowl + 0.35 * (shape.x_roof - shape.x_cowl) else body)
        cells.append(body)
        cells.append(S.GLASS_CAR if windscreen or rear_screen else body)
        rows.append(cells + cells[::-1])
    return rows


def _loft(shape: BodyShape, body: Surface) -> list[Part]:
    """The painted shell and its glass, in units of length, width, height."""
    x = _stations(shape)
    vertices = _sections(shape, x)
    rows, columns = vertices.shape[:2]
    flat = vertices.reshape(-1, 3)
    faces = grid_faces(rows, columns).reshape(-1, 2, 3)
    material = [cell for row in _material_of(shape, x, body) for cell in row]
    parts = []
    for surface in {id(cell): cell for cell in material}.values():
        chosen = np.array([cell is surface for cell in material])
        parts.append(Part(flat, faces[chosen].reshape(-1, 3), surface))
    for end in (0, rows - 1):
        ring = np.arange(columns) + end * columns
        fan = [[ring[0], ring[k], ring[k + 1]] for k in range(1, columns - 1)]
        parts.append(Part(flat, np.array(fan), replace(body, smooth=False)))
    return parts


def _wheels(length: float, width: float, radius: float, axles: tuple[float, ...]) -> list[Part]:
    """Tyres, rims and dark wheel arches at the given axle positions (share of the length from the nose)."""
    parts = []
    for axle in axles:
        for side in (-1, 1):
            x, inner, outer = length * (0.5 - axle), side * (0.5 * width - 0.23), side * (0.5 * width - 0.008)
            for depth, size, surface in ((0.0, 1.0, S.TYRE), (0.004, 0.64, S.RIM)):
                path = np.array([[x, inner, radius], [x, outer + side * depth, radius]])
                parts.append(tube(path, np.full(2, radius * size), 14, surface))
            arch = np.array([[x, inner, radius * 1.06], [x, outer - side * 0.014, radius * 1.06]])
            parts.append(tube(arch, np.full(2, radius * 1.16), 14, S.PLASTIC_DARK))
    return parts


def _details(shape: BodyShape, length: float, width: float, height: float) -> list[Part]:
    """Lamps, plates, grille, screens' neighbours and seats."""
    front, rear = 0.5 * length, -0.5 * length
    lamp_z, tail_z = height * (shape.nose - 0.09), height * (shape.deck - 0.14)
    parts = [box(0.02, 0.40 * width, 0.10 * height, S.PLASTIC_DARK, height * 0.22).at(front - 0.002, 0)]
    parts += [box(0.02, 0.34 * width, 0.05 * height, S.PLASTIC_DARK, lamp_z - 0.01).at(front - 0.004, 0)]
    parts += [box(0.02, 0.46, 0.10, S.PLATE, height * 0.27).at(front + 0.006, 0)]
    parts += [box(0.02, 0.46, 0.10, S.PLATE, height * 0.42).at(rear - 0.006, 0)]
    parts += [box(0.03, 0.70 * width, 0.07 * height, S.PLASTIC_DARK, height * 0.22).at(rear, 0)]
    for side in (-1, 1):
        parts.append(
            box(0.12, 0.17 * width, 0.085 * height, S.HEADLAMP, lamp_z).at(
                front - 0.07, side * 0.325 * width, 0, -side * 0.25
            )
        )
        parts.append(
            box(0.10, 0.10 * width, 0.13 * height, S.TAIL_LAMP, tail_z).at(
                rear + 0.046, side * 0.36 * width, 0, side * 0.1
            )
        )
    cabin = shape.x_tail - shape.x_cowl
    for row in (0.32, 0.68) if length > 3 else (0.45,):
        x = length * (0.5 - shape.x_cowl - row * cabin) - 0.15
        for side in (-1, 1):
            parts.append(box(0.18, 0.30 * width, 0.50 * height, S.INTERIOR, 0.32 * height).at(x, side * 0.21 * width))
    parts.append(
        box(0.92 * cabin * length, 0.8 * width, 0.02, S.INTERIOR, 0.38 * height).at(
            length * (0.5 - shape.x_cowl - 0.5 * cabin), 0
        )
    )
    return parts


# KITTI's annotators drew boxes round the returns: shorter and narrower than data sheets, a little higher.
_ANNOTATED = (0.955, 0.96, 1.025)


@dataclass(frozen=True)
class Model:
    """A thing with a label: parts in the local frame and the exact (length, width, height) they fill, metres.

    label  KITTI type, or "" for things KITTI does not label
    """

    label: str
    parts: list[Part]
    size: tuple[float, float, float]


def build_vehicle(name: str, rng: np.random.Generator) -> Model:
    """A vehicle of BODIES[name] with its own size, colour and wheels."""
    shape = BODIES[name]
    scale = rng.normal(1.0, 0.035)
    length = _ANNOTATED[0] * shape.length * float(np.clip(scale, 0.9, 1.1))
    width = _ANNOTATED[1] * shape.width * float(np.clip(rng.normal(1.0, 0.025) + 0.3 * (scale - 1), 0.92, 1.08))
    height = _ANNOTATED[2] * shape.height * float(np.clip(rng.normal(1.0, 0.03), 0.92, 1.08))
    jitter = {
        field: getattr(shape, field) + rng.normal(0, 0.008) for field in ("nose", "cowl", "x_cowl", "belt", "deck")
    }
    shape = replace(shape, **jitter)
    body = paint(rng)
    shell = [part.scaled(length, width, height) for part in _loft(shape, body)]
    radius = float(np.clip(0.205 * height, 0.28, 0.38)) * float(rng.uniform(0.95, 1.05))
    front_axle = 0.19 if shape.length > 3 else 0.17
    parts = shell + _wheels(length, width, radius, (front_axle, 0.81)) + _details(shape, length, width, height)
    return Model(shape.label, fitted(parts, length, width, height), (length, width, height))


def draw_vehicle(rng: np.random.Generator, labels: tuple[str, ...] = ("Car", "Van")) -> Model:
    """A vehicle at random among the bodies of these labels."""
    names = [name for name, shape in BODIES.items() if shape.label in labels]
    weights = np.array([BODIES[name].weight for name in names])
    return build_vehicle(str(rng.choice(names, p=weights / weights.sum())), rng)


def build_truck(rng: np.random.Generator) -> Model:
    """A lorry or bus: cab and load box on three axles."""
    length, width, height = float(rng.uniform(6.2, 13)), float(rng.uniform(2.3, 2.6)), float(rng.uniform(2.7, 3.6))
    cab_colour = replace(paint(rng), train_id=S.TRUCK)
    load_colour = replace(paint(rng), train_id=S.TRUCK, texture=Texture.BILLBOARD, gloss=0.05, scale=3.0, smooth=False)
    load_colour = replace(load_colour, second=S.vary(rng, (0.6, 0.6, 0.58), 0.3))
    glass = S.GLASS_CAR.classed(S.TRUCK)
    cab, tall = 1.9, 0.82 * height
    front = length / 2
    parts = [box(cab, width, tall - 0.5, cab_colour, 0.5).at(front - cab / 2, 0)]
    parts += [box(0.03, 0.86 * width, 0.28 * tall, glass, 0.58 * tall).at(front + 0.005, 0)]
    parts += [box(0.03, 0.7 * width, 0.16 * tall, S.PLASTIC_DARK.classed(S.TRUCK), 0.22 * tall).at(front + 0.005, 0)]
    for side in (-1, 1):
        parts.append(box(0.7, 0.03, 0.25 * tall, glass, 0.58 * tall).at(front - 0.75, side * (width / 2 + 0.002)))
        parts.append(box(0.1, 0.3, 0.16, S.HEADLAMP.classed(S.TRUCK), 0.65).at(front - 0.03, side * 0.36 * width))
        parts.append(box(0.06, 0.25, 0.2, S.TAIL_LAMP.classed(S.TRUCK), 0.8).at(-front + 0.02, side * 0.42 * width))
    parts.append(box(length - cab - 0.25, width, height - 0.95, load_colour, 0.95).at(-(cab + 0.25) / 2, 0))
    parts.append(box(length - 0.4, 0.8, 0.3, S.PLASTIC_DARK.classed(S.TRUCK), 0.6))
    wheels = _wheels(length, width, 0.48, (1.3 / length, 1 - 2.6 / length, 1 - 1.4 / length))
    parts += [replace(part, surface=part.surface.classed(S.TRUCK)) for part in wheels]
    return Model("Truck", fitted(parts, length, width, height), (length, width, height))
