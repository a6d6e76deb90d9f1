"""Areas, by the names that they had before places were `Layout`."""

from dejavu_torch.places.layout import GAP as GAP
from dejavu_torch.places.layout import SIDE as SIDE
from dejavu_torch.places.layout import Ground as Ground
from dejavu_torch.places.layout import Layout as Area
from dejavu_torch.places.layout import agree as agree
from dejavu_torch.places.layout import apart as apart
from dejavu_torch.places.layout import area_of as area_of
from dejavu_torch.places.layout import same_windows as same_windows
from dejavu_torch.places.layout import stored_area as stored_area

__all__ = ["GAP", "SIDE", "Area", "Ground", "agree", "apart", "area_of", "same_windows", "stored_area"]
