"""Where the arm goes: the lists of moves that a plan checks, and the procedures that carry them out."""
