"""What a damaged session still holds, and its repair."""
