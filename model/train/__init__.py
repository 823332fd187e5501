"""Training the generator: `brushloop train`. Only this part of `model` touches files."""

from pathlib import Path

SHIPPED_GENERATOR = Path(__file__).parents[1] / "generator" / "data" / "generator.safetensors"
"""The generator that comes with brushloop; its card beside it says what it was trained on, and by which command."""
