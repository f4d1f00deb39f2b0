"""Executors and kernels for inference on a CPU."""
