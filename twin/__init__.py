"""A twin of a brush: the simulator's brush, ink and camera noise, fitted to captured presses (`brushloop twin`)."""
