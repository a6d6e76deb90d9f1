"""Descriptors -> compressed maps, which score queries."""

from typing import TYPE_CHECKING

from dejavu_torch.lazy import lazily

if TYPE_CHECKING:
    from dejavu_torch.maps.spectral_map import SpectralMap as SpectralMap
    from dejavu_torch.maps.template_map import log_posterior as log_posterior

_NAMES = {
    "spectral_map": "SpectralMap",
    "template_map": "log_posterior",
}
__getattr__, __dir__ = lazily(__name__, _NAMES)
