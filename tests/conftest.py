"""What all tests share: the number of threads, fixed seeds, and where the real data lies."""

from __future__ import annotations

import gc
import io
import os
import signal
import threading
from pathlib import Path

import pytest
import torch
from hypothesis import settings
from PIL import Image
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

import dejavu_torch.places.rectangles as areas
from dejavu_torch.data.simulate.route import SimulatedRoute
from dejavu_torch.features import distilled
from dejavu_torch.maps import compiling
from dejavu_torch.resize import resize_frames

collect_ignore = ["mutants"]  # it has no tests, and runs them

# commands run in processes of their own, beside each other
THREADS = int(os.environ.get("DEJAVU_TEST_THREADS", "1"))
os.environ.setdefault("OMP_NUM_THREADS", str(THREADS))

compiling.SILENCE = 1e6  # seconds; which test compiles first is chance

# a shell has what runs in its background ignore Ctrl-C, and commands take over what they find
if (
    signal.getsignal(signal.SIGINT) == signal.SIG_IGN
    and threading.current_thread() is threading.main_thread()
):
    signal.signal(signal.SIGINT, signal.default_int_handler)

# the same examples on every machine, however slow it is
settings.register_profile("repeatable", derandomize=True, deadline=None, database=None, max_examples=25)
settings.load_profile("repeatable")


# whole commands, trainings, real footage and notebooks: not in a developer's inner loop
SLOW = (
    *("training", "benchmarks", "motion", "cluster", "fuzz", "test_cli", "test_faults", "test_readme"),
    *("test_real_routes", "test_golden", "test_periods_on_real_data", "test_spectral_model"),
    *(
        "test_model_export",
        "test_matrix",
        "test_notebooks",
        "data/test_simulate_railway",
        "evaluation/test_pictures",
    ),
)
# modules that run whole commands again and again
FEW_VIEWS = {
    *("test_cli", "test_cli_evaluate", "test_cli_spectral", "test_cli_resampling", "test_several_places"),
    *("test_cli_growth", "test_faults", "test_readme", "test_memory_bench", "test_scale", "test_demo"),
    *("test_cli_networks", "test_pretrained", "test_cli_rejection", "test_onnx_export", "test_reproduce"),
    *("test_routes", "test_spectral_training", "test_results", "test_trainings", "test_compare"),
    *("test_cli_live", "test_cli_hub", "test_configs", "test_joined", "test_cluster"),
    *("test_storage_bench", "test_train_command", "test_held_out", "test_devices", "test_free_memory"),
    *("test_spectral_model", "test_notebooks"),
}
DRAWN = ("test_simulate", "test_golden", "test_traverse", "test_source")  # what simulated routes draw
MOST_HELD = 40_000_000  # numbers of frames
PIXELS = FEW_VIEWS - {"test_demo", "test_compare"} | {"test_real_routes"}
UNDRAWN = ("test_compare", "test_real_routes", "test_several_places", "test_other_data")
UNDRAWN += ("test_pretrained", "test_joined", "test_cli_rejection", "test_cli_hub", "test_results")


def pytest_collection_modifyitems(items):
    """What runs whole commands is marked `slow` as well as single tests above 5 s, and goes first, so that
    processes that share the files end together."""
    here = Path(__file__).parent
    for item in items:
        path = item.path.relative_to(here) if item.path.is_relative_to(here) else item.path
        if str(path).startswith(SLOW):
            item.add_marker("slow")
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    items.sort(key=lambda item: item.path not in slow)  # stable


def pytest_collection_finish():
    """Thousands of tests are objects by the million: let no garbage collection go through them again."""
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="session", autouse=True)
def _few_threads():
    """Many small operations: on a busy machine two threads mostly wait for each other."""
    torch.set_num_threads(THREADS)


@pytest.fixture(scope="module", autouse=True)
def _short_work(request):
    """Where whole commands run again and again, their pictures are drawn but written as one pixel each, and
    whitening and calibration learn from few copies of frames, which the network sees small: these take most
    of their time, and what a picture looks like, and how many copies there are, is tested elsewhere."""
    with pytest.MonkeyPatch.context() as patch:
        if request.path.stem in PIXELS:
            one = io.BytesIO()
            Image.new("L", (1, 1)).save(one, "png")
            patch.setattr("dejavu_torch.evaluation.report.as_png", lambda picture: one.getvalue())
        if request.path.stem in UNDRAWN:  # nobody looks at the pictures of these comparisons
            for drawn in ("draw_pictures", "draw_compared"):
                patch.setattr(f"dejavu_torch.evaluation.compare.{drawn}", lambda *_: {})
        if request.path.stem in FEW_VIEWS:
            patch.setattr("dejavu_torch.features.whitening.VIEWS", 1)
            patch.setattr("dejavu_torch.features.whitening.VIEWS_PER_COMPONENT", 1)
            patch.setattr("dejavu_torch.features.whitening.COPIES", 1)
            patch.setattr("dejavu_torch.features.views.FEWEST", 100)
            patch.setattr(distilled, "resize_frames", lambda frames, size: resize_frames(frames, (48, 48)))
        if not request.path.stem.startswith(DRAWN):
            patch.setattr(SimulatedRoute, "read", read_once)
        yield


held = {}  # frames by route and number


def read_once(route, frames):
    """Frames of a simulated route: drawing them took most of the time of many a test."""
    if sum(map(Tensor.numel, held.values())) > MOST_HELD:
        held.clear()
    if new := [i for i in frames if (route.name, i) not in held]:
        drawn = route._frames(torch.tensor(new))
        held.update(zip([(route.name, i) for i in new], drawn, strict=True))
    return torch.stack([held[route.name, i] for i in frames])


@pytest.fixture(autouse=True)
def _seed():
    torch.manual_seed(0)


@pytest.fixture(scope="session")
def data_dir():
    """The folder of real data sets; a test that asks for it is skipped where there is none."""
    if not os.environ.get("DEJAVU_TEST_DATA"):
        pytest.skip("DEJAVU_TEST_DATA is not set")
    return Path(os.environ["DEJAVU_TEST_DATA"])


class LargestTensor(TorchDispatchMode):
    """Remembers the number of elements of the largest tensor that any operation made."""

    numel = 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):  # type: ignore[no-untyped-def]
        out = func(*args, **(kwargs or {}))
        for tensor in out if isinstance(out, (tuple, list)) else (out,):
            if isinstance(tensor, Tensor):
                self.numel = max(self.numel, tensor.numel())
        return out


@pytest.fixture
def largest_tensor():
    """`with largest_tensor() as seen: ...` and then `seen.numel`."""
    return LargestTensor


@pytest.fixture
def small_tiles(monkeypatch):
    """Areas have tiles of about six windows to a side."""
    monkeypatch.setattr(areas, "SIDE", 6)
