"""The camera, measured by a board: corners, lens, plane of the paper, drift, and where the robot is."""
