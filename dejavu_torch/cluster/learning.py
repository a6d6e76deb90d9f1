"""The chunks of a long route, made by the workers of a cluster."""

from __future__ import annotations

from collections.abc import Sequence

from tqdm import tqdm

from dejavu_torch.cluster.session import Cluster, Failure
from dejavu_torch.database.spectral import CodedChunk
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
        for task, result in cluster.run(coded, shared, tasks):
            if isinstance(result, Failure):
                failed.append((range(task[0].start, task[-1].stop), result))
                if len(failed) == FAILURES:
                    break
                continue
            for shard, chunks in zip(task, result, strict=True):
                bar.update(sum(one.places for one in chunks))
                yield shard, chunks
    if failed:
        chunks, failure = failed[0]
        start, stop = coder.span(chunks)
        more = f", and {len(failed) - 1} more such parts" if len(failed) > 1 else ""
        raise InputError(f"frames {start} to {stop - 1}, read on {failure.host}: {failure.why}{more}")


def coded(shards: list[range], coder: ChunkCoder, traverse: Traverse) -> list[list[CodedChunk]]:
    """The chunks of shards, by a worker."""
    return [chunks for _, chunks in code_here(coder, traverse, shards)]


def _dealt(shards: Sequence[range], workers: int) -> list[list[range]]:
    """Shards in about as many runs as there are workers.

    Example:
        >>> [len(run) for run in _dealt([range(i, i + 1) for i in range(7)], 3)]
        [3, 3, 1]
    """
    most = max(1, -(-len(shards) // workers))
    return [run[i : i + most] for run in joined(shards) for i in range(0, len(run), most)]
