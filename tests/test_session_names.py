"""Names of sessions that a client of the control socket may ask for."""

from __future__ import annotations

import pytest

from artemis_edge.service.daemon import _plain_name


@pytest.mark.parametrize("name", ["walk", "Gang 3, Süd", "歩" * 80])
def test_names_that_folders_can_have(name: str) -> None:
    assert _plain_name(name)


@pytest.mark.parametrize("name", ["", ".", "a/b", "a\0b", "a\nb", "\ud800", "x" * 101, "😀" * 90, 7, None])
def test_names_that_would_end_the_service(name: object) -> None:
    assert not _plain_name(name)
