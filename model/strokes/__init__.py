"""The stroke models, a file each; `model.registry` finds every file here that defines `models`."""
