"""From a descriptor, which tells places apart, to features that repeat."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from dejavu_torch.types import InputError

SHRINKAGE = 1.0  # how much of its mean over all directions is added to what changes in each
ROWS = 8192  # in double precision at a time


def learned_whitening(views: Tensor, places: Tensor, kept: int) -> tuple[Tensor, Tensor]:
    """The projection to what tells places apart and changes little between two views of one place.

    With d = (view - place) / 2, m = (view + place) / 2, B = Cov[m], and W = E[d d^T] plus its mean over all
    directions in each of them (shrinkage, for what few pairs say little of), the columns of P are the `kept`
    directions with the largest p^T B p / p^T W p, scaled to p^T W p = 1, the largest first (learned whitening
    of Mikolajczyk and Matas, ICCV 2007; a linear discriminant analysis of pairs).

    Args:
        views, places: descriptors of one place each, K numbers.
        kept: K', at most K.

    Shape: (n,K), (n,K) -> mean (K,), P (K,K'), float32.

    Raises:
        InputError: shapes that do not fit, descriptors that are not finite, or views that are their places
            but for rounding.

    Example:
        >>> places = torch.tensor([[0.0, 3.0], [0.0, -3.0]])
        >>> views = places + torch.tensor([[4.0, 0.0], [4.0, 0.0]])  # the first number is the weather's
        >>> mean, projection = learned_whitening(views, places, 1)
        >>> bool(projection[0].abs() < projection[1].abs())
        True
    """
    if views.ndim != 2 or views.shape != places.shape or not 1 <= kept <= views.shape[1]:
        seen = f"{tuple(views.shape)}, {tuple(places.shape)} and {kept} to keep"
        raise InputError(f"learned_whitening got {seen}; expected (n,K) twice, and 1 to K to keep")
    k = views.shape[1]
    within, second = views.new_zeros(2, k, k, dtype=torch.float64)
    mean = views.new_zeros(k, dtype=torch.float64)
    for view, place in zip(views.split(ROWS), places.split(ROWS), strict=True):
        change, middle = (view.double() - place.double()) / 2, (view.double() + place.double()) / 2
        within += change.T @ change / len(views)
        second += middle.T @ middle / len(views)
        mean += middle.sum(0) / len(views)
    scale, size = within.diagonal().mean(), second.diagonal().mean()
    if not scale.isfinite() or not scale > 1e-10 * size:
        raise InputError(
            f"the descriptors of {len(views)} views differ from those of their places by {scale.item():.2g} "
            "in the mean square; expected a finite number, and more than rounding: an augmentation, or a "
            "second traverse"
        )
    within.diagonal().add_(SHRINKAGE * scale)
    # P = L^-T E, where W = L L^T and E holds the eigenvectors of L^-1 B L^-T
    unit = torch.linalg.inv(torch.linalg.cholesky(within))
    vectors = torch.linalg.eigh(unit @ (second - torch.outer(mean, mean)) @ unit.T).eigenvectors.flip(1)
    return mean.float(), (unit.T @ vectors[:, :kept]).float()


class Coder(nn.Module):
    """Whitens a descriptor and codes it, by one hidden layer, into features that are to repeat.

    The code of a place is arbitrary: what is a little off its descriptor on another day has to get it all the
    same. So noise is added in training, to whitened descriptors, in which no direction changes much more than
    another; it does what an unseen day does.

    Args:
        inputs: K, of a descriptor.
        dimension: D, number of features, not standardised yet.
        hidden: width of the hidden layer.
        noise: its standard deviation beside components of about 1.
        kept: number of components that whitening keeps; fewer where K is smaller.

    Shape: (B,K) -> (B,D).

    Convention: before `whiten` the first components are taken as they are. They are brought to length
        sqrt(components) before the noise, and after it. Noise is for training mode alone.

    Raises:
        InputError: settings out of range.

    Example:
        >>> coder = Coder(inputs=8, dimension=4, hidden=16).eval()
        >>> views, places = torch.randn(2, 32, 8)
        >>> bool(coder.whitened), coder.whiten(views, places), bool(coder.whitened)
        (False, None, True)
        >>> coder(views).shape
        torch.Size([32, 4])
    """

    mean: Tensor
    projection: Tensor
    whitened: Tensor

    def __init__(
        self, inputs: int, dimension: int, hidden: int = 400, noise: float = 1.0, kept: int = 128
    ) -> None:
        super().__init__()
        if min(inputs, dimension, hidden, kept) < 1 or not 0 <= noise < math.inf:
            raise InputError(
                f"Coder got inputs={inputs}, dimension={dimension}, hidden={hidden}, kept={kept}, "
                f"noise={noise}; expected at least 1 each, the noise 0 or more"
            )
        self.noise = noise
        kept = min(kept, inputs)
        self.register_buffer("mean", torch.zeros(inputs))
        self.register_buffer("projection", torch.eye(inputs, kept))
        self.register_buffer("whitened", torch.tensor(False))
        norm = nn.BatchNorm1d(hidden)
        # what scale the units have is nobody's concern; a small one lets AdamW find their thresholds sooner
        nn.init.constant_(norm.weight, 0.1)
        self.layers = nn.Sequential(
            nn.Linear(kept, hidden, bias=False),
            norm,
            nn.ReLU(inplace=True),
            nn.Linear(hidden, dimension),
        )

    def whiten(self, views: Tensor, places: Tensor) -> None:
        """Take `learned_whitening` of (n,K) views and the (n,K) places that they show."""
        mean, projection = learned_whitening(views, places, self.projection.shape[1])
        self.mean.copy_(mean)
        self.projection.copy_(projection)
        self.whitened.fill_(True)

    def forward(self, descriptors: Tensor) -> Tensor:
        # bf16 would lose what whitening brings out
        with torch.autocast(descriptors.device.type, enabled=False):
            components = (descriptors.to(self.mean.dtype) - self.mean) @ self.projection
            components = to_length(components)
            if self.training and self.noise:
                components = to_length(components + self.noise * torch.randn_like(components))
        coded: Tensor = self.layers(components)
        return coded


def to_length(components: Tensor) -> Tensor:
    """Each row to length sqrt(components)."""
    return nn.functional.normalize(components, dim=1) * math.sqrt(components.shape[1])
