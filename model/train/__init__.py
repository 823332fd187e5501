"""Training the generator: `brushloop train`. Only this part of `model` touches files."""
