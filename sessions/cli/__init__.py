"""`brushloop sessions`: what a scientist does with recordings."""
