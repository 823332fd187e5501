"""Quality checks of a capture: measured, compared with a limit, and explained in a sentence."""
