"""KITTI average precision on any two folders of label and result files; numpy and numba only.

How a reader walks: `kitti_ap.evaluate` -> `protocol` (what is asked) -> `reading` (files to tables) -> `overlaps` (IoU)
-> `matcher` with `difficulty` (who counts) -> `matching` (who is found) -> `curves` (precision, recall, AP).
`bootstrap`, `explain` and `plots` look at the same match records again.
"""
