"""Hardware behind small protocols: samples, clock, errors, limits, and one module or folder per device."""
