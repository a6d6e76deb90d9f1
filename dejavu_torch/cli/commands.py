"""What the commands do: each a thin skin over functions."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from dejavu_torch.data.files import check_output_file, make_output_folder
from dejavu_torch.data.source import open_source
from dejavu_torch.data.truth import Shown
from dejavu_torch.database.l1 import l1_backend
from dejavu_torch.database.summary import describe
from dejavu_torch.evaluation.matches import write_matches
from dejavu_torch.evaluation.report import (
    Report,
    score_table,
    summary,
    text_table,
    write_index,
    write_report,
)
from dejavu_torch.experiments import bench
from dejavu_torch.experiments.compare import Comparison, compare
from dejavu_torch.experiments.evaluate import evaluate_file
from dejavu_torch.experiments.reproduce import reproduce
from dejavu_torch.experiments.section_five import (
    FOOTAGE,
    PUBLISHED,
    boundary_lines,
    lengths_picture,
    route_lines,
    section_five,
)
from dejavu_torch.features.hog import HOG
from dejavu_torch.model import DejaVu
from dejavu_torch.motion.ground_plane import check_corners
from dejavu_torch.motion.resampling import ResampledTraverse
from dejavu_torch.periods.stft import BACKEND
from dejavu_torch.types import InputError, Traverse


def run_demo(out: Path, seed: int, model: DejaVu, command: str) -> None:
    """The main job on the built-in route."""
    make_output_folder(out)
    reference = open_source(f"sim:aerial?seed={seed}")
    query = open_source(f"sim:aerial?seed={seed}&traverse=1")
    print(f"learning {reference.name}, then finding {query.name} on it")
    result = compare(reference, query, model=model, progress=True)
    _publish(result, out, "dejavu demo: the built-in route", command, save_map=True)


def run_learn(source: str, map: Path, model: DejaVu) -> None:
    """Learn a map and print its plan."""
    check_output_file(map)
    traverse = model.evenly(open_source(source), progress=True)
    _tell_spacing(traverse)
    model.learn(traverse, progress=True)
    model.save(map)
    _print_plan(model)


def run_localize(
    map: Path,
    source: str,
    out: Path,
    threshold: float | None,
    features: Any,
    corners: list[list[float]] | None,
    as_is: bool,
) -> None:
    """Find the frames of a source on a map; one csv row each."""
    check_output_file(out)
    model = DejaVu.load(map, features)
    if corners is not None:
        if as_is or model.velocity is None or model.step is None:
            why = "--as_is measures no ground" if as_is else f"{map} was learnt without --velocity"
            raise InputError(f"--corners {corners}: {why}; expected one that does")
        check_corners(corners)
        model.velocity.corners = tuple((float(x), float(y)) for x, y in corners)
    model.velocity = None if as_is else model.velocity
    model.threshold = model.threshold if threshold is None else threshold
    if model.threshold is None:
        print("no threshold given or stored in the map: every query with a finite score is accepted")
    if not model.map.plan:
        print("the map holds no layers: no place can be reported")
    traverse, shown = open_source(source), None
    if model.step is not None:
        traverse = model.evenly(traverse, model.step, progress=True)
        _tell_spacing(traverse)
        frame = traverse.frame if isinstance(traverse, ResampledTraverse) else None
        shown = Shown(frame, model.map.frame)
    queries, accepted = write_matches(out, model.matches(traverse, progress=True), shown)
    print(f"{queries} queries, {accepted} accepted; written to {out}")


def run_compare(
    reference: str,
    query: str,
    truth: str | None,
    tolerance: int,
    interpolate: bool,
    leave_out: int | None,
    map: Path | None,
    out: Path,
    model: DejaVu,
    command: str,
) -> None:
    """Learn, or take a map; localize and judge; report beside baselines and null control."""
    if map is not None:  # features of this package build themselves
        threshold = model.threshold
        model = DejaVu.load(map, None if isinstance(model.features, HOG) else model.features)
        model.threshold = model.threshold if threshold is None else threshold
    pair = open_source(reference), open_source(query)
    _make_report_folder(out, reference, query)
    result = compare(
        *pair, truth, model, tolerance, leave_out, interpolate=interpolate, progress=True, learn=map is None
    )
    _publish(result, out, f"{query} found on {reference}", command)


def run_evaluate(
    matches: Path,
    truth: str,
    tolerance: int,
    interpolate: bool,
    reference: str | None,
    query: str | None,
    map: Path | None,
    out: Path,
    command: str,
) -> None:
    """Judge the matches in a csv, whatever found them."""
    one, other = (None if source is None else open_source(source) for source in (reference, query))
    _make_report_folder(out, reference, query)
    result = evaluate_file(matches, truth, tolerance, interpolate, one, other, map)
    write_report(out, result.report, result.pictures, f"{matches} judged by {truth}", command)
    _print_scores(result.report, out)


def run_reproduce(dataset: str, out: Path, seed: int, tolerance: int, command: str) -> None:
    """The paper's datasets, beside the paper's own numbers."""
    make_output_folder(out)
    names = list(PUBLISHED) if dataset == "all" else [dataset]
    reports: dict[str, Report] = {}
    for name in names:
        print(f"{name}: a second traverse, the database itself, chunks of other lengths", flush=True)
        result = reproduce(name, tolerance=tolerance, seed=seed, progress=True)
        make_output_folder(out / name)
        title, plan = f"dejavu reproduce: {name}", describe(result.model.certificate)
        write_report(out / name, result.report, result.pictures, title, command, plan)
        write_matches(out / name / "matches.csv", [result.match], result.shown)
        reports[name] = result.report
    rows, notes = section_five(reports), [*route_lines(reports), *boundary_lines(reports), FOOTAGE]
    pages = {name: f"{name}/index.html" for name in names}
    write_index(out, rows, notes, lengths_picture(reports), pages, "the paper's experiments", command)
    print("\n".join([text_table(rows), *notes]))
    print(f"right within {tolerance} places; report: {out / 'index.html'}")


def run_info(map: Path, features: Any) -> None:
    """Tell what is in a map."""
    model = DejaVu.load(map, features)
    _print_plan(model)
    if model.learnt_from is not None:
        kind = "frames of " if len(model.learnt_from) == 3 else "ready features, "
        print(f"learnt from {kind}{' x '.join(str(n) for n in model.learnt_from)}")
    parts = [model.preprocess, model.features, model.periods, model.matcher]
    if model.step is not None and model.velocity is not None:
        print(f"places are {model.step:.4g} pixels of ground apart")
        parts.append(model.velocity)
    for part in parts:
        print(f"{type(part).__name__}: {part.extra_repr()}")
    if model.trained is not None:
        steps, seconds, seed = model.trained
        print(f"trained for {steps} steps in {seconds:.0f} s, seed {seed}")
    print(f"threshold: {model.threshold}; L1 here by {l1_backend()}, spectrogram by {BACKEND}")


def run_bench(what: str, out: Path) -> None:
    """Time this package beside what a user would pick instead."""
    rows = bench.run_bench(what, out)
    print(text_table(bench.bench_table(rows)))
    if any("No module" in (row.skipped or "") for row in rows):
        print("what is skipped comes with pip install '.[bench]'")
    print(f"x ours: seconds / those of the fastest dejavu; written to {out / 'bench.json'}")


def _make_report_folder(out: Path, *sources: str | None) -> None:
    """Make the folder of a report, which must not be where images lie."""
    if out.resolve() in [Path(source.partition("?")[0]).resolve() for source in sources if source]:
        raise InputError(f"{out} holds the images; expected another folder for the report")
    make_output_folder(out)


def _tell_spacing(traverse: Traverse) -> None:
    if isinstance(traverse, ResampledTraverse):
        frames, steps = len(traverse.way), f"even steps of {traverse.step:.4g} pixels of ground"
        print(f"{frames} frames make {traverse.length} {steps}")


def _print_plan(model: DejaVu) -> None:
    if not model.map.plan:
        print("this route does not repeat")
    print(describe(model.certificate))


def _publish(result: Comparison, out: Path, title: str, command: str, save_map: bool = False) -> None:
    _print_plan(result.model)
    if result.report.ours.scores is None:
        print("nothing tells which places are right, see --truth: matches and pictures, no scores")
    write_matches(out / "matches.csv", [result.match], result.shown)
    if save_map:
        result.model.save(out / "map.safetensors")
    write_report(out, result.report, result.pictures, title, command, describe(result.model.certificate))
    _print_scores(result.report, out)


def _print_scores(report: Report, out: Path) -> None:
    print(text_table(score_table(report)))
    print(f"{summary(report)} Report: {out / 'index.html'}")
