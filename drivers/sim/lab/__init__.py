"""A lab that nobody has measured yet: the loopback rig with everything drawn from a seed, and a person's hand in it."""
