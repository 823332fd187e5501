"""Characters written by the arm, from the plan to the report."""
