"""A map as an ONNX file gives torch's scores in onnxruntime, or there is no file."""

from __future__ import annotations

import json
import math
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from command_line import fails, run
from helpers import Fixed, refused, streamed
from PIL import Image
from torch import nn

from dejavu_torch import (
    HOG,
    DejaVu,
    LiveLocalizer,
    PlaceFilter,
    Preprocess,
    SequenceMatcher,
    SpectralMapper,
    TemplateMapper,
    Whitening,
    open_source,
)
from dejavu_torch import export as onnx_file
from dejavu_torch.export import METADATA, OPSET, export_onnx, nearness_of, run_session, session_of
from dejavu_torch.features.cnn import SmallCNN
from dejavu_torch.features.distilled import Distilled
from dejavu_torch.features.joined import Joined
from dejavu_torch.features.pixels import PatchPixels
from dejavu_torch.types import FrequencyLayer

pytest.importorskip("onnxscript")
pytest.importorskip("onnxruntime")

LAYERS = (FrequencyLayer(4, 4, 0, 20, (0, 2)), FrequencyLayer("5/2", 3, 5, 25, (0, 1)))


def of_features(**settings):
    """A template map of ready features; nothing covers places 25 to 29."""
    mapper = TemplateMapper(Fixed(*LAYERS), **settings)
    return DejaVu(mapper=mapper).learn(torch.rand(30, 4)).eval()


def of_frames(frames, features=None, **settings):
    return DejaVu(features, Whitening(views=1), SpectralMapper(16.0, **settings)).learn(frames).eval()


def facts_of(session):
    facts = json.loads(session.get_modelmeta().custom_metadata_map[METADATA])
    return facts


@pytest.fixture(scope="module")
def flights():
    """80 small frames of a road and of another flight over it."""
    sources = (open_source(f"sim:aerial?frames=80&traverse={i}") for i in range(2))
    road, query = (torch.cat(list(source.batches(80)))[..., ::2, ::2].contiguous() for source in sources)
    return road, query


def test_a_file_says_what_it_is(flights, tmp_path):
    import onnx

    network = SmallCNN(8, channels=3, resize=(16, 16), widths=(4, 8), squeeze=4)
    features = Joined([HOG(), Distilled(), PatchPixels(channel="grey"), network])
    model = of_frames(flights[0], features, chunk=30, metric="l2")
    model.threshold = 0.25
    written = export_onnx(model, tmp_path / "map.onnx")
    assert written.bytes == (tmp_path / "map.onnx").stat().st_size
    assert written.difference < 1e-4
    session = session_of(str(tmp_path / "map.onnx"))
    facts = facts_of(session)
    assert facts == written.facts
    assert (facts["opset"], facts["places"], facts["threshold"]) == (OPSET, 80, 0.25)
    assert facts["frame_shape"] == [3, 32, 32]
    for kind, values in (("inputs", session.get_inputs()), ("outputs", session.get_outputs())):
        assert facts[kind] == {value.name: value.shape for value in values}
    assert [entry.version for entry in onnx.load(tmp_path / "map.onnx").opset_import if not entry.domain] == [
        OPSET
    ]
    assert b"/" + Path(onnx_file.__file__).name.encode() not in (tmp_path / "map.onnx").read_bytes()
    with torch.no_grad():  # more frames than HOG takes at a time in torch, some of them flat
        frames = torch.cat([*[flights[1]] * 3, torch.zeros(2, 3, 32, 32)])
        torch.testing.assert_close(run_session(session, frames), model(frames), rtol=0, atol=1e-4)
        for size in ((48, 48), (20, 20)):  # brought to the map's
            frames = torch.rand(2, 3, *size)
            torch.testing.assert_close(run_session(session, frames), model(frames), rtol=0, atol=1e-4)


def test_features_that_show_nothing_score_as_in_torch(tmp_path):
    """Whitening would make a place of them."""
    rows = torch.randn(200, 12, generator=torch.Generator().manual_seed(0)).cumsum(0) + 3
    model = DejaVu(whitening=Whitening(8)).learn(rows)
    export_onnx(model, tmp_path / "map.onnx")
    queries = torch.cat([rows[20:22], torch.zeros(1, 12)])
    found = run_session(session_of(str(tmp_path / "map.onnx")), queries)
    torch.testing.assert_close(found, model(queries), rtol=0, atol=1e-4)
    assert not model.localize(queries, sequence=None).accepted[2]


@pytest.mark.parametrize(
    "settings",
    [{"metric": "l2", "temperature": 0.1}, {"metric": "cosine"}, {"metric": "l1", "reduction": "sum"}],
    ids=str,
)
def test_a_map_of_features_takes_features(settings, tmp_path):
    model, queries = of_features(**settings), torch.rand(9, 4)
    facts = export_onnx(model, tmp_path / "map.onnx").facts
    assert facts["inputs"] == {"features": ["batch", 4]}
    assert "threshold" not in facts
    found = run_session(session_of(str(tmp_path / "map.onnx")), queries)
    assert found[:, 25:].isposinf().all()
    torch.testing.assert_close(found, model(queries), rtol=0, atol=1e-5)


def assert_streams(file, route, model, state, queries):
    """A file goes from state to state as a sequence model does; its facts."""
    session, (_, *shape) = session_of(str(file)), queries.shape
    facts = facts_of(session)
    given = {"features": [1, *shape]} if len(shape) == 1 else {"frames": [1, shape[0], "height", "width"]}
    assert facts["inputs"] == {**given, "state": state}
    assert facts["outputs"] == {"scores": [1, route.map.places], "next_state": state}
    with torch.no_grad():
        (expected,) = streamed(model, [route(queries)])
    torch.testing.assert_close(run_session(session, queries), expected, rtol=0, atol=1e-4)
    return facts


@pytest.mark.parametrize("sequence", [None, PlaceFilter(within=2)], ids=["single", "filter"])
def test_a_file_centres_as_a_live_run_does(sequence, tmp_path):
    model, queries = DejaVu(mapper=SpectralMapper(8.0)).learn(torch.rand(60, 4)), torch.rand(9, 4) + 1
    facts = export_onnx(model, tmp_path / "map.onnx", sequence, centre=True).facts
    assert [*facts["inputs"].items()][-1] == ("mean", [model.map.dimension + 1])
    assert [*facts["outputs"]][-1] == "next_mean"
    found, live = (
        run_session(session_of(str(tmp_path / "map.onnx")), queries),
        LiveLocalizer(model, sequence, centre=True),
    )
    for query, scores in zip(queries, found, strict=True):
        live(query)
        assert live.scores is not None
        torch.testing.assert_close(scores, live.scores, rtol=0, atol=1e-4)
    plain = export_onnx(model, tmp_path / "plain.onnx", sequence)
    assert "mean" not in plain.facts["inputs"]
    assert not torch.allclose(
        found, run_session(session_of(str(tmp_path / "plain.onnx")), queries), atol=1e-2
    )


def test_only_maps_with_a_mean_centre(tmp_path):
    mapper = TemplateMapper(Fixed(FrequencyLayer(4, 4, 0, 20, (0, 1))))
    model = DejaVu(mapper=mapper).learn(torch.rand(20, 3, 24, 24))
    for centred in (
        lambda: LiveLocalizer(model, None, centre=True),
        lambda: export_onnx(model, tmp_path / "map.onnx", centre=True),
    ):
        with refused("TemplateMap has no mean", "expected a SpectralMap"):
            centred()


class Solves(nn.Module):
    """What ONNX has no operation for."""

    def forward(self, frames):
        return torch.linalg.svdvals(frames).flatten(1)


class Counts(nn.Module):
    """What is made for one number of frames."""

    def forward(self, frames):
        return frames.flatten(1) + torch.zeros(len(frames), 1)


@pytest.mark.parametrize(
    ("part", "words"),
    [
        ({"features": Solves()}, ("the features, Solves, cannot be exported: ",)),
        ({"features": Counts()}, ("the features, Counts, cannot be exported: ",)),
        (
            {"preprocess": Preprocess("grey", "clahe", grid=(2, 2))},
            ("the preprocess, Preprocess, cannot be exported: clahe", "expected another contrast"),
        ),
    ],
    ids=["no operation", "batch", "clahe"],
)
def test_a_part_that_cannot_be_exported_is_named(part, words, tmp_path, capfd):
    mapper = TemplateMapper(Fixed(FrequencyLayer(4, 4, 0, 20, (0, 1))))
    model = DejaVu(mapper=mapper, **part).learn(torch.rand(20, 3, 24, 24))
    with refused(*words):
        export_onnx(model, tmp_path / "map.onnx")
    assert list(tmp_path.iterdir()) == []
    assert capfd.readouterr() == ("", "")


def test_scores_that_differ_are_no_file(tmp_path, monkeypatch):
    for name, given in {"_program": None, "_serialised": b"", "session_of": None}.items():
        monkeypatch.setattr(onnx_file, name, lambda *_, given=given: given)
    monkeypatch.setattr(onnx_file, "run_session", lambda session, frames: torch.zeros(len(frames), 30))
    with refused("differ from torch's by", "expected at most"):
        export_onnx(of_features(), tmp_path / "map.onnx")
    assert list(tmp_path.iterdir()) == []


def test_what_cannot_be_written_is_refused(tmp_path, monkeypatch):
    with refused("there is no map yet"):
        export_onnx(DejaVu(), tmp_path / "map.onnx")
    with refused("folder", "does not exist"):
        export_onnx(of_features(), tmp_path / "none" / "map.onnx")
    with refused("does not know its frames"):
        export_onnx(DejaVu().learn_features(torch.rand(60, 4)), tmp_path / "map.onnx")
    with (
        monkeypatch.context() as patch,
        refused("an export needs onnxruntime", "pip install 'dejavu_torch[export]'"),
    ):
        patch.setitem(sys.modules, "onnxruntime", None)
        export_onnx(of_features(), tmp_path / "map.onnx")
    monkeypatch.setattr(onnx_file, "MAX_BYTES", 60 * 5 * 4 - 1)
    with refused("60 places of 5 dimensions", "GB"):
        export_onnx(DejaVu().learn(torch.rand(60, 4)), tmp_path / "map.onnx")
    assert list(tmp_path.iterdir()) == []


def test_the_command(tmp_path, capsys):
    model = of_features()
    model.save(tmp_path / "map.safetensors")
    words = ("export", tmp_path / "map.safetensors", "--onnx")
    run(*words, tmp_path / "map.onnx", "--sequence", "5", "--speeds", "[1,0.5]", "--threshold", "0.5")
    out = capsys.readouterr().out
    for told in ("features (1, 4)", "state (4, 30)", f"opset {OPSET}", f"written to {tmp_path / 'map.onnx'}"):
        assert told in out
    facts = assert_streams(
        tmp_path / "map.onnx", model, SequenceMatcher(5, (1, 0.5)), [4, 30], torch.rand(20, 4)
    )
    assert (facts["threshold"], facts["first_state"]) == (0.5, "nan")
    before = (tmp_path / "map.onnx").read_bytes()
    assert "such as route.onnx" in fails(capsys, *words, tmp_path / "map.pt")
    assert "expected one of them" in fails(
        capsys, *words, tmp_path / "map.onnx", "--filter", "--sequence", "3"
    )
    assert "the whole drive" in fails(capsys, *words, tmp_path / "map.onnx", "--match", "drive")
    with refused("a lag of 3", "expected one without"):
        export_onnx(model, tmp_path / "map.onnx", PlaceFilter(lag=3))
    assert (tmp_path / "map.onnx").read_bytes() == before


def test_the_documentation_runs_and_a_filter_goes_from_state_to_state(tmp_path, monkeypatch, capsys):
    pages = Path(__file__).parents[1] / "docs" / "howto"
    page = "\n".join((pages / f"{name}.md").read_text() for name in ("export", "deployment"))
    monkeypatch.chdir(tmp_path)
    frame = open_source("sim:aerial?frames=64&traverse=1")[40]
    Image.fromarray((frame * 255).byte().permute(1, 2, 0).numpy()).save("frame.png")
    space = {}
    for language, block in re.findall(r"```(sh|python)\n(.*?)```", page, re.DOTALL):
        if language == "python":
            exec(block, space)
        for line in block.splitlines() if language == "sh" else ():
            run(*shlex.split(line)[1:])
    printed = capsys.readouterr().out
    assert "\nscores agrees\n" in printed
    assert space["picture"].dtype == np.uint8
    found = re.findall(r"^(\d+) (?:True|False)$", printed, re.MULTILINE)
    assert [abs(int(place) - 40) <= 5 for place in found] == [True] * 4
    route = DejaVu.load("road.safetensors").eval()
    model = PlaceFilter().having(nearness=nearness_of(route.map))
    queries = open_source("sim:aerial?frames=64&traverse=1")[30:60]
    states = [128 + 1 + 64 * len(model.steady.change) * 2]  # both ways
    facts = assert_streams(Path("drive.onnx"), route, model, states, queries)
    assert (facts["threshold"], facts["counted"], facts["first_state"]) == (model.likely, 128, "0")


def walk(frames, seed):
    """Descriptors that change slowly."""
    steps = torch.randn(frames, 48, generator=torch.Generator().manual_seed(seed))
    for t in range(1, frames):
        steps[t] = 0.95 * steps[t - 1] + math.sqrt(1 - 0.95**2) * steps[t]
    return steps


def seen_again(rows, seed):
    return rows + 0.3 * torch.randn(rows.shape, generator=torch.Generator().manual_seed(seed))


def test_a_filter_in_a_file_learns_when_a_drive_has_left_the_map(tmp_path):
    road = walk(300, 0)
    model, given = DejaVu(whitening="none").learn(road).eval(), PlaceFilter()
    queries = torch.cat([seen_again(road[20:120], 5), seen_again(walk(100, 7), 6)])  # then another road
    facts = export_onnx(model, tmp_path / "map.onnx", given).facts
    assert given.counted == 0  # the caller's is as it was
    filter = given.having(nearness=nearness_of(model.map))
    states = [facts["counted"] + 1 + 300 * len(given.steady.change) * 2]
    assert_streams(tmp_path / "map.onnx", model, filter, states, queries)
    with torch.no_grad():
        (before,) = streamed(given, [model(queries)])
    after = run_session(session_of(str(tmp_path / "map.onnx")), queries)
    known, alone = ((-scores.amin(1)).exp() for scores in (after, before))
    assert float((alone[110:] >= 0.5).double().mean()) > 0.5
    assert float(known[110:].max()) < 0.1
    assert float((known[:100] - alone[:100]).abs().max()) < 0.05
    assert float((known[:100] >= 0.5).double().mean()) > 0.9
    session, state = session_of(str(tmp_path / "map.onnx")), torch.zeros(states).numpy()
    for query, count in ((queries[:1], 1), (queries[1:2], 2), (torch.zeros(1, 48), 2)):  # black: not counted
        _, state = session.run(None, {"features": query.numpy(), "state": state})
        assert state[: facts["counted"]].sum() == count
        assert state[facts["counted"] :].sum() == pytest.approx(1, abs=1e-4)


def test_what_has_no_say_about_being_off_the_map_has_a_state_as_before(tmp_path):
    """A map of templates or of a low fidelity, a filter that learns, and a sequence."""
    rough = DejaVu(mapper=SpectralMapper(1.0)).learn(torch.rand(90, 24)).eval()
    assert rough.map.fidelity < 0.7
    faithful = DejaVu(mapper=SpectralMapper(16.0)).learn(torch.rand(90, 8)).eval()
    learning = PlaceFilter(learns=True)
    for model, sequence in (
        (of_features(), PlaceFilter()),
        (rough, PlaceFilter()),
        (faithful, learning),
        (faithful, SequenceMatcher(5)),
    ):
        facts = export_onnx(model, tmp_path / "map.onnx", sequence).facts
        assert "counted" not in facts
        own = sequence.packed(sequence.start(model.map.places, fixed=True))
        queries = torch.rand(30, model.frame_shape[0])
        assert_streams(tmp_path / "map.onnx", model, sequence, [*own.shape], queries)


USED = {  # declarations of other libraries that the documentation's C++ uses
    "cnpy.h": """#include <map>
#include <string>
#include <vector>
namespace cnpy {
struct NpyArray { std::vector<size_t> shape; size_t num_vals; template <typename T> T* data(); };
using npz_t = std::map<std::string, NpyArray>;
npz_t npz_load(std::string);
}
""",
    "onnxruntime_cxx_api.h": """#include <cstdint>
#include <vector>
enum OrtAllocatorType { OrtArenaAllocator };
enum OrtMemType { OrtMemTypeDefault };
namespace Ort {
struct Env { Env(); };
struct SessionOptions { SessionOptions(); };
struct RunOptions { RunOptions(); };
struct MemoryInfo { static MemoryInfo CreateCpu(OrtAllocatorType, OrtMemType); };
struct Value {
  template <typename T>
  static Value CreateTensor(const MemoryInfo&, T*, size_t, const int64_t*, size_t);
  template <typename T> const T* GetTensorData() const;
};
struct Session {
  Session(const Env&, const char*, const SessionOptions&);
  std::vector<Value> Run(
    const RunOptions&, const char* const*, const Value*, size_t, const char* const*, size_t);
};
}
""",
}


@pytest.mark.skipif(not shutil.which("g++"), reason="no C++ compiler")
def test_the_documentations_cpp_compiles(tmp_path):
    page = (Path(__file__).parents[1] / "docs" / "howto" / "deployment.md").read_text()
    (code,) = re.findall(r"```cpp\n(.*?)```", page, re.DOTALL)
    for name, text in (USED | {"check.cpp": code}).items():
        (tmp_path / name).write_text(text)
    words = [
        "g++",
        "-std=c++17",
        "-Wall",
        "-Werror",
        "-fsyntax-only",
        f"-I{tmp_path}",
        tmp_path / "check.cpp",
    ]
    ran = subprocess.run(words, capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stderr
