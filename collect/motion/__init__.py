"""Where the arm goes: lists of moves for the plan and the run, and what carries them out."""
