"""Networks that functions make, and short names for those of torch.hub that recognise places."""

from __future__ import annotations

import pydoc
import sys
from contextlib import redirect_stdout
from typing import Any, NamedTuple

from torch import nn

from dejavu_torch.features.embedding import Embedding
from dejavu_torch.text import one_line
from dejavu_torch.types import Facts, InputError, expect

PREFIX = "hub:"
MEAN, STD = [0.485, 0.456, 0.406], [0.229, 0.224, 0.225]  # of ImageNet


class Network(NamedTuple):
    """A call of torch.hub.load, with the frame size (height, width) and the output of its evaluation."""

    repository: str
    entry: str
    settings: Facts
    size: tuple[int, int] = (322, 322)
    output: int | None = None

    @property
    def call(self) -> Facts:
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
    network: Facts | None = None,
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
    own = known(name)
    net = made("torch.hub.load", **own.call | (network or {}))
    size, chosen = own.size if resize is None else resize, own.output if output is None else output
    return Embedding(net, dimension=dimension, resize=size, mean=mean, std=std, output=chosen, **settings)


def made(function: str, **arguments: object) -> nn.Module:
    """The network that a function of any signature makes, such as torch.hub.load.

    jsonargparse itself only accepts functions with annotated arguments and return value.

    Args:
        function: its import path as the user typed it, never from a map or checkpoint.
    """
    try:
        maker: Any = pydoc.locate(function)
    except pydoc.ErrorDuringImport as error:
        raise InputError(f"{function} cannot be imported: {one_line(error.value)}") from error
    expect(callable(maker), "one, or a class", f"{function} is no function that can be imported")
    try:
        with redirect_stdout(sys.stderr):  # keeps stdout to lines of JSON
            network: nn.Module = maker(**arguments)
    except SystemExit as stop:  # it would end the command silently
        raise InputError(f"{function} ends the program ({stop}); expected one that makes a network") from stop
    expect(isinstance(network, nn.Module), "an nn.Module", f"{function} made a {type(network).__name__}")
    # DataParallel would use the first GPU, wherever the model is
    return network.module.cpu() if isinstance(network, nn.DataParallel) else network
