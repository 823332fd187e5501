"""Pages of what is measured before any stroke is compared: calibrations, lenses and trained networks."""
