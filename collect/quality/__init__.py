"""What is wrong with a capture, seconds after it: measured, compared with a threshold, and told in words."""
