"""Training says how far it is also where there is no terminal."""

import io

from rich.console import Console  # noqa: TID251
from rich.progress import Progress

from brushloop.model.train.run import Bar


def test_without_a_terminal_each_tenth_is_a_line_with_the_time_that_is_left() -> None:
    said, now_s = io.StringIO(), iter(range(1000))
    progress = Progress(console=Console(file=said, width=120), get_time=lambda: float(next(now_s)), disable=True)
    bar = Bar(progress, 20)
    for step in range(1, 21):
        bar.stepped(step, 0.5 / step)
    lines = said.getvalue().splitlines()
    assert len(lines) == 10
    assert lines[0].startswith("training: 2 of 20 steps")
    assert "s left" in lines[4]
    assert lines[-1] == "training: 20 of 20 steps, MSE 2.5e-02"
