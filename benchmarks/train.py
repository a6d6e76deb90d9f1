"""`benchmarks train`: the time to train a descriptor, and its accuracy."""

from __future__ import annotations

import logging
import tempfile
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import nn
from tqdm import tqdm

from benchmarks.measure import Row, truth_of, write_bench
from benchmarks.plots import plot_ratios
from dejavu_torch.data.ground_truth import GroundTruth
from dejavu_torch.data.source import open_source
from dejavu_torch.evaluation.curves import evaluate
from dejavu_torch.evaluation.report import text_table
from dejavu_torch.features.augmentation import Augmentation
from dejavu_torch.features.cnn import SmallCNN
from dejavu_torch.maps.spectral import SpectralMapper
from dejavu_torch.types import InputError, Traverse

ROUTE = ("sim:aerial?frames=1000", "sim:aerial?frames=1000&traverse=1")
STEPS = 600
SEEDS = (0, 1, 2)
BUDGETS = (2.4, 1.0, 0.4)  # route bytes per place of the maps of a descriptor
TOLERANCE = 5
STRENGTHS: dict[str, Any] = {"shift": (0.02, 0.08), "occlusion": 0.5}  # of configs/train_road.yaml
WEIGHT_DECAY = 0.5
LEARNING_RATE = 6e-3  # of configs/train_road.yaml
RATE = 0.3  # of a bit per place, there


class Rung(NamedTuple):
    """A way to train: backbone, augmentation, precision of the trainer, learning rate, weight of a bit."""

    name: str
    backbone: Callable[[], nn.Module]
    augmentation: Callable[[], Augmentation]
    precision: str = "32-true"
    lr: float = 3e-3
    rate: float = 0.0


def network() -> SmallCNN:
    """The network of configs/train_road.yaml, without local contrast."""
    return SmallCNN(squeeze=24, cell=0)


def ladder() -> list[Rung]:
    """Each rung changes one thing in the one before; 16 bits only if the processor has them."""
    from dejavu_torch.training.export import has_bf16

    rungs = [Rung("fused augmentation", network, lambda: Augmentation(**STRENGTHS))]
    rungs.append(rungs[-1]._replace(name="twice the learning rate", lr=LEARNING_RATE))
    if has_bf16():
        rungs.append(rungs[-1]._replace(name="16 bits", precision="bf16-mixed"))
    return [*rungs, rungs[-1]._replace(name="a rate in the loss", rate=RATE)]


def trained(
    rung: Rung, seed: int, reference: Traverse, query: Traverse, truth: GroundTruth, steps: int
) -> Row:
    import pytorch_lightning as pl
    from pytorch_lightning.callbacks import Timer

    from dejavu_torch.training.datamodule import RouteData
    from dejavu_torch.training.descriptors import DescriptorTask

    pl.seed_everything(seed, verbose=False)
    task = DescriptorTask(
        rung.backbone(), SpectralMapper(BUDGETS[0]), rate=rung.rate, lr=rung.lr, weight_decay=WEIGHT_DECAY
    )
    data = RouteData(reference, tolerance=TOLERANCE, augmentation=rung.augmentation(), held_out=0.0)
    timer = Timer()
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.filterwarnings("ignore", ".*isinstance.treespec")  # Lightning's own
        pl.Trainer(
            accelerator="cpu",
            max_steps=steps,
            precision=rung.precision,  # type: ignore[arg-type]
            gradient_clip_val=5.0,
            callbacks=[timer],
            logger=False,
            enable_checkpointing=False,
            enable_progress_bar=False,
            enable_model_summary=False,
            limit_val_batches=0,
            default_root_dir=folder,
        ).fit(task, datamodule=data)
    model = task.deployed()
    places, queries = model.descriptor.all_of(reference), model.descriptor.all_of(query)
    auc, recall = {}, {}
    for budget in BUDGETS:
        model.mapper = SpectralMapper(budget)
        try:
            model.learn_features(places, reference)
        except InputError:  # too few bytes for a short route
            continue
        scores = evaluate(model.localize_descriptors(queries), truth, TOLERANCE)
        auc[f"{budget:g}"], recall[f"{budget:g}"] = scores.auc, scores.recall_at_1
    return {
        "case": f"{reference.name}, {steps} steps",
        "contender": rung.name,
        "seed": seed,
        "steps": steps,
        "seconds": timer.time_elapsed("train"),
        "auc": auc,
        "recall_at_1": recall,
        "threads": torch.get_num_threads(),
    }


def run_train(
    sources: Sequence[str] = (), *, out: Path, steps: int | None = None, seeds: Sequence[int] = ()
) -> list[str]:
    """Seconds of a training, and the accuracy of its descriptor.

    Args:
        sources: REFERENCE QUERY; the built-in road if not given
        out: folder for bench.json and bench.png
        steps: steps of each training; 600 if not given
        seeds: seeds, with a training each; 0, 1 and 2 if not given

    Convention: on the CPU; seconds are for the steps only; auc and recall_at_1 are by route bytes per place,
        without those that are too few for a map.

    Raises:
        InputError: not two sources, no steps or seeds, or no ground truth.
    """
    from dejavu_torch.training.export import has_bf16

    steps, seeds = STEPS if steps is None else steps, seeds or SEEDS
    if len(sources) not in (0, 2):
        raise InputError(f"bench train got {len(sources)} sources; expected REFERENCE QUERY, or none")
    if steps < 1 or not all(0 <= seed < 2**32 for seed in seeds):
        seen = f"bench train got {steps} steps and seeds {list(seeds)}"
        raise InputError(f"{seen}; expected at least one each, and seeds from 0 to 2^32 - 1")
    reference, query = (open_source(source) for source in sources or ROUTE)
    truth = truth_of(reference, query)
    logging.getLogger("pytorch_lightning").setLevel(logging.WARNING)
    works = tqdm([(rung, seed) for rung in ladder() for seed in seeds], "train", disable=None, leave=False)
    rows = [trained(rung, seed, reference, query, truth, steps) for rung, seed in works]
    rungs: dict[str, list[Row]] = {}
    for row in rows:
        rungs.setdefault(row["contender"], []).append(row)
    means = {name: sum(row["seconds"] for row in own) / len(own) for name, own in rungs.items()}
    picture = plot_ratios({f"{steps} steps": means}, "seconds of a training, mean of the seeds")
    write_bench(out, rows, picture, bf16=has_bf16())
    table = [["", "seconds", *(f"AUC at {budget:g} B" for budget in BUDGETS)]]
    for name, own in rungs.items():
        areas = ([row["auc"][key] for row in own if key in row["auc"]] for key in map("{:g}".format, BUDGETS))
        table.append([name, f"{means[name]:.1f}", *map(spread, areas)])
    seen = (
        f"{rows[0]['case']}, seeds {', '.join(map(str, dict.fromkeys(seeds)))}, threads: {rows[0]['threads']}"
    )
    return [text_table(table), f"{seen}; each row changes one thing in the row above"]


def spread(values: list[float]) -> str:
    """The mean of some values with their minimum and maximum, or a single value."""
    if len(values) < 2:
        return f"{values[0]:.3f}" if values else "-"
    return f"{sum(values) / len(values):.3f} ({min(values):.3f}-{max(values):.3f})"
