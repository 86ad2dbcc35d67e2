"""The network: a small encoder and decoder with skips, about 0.45 million weights, a class for every pixel."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

# Where weights are dear and pixels few (an eighth of the width and less), blocks are depthwise; where pixels are
# many and weights few, plain 3 x 3 convolutions make better use of a processor.
_HALF, _QUARTER, _EIGHTH, _SIXTEENTH, _THIRTY_SECOND = 16, 32, 56, 80, 96
_EXPANSION = 3


class _Pointwise(nn.Conv2d):
    """A 1 x 1 convolution, which learns as a product of matrices: torch's own takes twice as long on one thread."""

    def forward(self, x: Tensor) -> Tensor:
        if not self.training:
            return super().forward(x)
        return functional.linear(x.permute(0, 2, 3, 1), self.weight[:, :, 0, 0], self.bias).permute(
            0, 3, 1, 2
        )


def _conv(inputs: int, outputs: int, kernel: int = 3, stride: int = 1, groups: int = 1) -> nn.Sequential:
    kind = _Pointwise if kernel == stride == groups == 1 else nn.Conv2d
    return nn.Sequential(
        kind(inputs, outputs, kernel, stride, kernel // 2, groups=groups, bias=False), nn.BatchNorm2d(outputs)
    )


class _Plain(nn.Module):
    """Residual block of two plain convolutions."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.first, self.second = _conv(width, width), _conv(width, width)

    def forward(self, x: Tensor) -> Tensor:
        return torch.relu(x + self.second(torch.relu(self.first(x))))


class _Inverted(nn.Module):
    """Residual block: widened, filtered per channel over 5 x 5, narrowed (Sandler et al., MobileNetV2, 2018)."""

    def __init__(self, width: int) -> None:
        super().__init__()
        wide = width * _EXPANSION
        self.widen, self.filter = _conv(width, wide, 1), _conv(wide, wide, 5, groups=wide)
        self.narrow = _conv(wide, width, 1)

    def forward(self, x: Tensor) -> Tensor:
        return x + self.narrow(torch.relu(self.filter(torch.relu(self.widen(x)))))


class _Down(nn.Module):
    """Half the size, other width."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.filter, self.mix = _conv(inputs, inputs, 5, 2, groups=inputs), _conv(inputs, outputs, 1)

    def forward(self, x: Tensor) -> Tensor:
        return torch.relu(self.mix(torch.relu(self.filter(x))))


class _Joined(nn.Module):
    """The coarser picture enlarged onto the finer one, and mixed."""

    def __init__(self, coarse: int, fine: int, outputs: int) -> None:
        super().__init__()
        self.coarse, self.fine = _conv(coarse, outputs, 1), _conv(fine, outputs, 1)
        self.mix = _conv(outputs, outputs)

    def forward(self, coarse: Tensor, fine: Tensor) -> Tensor:
        larger = functional.interpolate(
            self.coarse(coarse), scale_factor=2, mode="bilinear", align_corners=False
        )
        joined = torch.relu(larger + self.fine(fine))
        return torch.relu(joined + self.mix(joined))


class Network(nn.Module):
    """RGB float32 (n, 3, h, w), 0..1, sides multiples of 32, to logits (n, classes, h / 2, w / 2).

    The finest features are those of a quarter of the width; each of their cells says all four of the logits in it.
    """

    def __init__(self, classes: int) -> None:
        super().__init__()
        self.stem = nn.Sequential(_conv(3, _HALF, 3, 2), nn.ReLU())
        self.quarter = nn.Sequential(_conv(_HALF, _QUARTER, 3, 2), nn.ReLU(), _Plain(_QUARTER))
        self.eighth = nn.Sequential(
            _conv(_QUARTER, _EIGHTH, 3, 2), nn.ReLU(), *(_Inverted(_EIGHTH) for _ in range(2))
        )
        self.sixteenth = nn.Sequential(_Down(_EIGHTH, _SIXTEENTH), *(_Inverted(_SIXTEENTH) for _ in range(3)))
        self.thirty_second = nn.Sequential(
            _Down(_SIXTEENTH, _THIRTY_SECOND), *(_Inverted(_THIRTY_SECOND) for _ in range(2))
        )
        self.whole = nn.Linear(_THIRTY_SECOND, _THIRTY_SECOND)  # what the picture as a whole is of
        self.to_sixteenth = _Joined(_THIRTY_SECOND, _SIXTEENTH, 48)
        self.to_eighth = _Joined(48, _EIGHTH, 40)
        self.to_quarter = _Joined(40, _QUARTER, 40)
        self.logits = _Pointwise(40, 4 * classes, 1)

    def forward(self, picture: Tensor) -> Tensor:
        """Logits of every second pixel along each axis."""
        quarter = self.quarter(self.stem((picture - 0.4) * 4.0))
        eighth = self.eighth(quarter)
        sixteenth = self.sixteenth(eighth)
        deepest = self.thirty_second(sixteenth)
        deepest = torch.relu(deepest + self.whole(deepest.mean(dim=(2, 3)))[:, :, None, None])
        x = self.to_sixteenth(deepest, sixteenth)
        x = self.to_quarter(self.to_eighth(x, eighth), quarter)
        return functional.pixel_shuffle(self.logits(x), 2)
