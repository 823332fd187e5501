"""The loopback rig's arm: kinematics, paths, and their timing. Used by `sim.world` and the simulated cabinet."""
