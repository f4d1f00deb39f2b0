"""Chapters 2 and 3 of the thesis: metrics at boundaries, and Depth Coefficients."""

from __future__ import annotations

from typing import Any

from pipeline.experiments.tables import HIGHER, Claim, Column, Recipe, Row, Table

QUOTED = "quoted in the thesis from its authors; not among our networks"


def errors(digits: int = 1) -> tuple[Column, ...]:
    """MAE, RMSE, tMAE, tRMSE in mm, the columns of most tables."""
    return (
        Column("mae_mm", "MAE", "mm", digits=digits),
        Column("rmse_mm", "RMSE", "mm", digits=digits),
        Column("tmae_mm", "tMAE", "mm", digits=digits),
        Column("trmse_mm", "tRMSE", "mm", digits=digits),
    )


MIXED = Column("mixed_percent", "mixed depth at edges", "%", digits=2)


def millimetres(*centimetres: float) -> tuple[float | None, ...]:
    """Printed cm as mm, and nothing for the boundary number, which the thesis does not print."""
    return (*(round(10 * value, 1) for value in centimetres), None)


def training(network: str, loss: str, **changes: Any) -> Recipe:
    """A network trained and scored; equal settings anywhere in the thesis are one run (see `completion_runs`)."""
    base = {"network": network, "loss": loss, "rows": 64, "colour": True, "target": "clean", "scene": "street"}
    return Recipe("completion", {**base, **({"gamma": 2.0} if loss == "twin" else {}), **changes})


def analysis(what: str, **settings: Any) -> Recipe:
    """A computation without a network."""
    return Recipe("analysis", {"what": what, **settings})


def _coefficients(rows: int) -> Recipe:
    return training("resnet18", "dc", rows=rows)


_INDOOR = {"scene": "samples_500"}
_NYU_COLUMNS = (
    Column("rmse_mm", "RMSE", "mm"),
    Column("mae_mm", "MAE", "mm"),
    Column("rel", "REL", digits=4),
    Column("tmae_mm", "tMAE", "mm"),
    Column("trmse_mm", "tRMSE", "mm"),
    *(Column(f"delta_{x}", f"delta {x}", "%", HIGHER) for x in ("1.02", "1.05", "1.10", "1.25", "1.25^2")),
)

FIGURE_2_5 = Table(
    "2.5",
    "figure",
    "Losses, and their expectation at a pixel that may lie at 10 m or at 13 m",
    "why MSE and MAE allow mixed depth and the thresholded errors do not",
    (
        Column("between_loss", "expected loss half-way", digits=3, better=""),
        Column("surface_loss", "expected loss on a surface", digits=3, better=""),
        Column("least_at_m", "estimate of least expected loss", "m", better="", digits=2),
    ),
    tuple(
        Row(name, recipe=analysis("expected_loss", loss=name, depths=[10.0, 13.0], probability=0.5, gamma=2.0))
        for name in ("MSE", "MAE", "tRMSE^2", "tMAE")
    ),
    notes=("the figure prints curves, no numbers; where several estimates are equally good the least is given",),
    drawing="expected_loss",
    needs="nothing",
)

FIGURE_3_3 = Table(
    "3.3",
    "figure",
    "A linear filter over a depth step: on depth, and on Depth Coefficients",
    "interpolating coefficients puts nothing between two surfaces",
    (
        Column("estimate_m", "estimate of the missing pixel", "m", better="", digits=2),
        Column("mass_between", "weight on bins between the surfaces", "share", digits=3),
    ),
    (
        Row("depth", recipe=analysis("filter_step", on="depth", near=3.0, far=8.0)),
        Row("coefficients", recipe=analysis("filter_step", on="coefficients", near=3.0, far=8.0)),
    ),
    claims=(Claim("coefficients put less weight between the surfaces", "mass_between", ("coefficients",), ("depth",)),),
    notes=("the figure prints no numbers; our step goes from 3 m to 8 m, filter (1/4, 1/2, 1/4)",),
    needs="nothing",
)

TABLE_3_1 = Table(
    "3.1",
    "table",
    "Depth Coefficients on NYU Depth v2, 500 samples + RGB",
    "indoor comparison; most rows are quoted",
    _NYU_COLUMNS,
    (
        *(
            Row(name, printed, reason=QUOTED)
            for name, printed in (
                ("Ma", (236.0, 130.0, 0.046, 68.0, 75.0, 52.3, 82.3, 92.6, 97.1, 99.4)),
                ("Bilateral", (479.0, None, 0.084, None, None, 29.9, 58.0, 77.3, 92.4, 97.6)),
                ("SPN", (172.0, None, 0.031, None, None, 61.1, 84.9, 93.5, 98.3, 99.7)),
                ("Unet", (137.0, 51.0, 0.020, None, None, 78.1, 91.6, 96.2, 98.9, 99.8)),
                ("CSPN", (162.0, None, 0.028, None, None, 64.6, 87.7, 94.9, 98.6, 99.7)),
                ("CSPN+UNet", (117.0, None, 0.016, None, None, 83.2, 93.4, 97.1, 99.2, 99.9)),
            )
        ),
        Row(
            "DC, all coefficients",
            (118.0, 38.0, 0.013, 42.0, 53.0, 86.3, 95.0, 97.8, 99.4, 99.9),
            training("resnet18", "dc", **_INDOOR),
            "all",
        ),
        Row(
            "DC, 3 coefficients",
            (131.0, 38.0, 0.013, 40.0, 54.0, 86.8, 95.4, 97.9, 99.3, 99.8),
            training("resnet18", "dc", **_INDOOR),
            "peak",
        ),
    ),
    claims=(
        Claim("all coefficients: lower RMSE", "rmse_mm", ("DC, all coefficients",), ("DC, 3 coefficients",)),
        Claim("3 coefficients: lower tMAE", "tmae_mm", ("DC, 3 coefficients",), ("DC, all coefficients",)),
    ),
    notes=("on the synthetic world: streets with 500 random samples in place of NYU's rooms",),
    needs="synthetic world, or NYU Depth v2",
)

_SPARSITY = {64: ((24.1, 121.2, 20.3, 34.4), (25.2, 106.1, 23.9, 37.4)), 32: ((31.0, 132.2, 24.4, 39.5),
             (31.1, 115.8, 27.6, 42.2)), 16: ((37.8, 160.6, 33.4, 47.2), (38.6, 142.3, 36.1, 50.5))}  # fmt: skip

TABLE_3_2 = Table(
    "3.2",
    "table",
    "Depth Coefficients by LiDAR rows and decoding",
    "decoding all coefficients lowers RMSE, decoding three lowers tMAE",
    (*errors(), MIXED),
    tuple(
        Row(f"{rows}R, {name}", millimetres(*printed), _coefficients(rows), view)
        for rows, both in _SPARSITY.items()
        for name, view, printed in (("3 coefficients", "peak", both[0]), ("all", "all", both[1]))
    ),
    claims=tuple(
        claim
        for rows in _SPARSITY
        for claim in (
            Claim(
                f"{rows}R: decoding all has the lower RMSE",
                "rmse_mm",
                (f"{rows}R, all",),
                (f"{rows}R, 3 coefficients",),
            ),
            Claim(
                f"{rows}R: decoding 3 has the lower tMAE", "tmae_mm", (f"{rows}R, 3 coefficients",), (f"{rows}R, all",)
            ),
        )
    ),
    notes=("the thesis' chapter 3 clamps to 80 m before all errors; ours are the KITTI devkit's",),
    needs="synthetic world, or KITTI depth completion",
)

_SQUARE = (
    ("depth in, MSE", "resnet18_plain", "l2", (6.63, 15.28, 5.96, 6.97), ""),
    ("DC in, MSE", "resnet18_dc_input", "l2", (6.10, 15.32, 5.72, 6.73), ""),
    ("depth in, CE", "resnet18_depth_input", "dc", (9.53, 17.81, 6.75, 7.56), "all"),
    ("DC in, CE", "resnet18", "dc", (3.82, 11.85, 4.24, 5.37), "all"),
)

TABLE_3_3 = Table(
    "3.3",
    "table",
    "Depth Coefficients at the input, at the output, or both",
    "only together do they help",
    (*errors(), MIXED),
    tuple(
        Row(label, millimetres(*printed), training(network, loss, **_INDOOR), view)
        for label, network, loss, printed, view in _SQUARE
    ),
    claims=(
        Claim("DC in and CE out has the lowest MAE", "mae_mm", ("DC in, CE",), tuple(row[0] for row in _SQUARE[:3])),
        Claim("DC in and CE out has the lowest RMSE", "rmse_mm", ("DC in, CE",), tuple(row[0] for row in _SQUARE[:3])),
        Claim("DC in alone is no large gain, but one", "mae_mm", ("DC in, MSE",), ("depth in, MSE",)),
        Claim("CE out alone is worse", "mae_mm", ("depth in, MSE",), ("depth in, CE",)),
    ),
    notes=("on the synthetic world: streets with 500 random samples in place of NYU's rooms, t = 1 m (indoors 0.1 m)",),
    needs="synthetic world, or NYU Depth v2",
)


def _frustums(points: str) -> Recipe:
    return Recipe("frustum", {"points": points, "rows": 16})


_FRUSTUM_ROWS = (
    ("Raw 16R", "raw", (54.4, 36.2, 31.3, 73.6, 58.1, 50.4)),
    ("Ma", "ma", (36.7, 23.0, 18.5, 56.2, 33.8, 29.7)),
    ("DC, 3 coefficients", "dc", (64.9, 41.9, 34.7, 78.1, 54.0, 45.6)),
)

TABLE_3_4 = Table(
    "3.4",
    "table",
    "Cars found by Frustum PointNet on 16 rows, and on depth completed from them",
    "does completed depth help detection",
    (
        *(
            Column(f"r11/{space}_0.7_{level}", f"{space.upper()} {level}, R11", "AP %", HIGHER)
            for space in ("3d", "bev")
            for level in ("easy", "moderate", "hard")
        ),
        Column("3d_0.7_moderate", "3D moderate, R40", "AP %", HIGHER),
        Column("bev_0.7_moderate", "BEV moderate, R40", "AP %", HIGHER),
        Column("3d_0.5_easy", "3D easy, IoU 0.5, R40", "AP %", HIGHER),
    ),
    tuple(Row(name, (*printed, None, None, None), _frustums(points)) for name, points, printed in _FRUSTUM_ROWS),
    claims=(
        Claim("depth completed by DC beats the raw rows", "3d_0.5_easy", ("DC, 3 coefficients",), ("Raw 16R",)),
        Claim("the raw rows beat depth completed by Ma", "3d_0.5_easy", ("Raw 16R",), ("Ma",)),
    ),
    notes=(
        "every row trains a Frustum PointNet v1 of its own on x, y, z of its points, as the thesis did",
        "the thesis names neither version, 2D boxes, metric nor points per frustum: v1, AP with 11 recall points as "
        "KITTI had it then (R40 beside it); IoU 0.5 judges the order, because brief trainings place boxes coarsely",
        "2D boxes are the labelled ones, scored by the network itself; `frustum: boxes:` of a configuration names a "
        "published list (rgb_detection_val.txt) or a folder of result files, whose scores then count",
        "Ma is the ResNet-18 depth network with squared loss, DC the one with Depth Coefficients, both trained on 16 "
        "rows of the training frames; where the data set has no dense true depth (KITTI object) on synthetic frames, "
        "or given as weights by `frustum: completers:`",
        "in the thesis DC lies below the raw rows from above at moderate and hard: its caption holds for 3D and easy",
    ),
    needs="synthetic world, or KITTI object with --data",
)

TABLES: tuple[Table, ...] = (FIGURE_2_5, TABLE_3_1, TABLE_3_2, TABLE_3_3, FIGURE_3_3, TABLE_3_4)
