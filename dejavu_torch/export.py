"""Export of frames -> scores as one ONNX file, which runs without torch and without this package."""

from __future__ import annotations

import copy
import io
import json
import logging
import math
import os
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from importlib import import_module
from pathlib import Path
from typing import Any, Literal, NamedTuple, cast

import numpy as np
import torch
from torch import Tensor, nn

from dejavu_torch.data.output import check_output_file, whole_file
from dejavu_torch.features.extract import in_mode, moved_features
from dejavu_torch.features.preprocess import Preprocess
from dejavu_torch.features.probe import probe_picture
from dejavu_torch.maps.place_map import PlaceMap
from dejavu_torch.maps.spectral_map import SpectralMap, scores_of
from dejavu_torch.model import DejaVu, require_map
from dejavu_torch.recognition import chosen
from dejavu_torch.recognition.calibration import POWER
from dejavu_torch.recognition.calibration import TOLERANCE as BEYOND
from dejavu_torch.recognition.centring import running_mean
from dejavu_torch.recognition.online import UNKNOWN, Nearness
from dejavu_torch.recognition.querying import Sequences
from dejavu_torch.recognition.scorer import OfMap
from dejavu_torch.recognition.taken import DRAWN, FAITHFUL
from dejavu_torch.recognition.views import ALONE, Views
from dejavu_torch.text import one_line
from dejavu_torch.types import Facts, InputError, SequenceModel, expect
from dejavu_torch.version import __version__

OPSET = 18
METADATA = "dejavu_torch"  # key in the file's metadata, with a JSON mapping as value
MAX_BYTES = 2**31 - 2**24  # of the constants: protobuf files are smaller than 2 GB
TOLERANCE = 1e-3  # maximum difference to torch's scores, relative above 1
MAX_SIZE = 2**16  # frames of a batch, pixels of a side
TRIED = 3  # frames that the file is tested on
SEEDS = 8  # draws of the dimensions that are mirrored: one may leave a map as it is
DEVIATION = 0.16, 0.5, 0.84  # quantiles a standard deviation below and above the median, and that
PROBE = ".probe.npz"  # suffix of the file beside it, by which a deployment is checked
MAX_REASON = 200  # characters of an error of torch


class Exported(NamedTuple):
    """The result of an export.

    facts: the file's metadata. bytes: of the file. difference: the largest to torch's scores, relative above
    1, on frames of noise.
    """

    facts: Facts
    bytes: int
    difference: float


class Decoded(nn.Module):
    """`SpectralMap.scores` with the decoded descriptors as constants, (Q,K) -> (Q,N)."""

    descriptors: Tensor
    norms: Tensor
    stage: Tensor | None

    def __init__(self, place_map: SpectralMap) -> None:
        super().__init__()
        self.metric = place_map.metric
        decoded = torch.cat([place_map.decode(g) for g in range(len(place_map.chunks))])
        self.register_buffer("descriptors", place_map.staged(decoded).T.contiguous())
        units = torch.eye(place_map.dimension, device=place_map.device) if len(place_map.stage) else None
        self.register_buffer("stage", None if units is None else place_map.staged(units))
        self.register_buffer("norms", place_map.norms)

    def forward(self, queries: Tensor) -> Tensor:
        queries = queries if self.stage is None else queries @ self.stage
        length: Tensor = torch.linalg.vector_norm(queries, dim=1, keepdim=True)
        if self.metric == "cosine":
            queries = queries / torch.where(length > 0, length, 1)
        return scores_of(queries @ self.descriptors, self.norms, length, self.metric)


class Resized(nn.Module):
    """Resizes frames to the size of the map's: (B,C,any,any) -> (B,C,H,W)."""

    def __init__(self, size: tuple[int, int]) -> None:
        super().__init__()
        self.size = size

    def forward(self, frames: Tensor) -> Tensor:
        # even at that size, where it changes nothing, since a graph cannot branch
        return nn.functional.interpolate(frames, self.size, mode="bilinear", antialias=True)


class Seen(nn.Module):
    """Features of all views of frames: (B,C,H,W) -> (B x V, D)."""

    def __init__(self, features: nn.Module, shifts: Sequence[float]) -> None:
        super().__init__()
        self.features, self.shifts = features, shifts

    def forward(self, frames: Tensor) -> Tensor:
        return moved_features(self.features, frames, self.shifts).flatten(0, 1)


class Graph(nn.Module):
    """The exported form of a model: frames (B,C,H,W), or features (B,D), -> scores (B,N), of the best views.

    With a sequence: one frame (1,C,H,W) and the state before it -> scores (1,N) and the next state. If it is
    `centred`, there is a further state, of the mean. If it is `described`, the last output is the descriptor.
    """

    penalties: Tensor

    def __init__(
        self,
        model: DejaVu,
        sequence: SequenceModel | None,
        centred: bool,
        views: Views = ALONE,
        described: bool = False,
    ) -> None:
        super().__init__()
        parts: dict[str, nn.Module] = {}
        shape, (shifts, penalties) = model.frame_shape or (), views.known
        self.views = len(shifts)
        none = torch.zeros(1, model.map.dimension, device=model.map.device)
        unit = OfMap(model.map, none).unit
        self.register_buffer("penalties", unit * torch.tensor(penalties)[:, None].to(none))
        if len(shape) == 3:
            parts |= {"size": Resized((shape[1], shape[2]))}
        if len(shape) != 1:
            features = model.features if shifts == ALONE.shifts else Seen(model.features, shifts)
            parts |= {"preprocess": model.preprocess, "features": features}
        if model.whitening is not None and model.whitening.learned:
            whitening = copy.deepcopy(model.whitening)
            for part in whitening.parts:
                part.projection = part.unpacked  # not two values per byte
            parts["whitening"] = whitening
        parts["map"] = Decoded(model.map) if isinstance(model.map, SpectralMap) else model.map
        self.parts = nn.ModuleDict(parts)  # the stages in order
        self.sequence = sequence
        self.centring = running_mean(model.map) if centred else None
        self.described = described

    def forward(self, frames: Tensor, *states: Tensor) -> Tensor | tuple[Tensor, ...]:
        found = self.outputs(frames, *states)
        found = found if self.described else found[:-1]
        return found if len(found) > 1 else found[0]

    def outputs(self, frames: Tensor, *states: Tensor) -> tuple[Tensor, ...]:
        """All outputs, also the descriptor."""
        after: list[Tensor] = []
        shows = None if "features" in self.parts else (frames.abs().amax(1) > 0)[:, None]
        for name, part in self.parts.items():
            if isinstance(part, Preprocess) and part.blank > 0:
                shows = part.shows(frames)[:, None]
            if name == "map" and shows is not None:
                frames = frames * shows.repeat_interleave(self.views, 0).to(frames)
            descriptor = frames.unflatten(0, (-1, self.views))[:, 0] if name == "map" else frames
            if name == "map" and self.centring is not None:
                frames, mean = self.centring(frames, states[-1], self.views)
                after.append(mean)
            frames = part(frames)
        if self.views > 1:  # by which one is chosen
            frames = (frames.view(-1, self.views, frames.shape[1]) + self.penalties).amin(1)
        if self.sequence is not None:
            frames, state = self.sequence.step(frames, self.sequence.unpacked(states[0]))
            after.insert(0, self.sequence.packed(state))
        return frames, *after, descriptor


def export_onnx(
    model: DejaVu,
    path: str | Path,
    sequence: SequenceModel | None = None,
    centre: bool = False,
    shifts: Literal["auto", "none"] | list[float] = "auto",
    descriptor: bool = False,
) -> Exported:
    """Write preprocessing, features, whitening, map and scores as one ONNX file, opset 18, and beside it, as
    `route.probe.npz` of `route.onnx`, what it gives for one picture; see `probe_picture`.

    Args:
        model: with a map. A spectral map is decoded: the file holds the float32 descriptors of all places.
        path: of the file, which is written only if onnxruntime reproduces torch's scores.
        sequence: a `SequenceMatcher` or a `PlaceFilter`. The file then maps one frame and the state before it
            to scores and the next state, see `SequenceModel.step`; that of a filter has counts of how
            near frames came to the map, see `nearness_of`.
        centre: remove the mean of the frames so far from each, see `RunningMean`, which is a state as well.
        shifts: views of each frame, of which the best has the scores; "auto" are those that the map knows.
        descriptor: whether `descriptor` (B,K), of the frame as it is, is a further output, the last one.

    Shape: `frames` (B,C,H,W) float32 in [0, 1] -> `scores` (B,N), for any B, H and W: frames are resized to
        the size of the map's. For a map of ready features the input is `features` (B,D). With a sequence
        `frames` (1,C,H,W), `state` -> `scores` (1,N), `next_state`. If centred, `mean` (K+1,) is the last
        input, zeros before the first frame, and `next_mean` the last output.

        The probe has the inputs for one frame, with first states, and the outputs of torch for these, by
        name, and always the `descriptor`; there is none for ready features.

    Convention: the metadata's entry "dejavu_torch" is JSON: names and shapes of inputs and outputs, the
        number of places, and if there is one, the threshold, the calibration for single frames, the step
        between places of a resampled map, the number that fills the first state of a sequence, and how many
        numbers at the front of a filter's state count. Places are those of the map. Frames are not checked:
        NaN gives NaN.

    Raises:
        InputError: no map, a part that cannot be exported, different scores of the exported model, onnx or
            onnxruntime missing, more than 2 GB, or a file that cannot be written.
    """
    path = Path(path)
    probe = path.with_suffix(PROBE)
    check_output_file(path)
    check_output_file(probe)
    os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")  # of onnxruntime, unless the user has set it
    for name in ("onnx", "onnxscript", "onnxruntime"):
        try:
            import_module(name)
        except ImportError as error:
            seen = f"an export needs {name}, which cannot be imported ({one_line(error)})"
            raise InputError(f"{seen}; expected it: pip install 'dejavu_torch[export]'") from error
    require_map(model)
    model.map.layout.expect_one("to export the map of each")
    if model.frame_shape is None:
        raise InputError("the map does not know its frames; expected a map learned from a source")
    if sequence is not None:
        sequence.check(None, model.map.places)
        seen = f"the map of an area, and {type(sequence).__name__}"
        model.map.layout.expect_route("single queries to export", seen)
    if sequence is not None and sequence.lag:
        seen = f"a filter with a lag of {sequence.lag}"
        raise InputError(f"{seen}; expected one without: an ONNX file answers each frame at once")
    size = 4 * model.map.places * model.map.dimension if isinstance(model.map, SpectralMap) else 0
    seen = f"{model.map.places} places of {model.map.dimension} dimensions need {size / 1e9:.1f} GB"
    expect(size <= MAX_BYTES, f"at most {MAX_BYTES / 1e9:.1f} GB in an ONNX file", seen)
    if sequence is not None and sequence.answers == "filter":
        sequence = sequence.having(nearness=nearness_of(model.map))
    device = model.map.device
    images = len(model.frame_shape) == 3
    views = model.views_at_first(Sequences(shifts=shifts), images, learns=False)
    graph = Graph(model, sequence, centre, views, descriptor)
    shape, generator = (TRIED, *model.frame_shape), torch.Generator().manual_seed(0)
    noise = torch.rand(shape, generator=generator, dtype=torch.float32).to(device)
    noise[1:, ..., : noise.shape[-1] // 2], noise[2:] = 0, 0  # half a flat frame, a flat frame
    facts = _facts(model, sequence, centre, views)
    if descriptor:
        facts["outputs"]["descriptor"] = [*facts["outputs"]["scores"][:1], model.map.dimension]
    with torch.no_grad(), in_mode(graph, False), _quiet():
        states = [first.to(device) for first in _first_states(facts)]
        inputs = noise[: 2 if sequence is None else 1], *states
        try:
            names = [*facts["inputs"]], [*facts["outputs"]]
            free = {0: "batch"} if sequence is None else {}
            free |= {2: "height", 3: "width"} if noise.ndim == 4 else {}
            written = _serialised(_program(graph, inputs, names, free), facts)
            exact = model if sequence is None and not centre and "views" not in facts else graph
            difference = _difference(written, exact, noise, facts)
        except Exception as error:  # of any type, from torch, onnx or onnxruntime
            raise _refusal(graph, noise, error) from error
    seen = f"the exported scores differ from torch's by {difference:.2g} on noise"
    expect(difference <= TOLERANCE, f"at most {TOLERANCE:g}: a part behaves differently in ONNX", seen)
    with whole_file(path) as temporary:
        temporary.write_bytes(written)
    if images:
        _write_probe(probe, graph, facts, model.frame_shape)
    return Exported(facts, len(written), difference)


@torch.no_grad()
def nearness_of(place_map: PlaceMap) -> Nearness:
    """What a filter needs to learn how near queries come to a map: how near its own places come if they are
    mirrored. `UNKNOWN` of maps whose single images are not asked whether a drive is one of the map, see
    `OfMap.null`."""
    if place_map.fidelity is None or place_map.fidelity < FAITHFUL:
        return UNKNOWN
    known = cast(SpectralMap, place_map)
    step = max(1, known.places * SEEDS // DRAWN)
    some = torch.cat([known.decode(g)[::step] for g in range(len(known.chunks))])
    scorer = OfMap(known, some[:: max(1, len(some) * SEEDS // DRAWN)])  # of chunks, too, there may be many
    best = [scorer.mirrored(part, seed).amin(1) for seed in range(SEEDS) for part in scorer.parts()]
    low, off, high = torch.cat(best).cpu().quantile(torch.tensor(DEVIATION)).tolist()  # few may be dark
    return Nearness(off, (high - low) / 2, chosen.BINS) if high > low else UNKNOWN


def session_of(file: str | bytes, threads: int = 0) -> Any:
    """An onnxruntime session on the CPU for a file, by path or contents; 0 threads is its default."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    return onnxruntime.InferenceSession(file, options, providers=["CPUExecutionProvider"])


def run_session(session: Any, frames: Tensor) -> Tensor:
    """Scores of frames, or of features, from a session: (B,C,H,W) -> (B,N); one by one with a sequence."""
    facts = json.loads(session.get_modelmeta().custom_metadata_map[METADATA])
    name, *names = facts["inputs"]
    states, rows = [state.numpy() for state in _first_states(facts)], []
    for part in frames.cpu().split(1 if "state" in names else max(1, len(frames))):
        given = {name: part.numpy(), **dict(zip(names, states, strict=True))}
        scores, *states = session.run([*facts["outputs"]][: 1 + len(names)], given)
        rows.append(torch.from_numpy(scores))
    return torch.cat(rows)


def _first_states(facts: Facts) -> list[Tensor]:
    """The states before the first frame, from the metadata."""
    first = {"state": float(facts.get("first_state", 0)), "mean": 0.0}
    return [torch.full(shape, first[name]) for name, shape in facts["inputs"].items() if name in first]


def _write_probe(path: Path, graph: Graph, facts: Facts, shape: tuple[int, ...]) -> None:
    """Write what a graph gives for the probe: its inputs and outputs by name, with the descriptor."""
    inputs = [probe_picture(shape), *_first_states(facts)]
    with torch.no_grad(), in_mode(graph, False), whole_file(path) as temporary:
        outputs = graph.outputs(*(one.to(graph.penalties.device) for one in inputs))
        names = [*facts["inputs"], *dict.fromkeys((*facts["outputs"], "descriptor"))]
        known = zip(names, (one.cpu().numpy() for one in (*inputs, *outputs)), strict=True)
        with temporary.open("wb") as file:
            np.savez(file, **dict(known))


def _facts(model: DejaVu, sequence: SequenceModel | None, centre: bool, views: Views) -> Facts:
    """The metadata; free dimensions have a name."""
    shape, places = list(model.frame_shape or ()), model.map.places
    name, sizes = ("frames", [*shape[:1], "height", "width"]) if len(shape) == 3 else ("features", shape)
    facts: Facts = {"version": __version__, "opset": OPSET, "places": places, "frame_shape": shape}
    if sequence is None:
        facts |= {"inputs": {name: ["batch", *sizes]}, "outputs": {"scores": ["batch", places]}}
        threshold, platt = model.threshold, model.matching(None).platt
        if platt is not None:  # for `confidence_of`
            how = {"power": POWER} if platt.margin is None else {"margin": platt.margin}
            most = {"slope": platt.slope, "offset": platt.offset, "most": platt.most}
            facts["calibration"] = most | how | {"tolerance": BEYOND}
            precision = model.acceptance().precision
            facts |= {} if precision is None else {"precision": precision}
    else:
        first = sequence.packed(sequence.start(places, fixed=True))
        state = list(first.shape)
        facts["inputs"] = {name: [1, *sizes], "state": state}
        facts["outputs"] = {"scores": [1, places], "next_state": state}
        facts["first_state"] = "nan" if first.isnan().any() else "0"
        facts["sequence"] = str(sequence)
        facts |= {"counted": sequence.counted} if sequence.counted else {}
        threshold = sequence.threshold_of(model.threshold)
        threshold = sequence.likely if threshold is None else threshold  # without a calibration
    shifts, penalties = views.known
    if shifts != ALONE.shifts:
        facts["views"] = dict(zip(map(str, shifts), penalties, strict=True))
    if centre:
        facts["inputs"]["mean"] = facts["outputs"]["next_mean"] = [model.map.dimension + 1]
    facts |= {} if threshold is None else {"threshold": threshold}
    return facts | ({} if model.step is None else {"step": model.step})


def _program(
    graph: nn.Module, inputs: tuple[Tensor, ...], names: tuple[list[str], list[str]], free: dict[int, str]
) -> torch.onnx.ONNXProgram:
    """The ONNX program of a module; `free` names the variable dimensions of the first input."""
    # exported here, since torch.onnx.export would fall back to ways that fix the batch size
    sizes = {axis: torch.export.Dim(name, min=1, max=MAX_SIZE) for axis, name in free.items()}
    states = (None,) * (len(inputs) - 1)
    shapes = (sizes or None, states) if states else (sizes or None,)
    program = torch.export.export(graph, inputs, dynamic_shapes=shapes)
    return torch.onnx.export(
        program,
        dynamo=True,
        dynamic_shapes=shapes,  # for their names
        verbose=False,
        optimize=False,  # it would remove additions below 1e-8, such as those before a root in a divisor
        opset_version=OPSET,
        input_names=names[0],
        output_names=names[1],
        custom_translation_table=_translations(),
    )


def _translations() -> dict[Callable[..., object], Callable[..., object]]:
    """ONNX for operations that torch cannot translate."""
    import onnx_ir as ir
    from onnxscript import opset18

    op: Any = opset18

    def hypot(self: Any, other: Any) -> Any:
        # in double precision, as exact as torch: the choice of the stronger channel must not change
        sides = [op.Cast(side, to=ir.DataType.DOUBLE) for side in (self, other)]
        return op.Cast(op.Sqrt(op.Add(*(op.Mul(side, side) for side in sides))), to=self.dtype)

    def cdist(x1: Any, x2: Any, p: float = 2.0, compute_mode: int | None = None) -> Any:
        # row by row, which builds no tensor of Q x P x F
        if p not in (1.0, 2.0):
            raise NotImplementedError(f"cdist with p={p}")
        row = ir.Value(name="row", shape=ir.Shape(x1.shape[1:]), type=ir.TensorType(x1.dtype))
        difference = ir.node("Sub", [x2, row])
        axes = ir.node("Constant", [], {"value_ints": [1]})
        sums = ir.node(f"ReduceL{p:.0f}", [difference.outputs[0], axes.outputs[0]], {"keepdims": 0})
        sums.outputs[0].type, sums.outputs[0].shape = row.type, ir.Shape(x2.shape[:1])
        body = ir.Graph([row], sums.outputs, nodes=[difference, axes, sums], name="distances")
        return op.Scan(x1, body=body, num_scan_inputs=1)

    aten = torch.ops.aten
    return {aten.hypot.default: hypot, aten.cdist.default: cdist, aten._cdist_forward.default: cdist}


def _serialised(program: torch.onnx.ONNXProgram, facts: Facts) -> bytes:
    """The file's contents, without the source locations that torch adds to every node."""
    import onnx_ir as ir
    from onnxscript import optimizer

    model = program.model
    optimizer.inline(model)
    optimizer.fold_constants(model)
    optimizer.remove_unused_nodes(model)
    for node in model.graph.all_nodes():
        node.metadata_props.clear()
    model.metadata_props.clear()
    model.metadata_props[METADATA] = json.dumps(facts)
    model.producer_name, model.producer_version = METADATA, __version__
    written: bytes = ir.to_proto(model).SerializeToString()
    return written


def _difference(written: bytes, graph: nn.Module, frames: Tensor, facts: Facts) -> float:
    """The largest difference of onnxruntime's scores to those of a module, relative above 1."""
    states, rows = [state.to(frames.device) for state in _first_states(facts)], []
    for part in frames.split(1 if states else len(frames)):
        found = graph(part, *states)
        scores, *states = found[: 1 + len(states)] if isinstance(found, tuple) else [found]
        rows.append(scores)
    expected = torch.cat(rows).cpu()
    scores = run_session(session_of(written), frames)
    difference = (scores - expected).abs() / expected.abs().clamp(min=1)
    return float(torch.where(scores == expected, 0, difference.nan_to_num(math.inf)).max())


def _refusal(graph: Graph, frames: Tensor, error: Exception) -> InputError:
    """The error of the first part that cannot be exported by itself."""
    for name, part in graph.parts.items():
        try:
            after = part(frames)
            session_of(_serialised(_program(part, (frames,), (["input"], ["output"]), {0: "batch"}), {}))
        except Exception as own:
            return InputError(f"the {name}, {type(part).__name__}, cannot be exported: {_reason(own)}")
        frames = after
    return InputError(f"the model cannot be exported: {_reason(error)}")


def _reason(error: BaseException) -> str:
    """The first line of an exception's original cause."""
    while error.__cause__ is not None:
        error = error.__cause__
    text = str(error).strip() or type(error).__name__
    return one_line(text.splitlines()[0])[:MAX_REASON]


@contextmanager
def _quiet() -> Iterator[None]:
    """Suppresses what torch and onnxscript print and log."""
    before = logging.root.manager.disable
    logging.disable(logging.CRITICAL)
    try:
        with warnings.catch_warnings(), redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(before)
