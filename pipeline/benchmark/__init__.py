"""Benchmarks on real frames that need no depth ground truth (`run_pipeline --stage bench --suite real`)."""
