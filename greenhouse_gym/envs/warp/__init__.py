"""Environments as kernels for CPU and GPU, by NVIDIA Warp: ``make_vec(..., backend="warp")``."""
