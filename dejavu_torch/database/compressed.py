"""The compressed map: layers and their templates in flat buffers."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from itertools import accumulate
from typing import Any

import torch
from torch import Tensor, nn

from dejavu_torch.motion.resampling import nearest_places, shown_frames
from dejavu_torch.types import FrequencyLayer, InputError, Plan


class CompressedMap(nn.Module):
    """A route in sum(P x F) template numbers instead of N x D; the only fitted state (section III-A).

    Buffers (compressed sparse rows; their size is the storage claim):
        size: (2,) int64, places N and features D.
        layers: (L,5) int64, period numerator, period denominator, phases, start, stop.
        feature_ptr: (L+1,) int64, where each layer's features begin in `feature_index`.
        feature_index: (sum F,) int32.
        templates: (sum P x F,) float, row-major (P,F) blocks in the order of the layers.
        way: (frames of the reference,) float32, how many steps of evenly spaced places each is from the first
            place; (0,) where place i is frame i.
        weights: (D,) float, what a difference in each feature counts in eq. 3; (0,) where all count alike.

    Args:
        plan: the layers.
        templates: one (P,F) tensor per layer, as `PhaseTemplates` gives them; they may carry
            gradients.
        places: N, frames of the reference traverse.
        dimension: D, features per frame.
        way: see above; None where place i is frame i.
        weights: see above; None where all features count alike.

    Convention: templates are of `weighted` features: |w H - w mu| = w |H - mu|. Places are 0..N-1.
        `load_state_dict` takes the shapes of what it loads, so an empty `CompressedMap()` can
        receive any map.
    """

    size: Tensor
    layers: Tensor
    feature_ptr: Tensor
    feature_index: Tensor
    templates: Tensor
    way: Tensor
    weights: Tensor

    def __init__(
        self,
        plan: Plan = (),
        templates: Sequence[Tensor] = (),
        places: int = 0,
        dimension: int = 0,
        way: Tensor | None = None,
        weights: Tensor | None = None,
    ) -> None:
        super().__init__()
        for layer, block in zip(plan, templates, strict=True):
            if tuple(block.shape) != (layer.phases, len(layer.features)):
                raise InputError(
                    f"a layer of {layer.phases} phases and {len(layer.features)} features got templates "
                    f"{tuple(block.shape)}; expected ({layer.phases}, {len(layer.features)})"
                )
        rows = [(*layer.period.as_integer_ratio(), layer.phases, layer.start, layer.stop) for layer in plan]
        index = [feature for layer in plan for feature in layer.features]
        pointer = [0, *accumulate(len(layer.features) for layer in plan)]
        flat = torch.cat([block.flatten() for block in templates]) if plan else torch.zeros(0)
        device = flat.device
        self.register_buffer("size", torch.tensor([places, dimension], device=device))
        self.register_buffer("layers", torch.tensor(rows, dtype=torch.int64, device=device).reshape(-1, 5))
        self.register_buffer("feature_ptr", torch.tensor(pointer, device=device))
        self.register_buffer("feature_index", torch.tensor(index, dtype=torch.int32, device=device))
        self.register_buffer("templates", flat)
        self.register_buffer("way", torch.zeros(0, device=device) if way is None else way.float().to(device))
        alike = torch.zeros(0, device=device) if weights is None else weights.float().to(device)
        self.register_buffer("weights", alike)
        self._plan: Plan | None = None
        self.check()

    @property
    def places(self) -> int:
        """N, the number of places."""
        return int(self.size[0])

    @property
    def dimension(self) -> int:
        """D, the number of features per frame."""
        return int(self.size[1])

    @property
    def frame(self) -> Tensor:
        """The reference frame that each evenly spaced place shows, (N,) int64; (0,) where it is its own."""
        return shown_frames(self.way.cpu()) if len(self.way) else torch.zeros(0, dtype=torch.int64)

    @property
    def place_of(self) -> Tensor:
        """The evenly spaced place nearest to each reference frame, int64, -1 behind the first; or (0,)."""
        return nearest_places(self.way.cpu()) if len(self.way) else torch.zeros(0, dtype=torch.int64)

    @property
    def plan(self) -> Plan:
        """The layers, rebuilt from the buffers."""
        if self._plan is None:
            pointer, index = self.feature_ptr.tolist(), self.feature_index.tolist()
            self._plan = tuple(
                FrequencyLayer(Fraction(a, b), phases, start, stop, tuple(index[pointer[j] : pointer[j + 1]]))
                for j, (a, b, phases, start, stop) in enumerate(self.layers.tolist())
            )
        return self._plan

    def blocks(self) -> list[Tensor]:
        """Templates of each layer, (P,F) views of the flat buffer."""
        sizes = [layer.phases * len(layer.features) for layer in self.plan]
        parts = self.templates.split(sizes) if sizes else ()
        return [part.view(layer.phases, -1) for part, layer in zip(parts, self.plan, strict=True)]

    def weighted(self, features: Tensor) -> Tensor:
        """Features as the templates are made of and compared with: times `weights`. (n,D) -> (n,D)."""
        return features * self.weights if len(self.weights) else features

    def trainable(self, templates: bool = True, weights: bool = False, start: Tensor | None = None) -> None:
        """Make parameters of the templates, of the weights, or of both, until `settle`.

        Args:
            start: (D,) the weights to go on from where the map has none; None or (0,) is 1 for every feature.

        Raises:
            InputError: a start of another shape.
        """
        self.settle()
        if weights and not len(self.weights):
            own = self.templates.new_ones(self.dimension)
            if start is not None and len(start):
                if start.shape != own.shape:
                    raise InputError(f"the weights start as {tuple(start.shape)}; expected ({len(own)},)")
                own = start.detach().clone()
            self.templates = self._times(own)  # they are of weighted features
            self.weights = own
        for name, asked in (("templates", templates), ("weights", weights)):
            if asked:
                value = getattr(self, name).detach().clone()
                delattr(self, name)
                self.register_parameter(name, nn.Parameter(value))

    def settle(self) -> None:
        """Make buffers of what was trained.

        Convention: |w H - mu| is the same with both signs turned, so that no weight is below 0.
        """
        for name, parameter in list(self.named_parameters()):
            delattr(self, name)
            self.register_buffer(name, parameter.detach().clone())
        if (self.weights < 0).any():
            self.templates = self._times(torch.where(self.weights < 0, -1, 1))
            self.weights = self.weights.abs()
        self.check()

    def _times(self, factors: Tensor) -> Tensor:
        """The templates, those of each feature times its factor (D,)."""
        pairs = zip(self.blocks(), self.layer_features(), strict=True)
        scaled = [(block * factors[features]).flatten() for block, features in pairs]
        return torch.cat(scaled) if scaled else self.templates

    def layer_features(self) -> list[Tensor]:
        """Feature indices of each layer, (F,) int64."""
        sizes = self.feature_ptr.diff().tolist()
        return list(self.feature_index.long().split(sizes)) if sizes else []

    def check(self) -> None:
        """Refuse buffers that do not fit together.

        Raises:
            InputError: naming the first disagreement.
        """
        problem = self._disagreement()
        if problem:
            raise InputError(f"the map does not fit together: {problem}")

    def _disagreement(self) -> str:
        shapes = {"size": "(2,)", "layers": "(L,5)", "feature_ptr": "(L+1,)", "feature_index": "(F,)"}
        for name, shape in shapes.items():
            buffer = getattr(self, name)
            whole = not (buffer.is_floating_point() or buffer.is_complex() or buffer.dtype == torch.bool)
            if buffer.ndim != 1 + (name == "layers") or not whole:
                return f"{name} {tuple(buffer.shape)}; expected whole numbers {shape}, got {buffer.dtype}"
        if tuple(self.size.shape) != (2,) or self.layers.shape[1] != 5:
            return f"size {tuple(self.size.shape)}, layers {tuple(self.layers.shape)}; expected (2,), (L,5)"
        pointer = self.feature_ptr.tolist()
        if len(pointer) != len(self.layers) + 1 or pointer[0] != 0 or sorted(pointer) != pointer:
            return f"feature_ptr does not rise from 0 over {len(self.layers)} layers"
        if pointer[-1] != len(self.feature_index):
            return f"{len(self.feature_index)} feature indices; expected {pointer[-1]}"
        if self.way.ndim != 1 or not self.way.is_floating_point() or not self.way.isfinite().all():
            return f"way {tuple(self.way.shape)} {self.way.dtype}; expected finite floats of one dimension"
        if len(self.way) and len(self.frame) != self.places:
            return f"a way of {len(self.frame)} steps; expected {self.places}"
        if bool((self.layers[:, 1] < 1).any()):
            return "a period with a denominator below 1"
        for layer in self.plan:  # each layer checks itself as it is built
            if layer.stop > self.places or layer.features[-1] >= self.dimension:
                return (
                    f"a layer covers [{layer.start}, {layer.stop}) and feature {layer.features[-1]}; "
                    f"expected it inside {self.places} places of {self.dimension} features"
                )
        numbers = sum(layer.phases * len(layer.features) for layer in self.plan)
        if self.templates.ndim != 1 or len(self.templates) != numbers:
            return f"templates {tuple(self.templates.shape)}; expected ({numbers},)"
        if not self.templates.is_floating_point() or not self.templates.isfinite().all():
            return "templates that are not finite floats"
        if tuple(self.weights.shape) not in ((0,), (self.dimension,)):
            return f"weights {tuple(self.weights.shape)}; expected ({self.dimension},) or none"
        if not self.weights.is_floating_point() or not self.weights.isfinite().all():
            return "weights that are not finite floats"
        return ""

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any) -> None:
        for name, buffer in list(self.named_buffers(recurse=False)):
            if prefix + name in state_dict:
                loaded = state_dict[prefix + name]
                setattr(self, name, torch.empty_like(loaded, device=buffer.device))
        self._plan = None
        super()._load_from_state_dict(state_dict, prefix, *args)
        self.check()

    def extra_repr(self) -> str:
        return (
            f"places={self.places}, dimension={self.dimension}, layers={len(self.plan)}, "
            f"template_numbers={self.templates.numel()}"
        )
