"""Sparse depth and one image in, dense depth with two surfaces out (thesis chapters 2-4).

Imports nothing of `detection` or `pipeline`; knows no dataset folder, no YAML and no command line.
"""
