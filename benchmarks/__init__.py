"""Our implementations and their peers side by side, timed alternately in one run: `python -m benchmarks.NAME`."""
