"""A map and all that is ahead of it as one ONNX file, which runs without torch and without this package."""

from __future__ import annotations

import copy
import io
import json
import logging
import math
import os
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from dejavu_torch.data.output import check_output_file, whole_file
from dejavu_torch.features.extract import in_mode
from dejavu_torch.maps.spectral_map import SpectralMap
from dejavu_torch.model import DejaVu
from dejavu_torch.recognition.calibration import MARGIN
from dejavu_torch.recognition.calibration import TOLERANCE as TOLERANCE_OF_MARGIN
from dejavu_torch.recognition.sequence import SequenceMatcher
from dejavu_torch.text import one_line
from dejavu_torch.types import InputError, SequenceModel
from dejavu_torch.version import __version__

OPSET = 18
METADATA = "dejavu_torch"  # the key of the file's metadata whose value is a JSON mapping
MOST_BYTES = 2**31 - 2**24  # of the constants: protobuf writes files below 2 GB
TOLERANCE = 1e-3  # of the file's scores beside torch's, relative above 1
MOST_SIZE = 2**16  # frames of a batch, pixels of a side
TRIED = 3  # frames that the file is tried on before it is kept
LONGEST = 200  # characters of what torch says


class Exported(NamedTuple):
    """What was written.

    facts: the file's metadata. bytes: of the file. difference: the largest to torch's scores, relative above
    1, on frames of noise.
    """

    facts: dict[str, Any]
    bytes: int
    difference: float


class Rebuilt(nn.Module):
    """The scores of a spectral map from its descriptors as constants: what `SpectralMap.scores` gives.

    Shape: (Q,K) -> (Q,N).
    """

    descriptors: Tensor
    norms: Tensor
    per_norm: Tensor

    def __init__(self, route: SpectralMap) -> None:
        super().__init__()
        self.metric = route.metric
        rebuilt = torch.cat([route.decode(g) for g in range(len(route.chunks))])
        self.register_buffer("descriptors", rebuilt.T.contiguous())
        self.register_buffer("norms", route.norms)
        self.register_buffer("per_norm", route.inverse_norms())

    def forward(self, queries: Tensor) -> Tensor:
        length: Tensor = torch.linalg.vector_norm(queries, dim=1, keepdim=True)
        if self.metric == "cosine":
            queries = queries / torch.where(length > 0, length, 1)
            return 1 - queries @ self.descriptors * self.per_norm
        products = queries @ self.descriptors
        return (length.square() - 2 * products + self.norms.square()).clamp(min=0)


class Resized(nn.Module):
    """Frames at the size of the map's: (B,C,any,any) -> (B,C,H,W)."""

    def __init__(self, size: tuple[int, int]) -> None:
        super().__init__()
        self.size = size

    def forward(self, frames: Tensor) -> Tensor:
        # also where they have that size, which changes nothing: a graph does not branch
        return nn.functional.interpolate(frames, self.size, mode="bilinear", antialias=True)


class Graph(nn.Module):
    """A model as what is exported: frames (B,C,H,W), or features (B,D), -> scores (B,N).

    With a sequence: one frame (1,C,H,W) and the state before it -> scores (1,N) and the next state.

    Args:
        sequence: None takes each frame by itself.

    Attributes:
        parts: what a frame goes through, by name, in order.
    """

    def __init__(self, model: DejaVu, sequence: SequenceModel | None = None) -> None:
        super().__init__()
        parts: dict[str, nn.Module] = {}
        shape = model.frame_shape or ()
        if len(shape) == 3:
            parts |= {"size": Resized((shape[1], shape[2]))}
        if len(shape) != 1:
            parts |= {"preprocess": model.preprocess, "features": model.features}
        if model.whitening is not None and model.whitening.learned:
            whitening = copy.deepcopy(model.whitening)
            for part in whitening.parts:
                part.projection = part.whole  # not two numbers to a byte
            parts["whitening"] = whitening
        parts["map"] = Rebuilt(model.map) if isinstance(model.map, SpectralMap) else model.map
        self.parts = nn.ModuleDict(parts)
        self.sequence = sequence

    def forward(self, frames: Tensor, state: Tensor | None = None) -> Tensor | tuple[Tensor, Tensor]:
        for part in self.parts.values():
            frames = part(frames)
        return frames if self.sequence is None or state is None else self.sequence.step(frames, state)


def export_onnx(model: DejaVu, path: str | Path, sequence: SequenceModel | None = None) -> Exported:
    """Write preprocessing, features, whitening, map and scores as one ONNX file, opset 18.

    Args:
        model: with a map. A spectral map is rebuilt: the file holds the descriptors of all places, float32.
        path: of the file, written whole or not at all, and only if onnxruntime gives torch's scores with it.
        sequence: a `SequenceMatcher` or a `PlaceFilter`: the file then takes one frame at a time and the
            state before it, and gives the next state; see `SequenceModel.step`.

    Shape: `frames` (B,C,H,W) float32 in [0, 1] -> `scores` (B,N), for any B, H and W: frames of another size
        than the map's are resized to it. On a map of ready features the input is `features` (B,D). With a
        sequence `frames` (1,C,H,W), `state` -> `scores` (1,N), `next_state`.

    Convention: the metadata's entry "dejavu_torch" is JSON: the names and shapes of inputs and outputs, the
        places, the threshold where there is one, of single frames the calibration where there is one, the
        step between places of a resampled map, and with a sequence the number that fills its first state.
        Places are those of the map. Frames are not checked: NaN gives NaN.

    Raises:
        InputError: no map, a part that cannot be exported, or whose exported scores are others, onnx or
            onnxruntime missing, more than 2 GB, or a file that cannot be written.
    """
    path = Path(path)
    check_output_file(path)
    os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")  # onnxruntime's: it is for its user to switch on
    for name in ("onnx", "onnxscript", "onnxruntime"):
        try:
            import_module(name)
        except ImportError as error:
            raise InputError(
                f"an export needs {name}, which cannot be imported ({one_line(error)}); "
                "expected it to be there: pip install 'dejavu_torch[export]'"
            ) from error
    model.require_map()
    if model.map.routes:
        routes = ", ".join(route.name for route in model.map.routes)
        raise InputError(f"the map has the routes {routes}; expected to export the map of each")
    if model.frame_shape is None:
        raise InputError(
            "the map does not know what frames it was learned from; expected one learned from a source"
        )
    if sequence is not None:
        sequence.check(None, model.map.places)
    size = 4 * model.map.places * model.map.dimension if isinstance(model.map, SpectralMap) else 0
    if size > MOST_BYTES:
        raise InputError(
            f"{model.map.places} places of {model.map.dimension} numbers take {size / 1e9:.1f} GB; an ONNX "
            f"file holds {MOST_BYTES / 1e9:.1f} GB"
        )
    device = model.map.positions.device
    graph = Graph(model, sequence)
    noise = torch.rand(TRIED, *model.frame_shape, generator=torch.Generator().manual_seed(0)).to(device)
    noise[1:, ..., : noise.shape[-1] // 2], noise[2:] = 0, 0  # what is flat, too
    facts = _facts(model, sequence)
    with torch.no_grad(), in_mode(graph, False), _quiet():
        inputs: tuple[Tensor, ...] = (noise[:2],)
        if sequence is not None:
            inputs = noise[:1], sequence.start(model.map.places, fixed=True).to(device)
        try:
            names = [*facts["inputs"]], [*facts["outputs"]]
            free = {0: "batch"} if sequence is None else {}
            free |= {2: "height", 3: "width"} if noise.ndim == 4 else {}
            written = _serialised(_program(graph, inputs, names, free), facts)
            difference = _difference(written, graph, noise, facts)
        except Exception as error:  # of torch, onnx or onnxruntime, each of which has many
            raise _refusal(graph, noise, error) from error
    if not difference <= TOLERANCE:
        raise InputError(
            f"the exported scores differ from torch's by {difference:.2g} on noise; expected at most "
            f"{TOLERANCE:g}: a part does other work in ONNX"
        )
    with whole_file(path) as temporary:
        temporary.write_bytes(written)
    return Exported(facts, len(written), difference)


def session_of(file: str | bytes, threads: int = 0) -> Any:
    """An onnxruntime session on the CPU.

    Args:
        file: path, or contents. threads: 0 is as many as onnxruntime takes.
    """
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    return onnxruntime.InferenceSession(file, options, providers=["CPUExecutionProvider"])


def run_session(session: Any, frames: Tensor) -> Tensor:
    """Scores of frames, or of features, by a session: (B,C,H,W) -> (B,N); with a sequence one by one."""
    facts = json.loads(session.get_modelmeta().custom_metadata_map[METADATA])
    name, *states = facts["inputs"]
    given = frames.cpu().numpy()
    if not states:
        return torch.from_numpy(session.run(None, {name: given})[0])
    state = np.full(facts["inputs"]["state"], float(facts["first_state"]), np.float32)
    found = []
    for frame in given:
        scores, state = session.run(None, {name: frame[None], "state": state})
        found.append(torch.from_numpy(scores))
    return torch.cat(found)


def _facts(model: DejaVu, sequence: SequenceModel | None) -> dict[str, Any]:
    """The metadata; dimensions that are free have a name."""
    shape, places = list(model.frame_shape or ()), model.map.places
    name, taken = ("frames", [*shape[:1], "height", "width"]) if len(shape) == 3 else ("features", shape)
    facts: dict[str, Any] = {"version": __version__, "opset": OPSET, "places": places}
    facts |= {
        "frame_shape": shape,
        "inputs": {name: ["batch", *taken]},
        "outputs": {"scores": ["batch", places]},
    }
    if sequence is not None:
        first = sequence.start(places, fixed=True)
        facts["inputs"] = {name: [1, *taken], "state": list(first.shape)}
        facts["outputs"] = {"scores": [1, places], "next_state": list(first.shape)}
        facts |= {
            "first_state": "nan" if isinstance(sequence, SequenceMatcher) else "0",
            "sequence": str(sequence),
        }
    platt = model.matching(None).platt if sequence is None else None
    if platt is not None:  # of `confidence_of`
        facts["calibration"] = {**platt._asdict(), "margin": MARGIN, "tolerance": TOLERANCE_OF_MARGIN}
        precision = model.acceptance().precision
        facts |= {} if precision is None else {"precision": precision}
    threshold = model.threshold if sequence is None else sequence.threshold_of(model.threshold)
    if threshold is None and sequence is not None:
        threshold = sequence.likely  # of sequences the file has no calibration
    facts |= {} if threshold is None else {"threshold": threshold}
    return facts | ({} if model.step is None else {"step": model.step})


def _program(
    graph: nn.Module, inputs: tuple[Tensor, ...], names: tuple[list[str], list[str]], free: dict[int, str]
) -> Any:
    """What `torch.onnx.export` makes of a module; `free` names the sizes of the first input that may vary."""
    # not within torch.onnx.export, which would try other ways, some for one batch size only
    sizes = {axis: torch.export.Dim(name, min=1, max=MOST_SIZE) for axis, name in free.items()}
    shapes = (sizes or None, *[None] * (len(inputs) - 1))
    program = torch.export.export(graph, inputs, dynamic_shapes=shapes)
    return torch.onnx.export(
        program,
        dynamo=True,
        dynamic_shapes=shapes,  # for their names
        verbose=False,
        optimize=False,  # it leaves out the addition of less than 1e-8, as ahead of a root that divides
        opset_version=OPSET,
        input_names=names[0],
        output_names=names[1],
        custom_translation_table=_translations(),
    )


def _translations() -> dict[Callable[..., Any], Callable[..., Any]]:
    """What torch has no ONNX for."""
    import onnx_ir as ir
    from onnxscript import opset18

    op: Any = opset18

    def hypot(self: Any, other: Any) -> Any:
        # in double precision, as exact as torch's: which of two channels is the stronger must not change
        squares = [
            op.Mul(one, one) for one in (op.Cast(side, to=ir.DataType.DOUBLE) for side in (self, other))
        ]
        return op.Cast(op.Sqrt(op.Add(*squares)), to=self.dtype)

    def cdist(x1: Any, x2: Any, p: float = 2.0, compute_mode: int | None = None) -> Any:
        # row by row: nothing of Q x P x F is built
        if p not in (1.0, 2.0):
            raise NotImplementedError(f"cdist of p={p}")
        row = ir.Value(name="row", shape=ir.Shape(x1.shape[1:]), type=ir.TensorType(x1.dtype))
        change = ir.node("Sub", [x2, row])
        axes = ir.node("Constant", [], {"value_ints": [1]})
        sums = ir.node(f"ReduceL{p:.0f}", [change.outputs[0], axes.outputs[0]], {"keepdims": 0})
        sums.outputs[0].type, sums.outputs[0].shape = row.type, ir.Shape(x2.shape[:1])
        body = ir.Graph([row], sums.outputs, nodes=[change, axes, sums], name="distances")
        return op.Scan(x1, body=body, num_scan_inputs=1)

    aten = torch.ops.aten
    return {aten.hypot.default: hypot, aten.cdist.default: cdist, aten._cdist_forward.default: cdist}


def _serialised(program: Any, facts: dict[str, Any]) -> bytes:
    """The file's contents: without the places in our source that torch notes at every node."""
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


def _difference(written: bytes, graph: Graph, frames: Tensor, facts: dict[str, Any]) -> float:
    """How far onnxruntime's scores are from torch's at most, relative above 1."""
    if graph.sequence is None:
        expected = graph(frames)
    else:
        state, rows = graph.sequence.start(facts["places"], fixed=True).to(frames.device), []
        for frame in frames.split(1):
            scores, state = graph(frame, state)
            rows.append(scores)
        expected = torch.cat(rows)
    expected = expected.cpu()
    found = run_session(session_of(written), frames)
    apart = (found - expected).abs() / expected.abs().clamp(min=1)
    return float(torch.where(found == expected, 0, apart.nan_to_num(math.inf)).max())


def _refusal(graph: Graph, frames: Tensor, error: Exception) -> InputError:
    """The first part that cannot be exported by itself, and why."""
    for name, part in graph.parts.items():
        try:
            after = part(frames)
            session_of(_serialised(_program(part, (frames,), (["input"], ["output"]), {0: "batch"}), {}))
        except Exception as own:
            return InputError(f"the {name}, {type(part).__name__}, cannot be exported: {_reason(own)}")
        frames = after
    return InputError(f"the model cannot be exported: {_reason(error)}")


def _reason(error: BaseException) -> str:
    """The first line of what an exception came from."""
    while error.__cause__ is not None:
        error = error.__cause__
    text = str(error).strip() or type(error).__name__
    return one_line(text.splitlines()[0])[:LONGEST]


@contextmanager
def _quiet() -> Iterator[None]:
    """Without what torch and onnxscript print and log of their own work."""
    before = logging.root.manager.disable
    logging.disable(logging.CRITICAL)
    try:
        with warnings.catch_warnings(), redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(before)
