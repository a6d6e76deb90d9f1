"""The commands that write a report: demo, compare, evaluate and reproduce."""

from __future__ import annotations

import webbrowser
from collections.abc import Sequence
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from dejavu_torch.cli import options
from dejavu_torch.cli.commands import (
    print_localize,
    print_map,
    print_next,
    say,
    write_matches,
)
from dejavu_torch.cli.device import device_of
from dejavu_torch.data.output import check_output_file, check_output_folder, whole_folder
from dejavu_torch.data.source import check_not_read, open_source
from dejavu_torch.evaluation.doubts import contradiction, doubt_lines
from dejavu_torch.evaluation.options import UNREAD, Reporting, several
from dejavu_torch.model import DejaVu
from dejavu_torch.model_file import recipe_of
from dejavu_torch.recognition.querying import Querying
from dejavu_torch.types import InputError, expect

if TYPE_CHECKING:
    from dejavu_torch.evaluation.compare import Comparison
    from dejavu_torch.evaluation.localization import Localization
    from dejavu_torch.evaluation.report import Report

DEMO = ("demo:road?traverse=0", "demo:road?traverse=1")
COMPARED = ("map.safetensors", "matches.csv")  # files next to the report of a comparison


def run_demo(
    *,
    out: Path = Path("dejavu_demo"),
    open: bool = False,
    simulated: bool = False,
    verbose: bool = False,
    seed: int = 0,
    second: list[str] | str | None = None,
    drives: Literal["few", "all"] = "few",
    model: DejaVu,
    command: str,
) -> None:
    """Learn a flight over a real road, find the frames of a second flight on it, and write a report.

    Args:
        out: folder for report and pictures
        open: show the report in a browser
        simulated: two flights over a simulated road instead
        verbose: print all scores, as compare does
        seed: seed of the whitening and the controls, and of the simulated road
        second: another visit to the road, to learn which changes to ignore, or several, '[A,B]'
        drives: contenders that are also matched as a whole drive, see compare
    """
    from dejavu_torch.evaluation.compare import compare
    from dejavu_torch.evaluation.reproduce import paper_model

    _check_report_folder(out, COMPARED, several(second))
    given = options.LearningOptions(seed, second)
    given.seed_whitening(model)
    learned, localized = DEMO
    if simulated:
        learned, localized = (f"sim:aerial?seed={seed}{second}" for second in ("", "&traverse=1"))
    reference, query = open_source(learned), open_source(localized)
    what = "simulated flights over one road" if simulated else "real flights over one road"
    print(f"two {what}: learning {learned}, then finding the frames of {localized}", flush=True)
    reference, opened = given.with_views(model, reference, query)
    paper = paper_model()
    same = recipe_of(model.mapper) == recipe_of(paper.mapper)
    others = {} if same else {"paper": ("the paper to the letter", paper)}
    title = f"dejavu demo: two {what}"

    def on_found(found: Comparison) -> None:
        _publish_found(found, out, title, command, verbose=verbose)

    reporting = Reporting(storage_curve=True, drives=drives, others=others, on_found=on_found, progress=True)
    result = compare(reference, query, model=model, learning=opened, reporting=reporting)
    _publish(result, out, title, command, verbose=verbose, show=open)
    print_localize(out / "map.safetensors", model, command, localized, "or try")
    print_next("compare", "MORNING", "EVENING")


def run_compare(
    reference: str,
    query: str | None = None,
    *,
    out: Path | None = None,
    open: bool = False,
    judging: options.EvaluationOptions,
    learning: options.LearningOptions,
    map: Path | None = None,
    querying: Querying,
    searching: options.Searching,
    model: DejaVu,
    command: str,
) -> None:
    """Learn one visit to a route, find the frames of another on it, and write a report that compares the map
    with other ways to store the route.

    Args:
        reference: the visit to learn: a folder of images, a video, or another source of `dejavu learn`
        query: the visit whose frames are found; none with --loops
        out: folder for report, pictures, matches.csv and map.safetensors; by default dejavu_report, or
            dejavu_report_2 and so on if that exists
        open: show the report in a browser
        map: evaluate this map of the reference
    """
    from dejavu_torch.evaluation.compare import compare

    out = _unused_folder() if out is None else out
    within, loops = max(0, judging.tolerance), querying.loops
    if loops is None:
        expect(query is not None, "a second visit, or --loops within the first", "compare without QUERY")
    else:
        expect(query is None, "the reference alone", f"--loops {loops} and the query {query}")
    judging.check_loops(querying)
    where = device_of(learning.device, learns=map is None)
    acceptance = options.Acceptance(model.threshold, model.precision)
    matcher = querying.matcher(within, acceptance.threshold)
    ordered = querying.order(matcher)
    acceptance.check(matcher, judging.distractors)
    if map is not None:
        model = options.load_map(map, options.named_features(model))
        model.map.layout.expect_one(f"a map of {reference} alone", f"--map {map}")
        acceptance.of(model)
    searching.of(model.to(where))
    first = open_source(reference)
    queries = first if query is None else open_source(query)
    matcher = querying.matcher(within, acceptance.threshold, queries.ordered if ordered is None else ordered)
    assert not isinstance(matcher, str)
    tells = matcher is not None and matcher.answers != "sequence"  # probabilities
    if tells and acceptance.threshold is not None and query:
        model.threshold = None  # it is for a probability, so the map must not keep it
    seconds = several(learning.second)
    _check_report_folder(
        out, COMPARED, [reference, *filter(None, [query]), *seconds], [judging.truth, *learning.files]
    )
    others = [open_source(one) for one in (*seconds, learning.calibration) if one not in UNREAD]
    distractors = judging.off_map([first, queries, *others])
    if matcher is None or not matcher.whole:  # which has probabilities of its own
        learning.check_calibrated(model, first, map, judging.distractors)
    learning.seed_whitening(model)
    first, opened = learning.with_views(model, first, queries)
    on, asked = short_name(reference), None if query is None else short_name(query)
    title = f"loops within {on}" if asked is None else f"{asked} found on {on}"

    def on_found(found: Comparison) -> None:
        _publish_found(found, out, title, command, map, querying.top)

    reporting = replace(judging, distractors=distractors, on_found=on_found, progress=True)
    querying = replace(querying.by(matcher), ordered=ordered is True, unordered=ordered is False)
    found = None if query is None else queries
    settings = judging.truth, model, judging.tolerance, opened, querying, reporting
    _publish(compare(first, found, *settings), out, title, command, show=open)


def run_evaluate(
    matches: Path,
    *,
    truth: str,
    out: Path,
    tolerance: int = 5,
    interpolate: bool = False,
    reference: str | None = None,
    query: str | None = None,
    map: Path | None = None,
    route: str | None = None,
    recall_values: Sequence[int] = (),
    higher_is_better: bool = False,
    loops: int | None = None,
    command: str,
) -> None:
    """Score a csv of matches from any method: scores, curve, coverage.

    Args:
        matches: csv of query,place,score[,accepted][,probability][,confidence][,rank][,route]
        truth: right places, as in `dejavu compare`
        out: folder for report and pictures
        tolerance: count an answer as right if it is at most this many frames off
        interpolate: interpolate a --truth that lists only some queries
        reference: source of the places, for their number and coordinates; as in `dejavu learn`
        query: source of the queries; as in `dejavu learn`
        map: map of the matches, for its number of frames and, if they are resampled, their places
        route: route of a merged map that --truth, --reference and the queries belong to; answers on other
            routes are wrong
        recall_values: also print the share of queries with a right answer among their first N ranks, for each
            N, such as 1 5 10 20; with --tolerance 0 these are the figures of VPR-methods-evaluation
        higher_is_better: the scores are similarities, not distances
        loops: as in localize: only places more than this many frames before a query are right
    """
    from dejavu_torch.evaluation.evaluate import Asked, evaluate_file
    from dejavu_torch.evaluation.report import report_folder, write_report

    first, second = (None if source is None else open_source(source) for source in (reference, query))
    _check_report_folder(out, (), [reference, query], [matches, truth, map])
    asked = Asked(first, second, map, route)
    given = asked, interpolate, recall_values, higher_is_better, loops
    result = evaluate_file(matches, truth, tolerance, *given)
    with report_folder(out) as folder:
        title = f"{short_name(matches)} evaluated by {short_name(truth)}"
        write_report(folder, result.report, result.pictures, title, command)
    _print_doubts(result.report)
    if recall_values:
        recalls = result.report.facts["recall_values"]
        print(", ".join(f"R@{first}: {100 * recall:.1f}" for first, recall in recalls.items()))
        if tolerance:
            off = f"{tolerance} {result.report.facts['unit']}"
            print(f"answers may be {off} off here; in VPR-methods-evaluation they may not")
    _print_scores(result.report, out)


def run_reproduce(
    dataset: str = "all", *, out: Path, seed: int = 0, tolerance: int = 5, command: str
) -> None:
    """Repeat the paper's experiments on simulated routes, and compare with its published numbers.

    Args:
        dataset: aerial, outdoor, underground or all
        out: folder for the reports
        seed: seed of the routes
        tolerance: count an answer as right if it is at most this many frames off
    """
    from dejavu_torch.evaluation import paper_tables as tables
    from dejavu_torch.evaluation.report import report_folder, text_table, write_index, write_report
    from dejavu_torch.evaluation.reproduce import reproduce

    names = list(tables.PUBLISHED) if dataset == "all" else [dataset]
    if not {*names} <= {*tables.PUBLISHED}:
        raise InputError(f"there is no dataset {dataset!r}; expected {', '.join(tables.PUBLISHED)} or all")
    check_output_folder(out)
    reports: dict[str, Report] = {}
    for name in names:
        print(f"{name}: a second visit, and the reference itself", flush=True)
        result = reproduce(name, tolerance=tolerance, seed=seed, progress=True)
        run, title = result.run, f"dejavu reproduce: {name}"
        plan = str(run.model.summary())
        with report_folder(out / name) as folder:
            write_report(folder, result.report, result.pictures, title, command, plan)
            write_matches(folder / "matches.csv", [run.match], run.query, run.model)
        reports[name] = result.report
    rows = tables.section_five(reports)
    notes = [*tables.route_lines(reports), *tables.boundary_lines(reports), tables.FOOTAGE]
    pages = {name: f"{name}/index.html" for name in names}
    with whole_folder(out) as folder:
        write_index(folder, rows, notes, pages, "the paper's experiments", command)
    print("\n".join([text_table(rows), *notes]))
    say(f"right within {tolerance} places; next: open {out / 'index.html'}")


def short_name(path: str | Path) -> str:
    """The last two parts of a path, and the options of a source but for files, for a title."""
    address, _, options = str(path).partition("?")
    kept = "&".join(one for one in options.split("&") if one and "/" not in one)
    return "/".join(address.rstrip("/").split("/")[-2:]) + (f"?{kept}" if kept else "")


def _check_report_folder(
    out: Path, others: Sequence[str], sources: Sequence[str | None], files: Sequence[str | Path | None] = ()
) -> None:
    """Refuse early a folder that cannot be written, or in which files that are read would be lost.

    Args:
        others: files written there besides the report. sources, files: that are read.
    """
    check_not_read(out, *sources)
    check_output_folder(out)
    if out.is_dir():
        from dejavu_torch.evaluation.report import PICTURES

        for name in ("index.html", "report.json", *others, *(f"{name}.png" for name in PICTURES)):
            check_output_file(out / name)
            check_not_read(out / name, *sources, *files)


def _publish_found(
    found: Comparison,
    out: Path,
    title: str,
    command: str,
    given: Path | None = None,
    top: int | None = None,
    verbose: bool = True,
) -> None:
    """Write map, matches and a page of what was found, before it is compared, and print it.

    Args:
        given: file of the map, unless it was learned.
        top: candidates of each query to write; None writes the matches.
        verbose: also print the map.
    """
    from dejavu_torch.evaluation.report import found_lines, report_folder, write_report

    run, kept = found.run, out / "map.safetensors"
    _print_doubts(found.report)
    if verbose:
        _print_run(run)
    match = run.match
    if top is not None:
        match = found.candidates.map(lambda column: column[:, :top].flatten())
    with report_folder(out) as folder:
        if given is None or given.resolve() != kept.resolve():
            run.model.save(folder / kept.name)
        write_matches(folder / "matches.csv", [match], run.query, run.model, top)
        plan = str(run.model.summary())
        write_report(folder, found.report, found.pictures, title, command, plan, complete=False)
    if lines := found_lines(found.report):
        print("\n".join(lines), end="\n\n", flush=True)


def _publish(
    result: Comparison, out: Path, title: str, command: str, verbose: bool = True, show: bool = False
) -> None:
    """Write the complete report of a comparison, and print its scores: all of them, or a short table."""
    from dejavu_torch.evaluation.report import compared_lines, report_folder, write_report

    plan = str(result.run.model.summary())
    with report_folder(out) as folder:
        write_report(folder, result.report, result.pictures, title, command, plan)
    if verbose:
        _print_scores(result.report, out)
    else:
        print("\n".join(compared_lines(result.report)))
        say(f"the page with pictures: {out / 'index.html'}")
    if show and not webbrowser.open((out / "index.html").absolute().as_uri()):
        say(f"there is no browser here; the report is {(out / 'index.html').absolute()}")


def _unused_folder() -> Path:
    """A folder for a report that is not there yet."""
    names = ("dejavu_report" + f"_{i}" * (i > 1) for i in count(1))
    return next(path for path in map(Path, names) if not path.exists())


def _print_run(run: Localization) -> None:
    """Print the map of a run, and what it accepts."""
    acceptance = run.model.acceptance(run.way)
    print_map(run.model)
    if run.truth is None:
        print("no ground truth (see --truth): matches and pictures, but no scores")
    if not acceptance.given:
        print(acceptance)


def _print_doubts(report: Report) -> None:
    """Say first if the answers contradict the ground truth, and what else is doubtful."""
    for doubt in doubt_lines(report.facts):
        say(doubt)


def _print_scores(report: Report, out: Path) -> None:
    from dejavu_torch.evaluation import report as page
    from dejavu_torch.evaluation.rejection import rejection_table

    rejection = rejection_table(report.facts.get("rejection", {}))
    for rows in (page.score_table(report), page.sequence_table(report), rejection):
        if rows:
            print(page.text_table(rows))
    say(page.summary(report))
    if report.ours.scores is not None:
        say(page.verdict(report))
    else:
        if line := contradiction(report.facts, False):
            say(line)
        if steps := page.steps_after(report.facts):
            say(f"next: {steps}")
    say(f"next: open {out / 'index.html'}")
