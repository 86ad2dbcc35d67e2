"""Addresses at which no cluster can be reached."""

from __future__ import annotations

import pytest

from artemis_edge.cluster import on_cluster
from artemis_edge.errors import InputError


def test_a_protocol_that_dask_is_not_set_up_for(monkeypatch: pytest.MonkeyPatch) -> None:
    distributed = pytest.importorskip("distributed")

    def client(*_: object, **__: object) -> None:
        raise TypeError("TLS expects a `ssl_context` argument")

    monkeypatch.setattr(distributed, "Client", client)
    with pytest.raises(InputError, match="give tcp://HOST:PORT"):
        on_cluster("tls://127.0.0.1:1", [], plain=True)
