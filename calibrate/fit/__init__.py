"""A stroke model fitted to the presses of one brush."""
