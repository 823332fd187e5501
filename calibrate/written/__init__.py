"""Characters that the arm has written, beside what they should look like."""
