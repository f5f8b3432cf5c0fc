"""The renderer's per-pixel work as Warp kernels, one source for CPU and CUDA; imported where they are used."""
