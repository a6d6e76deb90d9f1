"""Replaced by `dejavu_torch.data.simulate.SIMULATORS`."""

from dejavu_torch.data.simulate.outdoor import Outdoor as Outdoor
from dejavu_torch.data.simulate.underground import Underground as Underground
