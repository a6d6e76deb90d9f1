"""The chunks of a long route, made by the workers of a cluster."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from tqdm import tqdm

from dejavu_torch.cluster.session import Cluster, Failure
from dejavu_torch.maps.spectral import CodedChunk
from dejavu_torch.streaming.coder import ChunkCoder, Made, code_here, joined
from dejavu_torch.types import InputError, Traverse

FAILURES = 8  # shards that may fail before the others are given up


def code_on(
    cluster: Cluster,
    coder: ChunkCoder,
    traverse: Traverse,
    shards: Sequence[range],
    progress: str | None = None,
) -> Made:
    """As `code_here`, by a cluster: the same bytes, since every worker runs that function.

    A traverse that cannot seek is read from its beginning by every worker, so that its shards are dealt out
    in few runs.

    Raises:
        InputError: shards that came to nothing, when all others are made; the first of them is named.
    """
    shared = cluster.put(coder, traverse)
    tasks = [[shard] for shard in shards] if traverse.seeks else _dealt(shards, cluster.workers)
    failed: list[tuple[range, Failure]] = []
    total = sum(len(range(*coder.span(shard))) for shard in shards)
    bar = tqdm(total=total, desc=progress, unit="frame", disable=None if progress else True, leave=False)
    with bar:
        for task, made, failure in cluster.run(coded, shared, tasks):
            for shard, chunks in zip(task, made, strict=False):
                bar.update(sum(one.places for one in chunks))
                yield shard, chunks
            if failure is not None:
                left = task[len(made) :] if failure.host is None else task[len(made) : len(made) + 1]
                failed.append((range(left[0].start, left[-1].stop), failure))
                if len(failed) == FAILURES:
                    break
    if failed:
        part, failure = min(failed, key=lambda one: one[0].start)
        start, stop = coder.span(part)
        read = "" if failure.host is None else f", read on {failure.host}"
        more = f", and {len(failed) - 1} more such parts" if len(failed) > 1 else ""
        raise InputError(f"frames {start} to {stop - 1}{read}: {failure.why}{more}")


def coded(shards: list[range], coder: ChunkCoder, traverse: Traverse) -> Iterator[list[CodedChunk]]:
    """The chunks of each shard, by a worker."""
    for _, chunks in code_here(coder, traverse, shards):
        yield chunks


def _dealt(shards: Sequence[range], workers: int) -> list[list[range]]:
    """Shards in about as many runs as there are workers.

    Example:
        >>> [len(run) for run in _dealt([range(i, i + 1) for i in range(7)], 3)]
        [3, 3, 1]
    """
    most = max(1, -(-len(shards) // workers))
    return [run[i : i + most] for run in joined(shards) for i in range(0, len(run), most)]
