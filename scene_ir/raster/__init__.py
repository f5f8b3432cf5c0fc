"""The rasteriser: four differentiable verbs, each as plain torch and as Warp kernels; see `scene_ir.raster.verbs`."""
