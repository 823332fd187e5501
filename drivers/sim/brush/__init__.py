"""The loopback rig's brush and paper: mechanics, footprint, drags, ink. Used by `sim.world` and by the twin.

It must not know the stroke models that it is used to check; its numbers are frozen to the bit.
"""
