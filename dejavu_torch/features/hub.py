"""Short names for place recognition networks of torch.hub, and the `Embedding` that each stands for."""

from __future__ import annotations

from typing import Any

from dejavu_torch.features.embedding import Embedding
from dejavu_torch.types import InputError

PREFIX = "hub:"


def embedding(
    repository: str, entry: str, resize: tuple[int, int] = (322, 322), output: int | None = None, **own: Any
) -> dict[str, Any]:
    """Settings of an `Embedding` of a torch.hub network, with the frame size of the network's evaluation."""
    call = {"repo_or_dir": repository, "model": entry, "trust_repo": True, **own}
    settings: dict[str, Any] = {"dimension": None, "resize": [*resize], "output": output}
    settings |= {"mean": [0.485, 0.456, 0.406], "std": [0.229, 0.224, 0.225]}
    network = {"class_path": "torch.hub.load", "init_args": call}
    path = f"{Embedding.__module__}.{Embedding.__name__}"
    return {"class_path": path, "init_args": {**settings, "network": network}}


RESNET: dict[str, Any] = {"resize": (480, 640), "backbone": "ResNet50", "fc_output_dim": 2048}
BOQ: dict[str, Any] = {"backbone_name": "dinov2", "output_dim": 12288}
SELA: dict[str, Any] = {"backbone": "dinov2-large", "aggregation": "gem", "hashing": True, "rerank": True}
NETWORKS = {
    "anyloc": embedding("AnyLoc/DINO", "get_vlad_model", backbone="DINOv2", domain="urban"),
    "boq": embedding("amaralibey/bag-of-queries", "get_trained_boq", **BOQ),
    "cosplace": embedding("gmberton/cosplace", "get_trained_model", **RESNET),
    "cricavpr": embedding("Lu-Feng/CricaVPR", "trained_model", (224, 224)),
    "eigenplaces": embedding("gmberton/eigenplaces", "get_trained_model", **RESNET),
    "megaloc": embedding("gmberton/MegaLoc", "get_trained_model"),
    "sage": embedding("chenshunpeng/SAGE", "sage_vitb"),
    "salad": embedding("serizba/salad", "dinov2_salad"),
    "selavpr++": embedding("Lu-Feng/SelaVPRplusplus", "SelaVPRplusplus", output=1, **SELA),
}


def known(name: str) -> dict[str, Any]:
    """The settings of a short name such as `hub:megaloc`."""
    settings = NETWORKS.get(name.removeprefix(PREFIX))
    if settings is None:
        names = ", ".join(f"{PREFIX}{network}" for network in NETWORKS)
        raise InputError(f"{name} is not the short name of a network; expected one of {names}")
    return settings
