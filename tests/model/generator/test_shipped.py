"""The generator that comes with brushloop is the one that its card describes."""

from __future__ import annotations

import torch

from brushloop.model.train import SHIPPED_GENERATOR
from brushloop.model.train.checkpoint import load_generator, load_weights, sha256
from brushloop.model.train.config import preset
from brushloop.model.train.data import exact_sets

MOST_BYTES = 10_000_000


def test_it_is_small_and_its_card_names_it_and_its_training() -> None:
    assert SHIPPED_GENERATOR.stat().st_size <= MOST_BYTES
    card = SHIPPED_GENERATOR.with_suffix(".md").read_text(encoding="utf-8")
    assert sha256(SHIPPED_GENERATOR) in card
    assert "trained on exact area coverage of the stroke model `ccd-bsm`" in card
    assert "It has seen no real ink" in card
    assert f"{load_weights(SHIPPED_GENERATOR)[2]['mse']:.3g}" in card


def test_the_documented_command_trains_it_and_images_it_has_not_seen_score_as_its_card_says() -> None:
    config, network, report = load_weights(SHIPPED_GENERATOR)
    assert config == preset("anchored")
    _, held_out = exact_sets(config.model_copy(update={"seed": 1, "training_images": 1, "validation_images": 64}))
    inputs, target = held_out.pick(torch.arange(len(held_out)))
    with torch.no_grad():
        mse = float((network(inputs) - target).square().mean())
    assert 0.5 * report["mse"] < mse < 2.0 * report["mse"]


def test_it_predicts_every_press_of_the_paper_and_calls_itself_what_it_is() -> None:
    model = load_generator(SHIPPED_GENERATOR)
    assert (model.name, model.label, model.fitted) == ("ccd-bsmg", "CCD-BSMG", False)
    for depth_mm in (11.0, 20.0):
        for tilt_deg in (0.0, 10.0):
            model.profile(depth_mm, tilt_deg)
    assert "trained on exact images of CCD-BSM" in model.definition
