"""Scores of a run: metrics.json and its tables."""
