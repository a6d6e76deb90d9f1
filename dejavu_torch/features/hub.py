"""Short names for place recognition networks of torch.hub, and the `Embedding` that each stands for."""

from __future__ import annotations

import sys
from contextlib import redirect_stdout
from typing import Any, NamedTuple

import torch

from dejavu_torch.features.embedding import Embedding
from dejavu_torch.types import InputError

PREFIX = "hub:"
MEAN, STD = [0.485, 0.456, 0.406], [0.229, 0.224, 0.225]  # of ImageNet


class Network(NamedTuple):
    """A call of torch.hub.load, with the frame size (height, width) and the output of its evaluation."""

    repository: str
    entry: str
    settings: dict[str, Any]
    size: tuple[int, int] = (322, 322)
    output: int | None = None

    @property
    def call(self) -> dict[str, Any]:
        """The arguments of torch.hub.load."""
        return {"repo_or_dir": self.repository, "model": self.entry, "trust_repo": True, **self.settings}


RESNET = {"backbone": "ResNet50", "fc_output_dim": 2048}
SELA = {"backbone": "dinov2-large", "aggregation": "gem", "hashing": True, "rerank": True}
BOQ = {"backbone_name": "dinov2", "output_dim": 12288}
NETWORKS = {
    "anyloc": Network("AnyLoc/DINO", "get_vlad_model", {"backbone": "DINOv2", "domain": "urban"}),
    "boq": Network("amaralibey/bag-of-queries", "get_trained_boq", BOQ),
    "cosplace": Network("gmberton/cosplace", "get_trained_model", RESNET, (480, 640)),
    "cricavpr": Network("Lu-Feng/CricaVPR", "trained_model", {}, (224, 224)),  # attends over the batch
    "eigenplaces": Network("gmberton/eigenplaces", "get_trained_model", RESNET, (480, 640)),
    "megaloc": Network("gmberton/MegaLoc", "get_trained_model", {}),
    "sage": Network("chenshunpeng/SAGE", "sage_vitb", {}),
    "salad": Network("serizba/salad", "dinov2_salad", {}),
    "selavpr++": Network("Lu-Feng/SelaVPRplusplus", "SelaVPRplusplus", SELA, output=1),
}


def known(name: str) -> Network:
    """The network with a short name such as `hub:megaloc`."""
    network = NETWORKS.get(name.removeprefix(PREFIX))
    if network is None:
        names = ", ".join(f"{PREFIX}{one}" for one in NETWORKS)
        raise InputError(f"{name} is not the short name of a network; expected one of {names}")
    return network


def hub(
    name: str,
    network: dict[str, Any] | None = None,
    dimension: int | None = None,
    resize: tuple[int, int] | None = None,
    mean: float | list[float] | None = MEAN,
    std: float | list[float] | None = STD,
    output: int | None = None,
    **settings: Any,
) -> Embedding:
    """Download a network of torch.hub, which runs its repository's code, as features.

    Args:
        name: short name, such as megaloc
        network: arguments of torch.hub.load that replace those of the name, such as {domain: aerial}
        dimension, mean, std: of `Embedding`, as are all others
        resize, output: likewise; those of the name if not given
    """
    made = known(name)
    with redirect_stdout(sys.stderr):  # stdout may be read by a program
        net = torch.hub.load(**made.call | (network or {}))
    net = net.module.cpu() if isinstance(net, torch.nn.DataParallel) else net
    size, chosen = made.size if resize is None else resize, made.output if output is None else output
    return Embedding(net, dimension=dimension, resize=size, mean=mean, std=std, output=chosen, **settings)
