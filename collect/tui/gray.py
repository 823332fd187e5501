"""What half-cells and sixels share: a picture fitted into its place in few grays, and a line of it as runs."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


def fitted(image: NDArray[np.uint8], width: int, height: int, levels: int, step: int = 1) -> NDArray[np.int64]:
    """The (h, w) gray picture as large as fits into `width` x `height`, its shape kept, in grays 0 to `levels` - 1.

    Its rows are a multiple of `step`, and at least one.
    """
    import cv2
    import numpy as np

    scale = min(width / image.shape[1], height / image.shape[0])
    columns, rows = max(1, int(image.shape[1] * scale)), max(1, int(image.shape[0] * scale / step)) * step
    small = np.asarray(cv2.resize(image, (columns, rows), interpolation=cv2.INTER_AREA), np.int64)
    return (small * (levels - 1) + 127) // 255


def runs(values: NDArray[np.int64]) -> list[tuple[int, int]]:
    """(value, count) of each run of equal values."""
    import numpy as np

    starts = np.flatnonzero(np.concatenate(([True], values[1:] != values[:-1])))
    counts = np.diff(np.append(starts, len(values)))
    return list(zip(values[starts].tolist(), counts.tolist(), strict=True))
