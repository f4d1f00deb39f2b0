"""What goes into an augmented cloud, and the named settings of thesis Tables 5.3, 5.5, 5.6 and 5.7."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType

from auglidar_base.errors import SettingsError
from pipeline.pointcloud.grid_sampling import GridSampling
from pipeline.pointcloud.radius_gather import Radii
from pipeline.pointcloud.range_image import RangeGrid
from pipeline.pointcloud.semantic_mask import OBJECTS, SemanticMask
from pipeline.pointcloud.sigma_filter import SigmaBand

SURFACE_COLUMNS = ("sigma", "gap", "expected_error")
SEMANTIC_COLUMNS = ("semantic",)
COLUMNS = (*SEMANTIC_COLUMNS, *SURFACE_COLUMNS, "nearest_return")


@dataclass(frozen=True)
class AugmentSettings:
    """The steps of thesis 5.3.4 in their order; None leaves a step out.

    lidar           raw LiDAR in the output (Table 5.3)
    completed       completed depth in the output (Table 5.3)
    crop_lidar      use only raw returns that the camera sees (about 18k of 115k in KITTI), as completed points are
    sigma           sigma filter (thesis 5.3.4.1)
    range_image     azimuth-elevation resampling (Tables 5.5, 5.7)
    grid            grid sampling (thesis 5.3.4.2)
    classes         relevant Cityscapes trainIds (thesis 5.3.4.2)
    semantic        semantic mask and context (thesis 5.3.4.2); None with the column "semantic" is the soft variant: all
                    kept, scored
    semantic_lidar  apply the semantic mask to the raw LiDAR too (Table 5.6, "Sem. Lidar")
    near_lidar      gathering around raw LiDAR (thesis 5.3.4.3)
    columns         extra columns: semantic (flag or score), sigma, gap (background - foreground, m),
                    expected_error (m), nearest_return (distance to the nearest raw return, m)
    max_points      most points in the output, 0 = no limit; measured points stay first
    """

    lidar: bool = True
    completed: bool = True
    crop_lidar: bool = True
    sigma: SigmaBand | None = field(default_factory=SigmaBand)
    range_image: RangeGrid | None = None
    grid: GridSampling | None = field(default_factory=GridSampling)
    classes: tuple[int, ...] = OBJECTS
    semantic: SemanticMask | None = field(default_factory=SemanticMask)
    semantic_lidar: bool = False
    near_lidar: Radii | None = field(default_factory=Radii)
    columns: tuple[str, ...] = ()
    max_points: int = 0

    def __post_init__(self) -> None:
        object.__setattr__(self, "classes", tuple(self.classes))
        object.__setattr__(self, "columns", tuple(self.columns))
        unknown = [name for name in self.columns if name not in COLUMNS]
        if unknown or len(set(self.columns)) != len(self.columns):
            raise SettingsError(f"augment columns: expected different ones of {', '.join(COLUMNS)}, got {self.columns}")
        if not all(0 <= label <= 255 for label in self.classes):
            raise SettingsError(f"augment classes: expected Cityscapes trainIds 0-255, got {self.classes}")
        if self.max_points < 0:
            raise SettingsError(f"augment max_points: expected 0 (no limit) or more, got {self.max_points}")
        if self.semantic_lidar and self.semantic is None:
            raise SettingsError("augment semantic_lidar: needs a semantic mask")
        if not (self.lidar or self.completed):
            raise SettingsError("augment: neither raw LiDAR nor completed depth is asked for")

    @property
    def needs_semantics(self) -> bool:
        """True when a semantics map has to be given."""
        masked = self.semantic is not None and (self.completed or self.semantic_lidar)
        return masked or any(name in SEMANTIC_COLUMNS for name in self.columns)

    @property
    def leaves_lidar_as_it_is(self) -> bool:
        """True when nothing is completed, masked, added or thinned: what the camera sees of the raw LiDAR comes out."""
        return not (self.completed or self.semantic_lidar or self.columns or self.max_points)

    @property
    def needs_surfaces(self) -> bool:
        """True when the completed depth must have foreground, background and sigma."""
        return self.completed and (self.sigma is not None or any(name in SURFACE_COLUMNS for name in self.columns))


# Table 5.3. L: raw LiDAR; D: completed depth; F: sigma filter; SF: sigma filter and semantic mask.
_L = AugmentSettings(completed=False, sigma=None, grid=None, semantic=None, near_lidar=None)
_D = AugmentSettings(lidar=False, sigma=None, grid=None, semantic=None, near_lidar=None)
_D_F = replace(_D, sigma=SigmaBand())
_D_SF = replace(_D_F, grid=GridSampling(0.2), semantic=SemanticMask(context=Radii(0.3, 0.3)))
_TWO_RADII = replace(_D_SF, lidar=True, semantic=SemanticMask(context=Radii(0.3, 1.5, 40.0)), near_lidar=Radii())
_MASKED = replace(_TWO_RADII, columns=("semantic",))

PRESETS: Mapping[str, AugmentSettings] = MappingProxyType(
    {
        "L": _L,
        "D": _D,
        "D_F": _D_F,
        "D_SF": _D_SF,
        "L_D_SF": _TWO_RADII,
        "L_D_SF_mask": _MASKED,
        # All completed points near a return, no mask: the soft variant, which needs no semantics.
        "L_D_F": replace(_TWO_RADII, semantic=None),
        # Table 5.5: filtered depth resampled like a LiDAR, and masked depth on a 0.1 m grid.
        "64R": replace(_D_F, range_image=RangeGrid(64)),
        "128R": replace(_D_F, range_image=RangeGrid(128)),
        "256R": replace(_D_F, range_image=RangeGrid(256)),
        "512R": replace(_D_F, range_image=RangeGrid(512)),
        "table_5_5_semantic": replace(_D_SF, grid=GridSampling(0.1)),
        # Table 5.6, in its order.
        "table_5_6_lidar": _L,
        "table_5_6_semantic_lidar": replace(_L, semantic=SemanticMask(), semantic_lidar=True),
        "table_5_6_r0.3": _D_SF,
        "table_5_6_r1": replace(_D_SF, semantic=SemanticMask(context=Radii(1.0, 1.0))),
        "table_5_6_r0.3_r1.5": _TWO_RADII,
        "table_5_6_mask": _MASKED,
    }
)


def preset(name: str) -> AugmentSettings:
    """The named settings. Raises ValueError with the list of names for an unknown one."""
    if name not in PRESETS:
        raise ValueError(f"unknown preset {name!r}; there are {', '.join(PRESETS)}")
    return PRESETS[name]
