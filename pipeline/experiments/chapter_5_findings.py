"""The thesis' claims about detection, and the orderings that test each (see `findings`)."""

from __future__ import annotations

from pipeline.experiments.finding import Finding

FINDINGS: tuple[Finding, ...] = (
    Finding("Depth noise costs AP (5.8).", (("table", "5.8", ("blur costs", "misalignment costs")),)),
    Finding("Blur at boundaries hurts as much as misalignment (5.8).", (("table", "5.8", ("blur hurts at least",)),)),
    Finding(
        "Furthest point sampling promotes outliers (section 5.3.3.1, Fig. 5.4).",
        (("figure", "5.4", ("FPS promotes noise", "FPS promotes points")),),
    ),
    Finding(
        "Furthest point sampling promotes background (section 5.3.3.1, Fig. 5.4).",
        (("figure", "5.4", ("FPS promotes background",)),),
    ),
    Finding("Dense depth alone is worse than raw LiDAR (5.1, 5.2).", (
        ("table", "5.1", ("raw LiDAR beats completed",)), ("table", "5.2", ("raw beats",)),
    )),
    Finding("The sigma filter helps (5.3, 5.4).", (
        ("table", "5.3@64", ("the sigma filter",)), ("table", "5.3@16", ("the sigma filter",)),
        ("table", "5.4", ("the sigma filter",)),
    )),
    Finding("Mask and gathering help further (5.3).", (
        ("table", "5.3@64", ("mask and gathering",)), ("table", "5.3@16", ("mask and gathering",)),
    )),
    Finding("Context around objects and the mask column help (5.6).", (
        ("table", "5.6", ("more context", "the mask column")),
    )),
    Finding("Augmented LiDAR beats LiDAR (5.3).", (
        ("table", "5.3@64", ("augmented LiDAR",)), ("table", "5.3@16", ("augmented LiDAR",)),
    )),
    Finding(
        "More rows help a point-based detector only with relevant points, a voxel-based one always (5.7).",
        (("table", "5.7", ("all points", "semantic points")),),
    ),
    Finding("Relevant points help a point-based detector (5.7, 5.9).", (
        ("table", "5.7", ("relevant points",)), ("table", "5.9", ("semantic pixels beat all",)),
    )),
    Finding("Masks choose better than boxes (5.9).", (("table", "5.9", ("semantic pixels beat boxes",)),)),
)  # fmt: skip
