"""Learn, localize, judge, and set it beside the baselines and the null control."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import NamedTuple

import torch
from torch import Tensor

import dejavu_torch
from dejavu_torch.data.truth import find_truth, read_offset
from dejavu_torch.evaluation.baselines import fair_stride, nearest_frames, stride_bytes
from dejavu_torch.evaluation.controls import leave_out_match, null_control
from dejavu_torch.evaluation.curves import RECALL_DEFINITION, curve_of, judge
from dejavu_torch.evaluation.plots import Plot, plot_activations, plot_chunks, plot_coverage, plot_curves
from dejavu_torch.evaluation.report import Contender, Report
from dejavu_torch.features.extract import frame_shape
from dejavu_torch.model import DejaVu
from dejavu_torch.recognition.distance import phase_distances
from dejavu_torch.types import InputError, Match, Traverse


class Comparison(NamedTuple):
    """A comparison's figures, matches and pictures; `model` holds the map."""

    report: Report
    match: Match
    model: DejaVu
    pictures: Mapping[str, Plot]


def compare(
    reference: Traverse,
    query: Traverse,
    truth: str | None = None,
    model: DejaVu | None = None,
    tolerance: int = 5,
    leave_out: int | None = None,
    seed: int = 0,
    progress: bool = False,
) -> Comparison:
    """Learn the reference, find the queries on it, and judge that against what else could be stored.

    Args:
        reference: the traverse to learn. query: a second traverse of the route.
        truth: see `find_truth`; without a truth there are matches and pictures but no scores.
        model: settings; None is DejaVu with its defaults. It is taught the reference.
        tolerance: frames within which a place is right, inclusive.
        leave_out: also query the reference with itself, leaving out this many frames to each side of
            the query from every mean; a diagnostic.
        seed: of the shuffle of the null control.
        progress: show progress bars on a terminal.

    Raises:
        InputError: bad input of any of the stages.
    """
    if tolerance < 0 or (leave_out is not None and leave_out < 0):
        raise InputError(f"tolerance is {tolerance}, leave_out {leave_out}; expected at least 0")
    if truth is not None:
        read_offset(truth)  # before the long work
    model = DejaVu() if model is None else model
    began = time.perf_counter()
    stored = model.extract_all(reference, "learning" if progress else None)
    model.learn_features(stored, frame_shape(reference))
    learnt = time.perf_counter()
    model.check_queries(frame_shape(query), query.name)
    seen = model.extract_all(query, "localizing" if progress else None)
    match = model.localize(seen)
    localized = time.perf_counter()

    right = find_truth(truth, reference, query, len(stored), len(seen))
    itemsize = model.map.templates.element_size()
    size = model.map_bytes
    frames, dimension = stored.shape
    k = fair_stride(frames, dimension, itemsize, size, tolerance)
    coarsest = max(1, 2 * tolerance)
    everything, strided, sparse = nearest_frames(stored, seen, (1, k, coarsest), model.matcher.metric)
    found = {
        "uncompressed": (f"all {len(stored)} frames", everything, 1),
        "stride": (f"every {_ordinal(k)} frame (the map's bytes)", strided, k),
        "stride_coarsest": (f"every {_ordinal(coarsest)} frame (2 x tolerance)", sparse, coarsest),
        "null": ("null: all learnt shuffled", null_control(model, stored, seen, seed), None),
        "null_same_plan": (
            "null: this map's layers, shuffled",
            null_control(model, stored, seen, seed, same_plan=True),
            None,
        ),
    }
    if leave_out is not None:
        itself = leave_out_match(model, stored, leave_out)
        found["leave_out"] = (f"reference on itself, +-{leave_out} left out", itself, None)

    def contender(
        name: str, match: Match, truth: Tensor | None, bytes: int | None, k: int | None
    ) -> Contender:
        return Contender(name, None if truth is None else judge(match, truth, tolerance), bytes, k)

    contenders = {}
    for key, (name, other, stride) in found.items():
        bytes = None if stride is None else stride_bytes(frames, dimension, itemsize, stride)
        own = torch.arange(len(stored))[:, None] if key == "leave_out" else right
        contenders[key] = contender(name, other, own, bytes, stride)

    plan = model.map.plan
    chunks = model.certificate.chunks
    facts = {
        "frames": len(stored),
        "queries": len(seen),
        "tolerance": tolerance,
        "recall_definition": RECALL_DEFINITION,
        "map_bytes": size,
        "backbone_bytes": model.backbone_bytes,
        "bytes_per_place": size / len(stored),
        "full_bytes": stored.numel() * itemsize,
        "templates": sum(layer.phases for layer in plan),
        "template_numbers": model.map.templates.numel(),
        "periods": sorted({_plain(layer.period) for layer in plan}),
        "chunks": [
            {"start": c.start, "stop": c.stop, "periods": [_plain(period) for period in c.periods]}
            for c in chunks
        ],
        "seconds_learn": learnt - began,
        "seconds_localize": localized - learnt,
        "accepted": int(match.accepted.sum()),
        "threshold": model.threshold,
        "reference": reference.name,
        "query": query.name,
        "version": dejavu_torch.__version__,
        "torch": torch.__version__,
    }
    ours = contender("this map", match, right, size, None)
    pictures = _pictures(model, reference, seen, match, right, tolerance, found)
    return Comparison(Report(ours, contenders, facts), match, model, pictures)


def _pictures(
    model: DejaVu,
    reference: Traverse,
    seen: Tensor,
    match: Match,
    truth: Tensor | None,
    tolerance: int,
    found: Mapping[str, tuple[str, Match, int | None]],
) -> dict[str, Plot]:
    pictures = {}
    if truth is not None:
        curves = {"this map": curve_of(match, truth, tolerance)}
        for key, (name, other, _) in found.items():
            if key != "leave_out":  # it has other queries
                curves[name] = curve_of(other, truth, tolerance)
        pictures["pr"] = plot_curves(curves, f"right within {tolerance} frames")
    pictures["coverage"] = plot_coverage(match, truth, tolerance, model.map.places)
    pictures["chunks"] = plot_chunks(model.map.plan, model.map.places)
    drawn = draw_activations(model, reference, seen, truth)
    return pictures | ({"activations": drawn} if drawn else {})


def draw_activations(model: DejaVu, reference: Traverse, seen: Tensor, truth: Tensor | None) -> Plot | None:
    """Two layers of one chunk answering one query, and their fusion; None where no chunk has two layers.

    The longest chunk, its two layers of most features, and the query whose right place is nearest to
    the chunk's middle (without truth: the middle query).
    """
    plan = model.map.plan
    groups = {
        (p.start, p.stop): [j for j, q in enumerate(plan) if (q.start, q.stop) == (p.start, p.stop)]
        for p in plan
    }
    groups = {chunk: members for chunk, members in groups.items() if len(members) > 1}
    if not groups:
        return None
    start, stop = max(groups, key=lambda chunk: (chunk[1] - chunk[0], -chunk[0]))
    chosen = sorted(groups[start, stop], key=lambda j: -len(plan[j].features))[:2]
    query, places = len(seen) // 2, []
    if truth is not None:
        apart = torch.where(truth >= 0, (truth - (start + stop) / 2).abs(), torch.inf).amin(1)
        query = int(apart.argmin())
        places = [place for place in truth[query].tolist() if start <= place < stop]
    one = seen[query : query + 1]
    blocks, features = model.map.blocks(), model.map.layer_features()
    scores = [
        phase_distances(one[:, features[j]], blocks[j], model.matcher.metric)[0, plan[j].place_phases].cpu()
        for j in chosen
    ]
    with torch.no_grad():
        fused = model.matcher(one, model.map)[0, start:stop].cpu()
    strip = slit_scan(reference, start, stop)
    return plot_activations([plan[j] for j in chosen], scores, fused, query, places, strip)


def slit_scan(traverse: Traverse, start: int, stop: int) -> Tensor | None:
    """The middle image column of each of the frames [start, stop), side by side: (C,H,stop - start).

    None where the traverse holds features.
    """
    columns: list[Tensor] = []
    seen = 0
    for batch in traverse.batches(64):
        if batch.ndim == 2 or seen >= stop:
            break
        middle = batch[max(0, start - seen) : stop - seen, ..., batch.shape[-1] // 2]
        columns.append(middle.clone())  # a view would keep the whole frames
        seen += len(batch)
    return torch.cat(columns).permute(1, 2, 0).float() if columns else None


def _plain(period: object) -> int | float:
    value = float(period)  # type: ignore[arg-type]
    return int(value) if value.is_integer() else value


def _ordinal(k: int) -> str:
    return {1: "1st", 2: "2nd", 3: "3rd"}.get(k, f"{k}th")
