"""Image encoders: two small CNNs that learn from nothing, and ResNet-18 that reads torchvision's weights.

All take (n, 3, h, w) in channels-last memory and give (n, `width`, h', w'). Normalisation is by groups,
which does not depend on the batch, or frozen, where weights trained elsewhere bring their own statistics.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path

import torch
import torch.nn.functional as F
from safetensors.torch import load_file
from torch import Tensor, nn

GROUPS = 8

Norm = Callable[[int], nn.Module]


class SmallCnn(nn.Module):
    """5x5 stem and three residual blocks, each with stride 2: 96x96 gives 6x6 tokens."""

    width = 96
    stride = 16

    def __init__(self, stem: int = 24) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(3, stem, 5, stride=2, padding=2, bias=False)
        self.norm1 = _group_norm(stem)
        self.blocks = nn.Sequential(
            BasicBlock(stem, stem, 2, _group_norm),
            BasicBlock(stem, 2 * stem, 2, _group_norm),
            BasicBlock(2 * stem, 4 * stem, 2, _group_norm),
        )
        _initialise(self)

    def forward(self, images: Tensor) -> Tensor:
        out: Tensor = self.blocks(F.relu(self.norm1(self.conv1(images))))
        return out


class KeypointCnn(nn.Module):
    """Where in the image `n_points` learned features are: each the centre of a softmax over its map.

    A place is told by numbers that move with it, so few demonstrations teach where to go: tokens of a grid
    have to learn each place anew. Spatial softmax of Levine et al. 2016 (arXiv 1504.00702), on maps of a
    quarter of the image's height and width.
    """

    def __init__(self, n_points: int = 32, stem: int = 24) -> None:
        super().__init__()
        self.width = 2 * n_points
        self.conv1 = nn.Conv2d(3, stem, 5, stride=2, padding=2, bias=False)
        self.norm1 = _group_norm(stem)
        self.blocks = nn.Sequential(
            BasicBlock(stem, stem, 2, _group_norm), BasicBlock(stem, 2 * stem, 1, _group_norm)
        )
        self.maps = nn.Conv2d(2 * stem, n_points, 1, bias=False)  # the softmax would cancel one
        self.sharpness = nn.Parameter(torch.zeros(n_points))  # log of what maps are multiplied by
        _initialise(self)

    def forward(self, images: Tensor) -> Tensor:
        """(n, 2 n_points, 1, 1): x of all points, then y, from -1 to 1 across the image."""
        maps = self.maps(self.blocks(F.relu(self.norm1(self.conv1(images)))))  # (n, points, h, w)
        sharp = maps * self.sharpness.exp()[:, None, None]
        shares = sharp.flatten(2).softmax(-1).unflatten(2, maps.shape[2:])
        x = torch.linspace(-1.0, 1.0, maps.shape[3], device=maps.device)
        y = torch.linspace(-1.0, 1.0, maps.shape[2], device=maps.device)
        points = torch.cat(((shares.sum(2) * x).sum(-1), (shares.sum(3) * y).sum(-1)), dim=1)
        return points[..., None, None]


class ResNet18(nn.Module):
    """He et al. 2016, with the names of torchvision's state dict, without its last layer."""

    width = 512
    stride = 32

    def __init__(self, frozen: bool) -> None:
        """`frozen`: normalise with statistics that come with weights, see `read_weights`."""
        super().__init__()
        norm: Norm = FrozenNorm if frozen else _group_norm
        self.conv1 = nn.Conv2d(3, 64, 7, stride=2, padding=3, bias=False)
        self.bn1 = norm(64)
        self.layer1 = nn.Sequential(BasicBlock(64, 64, 1, norm), BasicBlock(64, 64, 1, norm))
        self.layer2 = nn.Sequential(BasicBlock(64, 128, 2, norm), BasicBlock(128, 128, 1, norm))
        self.layer3 = nn.Sequential(BasicBlock(128, 256, 2, norm), BasicBlock(256, 256, 1, norm))
        self.layer4 = nn.Sequential(BasicBlock(256, 512, 2, norm), BasicBlock(512, 512, 1, norm))
        _initialise(self)

    def forward(self, images: Tensor) -> Tensor:
        out = F.max_pool2d(F.relu(self.bn1(self.conv1(images))), 3, stride=2, padding=1)
        deep: Tensor = self.layer4(self.layer3(self.layer2(self.layer1(out))))
        return deep

    def read_weights(self, path: Path) -> None:
        """Load torchvision's `resnet18` state dict from a .pth or .safetensors file."""
        if not path.exists():
            raise FileNotFoundError(f"No ResNet-18 weights at {path}.")
        if path.suffix == ".safetensors":
            weights = load_file(path)
        else:
            weights = torch.load(path, map_location="cpu", weights_only=True)
        kept = {
            name: value
            for name, value in weights.items()
            if not name.startswith("fc.") and not name.endswith("num_batches_tracked")
        }
        try:
            self.load_state_dict(OrderedDict(kept))
        except RuntimeError as error:
            raise ValueError(
                f"{path} does not hold the weights of torchvision's resnet18: {error}"
            ) from error


class BasicBlock(nn.Module):
    """Two 3x3 convolutions beside a shortcut."""

    def __init__(self, in_width: int, width: int, stride: int, norm: Norm) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(in_width, width, 3, stride=stride, padding=1, bias=False)
        self.bn1 = norm(width)
        self.conv2 = nn.Conv2d(width, width, 3, padding=1, bias=False)
        self.bn2 = norm(width)
        self.downsample: nn.Module | None = None
        if stride != 1 or in_width != width:
            self.downsample = nn.Sequential(
                nn.Conv2d(in_width, width, 1, stride=stride, bias=False), norm(width)
            )

    def forward(self, x: Tensor) -> Tensor:
        out = self.bn2(self.conv2(F.relu(self.bn1(self.conv1(x)))))
        return F.relu(out + (x if self.downsample is None else self.downsample(x)))


class FrozenNorm(nn.Module):
    """Batch normalisation whose statistics and affine part are given and stay."""

    weight: Tensor
    bias: Tensor
    running_mean: Tensor
    running_var: Tensor

    def __init__(self, width: int) -> None:
        super().__init__()
        for name, value in (("weight", 1.0), ("bias", 0.0), ("running_mean", 0.0), ("running_var", 1.0)):
            self.register_buffer(name, torch.full((width,), value))

    def forward(self, x: Tensor) -> Tensor:
        return F.batch_norm(x, self.running_mean, self.running_var, self.weight, self.bias)


def _group_norm(width: int) -> nn.Module:
    return nn.GroupNorm(GROUPS, width)


def _initialise(module: nn.Module) -> None:
    for part in module.modules():
        if isinstance(part, nn.Conv2d):
            nn.init.kaiming_normal_(part.weight, mode="fan_out", nonlinearity="relu")
