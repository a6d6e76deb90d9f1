"""Simulated routes and grounds: the true place of every frame is known."""

from collections.abc import Callable

from dejavu_torch.data.simulate.aerial import AerialRoad
from dejavu_torch.data.simulate.outdoor import Outdoor
from dejavu_torch.data.simulate.route import SimulatedRoute
from dejavu_torch.data.simulate.terrain import open_terrain
from dejavu_torch.data.simulate.underground import Underground
from dejavu_torch.types import Traverse

# for a new route, subclass SimulatedRoute (or Railway) in a file of its own and add it here
SIMULATORS: dict[str, type[SimulatedRoute]] = {c.kind: c for c in (AerialRoad, Outdoor, Underground)}
SIMULATED: dict[str, Callable[..., Traverse]] = {**SIMULATORS, "terrain": open_terrain}  # routes and areas
