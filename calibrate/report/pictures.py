"""Pictures for the report, as data URIs: no report ever fetches anything."""

from __future__ import annotations

import base64
import io
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from calibrate.compare.field import Image
from calibrate.drags.measure import DragResults


def data_uri(image: NDArray[np.uint8]) -> str:
    """An (h, w) gray or (h, w, 3) BGR image as a PNG data URI."""
    _, data = cv2.imencode(".png", image)
    return "data:image/png;base64," + base64.b64encode(data.tobytes()).decode()


def ink(image: Image) -> str:
    """(h, w) ink in [0, 1] as black on white."""
    return data_uri(np.rint(255.0 * (1.0 - image)).astype(np.uint8))


def difference(captured: Image, predicted: Image) -> str:
    """Gray where both agree on ink, vermilion where only the capture has it, blue where only the model has."""
    both = np.minimum(captured, predicted)
    only_captured, only_predicted = captured - both, predicted - both
    # Colours told apart by colour-blind eyes (Okabe and Ito), as BGR distances from white.
    colour = 255.0 - (
        both[..., None] * np.array([90.0, 90.0, 90.0])
        + only_captured[..., None] * np.array([255.0, 161.0, 42.0])
        + only_predicted[..., None] * np.array([77.0, 141.0, 255.0])
    )
    return data_uri(np.clip(np.rint(colour), 0, 255).astype(np.uint8))


def drag_plot(results: DragResults) -> str:
    """Width against depth and length against commanded length, with the fitted lines."""
    figure, axes = _figure(1, 2, (10.0, 3.4))
    whole = [drag for drag in results.strokes if not drag.cut]
    pairs = (
        ([(d.depth_mm, d.measured.mid_width_mm) for d in whole if d.depth_mm is not None], results.width_on_depth),
        (
            [(d.commanded["length_mm"], d.measured.length_mm) for d in whole if "length_mm" in d.commanded],
            results.length_on_commanded,
        ),
    )
    titles = (
        ("commanded depth, mm", "measured width at the middle, mm"),
        ("commanded length, mm", "measured length, mm"),
    )
    for axis, (points, line), (x_title, y_title) in zip(axes, pairs, titles, strict=True):
        axis.plot([x for x, _ in points], [y for _, y in points], ".", ms=5, alpha=0.6, color="#0072B2")
        if line is not None:
            ends = np.array([min(x for x, _ in points), max(x for x, _ in points)])
            axis.plot(ends, line.slope * ends + line.intercept, color="#D55E00", lw=1.5)
        axis.set_xlabel(x_title)
        axis.set_ylabel(y_title)
        axis.grid(alpha=0.3)
    return _png(figure)


def _figure(rows: int, columns: int, size: tuple[float, float]) -> tuple[Any, Any]:
    # The object interface: pyplot would keep every figure alive and look for a display.
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, layout="constrained")
    return figure, figure.subplots(rows, columns)


def _png(figure: Any) -> str:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    return "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode()
