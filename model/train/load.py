"""A trained generator from its file, as a stroke model."""

from __future__ import annotations

from pathlib import Path

from model.ccdbsm import Brush
from model.generator.stroke import GeneratorModel, generator_model
from model.train.checkpoint import load_weights
from model.train.config import checked
from model.train.errors import TrainError


def load_generator(path: Path | str, brush: Brush | None = None) -> GeneratorModel:
    """The stroke model that `generator.safetensors` holds, for the brush it was trained with or for another.

    Raises TrainError for a file that cannot be used, and for another brush where R and L are no inputs of it.
    """
    config, network, _ = load_weights(Path(path))
    if brush is not None:
        size = {"radius_mm": float(brush.radius_mm), "length_mm": float(brush.length_mm)}
        for name, value in size.items():
            trained = getattr(config.target, name)
            if name not in config.target.ranges and value != trained:
                raise TrainError(path, f"was trained for a brush with {name} = {trained:g}, not {value:g}")
        fields = config.model_dump()
        config = checked(path, fields | {"target": fields["target"] | size})
    return generator_model(network, config.build_target(), fitted=config.tuning is not None)
