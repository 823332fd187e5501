"""The peer: a renderer of the Learning-to-Paint kind (Huang et al., ICCV 2019), written from its published sizes.

Fully connected 512, 1024, 2048, 4096 with ReLU, to 16 x 16 x 16; three times two 3 x 3 convolutions and a pixel
shuffle by 2; a sigmoid. The original takes 10 stroke parameters in [0, 1] and is trained with Adam on MSE.
"""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import Tensor, nn


class LearningToPaint(nn.Module):
    """(B, P) inputs in [0, 1] to (B, 128, 128) in [0, 1]."""

    def __init__(self, inputs: int) -> None:
        super().__init__()
        sizes = (inputs, 512, 1024, 2048, 4096)
        fully: list[nn.Module] = []
        for before, after in pairwise(sizes):
            fully += [nn.Linear(before, after), nn.ReLU()]
        self.fully_connected = nn.Sequential(*fully)
        convolution: list[nn.Module] = []
        for before, between, after in ((16, 32, 32), (8, 16, 16), (4, 8, 4)):
            convolution += [nn.Conv2d(before, between, 3, padding=1), nn.ReLU()]
            convolution += [nn.Conv2d(between, after, 3, padding=1), nn.PixelShuffle(2)]
        self.convolution = nn.Sequential(*convolution)
        self.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue, reportUnknownMemberType]

    def forward(self, inputs: Tensor) -> Tensor:
        """See the class."""
        map_ = self.fully_connected(inputs).unflatten(1, (16, 16, 16))
        return 1 - torch.sigmoid(self.convolution(map_).squeeze(1))
