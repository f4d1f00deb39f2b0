"""Points in, 3D boxes out, and the KITTI average precision of the boxes (thesis chapter 5).

Imports nothing of `completion` or `pipeline`; knows no dataset folder, no YAML and no command line.
"""
