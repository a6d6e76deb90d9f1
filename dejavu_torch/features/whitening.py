"""Learned whitening: the directions of a descriptor that tell places apart and change little on one place."""

from __future__ import annotations

import torch
from torch import Tensor

from dejavu_torch.types import InputError

SHRINKAGE = 1.0  # how much of its mean over all directions is added to the change in each
ROWS = 8192  # in double precision at a time


def learned_whitening(views: Tensor, places: Tensor, kept: int) -> tuple[Tensor, Tensor]:
    """The projection to what tells places apart and changes little between two views of one place.

    With d = (view - place) / 2, m = (view + place) / 2, B = Cov[m], and W = E[d d^T] plus its mean over all
    directions in each of them (shrinkage: a few pairs say little about most directions), the columns of P are
    the `kept` directions with the largest p^T B p / p^T W p, scaled to p^T W p = 1, the largest first
    (learned whitening of Mikolajczyk and Matas, ICCV 2007; a linear discriminant analysis of pairs).

    Args:
        views, places: descriptors of one place each, K numbers.
        kept: K', at most K.

    Shape: (n,K), (n,K) -> mean (K,), P (K,K'), float32.

    Raises:
        InputError: shapes that do not fit, descriptors that are not finite, or views that equal their places
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
