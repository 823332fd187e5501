"""A twin of a brush: the simulator's brush, ink and camera noise, fitted to captured presses (`brushloop twin`).

Reached from the front door alone; of the drivers it may use only the simulated brush.
"""
