"""Measured zero touch and the self-check: where the paper really lies, and whether the rig is set up right."""
