"""One stroke out of a photograph: the paper's preprocessing, and the stroke that is new since another photograph."""
