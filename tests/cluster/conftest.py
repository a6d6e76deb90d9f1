"""One cluster of two workers on this machine for all tests here: to start Ray takes seconds."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from dejavu_torch.cluster import session
from dejavu_torch.cluster.session import Cluster


@pytest.fixture(scope="session")
def cluster() -> Iterator[Cluster]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(session, "processors", lambda: 2)
        with Cluster() as workers:
            yield workers
