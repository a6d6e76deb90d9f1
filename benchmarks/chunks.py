"""`benchmarks chunks`: the paper's maps with chunks of other lengths (section VI)."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from tqdm import tqdm

from benchmarks.measure import Column, Row, new_row, table, write_bench
from dejavu_torch.data.source import open_source
from dejavu_torch.evaluation.compare import Comparison, compare
from dejavu_torch.evaluation.controls import with_mapper
from dejavu_torch.evaluation.curves import evaluate
from dejavu_torch.evaluation.paper_tables import PUBLISHED
from dejavu_torch.evaluation.reproduce import PAPER, paper_model
from dejavu_torch.maps.template_map import Reduction, TemplateMapper
from dejavu_torch.periods.spectrogram import SpectrogramAnalysis

LENGTHS = (256, 512, 1024, 2048)
TOLERANCE = 5
KEYS = ("recall_at_1", "auc", "recall_at_1_comparable", "bytes_per_place")
COLUMNS: dict[str, Column] = {
    **{"recall@1": ("recall_at_1", ".3f"), "AUC": ("auc", ".3f")},
    **{"comparable": ("recall_at_1_comparable", ".3f"), "bytes per place": ("bytes_per_place", ".0f")},
}


def run_chunks(*, out: Path, frames: int | None = None, seed: int = 0) -> list[str]:
    """The paper's maps of its three datasets, simulated, with chunks of 256 to 2048 places.

    Args:
        out: folder for bench.json
        frames: of each route; None is the simulator's default
        seed: of the routes
    """
    rows: list[Row] = []
    for dataset in tqdm(PUBLISHED, "chunks", disable=None, leave=False):
        address = f"sim:{dataset}?seed={seed}" + (f"&frames={frames}" if frames else "")
        reference, query = open_source(address), open_source(f"{address}&traverse=1")
        model = paper_model(reference)
        model.mapper = mapper_of(LENGTHS[0], "sum")  # which any route is long enough for
        rows += lengths_of(dataset, compare(reference, query, model=model, tolerance=TOLERANCE))
        write_bench(out, rows)
    return [table(rows, COLUMNS), "comparable: recall@1 with scores that are comparable between chunks"]


def mapper_of(window: int, reduction: Reduction) -> TemplateMapper:
    return TemplateMapper(SpectrogramAnalysis(window, **PAPER), reduction=reduction)


def lengths_of(dataset: str, result: Comparison) -> Iterator[Row]:
    """A row for each length of the chunks that the route has."""
    run = result.run
    assert run.truth is not None
    places = len(run.reference_features)
    for window in (length for length in LENGTHS if length <= places):
        found, size = [], 0
        for reduction in ("sum", "mean"):
            model = with_mapper(run.model, mapper_of(window, reduction))
            model.learn_features(run.reference_features, run.reference)
            size = model.summary().map_bytes
            match = model.localize(run.query_features).renumbered(model.map.table.scored)
            found.append(evaluate(match, run.truth, run.tolerance))
        printed, comparable = found
        yield new_row(dataset, f"chunks of {window}", KEYS) | {
            "recall_at_1": printed.recall_at_1,
            "auc": printed.auc,
            "recall_at_1_comparable": comparable.recall_at_1,
            "bytes_per_place": size / places,
        }
