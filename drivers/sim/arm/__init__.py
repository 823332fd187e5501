"""The loopback rig's arm: kinematics, paths, and moves with trapezoidal speed."""
