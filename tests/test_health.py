"""What the machine has left, and what is given back to it."""

import threading
from pathlib import Path

from artemis_edge import health
from tests.waiting import until


def test_memory_that_was_freed_is_given_back() -> None:
    many = [bytes(2000 + k % 7) for k in range(50_000)]
    last = bytes(3000)  # lies behind them, so that the heap cannot simply shrink
    full = health.resident_mb()
    many.clear()
    health.give_back_memory()
    assert len(last) == 3000 and health.resident_mb() < full - 50


def test_the_peak_is_not_less_than_what_is_there() -> None:
    health.restart_peak()
    now = health.resident_mb()
    assert 0 < now <= health.peak_resident_mb() + 1


def test_the_disk_of_a_folder_that_is_not_there_yet_is_its_parents(tmp_path: Path) -> None:
    assert health.free_disk_mb(tmp_path / "a" / "b") > 0
    assert health.processors() >= 1 and health.available_memory_mb() > 0


def test_cpu_is_told_by_thread() -> None:
    counting, told = threading.Event(), threading.Event()

    def count() -> None:
        while not told.is_set():
            counting.set()

    busy = threading.Thread(target=count, name="counting", daemon=True)
    busy.start()
    try:
        counting.wait()
        before = health.cpu_by_thread_s()
        assert until(lambda: health.cpu_by_thread_s()["counting"] > before["counting"] + 0.01)
        assert {"MainThread", "counting"} <= set(before)
    finally:
        told.set()
        busy.join()
    assert "counting" not in health.cpu_by_thread_s()
