"""The network: shapes, switches, and that all of it learns from what counts."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from policy.act import Act, Batch
from policy.config import PRESETS, TrainConfig
from policy.features import Encoding
from policy.vision import KeypointCnn, ResNet18

TINY = TrainConfig(
    width=16, feedforward=32, heads=2, chunk_seconds=0.5, dropout=0.0, state_dropout=0.0, latent=4
)
B, SIZE = 3, 32


def built(config: TrainConfig, n_arms: int = 1, n_cameras: int = 2) -> tuple[Act, Encoding]:
    torch.manual_seed(0)
    control = "joint" if config.policy == "act" else "cartesian"
    between = config.between and n_arms == 2 and control == "cartesian"
    encoding = Encoding(n_arms, control, config.frame, config.rotation, config.stiffness, between=between)
    return Act.of(config, encoding, {f"c{n}": (SIZE, SIZE) for n in range(n_cameras)}), encoding


def batch_for(config: TrainConfig, encoding: Encoding, n_cameras: int = 2, valid: int | None = None) -> Batch:
    """Random numbers; the first `valid` steps count."""
    torch.manual_seed(1)
    counts = torch.arange(config.chunk) < (config.chunk if valid is None else valid)
    return Batch(
        state=torch.randn(B, encoding.state_width),
        wrench=torch.randn(B, config.wrench_history, 6 * encoding.n_arms),
        images=torch.randint(0, 256, (B, n_cameras, SIZE, SIZE, 3), dtype=torch.uint8),
        action=torch.randn(B, config.chunk, encoding.action_width),
        valid=counts.expand(B, -1),
    )


SWITCHES = {
    "as it is": {},
    "cvae": {"cvae": True},
    "no wrench": {"wrench": False, "cvae": True},
    "no images": {"images": False},
    "joints": {"policy": "act"},
    "joints without wrench": {"policy": "act", "wrench": False},
    "norm after": {"pre_norm": False},
    "grid": {"backbone": "cnn"},
    "resnet": {"backbone": "resnet18"},
    "paper's action": {"rotation": "axis-angle", "stiffness": "cholesky", "frame": "absolute"},
}


@pytest.mark.parametrize("n_arms", [1, 2])
@pytest.mark.parametrize("name", SWITCHES)
def test_shapes_and_a_gradient_for_every_parameter(name: str, n_arms: int) -> None:
    config = dataclasses.replace(TINY, **SWITCHES[name])
    model, encoding = built(config, n_arms)
    batch = batch_for(config, encoding)
    assert model(batch).shape == (B, config.chunk, encoding.action_width)
    model.loss(batch)["loss"].backward()
    # With its layers in the wrong order the published decoder has 32 million parameters without one.
    dead = [n for n, p in model.named_parameters() if p.grad is None or not p.grad.abs().max() > 1e-9]
    assert not dead


def test_what_lies_past_the_end_does_not_change_the_loss() -> None:
    config = dataclasses.replace(TINY, cvae=True)
    model, encoding = built(config)
    batch = batch_for(config, encoding, valid=4)
    other = dataclasses.replace(batch, action=batch.action.clone())
    other.action[:, 4:] = 1e3
    losses = []
    for given in (batch, other):
        torch.manual_seed(2)  # of the latent
        losses.append(model.loss(given)["loss"].item())
    assert losses[0] == pytest.approx(losses[1], rel=1e-6)
    # ACT divides by the padding, too, which here would take off 60 %.
    plain, _ = built(dataclasses.replace(config, cvae=False))
    error = (plain(batch) - batch.action).abs()[:, :4].mean((0, 1))
    assert plain.loss(batch)["loss"].item() == pytest.approx(
        (error * plain.loss_weights).sum().item(), rel=1e-6
    )


def test_each_sample_counts_the_same_however_much_of_it_is_padding() -> None:
    model, encoding = built(TINY)
    batch = batch_for(TINY, encoding)
    valid = batch.valid.clone()
    valid[0, 2:] = False
    whole = model.loss(dataclasses.replace(batch, valid=valid))["loss"].item()
    each = [
        model.loss(
            Batch(
                *(x[n : n + 1] for x in (batch.state, batch.wrench, batch.images, batch.action)),
                valid=valid[n : n + 1],
            )
        )["loss"].item()
        for n in range(B)
    ]
    assert whole == pytest.approx(sum(each) / B, rel=1e-5)  # so that processes may share a batch


def test_copies_of_one_stiffness_do_not_drown_the_pose() -> None:
    config = PRESETS["paper"]
    encoding = Encoding(2, stiffness="cholesky", rotation="axis-angle", frame="absolute")
    small = dataclasses.replace(config, width=16, heads=2, feedforward=16, max_height=64, max_width=64)
    weights = Act(small, encoding, 0).loss_weights
    share = {g: weights[encoding.columns(g)].sum().item() / weights.sum().item() for g in encoding.groups}
    # 24 of 38 numbers are stiffness: 63 % of a plain mean.
    assert share == pytest.approx(dict.fromkeys(encoding.groups, 0.25))


@pytest.mark.parametrize(("switch", "blank"), [("wrench", "hide_wrench"), ("images", "hide_images")])
def test_what_is_switched_off_or_hidden_does_not_matter(switch: str, blank: str) -> None:
    model, encoding = built(TINY)
    model.eval()
    batch = batch_for(TINY, encoding)
    other = dataclasses.replace(batch, **{switch: torch.flip(getattr(batch, switch), (0,))})
    assert not torch.allclose(model(batch), model(other), atol=1e-5)
    assert torch.equal(model(batch, **{blank: True}), model(other, **{blank: True}))
    off, encoding = built(dataclasses.replace(TINY, **{switch: False}))
    off.eval()
    assert torch.equal(off(batch), off(other))


def test_a_running_policy_has_no_chance_in_it() -> None:
    config = dataclasses.replace(TINY, cvae=True, dropout=0.3)
    model, encoding = built(config)
    batch = batch_for(config, encoding)
    assert not torch.equal(model.train()(batch), model(batch))
    model.eval()
    assert torch.equal(model(batch), model(batch))


@pytest.mark.parametrize(("backbone", "millions"), [("keypoints", 0.76), ("cnn", 0.9), ("resnet18", 11.8)])
def test_a_small_policy_stays_small(backbone: str, millions: float) -> None:
    model, _ = built(TrainConfig(backbone=backbone))
    assert sum(p.numel() for p in model.parameters()) / 1e6 == pytest.approx(millions, rel=0.05)


def test_points_move_with_what_they_mark() -> None:
    torch.manual_seed(0)
    model = KeypointCnn()
    model.sharpness.data.fill_(8.0)  # a point is then where its map is highest
    images = torch.zeros(2, 3, 64, 96)
    images[0, :, 20:28, 32:40] = 4.0
    images[1, :, 28:36, 48:56] = 4.0
    points = model(images)[..., 0, 0].unflatten(1, (2, 32))
    assert points.abs().max() <= 1.0
    x, y = points[1] - points[0]
    marks = (x != 0) | (y != 0)  # the others are drawn to the border
    assert marks.sum() >= 8
    # 16 of 96 and 8 of 64 pixels are 4 of 24 and 2 of 16 cells, whose centres run from -1 to 1.
    torch.testing.assert_close(x[marks], torch.full_like(x[marks], 2 * 4 / 23), atol=0.01, rtol=0)
    torch.testing.assert_close(y[marks], torch.full_like(y[marks], 2 * 2 / 15), atol=0.01, rtol=0)


def test_resnet_reads_torchvisions_file(tmp_path: Path) -> None:
    torch.manual_seed(0)
    source = ResNet18(frozen=True)
    for name, buffer in source.named_buffers():
        buffer.uniform_(0.5, 1.5) if "var" in name else buffer.normal_()
    # What torchvision saves holds the last layer and counters, too.
    extra = {"fc.weight": torch.zeros(1000, 512), "bn1.num_batches_tracked": torch.tensor(0)}
    weights = {name: value.contiguous() for name, value in source.state_dict().items()} | extra
    torch.save(weights, tmp_path / "resnet18.pth")
    save_file(weights, tmp_path / "resnet18.safetensors")
    images = torch.randn(2, 3, 64, 64)
    for file in ("resnet18.pth", "resnet18.safetensors"):
        model = ResNet18(frozen=True)
        model.read_weights(tmp_path / file)
        assert torch.equal(model(images), source(images))
    assert source(images).shape == (2, 512, 2, 2)
    with pytest.raises(FileNotFoundError, match="No ResNet-18 weights"):
        model.read_weights(tmp_path / "other.pth")
    save_file({"x": torch.zeros(1)}, tmp_path / "wrong.safetensors")
    with pytest.raises(ValueError, match="does not hold the weights of torchvision's resnet18"):
        model.read_weights(tmp_path / "wrong.safetensors")


@pytest.mark.parametrize(
    ("wrong", "why"),
    [
        ({"chunk_seconds": 0.0}, "--chunk-seconds must be above 0"),
        ({"steps": 0}, "--steps must be at least 1"),
        ({"dropout": 1.0}, "--dropout must be at least 0 and below 1"),
        ({"width": 30}, "multiple of 4 and of --heads"),
        ({"rate": 200.0}, "above the 100 Hz"),
        ({"backbone_weights": "x.pth"}, "needs --backbone resnet18"),
        ({"seed": -1}, "--seed must not be negative"),
        ({"device": "gpu"}, "--device is auto, cpu, cuda or cuda:N, not 'gpu'"),
    ],
)
def test_settings_that_make_no_sense_are_refused(wrong: dict[str, object], why: str) -> None:
    with pytest.raises(ValueError, match=why):
        TrainConfig(**wrong)


def test_the_chunk_of_the_paper_is_100_steps_of_2_5_seconds() -> None:
    assert PRESETS["paper"].chunk == 100
    assert PRESETS["small"].chunk == 40


def test_half_precision_gives_nearly_the_same_loss_in_whole_precision() -> None:
    config = dataclasses.replace(TINY, cvae=True)
    model, encoding = built(config)
    batch = batch_for(config, encoding)
    losses = []
    for half in (False, True):
        torch.manual_seed(2)  # of the latent
        with torch.autocast("cpu", torch.bfloat16, enabled=half):
            losses.append(model.loss(batch)["loss"])
    assert losses[1].dtype == torch.float32
    assert losses[1].item() == pytest.approx(losses[0].item(), rel=0.02)


def test_a_share_of_the_samples_is_learned_without_the_state() -> None:
    model, encoding = built(dataclasses.replace(TINY, state_dropout=0.5), n_cameras=1)
    torch.manual_seed(1)
    n = 64
    wrench = torch.randn(n, TINY.wrench_history, 6)
    images = torch.zeros(n, 1, 16, 16, 3, dtype=torch.uint8)
    batches = [Batch(torch.randn(n, encoding.state_width), wrench, images) for _ in range(2)]

    def same(model: Act) -> int:
        told = []
        for batch in batches:
            torch.manual_seed(2)
            told.append(model(batch))
        return int(torch.isclose(*told, atol=1e-6).all((1, 2)).sum())

    assert 16 < same(model) < 48
    assert same(model.eval()) == 0
    blind, _ = built(dataclasses.replace(TINY, state_dropout=0.5, images=False))
    assert same(blind) == 0  # the state is all it has


def test_no_sample_is_learned_without_how_the_tools_stand_to_each_other() -> None:
    model, encoding = built(dataclasses.replace(TINY, state_dropout=0.9), n_arms=2, n_cameras=1)
    torch.manual_seed(1)
    n = 16
    states = torch.randn(2, n, encoding.state_width)
    states[1, :, : encoding.own_width] = states[0, :, : encoding.own_width]
    wrench, images = torch.zeros(n, TINY.wrench_history, 12), torch.zeros(n, 1, 16, 16, 3, dtype=torch.uint8)
    told = []
    for state in states:
        torch.manual_seed(2)
        told.append(model(Batch(state, wrench, images)))
    assert not torch.isclose(*told, atol=1e-6).all((1, 2)).any()
