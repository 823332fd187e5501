"""Algorithm 1: it learns, stops where it should, says when it draws nothing, and does the same again after a cut."""

from __future__ import annotations

import threading
from contextlib import closing

import pytest
import torch
from torch import Tensor

from brushloop.model.train.checkpoint import State
from brushloop.model.train.config import TrainConfig, differences
from brushloop.model.train.data import Exact, batch_numbers, batches, exact_sets
from brushloop.model.train.errors import BlankOutput, Diverged, TrainingStopped
from brushloop.model.train.loop import converged, learning_rate, new_state, train
from tests.waiting import PATIENCE_S


def same(a: State, b: State) -> bool:
    """Whether two states agree to the bit."""
    pairs = [(a.weights[name], b.weights[name]) for name in a.weights]
    pairs += [(x, y) for name in a.moments for x, y in zip(a.moments[name], b.moments[name], strict=True)]
    return a.step == b.step and all(torch.equal(x, y) for x, y in [*pairs, (a.losses, b.losses)])


def test_it_learns_and_shows_pictures_every_m_steps(tiny: TrainConfig, notes) -> None:
    longer = tiny.model_copy(update={"steps": 120, "validate_every": 40, "learning_rate": 0.02})
    state = train(longer, new_state(longer), exact_sets(longer), notes)
    assert state.step == len(notes.losses) == 120
    assert notes.losses[-1] < 0.2 * notes.losses[0]
    assert [v.step for v in notes.validations] == [40, 80, 120]
    assert notes.validations[-1].mse == pytest.approx(state.validations[-1, 1].item())
    assert notes.validations[-1].iou > 0.8
    assert notes.shown == list(range(15, 121, 15))


def test_a_cut_and_resumed_training_is_the_same_to_the_bit(tiny: TrainConfig, notes) -> None:
    sets = exact_sets(tiny)
    unbroken = train(tiny, new_state(tiny), sets, notes)
    resumed = train(tiny, notes.states[10], sets, notes)
    assert same(unbroken, resumed)
    other = tiny.model_copy(update={"seed": 1})
    assert not same(unbroken, train(other, new_state(other), exact_sets(other), notes))


def test_batches_follow_from_seed_and_step(tiny: TrainConfig) -> None:
    epoch = torch.cat([batch_numbers(96, 16, 5, step) for step in range(6)])
    assert epoch.sort().values.tolist() == list(range(96))
    assert torch.equal(batch_numbers(96, 16, 5, 9), batch_numbers(96, 16, 5, 9))
    assert not torch.equal(batch_numbers(96, 16, 5, 0), batch_numbers(96, 16, 5, 6))
    assert len(batch_numbers(7, 64, 0, 3)) == 7
    first, second = exact_sets(tiny), exact_sets(tiny)
    assert torch.equal(first[0].inputs, second[0].inputs)
    assert not torch.isin(first[1].inputs[:, 0], first[0].inputs[:, 0]).any()


@pytest.mark.parametrize("workers", [1, 2])
def test_batches_drawn_ahead_are_those_drawn_in_time(tiny: TrainConfig, notes, workers: int) -> None:
    in_time, ahead = (tiny.model_copy(update={"workers": n, "steps": 8}) for n in (0, workers))
    pairs = zip(*(batches(config, exact_sets(config)[0], 3) for config in (in_time, ahead)), strict=True)
    for drawn_in_time, drawn_ahead in pairs:
        assert all(map(torch.equal, drawn_in_time, drawn_ahead))
    assert same(*(train(config, new_state(config), exact_sets(config), notes) for config in (in_time, ahead)))
    assert differences(in_time, ahead) == []  # so either goes on where the other stopped


def test_batches_are_drawn_while_earlier_ones_are_in_use(tiny: TrainConfig) -> None:
    class Noted(Exact):
        def pick(self, numbers: Tensor) -> tuple[Tensor, Tensor]:
            drawn.release()
            return super().pick(numbers)

    drawn = threading.Semaphore(0)
    training = exact_sets(tiny)[0]
    with closing(batches(tiny, Noted(training.target, training.inputs), 0)) as ahead:
        next(ahead)
        assert all(drawn.acquire(timeout=PATIENCE_S) for _ in range(3))  # the first and two more


def test_asked_to_stop_it_keeps_the_last_step(tiny: TrainConfig, notes) -> None:
    with pytest.raises(TrainingStopped, match=r"step 4: .* resumes here"):
        train(tiny, new_state(tiny), exact_sets(tiny), notes, stopping=lambda: len(notes.losses) == 3)
    assert list(notes.states) == [4]


def test_blank_output_ends_the_training_with_advice(tiny: TrainConfig, notes) -> None:
    state = new_state(tiny)
    state.weights["convolution.0.bias"] -= 100.0
    slow = tiny.model_copy(update={"learning_rate": 1e-9})
    with pytest.raises(BlankOutput, match=r"step 20: the generator draws 0.00% ink where .* ink_weight") as caught:
        train(slow, state, exact_sets(tiny), notes)
    assert caught.value.exit_code == 4
    full = new_state(tiny)
    full.weights["convolution.0.bias"] += 100.0
    with pytest.raises(BlankOutput, match="draws 100"):
        train(slow, full, exact_sets(tiny), notes)


def test_a_loss_that_is_no_number_ends_the_training(tiny: TrainConfig, notes) -> None:
    state = new_state(tiny)
    state.weights["convolution.0.bias"].fill_(torch.nan)
    with pytest.raises(Diverged, match="step 1"):
        train(tiny, state, exact_sets(tiny), notes)
    assert notes.states == {}


def test_it_stops_when_converged(tiny: TrainConfig, notes) -> None:
    easy = tiny.model_copy(update={"target_mse": 0.9})
    assert train(easy, new_state(easy), exact_sets(easy), notes).step == 10
    patient = tiny.model_copy(update={"patience": 2})
    row = [0.0, 0.0, 1.0, 1.0]
    rows = [[0.0, mse, *row[2:]] for mse in (1.0, 0.5, 0.499, 0.498)]
    assert converged(patient, rows)
    assert not converged(patient, rows[:3])
    assert not converged(patient, [*rows, [0.0, 0.4, 1.0, 1.0]])


def test_the_rate_rises_and_falls_to_nothing(tiny: TrainConfig) -> None:
    rates = [learning_rate(tiny.model_copy(update={"warmup_steps": 5}), step) for step in range(31)]
    assert rates[0] == pytest.approx(tiny.learning_rate / 5, rel=0.01)
    assert max(rates) == rates[4]
    assert rates[30] == pytest.approx(0, abs=1e-12)
