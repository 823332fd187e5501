"""From a photograph to one stroke: light, rectification, components, binarisation, measurement."""
