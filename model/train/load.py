"""A trained generator from its file, as a stroke model."""

from __future__ import annotations

from pathlib import Path

from model.generator.stroke import GeneratorModel, generator_model
from model.train.checkpoint import load_weights


def load_generator(path: Path | str) -> GeneratorModel:
    """The stroke model that `generator.safetensors` holds; raises TrainError for a file that cannot be used."""
    config, network, _ = load_weights(Path(path))
    return generator_model(network, config.build_target(), fitted=config.tuning is not None)
