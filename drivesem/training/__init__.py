"""What training needs beyond detectors.training: frames, what is judged, weights kept, curves, the model card."""
