"""Force sensors between flange and brush, each on a CAN bus of its own; never the arm's internal bus."""
