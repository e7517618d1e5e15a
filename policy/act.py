"""ACT and Comp-ACT: a transformer that turns images, arm state and recent forces into a chunk of actions.

    images (B, cameras, h, w, 3)  CNN, shared by cameras     cameras * h' * w' tokens  \
    state (B, S)                  linear                     1 token                    >  encoder  -> memory
    wrench (B, samples, W)        convolution over time      samples / 4 tokens        /
    latent (B, Z)                 linear, with the CVAE      1 token                  /
    queries (chunk, D)            learned                    decoder over memory      -> actions (B, chunk, A)

While it learns, the CVAE's encoder draws the latent from the action chunk, the state and the wrench; when it
runs, the latent is zero. Zhao et al. 2023 (arXiv 2304.13705, github.com/tonyzhaozh/act), with the wrench and
the stiffness of Kamijo et al. 2024 (arXiv 2406.14990, github.com/omron-sinicx/CompACT). Changed on purpose:

- The actions come from the last decoder layer; the published code takes the first, and the others never learn
  (tonyzhaozh/act issues 10, 25).
- The loss of a chunk is averaged over its valid steps, not over the padding (huggingface/lerobot 3442).
- The groups of an action (position, rotation, gripper, stiffness) have weights, each averaged over its
  numbers: in the paper's layout 63 % of the loss is stiffness.
- The decoder starts from its queries, not from zeros, on which its first self-attention cannot work; keys
  have no bias, which the softmax would cancel. So every parameter learns.
- Dropout acts on branches, not on attention weights: attention can be fused.
- The wrench has a short history.

Kept: positions are added to queries and keys at every layer, as in DETR; the KL term sums over the latent.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from policy.config import TrainConfig
from policy.features import Encoding, Group
from policy.vision import KeypointCnn, ResNet18, SmallCnn

IMAGE_MEAN = (0.485, 0.456, 0.406)  # of ImageNet, as torchvision's weights expect
IMAGE_STD = (0.229, 0.224, 0.225)


@dataclass(frozen=True, slots=True)
class Batch:
    """What the network is given, normalised by `Features`; images as they are."""

    state: Tensor  # (B, state width)
    wrench: Tensor  # (B, samples, arms * 6), the oldest sample first; not read without wrench
    images: Tensor  # (B, cameras, h, w, 3) uint8
    action: Tensor | None = None  # (B, chunk, action width): what to learn
    valid: Tensor | None = None  # (B, chunk) bool: steps that count
    light: Tensor | None = None  # (B, cameras, 2): contrast, and what is added, to change images of 0 .. 1 by

    def to(self, device: torch.device) -> Batch:
        def moved(tensor: Tensor | None) -> Tensor | None:
            return None if tensor is None else tensor.to(device, non_blocking=True)

        state, wrench, images = (
            t.to(device, non_blocking=True) for t in (self.state, self.wrench, self.images)
        )
        return Batch(state, wrench, images, moved(self.action), moved(self.valid), moved(self.light))


class Act(nn.Module):
    """Everything from a batch to actions and their loss."""

    image_mean: Tensor
    image_std: Tensor
    loss_weights: Tensor
    step_positions: Tensor

    def __init__(self, config: TrainConfig, encoding: Encoding, n_cameras: int) -> None:
        super().__init__()
        d, chunk, width = config.width, config.chunk, encoding.action_width
        self.n_cameras = n_cameras if config.images else 0
        self.has_wrench, self.has_cvae = config.wrench, config.cvae
        self.latent, self.kl_weight = config.latent, config.kl_weight
        self.state_dropout, self.own_width = config.state_dropout, encoding.own_width
        self._groups: dict[Group, list[int]] = {name: encoding.columns(name) for name in encoding.groups}
        n_wrench = encoding.n_arms * 6

        if self.n_cameras:
            self.vision = _vision(config)
            self.image_token = nn.Conv2d(self.vision.width, d, 1)
            self.camera = nn.Parameter(torch.randn(self.n_cameras, 1, d) * 0.02)
        self.state_token = nn.Linear(encoding.state_width, d)
        n_tokens = 1
        if self.has_wrench:
            self.wrench_tokens = WrenchEncoder(n_wrench, d)
            n_tokens += self.wrench_tokens.count(config.wrench_history)
        if self.has_cvae:
            self.latent_token = nn.Linear(config.latent, d)
            n_tokens += 1
            self.posterior = Posterior(config, encoding.state_width, n_wrench, width)
        self.token_position = nn.Parameter(torch.randn(n_tokens, d) * 0.02)

        self.encoder = nn.ModuleList(EncoderLayer(config) for _ in range(config.encoder_layers))
        self.encoder_norm = nn.LayerNorm(d) if config.pre_norm else nn.Identity()
        self.query = nn.Parameter(torch.randn(chunk, d))
        self.decoder = nn.ModuleList(DecoderLayer(config) for _ in range(config.decoder_layers))
        self.decoder_norm = nn.LayerNorm(d)
        self.head = nn.Linear(d, width)

        self.register_buffer("image_mean", torch.tensor(IMAGE_MEAN), persistent=False)
        self.register_buffer("image_std", torch.tensor(IMAGE_STD), persistent=False)
        self.register_buffer("loss_weights", _loss_weights(config, self._groups, width), persistent=False)

    @staticmethod
    def of(config: TrainConfig, encoding: Encoding, cameras: Mapping[str, tuple[int, int]]) -> Act:
        model = Act(config, encoding, len(cameras))
        for parameter in model.parameters():
            if parameter.dim() == 4:
                parameter.data = parameter.data.to(memory_format=torch.channels_last)
        return model

    def forward(self, batch: Batch, *, hide_images: bool = False, hide_wrench: bool = False) -> Tensor:
        """(B, chunk, action width), normalised, with the latent at zero."""
        latent = batch.state.new_zeros(len(batch.state), self.latent)
        return self._actions(batch, latent, hide_images, hide_wrench)

    def loss(self, batch: Batch) -> dict[str, Tensor]:
        """The scalar `loss`, and what it is made of: L1 of each group, KL of the latent."""
        if not self.has_cvae:
            return self.errors(self(batch), batch)
        mean, log_variance = (x.float() for x in self.posterior(batch, batch.action, batch.valid))
        latent = mean + torch.exp(log_variance / 2) * torch.randn_like(mean)
        kl = -0.5 * (1 + log_variance - mean**2 - log_variance.exp()).sum(-1).mean()
        told = self.errors(self._actions(batch, latent), batch)
        return {**told, "loss": told["loss"] + self.kl_weight * kl, "kl": kl.detach()}

    def errors(self, actions: Tensor, batch: Batch) -> dict[str, Tensor]:
        """Weighted L1 of predicted actions (B, chunk, action width) as `loss`, and that of each group."""
        assert batch.action is not None
        assert batch.valid is not None
        error = (actions.float() - batch.action).abs()  # whole precision, also where the network has half
        valid = batch.valid.to(error.dtype)
        # The mean over a chunk's valid steps, then over the chunks: each moment of a take counts the same.
        of_chunk = (error * valid[..., None]).sum(1) / valid.sum(1).clamp(min=1)[:, None]  # (B, width)
        l1 = of_chunk.mean(0)
        told: dict[str, Tensor] = {
            name: l1[columns].mean().detach() for name, columns in self._groups.items()
        }
        return {"loss": (l1 * self.loss_weights).sum(), **told}

    def _actions(
        self, batch: Batch, latent: Tensor, hide_images: bool = False, hide_wrench: bool = False
    ) -> Tensor:
        state = batch.state
        if self.training and self.n_cameras:
            kept = torch.rand(len(state), 1, device=state.device) >= self.state_dropout
            own = torch.arange(state.shape[1], device=state.device) < self.own_width
            state = state * (kept | ~own)
        tokens = [self.state_token(state)[:, None]]
        if self.has_wrench:
            tokens.append(self.wrench_tokens(batch.wrench * (not hide_wrench)))
        if self.has_cvae:
            tokens.append(self.latent_token(latent)[:, None])
        x = torch.cat(tokens, dim=1)
        positions = self.token_position[None].expand(len(x), -1, -1)
        if self.n_cameras:
            seen, seen_positions = self._see(batch, hide_images)
            x = torch.cat((x, seen), dim=1)
            positions = torch.cat((positions, seen_positions.expand(len(x), -1, -1)), dim=1)
        for layer in self.encoder:
            x = layer(x, positions)
        memory = self.encoder_norm(x)  # (B, tokens, d)
        queries = self.query[None].expand(len(x), -1, -1)
        y = queries
        for layer in self.decoder:
            y = layer(y, queries, memory, positions)
        actions: Tensor = self.head(self.decoder_norm(y))
        return actions

    def _see(self, batch: Batch, hide: bool) -> tuple[Tensor, Tensor]:
        """(B, cameras * h' * w', d) tokens and (1, …, d) their positions."""
        pixels = batch.images / 255.0
        if batch.light is not None:
            contrast, brightness = batch.light[:, :, None, None, None].unbind(-1)
            pixels = (pixels - 0.5) * contrast + (0.5 + brightness)
        pixels = (pixels - self.image_mean) / self.image_std * (not hide)
        maps = self.image_token(self.vision(pixels.flatten(0, 1).permute(0, 3, 1, 2)))  # (B c, d, h', w')
        grid = _sine_grid(maps.shape[2], maps.shape[3], maps.shape[1], maps.device)  # (h' w', d)
        tokens = maps.flatten(2).transpose(1, 2).reshape(len(pixels), -1, maps.shape[1])
        return tokens, (self.camera + grid[None]).reshape(1, -1, maps.shape[1])


class WrenchEncoder(nn.Module):
    """Forces over the last moments as tokens: a convolution over time with stride 4."""

    def __init__(self, width: int, d: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv1d(width, d // 2, 4, stride=2, padding=1)
        self.conv2 = nn.Conv1d(d // 2, d, 4, stride=2, padding=1)

    @staticmethod
    def count(samples: int) -> int:
        return max(samples // 4, 1)

    def forward(self, wrench: Tensor) -> Tensor:
        """(B, samples / 4, d) of (B, samples, width)."""
        x = wrench.transpose(1, 2)
        if x.shape[-1] < 4:  # too short to see a course in
            x = x[..., -1:].expand(-1, -1, 4)
        tokens: Tensor = self.conv2(F.gelu(self.conv1(x)))
        return tokens.transpose(1, 2)


class Posterior(nn.Module):
    """The CVAE's encoder: mean and log variance of the latent, from a chunk and what was observed."""

    positions: Tensor

    def __init__(self, config: TrainConfig, n_state: int, n_wrench: int, n_action: int) -> None:
        super().__init__()
        d = config.width
        self.summary = nn.Parameter(torch.randn(1, 1, d) * 0.02)
        self.state = nn.Linear(n_state, d)
        self.wrench = WrenchEncoder(n_wrench, d) if config.wrench else None
        self.action = nn.Linear(n_action, d)
        self.layers = nn.ModuleList(EncoderLayer(config) for _ in range(config.cvae_layers))
        self.norm = nn.LayerNorm(d)
        self.out = nn.Linear(d, 2 * config.latent)
        n_wrench_tokens = WrenchEncoder.count(config.wrench_history) if config.wrench else 0
        n = 2 + n_wrench_tokens + config.chunk
        self.register_buffer("positions", _sine_line(n, d, torch.device("cpu"))[None], persistent=False)

    def forward(self, batch: Batch, action: Tensor, valid: Tensor) -> tuple[Tensor, Tensor]:
        tokens = [self.summary.expand(len(action), -1, -1), self.state(batch.state)[:, None]]
        if self.wrench is not None:
            tokens.append(self.wrench(batch.wrench))
        observed = torch.cat(tokens, dim=1)
        x = torch.cat((observed, self.action(action)), dim=1)
        attended = torch.cat((valid.new_ones(observed.shape[:2]), valid), dim=1)[
            :, None, None
        ]  # (B, 1, 1, n)
        for layer in self.layers:
            x = layer(x, self.positions, attended)
        mean, log_variance = self.out(self.norm(x[:, 0])).chunk(2, dim=-1)
        return mean, log_variance


class EncoderLayer(nn.Module):
    """Self-attention and feed-forward, normalised before (GPT) or after (ACT) each."""

    def __init__(self, config: TrainConfig) -> None:
        super().__init__()
        self.pre_norm = config.pre_norm
        self.attention = Attention(config)
        self.feedforward = FeedForward(config)
        self.norms = nn.ModuleList(nn.LayerNorm(config.width) for _ in range(2))
        self.dropout = nn.Dropout(config.dropout)

    def forward(self, x: Tensor, positions: Tensor, attended: Tensor | None = None) -> Tensor:
        before, after = (self.norms, _AS_IT_IS) if self.pre_norm else (_AS_IT_IS, self.norms)
        y = before[0](x)
        x = after[0](x + self.dropout(self.attention(y + positions, y + positions, y, attended)))
        out: Tensor = after[1](x + self.dropout(self.feedforward(before[1](x))))
        return out


class DecoderLayer(nn.Module):
    """Self-attention among the chunk's steps, attention to what was observed, feed-forward."""

    def __init__(self, config: TrainConfig) -> None:
        super().__init__()
        self.pre_norm = config.pre_norm
        self.own = Attention(config)
        self.cross = Attention(config)
        self.feedforward = FeedForward(config)
        self.norms = nn.ModuleList(nn.LayerNorm(config.width) for _ in range(3))
        self.dropout = nn.Dropout(config.dropout)

    def forward(self, x: Tensor, queries: Tensor, memory: Tensor, positions: Tensor) -> Tensor:
        before, after = (self.norms, _AS_IT_IS) if self.pre_norm else (_AS_IT_IS, self.norms)
        y = before[0](x)
        x = after[0](x + self.dropout(self.own(y + queries, y + queries, y)))
        y = before[1](x)
        x = after[1](x + self.dropout(self.cross(y + queries, memory + positions, memory)))
        out: Tensor = after[2](x + self.dropout(self.feedforward(before[2](x))))
        return out


class Attention(nn.Module):
    """Multi-head attention (Vaswani et al. 2017), fused where the device can."""

    def __init__(self, config: TrainConfig) -> None:
        super().__init__()
        d = config.width
        self.heads = config.heads
        self.query, self.value, self.out = (nn.Linear(d, d) for _ in range(3))
        self.key = nn.Linear(d, d, bias=False)
        for linear in (self.query, self.key, self.value):
            nn.init.xavier_uniform_(linear.weight)

    def forward(self, query: Tensor, key: Tensor, value: Tensor, attended: Tensor | None = None) -> Tensor:
        """(B, n, d) for queries (B, n, d); `attended` (B, 1, 1, m) is false for keys to leave out."""
        q, k, v = (
            self._split(linear(x))
            for linear, x in ((self.query, query), (self.key, key), (self.value, value))
        )
        mixed = F.scaled_dot_product_attention(q, k, v, attn_mask=attended)
        out: Tensor = self.out(mixed.transpose(1, 2).flatten(2))
        return out

    def _split(self, x: Tensor) -> Tensor:
        return x.reshape(*x.shape[:2], self.heads, -1).transpose(1, 2)  # (B, heads, n, d / heads)


class FeedForward(nn.Sequential):
    """Two linear layers around a ReLU."""

    def __init__(self, config: TrainConfig) -> None:
        super().__init__(
            nn.Linear(config.width, config.feedforward),
            nn.ReLU(),
            nn.Dropout(config.dropout),
            nn.Linear(config.feedforward, config.width),
        )


def _vision(config: TrainConfig) -> KeypointCnn | SmallCnn | ResNet18:
    if config.backbone == "resnet18":
        return ResNet18(frozen=bool(config.backbone_weights))
    return KeypointCnn() if config.backbone == "keypoints" else SmallCnn()


_AS_IT_IS = [nn.Identity()] * 3


def _loss_weights(config: TrainConfig, groups: Mapping[Group, list[int]], width: int) -> Tensor:
    """(width,): each group's weight, spread over its numbers."""
    weight_of: dict[Group, float] = {
        "position": config.position_weight,
        "rotation": config.rotation_weight,
        "joints": config.joint_weight,
        "gripper": config.gripper_weight,
        "stiffness": config.stiffness_weight,
    }
    weights = torch.zeros(width)
    for name, columns in groups.items():
        weights[columns] = weight_of[name] / len(columns)
    return weights


def _sine_line(n: int, d: int, device: torch.device) -> Tensor:
    """(n, d) sinusoidal positions of a sequence (Vaswani et al. 2017)."""
    frequency = torch.exp(torch.arange(0, d, 2, device=device) * (-math.log(10_000.0) / d))
    angles = torch.arange(n, device=device)[:, None] * frequency
    return torch.stack((angles.sin(), angles.cos()), dim=-1).flatten(1)


def _sine_grid(height: int, width: int, d: int, device: torch.device) -> Tensor:
    """(height * width, d) sinusoidal positions in an image, half for rows, half for columns, as in DETR."""
    rows = _sine_line(height, d // 2, device)[:, None].expand(-1, width, -1)
    columns = _sine_line(width, d // 2, device)[None].expand(height, -1, -1)
    return torch.cat((rows, columns), dim=-1).flatten(0, 1)
