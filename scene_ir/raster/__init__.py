"""The rasteriser: four differentiable verbs, each in plain torch and as Warp kernels: `scene_ir.raster.verbs`."""
