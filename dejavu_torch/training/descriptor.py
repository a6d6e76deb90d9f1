"""Ahead of a code, a descriptor that is worth one: it tells places apart, and is whitened."""

from __future__ import annotations

import math
from typing import cast

import pytorch_lightning as pl
import torch
from pytorch_lightning.callbacks import EarlyStopping, ModelCheckpoint
from torch import Tensor, nn

from dejavu_torch.database.distance import phase_distances
from dejavu_torch.features.coder import Coder, to_length
from dejavu_torch.features.embedding import Embedding
from dejavu_torch.features.preprocess import Preprocess
from dejavu_torch.training.datamodule import RouteData
from dejavu_torch.training.frames import StoredFrames
from dejavu_torch.training.freeze import freeze
from dejavu_torch.training.losses import place_cross_entropy
from dejavu_torch.training.objective import Losses
from dejavu_torch.training.reference import in_mode, reference_features

VIEWS = 10  # of each training frame, that whitening and the code see
NUMBERS = 2**27  # of all views at most, but for one of each frame: half a gigabyte
BATCH = 128  # descriptors of a step: they cost little
TEMPERATURE = 0.1  # of cosine distances, at the start
NOISE = 0.5  # on descriptors in training, beside components of about 1


class DescriptorStage(nn.Module):
    """The first part of a training whose backbone is an `Embedding` with a hidden layer.

    The network learns to tell stretches of the route apart: place cross-entropy over the cosine distances of
    its descriptor to one proxy for each stretch. Then it stays as it is. Some views of all training frames
    are described once and for all, the descriptor is whitened by what the augmentation and a second traverse
    change in them, and the code is learnt from them. A network without parameters, such as HOG, is whitened
    at once; a whitened one, as another map brings, is left alone. Of other backbones nothing is asked.
    """

    def __init__(self, backbone: nn.Module) -> None:
        super().__init__()
        self._parts = (backbone,)  # in a tuple, which makes it no part of this module
        self.present = isinstance(backbone, Embedding) and isinstance(backbone.linear, Coder)
        self.every = 1
        self.settled: int | None = None  # at which step
        self.held: list[nn.Parameter] = []  # what was trained up to there
        self.views: Tensor | None = None  # (n,K) descriptors
        self.right = torch.zeros(0, 1, dtype=torch.int64)  # (n,R), the places that they show
        self.proxies: nn.Parameter | None = None
        self.log_temperature: nn.Parameter | None = None

    def prepare(self, places: int, every: int) -> None:
        """Make the proxies, one for each `every` places, where a network is to be trained."""
        self.views = None  # a further training looks at its own frames,
        self.settled = None if self.settled is None else 0  # and has steps for the code alone
        trained = self.lacking and any(p.requires_grad for p in self._embedding.network.parameters())
        if trained and self.proxies is None:
            self._make_proxies(-(-places // max(1, every)), max(1, every))

    def _make_proxies(self, count: int, every: int) -> None:
        mean, self.every = self._coder.mean, every
        self.proxies = nn.Parameter(torch.randn(count, len(mean), device=mean.device))
        self.log_temperature = nn.Parameter(torch.full_like(mean[0], math.log(TEMPERATURE)))

    def stored(self) -> dict[str, int | None]:
        """What a checkpoint has to know besides the parameters."""
        return {"settled": self.settled, "every": self.every}

    def restore(self, stored: dict[str, int | None], state: dict[str, Tensor]) -> list[nn.Module]:
        """Be as the checkpoint was, whatever this run's tolerance; as `settle` where it was settled."""
        proxies = state.get("descriptor.proxies")
        if self.present and proxies is not None:
            self._make_proxies(len(proxies), stored["every"] or 1)
        known, self.settled = self.settled, stored["settled"]
        return self.settle(self.settled) if known is None and self.settled is not None else []

    @property
    def lacking(self) -> bool:
        """Whether there is a descriptor that is not whitened yet."""
        return self.present and not bool(self._coder.whitened)

    @property
    def learning(self) -> bool:
        """Whether steps are to be taken before it can be."""
        return self.lacking and self.proxies is not None

    @property
    def _embedding(self) -> Embedding:
        return cast(Embedding, self._parts[0])

    @property
    def _coder(self) -> Coder:
        return cast(Coder, self._embedding.linear)

    def losses(self, frames: Tensor, right: Tensor, tolerance: int, places: int) -> Losses:
        """Place cross-entropy over the proxies. Preprocessed frames (B,C,H,W), right places (B,R)."""
        assert self.proxies is not None
        assert self.log_temperature is not None
        descriptors = to_length(self._embedding.describe(frames).float())
        noisy = descriptors + NOISE * torch.randn_like(descriptors)
        distances = phase_distances(noisy, self.proxies, "cosine")
        stretch = torch.arange(places, device=distances.device) // self.every
        scores = distances.index_select(1, stretch)
        found = place_cross_entropy(scores, right, tolerance, self.log_temperature.exp())
        return Losses(found.loss, {"descriptor": found.loss}, found.left_out)

    def settle(self, step: int) -> list[nn.Module]:
        """Keep the network as it is from now on; return the modules whose running statistics have to stay."""
        embedding, self.settled = self._embedding, step
        self.held = [parameter for parameter in embedding.network.parameters() if parameter.requires_grad]
        return freeze(embedding, ["network"], "train") if self.held else []

    @torch.no_grad()
    def look(self, preprocess: Preprocess, data: RouteData, at_once: int) -> None:
        """Describe views of all training frames; whiten by how they differ from the places that they show."""
        embedding, device = self._embedding, self._coder.mean.device
        describe = _Described(preprocess, embedding)
        views, right = [], []
        with in_mode(embedding, False):
            loader = data.train_dataloader()
            most = NUMBERS // (len(self._coder.mean) * len(cast(StoredFrames, loader.dataset)))
            for _ in range(max(1, min(VIEWS, most)) if data.augmentation.acts else 1):
                for batch in loader:
                    known = batch.truth.positives[:, 0] >= 0
                    if not known.any():
                        continue
                    frames = data.augmented(batch.frames.to(device), data.clip)[known]
                    views.append(describe(frames).float())
                    right.append(batch.truth.positives[known].to(device))
            self.views, self.right = torch.cat(views), torch.cat(right)
            if self.lacking:
                values, name = data.sets["reference"].values, data.reference.name
                places = reference_features(describe, values, at_once, device, name, shuffled=False)
                self._coder.whiten(self.views, places[self.right[:, 0]])
        data.augmenting = False  # nothing looks at the frames of a batch any more

    def draw(self) -> tuple[Tensor, Tensor]:
        """Features of some views, and their right places: (B,D), (B,R)."""
        assert self.views is not None
        drawn = torch.randint(len(self.views), (BATCH,), device=self.views.device)
        return self._embedding.code(self.views[drawn]), self.right[drawn]


def start_over(trainer: pl.Trainer, settled: bool) -> None:
    """What watches the training compares nothing with figures of a code that was not learned yet.

    Args:
        settled: whether the descriptor is settled now; before, best checkpoints are kept as they come.
    """
    for callback in trainer.callbacks:  # type: ignore[attr-defined]
        if isinstance(callback, EarlyStopping):
            callback.wait_count = 0
            callback.best_score = torch.tensor(math.inf if callback.mode == "min" else -math.inf)
        if settled and isinstance(callback, ModelCheckpoint):
            callback.best_k_models.clear()
            callback.best_model_score, callback.best_model_path, callback.kth_best_model_path = None, "", ""


class _Described(nn.Module):
    """What the network of an embedding makes of frames."""

    def __init__(self, preprocess: nn.Module, embedding: Embedding) -> None:
        super().__init__()
        self.preprocess, self.embedding = preprocess, embedding

    def forward(self, frames: Tensor) -> Tensor:
        return self.embedding.describe(self.preprocess(frames))
