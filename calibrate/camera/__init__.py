"""The camera: its lens from photographs of a board, the paper plane, its drift, and where the robot's points lie."""
