"""Short names of networks of torch.hub that describe places, and the `Embedding` that each stands for."""

from __future__ import annotations

from typing import Any

from dejavu_torch.features.embedding import Embedding
from dejavu_torch.types import InputError

PREFIX = "hub:"


def embedding(
    repository: str, entry: str, resize: tuple[int, int] = (322, 322), output: int | None = None, **own: Any
) -> dict[str, Any]:
    """`class_path` and `init_args` of an `Embedding` of torch.hub.load(repository, entry, **own), for
    frames of the size that the network was evaluated with, normalised as ImageNet's are."""
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
    "salad": embedding("serizba/salad", "dinov2_salad"),
    "selavpr++": embedding("Lu-Feng/SelaVPRplusplus", "SelaVPRplusplus", output=1, **SELA),
}


def known(name: str) -> dict[str, Any]:
    """What a short name such as `hub:megaloc` stands for."""
    found = NETWORKS.get(name.removeprefix(PREFIX))
    if found is None:
        names = ", ".join(f"{PREFIX}{one}" for one in NETWORKS)
        raise InputError(f"{name} is no short name of a network; expected one of {names}")
    return found
