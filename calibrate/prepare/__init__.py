"""From a photograph to a 128 x 128 stroke in named stages, and strokes on pages that already carry ink."""
