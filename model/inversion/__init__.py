"""From images of presses back to (H, alpha) and place: batched least squares on the exact raster, with intervals."""
