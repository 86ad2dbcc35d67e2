"""The terminal: pages by pilot, pictures by hand, and a whole session against a remote that is told what to say."""

import multiprocessing
import threading
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from msgspec.structs import replace
from textual.geometry import Region, Size
from textual.pilot import Pilot
from textual.widgets import DataTable, Input, Static

from artemis_edge import check
from artemis_edge.check_finding import Finding
from artemis_edge.commands.tui import read_keys
from artemis_edge.errors import InputError
from artemis_edge.frames import MeshDelta
from artemis_edge.newest import Newest, joined
from artemis_edge.status import QueryStatus, Status
from artemis_edge.tui import app as app_module
from artemis_edge.tui import jobs, pages, picture, widgets
from artemis_edge.tui.app import ArtemisTui, LivePage
from artemis_edge.tui.child import Teller
from artemis_edge.tui.history import History
from artemis_edge.tui.jobs import Job
from artemis_edge.tui.live_questions import LiveQuestions
from artemis_edge.tui.pages import ReportPlace, SessionsPage, recordings
from artemis_edge.tui.picture import SKY, MapCopy, draw, found_in, luminance_text
from artemis_edge.tui.remote import RemoteError
from artemis_edge.tui.socket_remote import SocketRemote
from artemis_edge.tui.widgets import MeshPicture, advice, frame_times, gauges
from tests.fake_remote import FULL, Fake, delta, live, run, settled
from tests.waiting import until


@pytest.mark.parametrize("size", [(80, 24), (160, 48)])
@pytest.mark.parametrize("colour", [True, False])
def test_live_page_shows_everything(size: tuple[int, int], colour: bool, tmp_path: Path) -> None:
    app = ArtemisTui(Fake(), tmp_path, colour)

    async def script(pilot: Pilot[None]) -> None:
        await settled(pilot, lambda: live(app).query_one("#queries", DataTable).row_count == 2)
        assert live(app).query_one("#streams", DataTable).row_count == 3
        picture = live(app).query_one(MeshPicture)
        assert picture.size.width >= 30 and picture.size.height >= 6
        live(app).redraw()
        text = "".join(strip.text for strip in picture._lines)
        assert any(c not in " " for c in text), "the map is drawn"
        shown = app.export_screenshot()
        for words in ("RECORDING", "bench", "lidar_0", "turn&#160;slower"):
            assert words in shown

    run(app, script, size)


def test_ask_recall_jump_and_forget(tmp_path: Path) -> None:
    remote = Fake()
    app = ArtemisTui(remote, tmp_path, history=History(tmp_path / "history"))

    async def script(pilot: Pilot[None]) -> None:
        await settled(pilot, lambda: live(app).query_one("#queries", DataTable).row_count == 2)
        await pilot.press("slash", *"red car", "enter")
        await settled(pilot, lambda: remote.told == ["ask red car"])
        await pilot.press("slash", "up")
        assert live(app).query_one(Input).value == "red car"
        await pilot.press("down")
        assert live(app).query_one(Input).value == ""
        await pilot.press("escape", "enter")
        assert live(app)._look_at == (1.0, 2.0, 0.0)
        await pilot.press("enter")
        assert live(app)._look_at == (5.0, 5.0, 0.0), "the next object"
        await pilot.press("escape")
        assert live(app)._look_at is None
        await pilot.press("down", "delete")
        await settled(pilot, lambda: remote.told[-1] == "forget unicorn")

    run(app, script)
    assert History(tmp_path / "history").lines == ["red car"]


def test_start_stop_mark_view_and_zoom(tmp_path: Path) -> None:
    remote = Fake()
    app = ArtemisTui(remote, tmp_path, keymap={"mark": "k"})

    async def script(pilot: Pilot[None]) -> None:
        await pilot.press("r", "s", "k")
        await settled(pilot, lambda: sorted(remote.told) == ["mark", "start", "stop"])
        await pilot.press("v", "plus")
        assert live(app).view == "above" and live(app).span_m == pytest.approx(28.0)
        for _ in range(20):
            await pilot.press("minus")
        assert live(app).span_m == 320.0

    run(app, script)


def test_pages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = [Finding("disk", "warn", "1 GB free"), Finding("clock", "fail", "no pulse")]
    monkeypatch.setattr(check, "check", lambda: found)
    (tmp_path / "walk").mkdir()
    (tmp_path / "walk" / "session.mcap").write_bytes(b"no recording")
    app = ArtemisTui(Fake(), tmp_path)

    async def script(pilot: Pilot[None]) -> None:
        await pilot.press("2")
        await settled(pilot, lambda: app.screen.query_one(DataTable).row_count == 2)
        assert "1 to mend" in str(app.screen.query_one("#summary", Static).render())
        assert str(app.screen.query_one(DataTable).get_row_at(0)[1]) == "clock", "the gravest first"
        await pilot.press("3")
        await settled(pilot, lambda: app.screen.query_one(DataTable).row_count == 1)
        card = app.screen.query_one("#card", Static)
        await settled(pilot, lambda: "session.mcap" in str(card.render()) or "MCAP" in str(card.render()))
        await pilot.press("question_mark")
        assert "Watch&#160;the&#160;picture" in app.export_screenshot()
        await pilot.press("1")
        assert isinstance(app.screen, LivePage)

    run(app, script)


class FakeJob:
    def __init__(self, label: str, words: list[str], out: Path) -> None:
        self.words, self.out, self.over, self.sentence, self.report = words, out, False, f"{label}: busy", ""

    def stop(self) -> None:
        self.over, self.sentence, self.report = True, "stopped", str(self.out / "report.html")

    def close(self) -> None:
        self.stop()


def test_a_recording_is_mapped_from_its_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pages, "Job", FakeJob)
    monkeypatch.setattr(app_module, "can_open", lambda: False)
    (tmp_path / "walk").mkdir()
    (tmp_path / "walk" / "session.mcap").write_bytes(b"no recording")
    app = ArtemisTui(Fake(), tmp_path)

    async def script(pilot: Pilot[None]) -> None:
        await pilot.press("3", "f", "p")
        page = app.screen
        assert isinstance(page, SessionsPage) and isinstance(page.job, FakeJob)
        out = str(tmp_path / "walk" / "reprocess")
        profile = page.job.words[-1]
        assert page.job.words == ["reprocess", str(tmp_path / "walk"), "--out", out, "--profile", profile]
        assert "busy" in str(page.query_one("#job", Static).render())
        first = page.job
        await pilot.press("y")
        assert page.job is first, "one at a time"
        await pilot.press("x", "o")
        await pilot.pause()
        assert isinstance(app.screen, ReportPlace) and f"{out}/report.html" in str(
            app.screen.query_one(Static).render()
        )
        await pilot.press("escape", "y")
        await pilot.pause()
        assert page.job is not first and page.job.words[0] == "replay"

    run(app, script)


def test_a_job_tells_how_it_does(tmp_path: Path) -> None:
    job = Job("reprocess walk", ["reprocess", str(tmp_path / "walk"), "--out", str(tmp_path)], tmp_path)
    assert until(lambda: job.over, 60.0)
    assert job.sentence.startswith(f"reprocess walk: there is no {tmp_path / 'walk'};") and job.report == ""
    job.close()
    assert jobs._bar("replay a", 3, 12) == "replay a: [######..................] 3 of 12"
    assert jobs._PROGRESS.match("mapping walk: 3 of 12, 40 ms a frame")
    assert jobs._PROGRESS.match("note: an image of the first 3 is damaged") is None


def test_a_remote_that_goes_and_comes_back(tmp_path: Path) -> None:
    remote = Fake()
    app = ArtemisTui(remote, tmp_path)

    async def script(pilot: Pilot[None]) -> None:
        remote.fault = "the service does not answer; is it running?"
        await settled(pilot, lambda: app.status.state == "fault")
        assert "does not answer" in app.status.message
        remote.fault = ""
        await settled(pilot, lambda: app.status.state == "recording")

    run(app, script)


def test_the_report_opens_when_there_is_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    remote = Fake()
    app = ArtemisTui(remote, tmp_path)
    opened: list[str] = []
    monkeypatch.setattr(app, "open_url", lambda url, **_: opened.append(url))
    monkeypatch.setattr(app_module, "can_open", lambda: True)

    async def script(pilot: Pilot[None]) -> None:
        await pilot.press("o")
        assert opened == []
        remote.now = Status(state="done", report=str(tmp_path / "report.html"))
        await settled(pilot, lambda: app.status.report != "")
        await pilot.press("o")
        assert opened == [(tmp_path / "report.html").resolve().as_uri()]

    run(app, script)


def test_only_a_desktop_opens_browsers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.platform", "linux")
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "SSH_CONNECTION", "SSH_TTY"):
        monkeypatch.delenv(name, raising=False)
    assert not app_module.can_open(), "a computer without a screen"
    monkeypatch.setenv("DISPLAY", ":0")
    assert app_module.can_open()
    monkeypatch.setenv("SSH_TTY", "/dev/pts/3")
    assert not app_module.can_open(), "a text browser would take the terminal"


# --- the parts


def test_nearest_and_highlighted_vertices_win() -> None:
    copy = MapCopy()
    copy.apply(delta((0, 0, 0), np.array([[3.0, 0, 0], [3.0, 0, 1.0], [0, 3.0, 0]])))
    image = draw(copy, 21, 21, (0, 0, 0), 0.0, "above", 21.0)
    assert tuple(image[10, 13]) == (200, 200, 200), "3 m east of the middle"
    assert tuple(image[7, 10]) == (200, 200, 200), "3 m north"
    assert tuple(image[10, 10]) == (255, 255, 255), "oneself"
    assert tuple(image[0, 0]) == SKY
    copy.apply(delta((0, 0, 0), np.array([[0, 3.0, 0]]), label=2))
    car = QueryStatus("car", colour=(255, 0, 0), labels=[2])
    image = draw(copy, 21, 21, (0, 0, 0), 0.0, "above", 21.0, [car])
    assert tuple(image[10, 13]) == SKY, "the block's newest state has replaced the older"
    assert image[7, 10, 0] > 200 > image[7, 10, 1]


def test_what_is_ahead_is_drawn_and_what_is_behind_is_not() -> None:
    for ahead, seen in ((8.0, True), (-60.0, False)):
        copy = MapCopy()
        copy.apply(delta((0, 0, 0), np.array([[0.0, ahead, 0.0]])))
        image = draw(copy, 40, 40, (0, 0, 0), np.pi / 2, "behind", 40.0)
        assert bool((image != SKY).any()) is seen


@pytest.mark.parametrize("kind", ["above", "behind"])
def test_an_empty_map_and_strange_points_draw(kind: str) -> None:
    copy = MapCopy()
    assert (draw(copy, 8, 8, (0, 0, 0), 0.0, "behind") == SKY).all()
    copy.apply(delta((0, 0, 0), np.array([[np.nan, 0, 0], [np.inf, 0, 0], [1e30, 0, 0]])))
    with np.errstate(all="ignore"):
        assert draw(copy, 8, 8, (0, 0, 0), 0.0, kind).shape == (8, 8, 3)  # type: ignore[arg-type]


def test_text_without_colour_has_a_line_for_two_rows() -> None:
    image = np.zeros((5, 3, 3), np.uint8)
    image[0:2] = 255
    assert luminance_text(image) == ["@@@", "   "]


def test_sentences_for_the_operator() -> None:
    text = advice(FULL).plain
    assert (
        text.index("few walls")
        < text.index("turn slower")
        < text.index("imu: no data")
        < text.index("3 packets")
    )
    assert "disk 12 min" in str(gauges(FULL)) and "battery 4 min" in str(gauges(FULL))
    assert "disk not known" in str(gauges(Status()))
    assert "at most 130" in frame_times([20.0, 130.0], 40).plain
    assert frame_times([], 40).plain == "no frame yet"
    assert advice(Status()).plain == ""


def test_newest_keeps_one_state_of_a_block() -> None:
    newest = Newest()
    assert newest.take() is None
    for index, (block, count) in enumerate([((0, 0, 0), 3), ((1, 0, 0), 4), ((0, 0, 0), 5)]):
        newest.add(delta(block, np.full((count, 3), float(index)), index=index))
    assert len(newest) == 2
    first = newest.take(1)
    assert first is not None and first.block.tolist() == [[1, 0, 0]] and len(first.position) == 4
    second = newest.take()
    assert second is not None and second.vertex_start.tolist() == [0, 5] and (second.position == 2.0).all()
    assert newest.take() is None


def test_joined_blocks_are_those_that_went_in() -> None:
    parts = [(delta((k, 0, 0), np.full((k + 3, 3), float(k)), index=k), 0) for k in range(3)]
    whole = joined(parts)
    assert whole.vertex_start.tolist() == [0, 3, 7, 12] and whole.triangle_start.tolist() == [0, 1, 2, 3]
    for k, (part, _) in enumerate(parts):
        rows = slice(int(whole.vertex_start[k]), int(whole.vertex_start[k + 1]))
        np.testing.assert_array_equal(whole.position[rows], part.position)
    assert whole.index == 2


def test_keys_file(tmp_path: Path) -> None:
    file = tmp_path / "keys.toml"
    assert read_keys(file) == {}
    file.write_text('ask = "a"\n')
    assert read_keys(file) == {"ask": "a"}
    for text, says in (("ask = 3", "ask should be the name"), ("ask = ", "not valid TOML")):
        file.write_text(text)
        with pytest.raises(InputError, match=says):
            read_keys(file)


def test_history_survives_and_forgets_repetitions(tmp_path: Path) -> None:
    file = tmp_path / "sub" / "history"
    history = History(file)
    for text in ("car", "bench", "  car  "):
        history.add(text)
    again = History(file)
    assert again.lines == ["bench", "car"]
    assert [again.step(-1), again.step(-1), again.step(-1), again.step(1), again.step(1)] == [
        "car", "bench", "bench", "car", "",
    ]  # fmt: skip
    assert History(None).step(-1) == ""


def test_recordings_are_found_newest_first(tmp_path: Path) -> None:
    import os

    for k, name in enumerate(("a/one.mcap", "b/two.mcap", "three.mcap")):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"x")
        os.utime(tmp_path / name, (k, k))
    assert [p.name for p, _ in recordings(tmp_path)] == ["three.mcap", "b", "a"]
    assert recordings(tmp_path / "nothing") == []


class Service:
    """A control socket in a thread, which answers as the service does."""

    def __init__(self, path: Path) -> None:
        from artemis_edge.service.control import ControlSocket

        self.asked: list[dict[str, Any]] = []
        self.control = ControlSocket(path, 0o600, self._answer)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    def _answer(self, what: str, request: dict[str, Any]) -> dict[str, Any]:
        self.asked.append(request)
        if what == "status":
            return dict(msgspec.to_builtins(FULL))
        if what == "mark":
            return {"number": 3}
        if what == "start":
            raise InputError("the service is recording: wait until it is idle")
        return {"phase": "saving"}

    def _serve(self) -> None:
        while not self._stop.is_set():
            self.control.turn(dict, 0.02)

    def close(self) -> None:
        self._stop.set()
        self._thread.join()
        self.control.close()


def test_the_service_is_asked_over_its_socket(tmp_path: Path) -> None:
    path = tmp_path / "artemis.sock"
    remote = SocketRemote(path)
    with pytest.raises(RemoteError, match="start it with: artemis-edge run"):
        remote.status()
    service = Service(path)
    try:
        assert remote.status() == FULL
        assert remote.command("mark") == "marked, number 3"
        assert remote.command("stop") == "the service is saving"
        with pytest.raises(RemoteError, match="wait until it is idle"):
            remote.command("start")
        assert remote.ask("red car") == "looking for 'red car'"
        assert service.asked[-1]["text"] == "red car"
    finally:
        service.close()
    with pytest.raises(RemoteError):
        remote.status()
    again = Service(path)
    try:
        assert remote.status() == FULL, "it connects again by itself"
    finally:
        again.close()
        remote.close()


def test_a_question_of_labels_is_counted_in_the_map() -> None:
    rng = np.random.default_rng(1)
    copy = MapCopy()
    copy.apply(delta((0, 0, 0), rng.uniform(0, 1, (100, 3)), 3))
    copy.apply(delta((5, 0, 0), rng.uniform(0, 1, (60, 3)) + np.array([10, 0, 0]), 3))
    copy.apply(delta((9, 0, 0), np.full((5, 3), 30.0), 3))
    copy.apply(delta((0, 9, 0), rng.uniform(0, 1, (90, 3)) + np.array([0, 20, 0]), 4))
    found = found_in(copy, QueryStatus("car", "matched", labels=[3]))
    assert found.count == 2, "five vertices are a stray mask"
    assert found.status == "matched"
    np.testing.assert_allclose(sorted(p[0] for p in found.places), (0.5, 10.5), atol=0.2)
    nothing = found_in(copy, QueryStatus("dog", "matched", labels=[7]))
    assert nothing.count == 0 and nothing.status == "searching"


def test_live_questions_choose_among_what_is_looked_for() -> None:
    live = LiveQuestions(["car", "tree"])
    live.order("ask", "trees")
    live.order("ask", "unicorn")
    live.order("ask", "person")
    live.order("mark", "")
    trees, unicorn, person = live.told()
    assert trees.labels == [2] and trees.status == "matched"
    assert unicorn.status == person.status == "unsupported"
    assert len({q.colour for q in live.told()}) == 3
    live.order("forget", "unicorn")
    assert [q.text for q in live.told()] == ["trees", "person"]


def test_the_demos_child_tells_and_hears() -> None:
    ours, theirs = multiprocessing.Pipe()
    left = threading.Event()
    teller = Teller(theirs, left.set)
    teller.live = LiveQuestions(["car"])
    teller.say(state="replaying", frames=3)
    teller.frame(delta((0, 0, 0), np.zeros((4, 3))), 20.0)
    ours.send(("ask", "car"))
    status, news = None, []
    for _ in range(50):
        status, found = ours.recv()
        news += [] if found is None else [found]
        if status.queries and news:
            break
    assert status is not None and status.frames == 3 and status.frame_ms == [20.0]
    assert [q.labels for q in status.queries] == [[1]] and len(news[0].position) == 4
    teller.say(state="done")
    teller.close()
    while ours.poll(1.0):
        status, _ = ours.recv()
        if status.state == "done":
            break
    assert status.state == "done"
    ours.close()
    assert left.wait(5.0), "without a terminal the demo ends"
    theirs.close()


def test_a_question_is_looked_for_again_once_a_second(monkeypatch: pytest.MonkeyPatch) -> None:
    copy, now = MapCopy(), [0.0]
    find = picture.Finder(copy, lambda: now[0])
    query = QueryStatus("bench", labels=[3])
    copy.apply(_patch((0.0, 0.0, 0.0), label=3))
    assert find(query).count == 1 and find(query) == picture.found_in(copy, query)
    copy.apply(_patch((9.0, 0.0, 0.0), label=3))
    assert find(query).count == 1, "the map has changed, but just now"
    now[0] = 1.0
    assert find(query).count == 2
    copy.apply(_patch((18.0, 0.0, 0.0), label=4))
    assert find(replace(query, labels=[4])).count == 1, "another question does not wait"
    monkeypatch.setattr(picture, "found_in", None)  # nothing is looked for while the map stays
    now[0] = 9.0
    assert find(replace(query, labels=[4])).count == 1


def _patch(at: tuple[float, float, float], label: int) -> MeshDelta:
    """A block of vertices that lie together."""
    return delta((int(at[0]), 0, 0), np.tile(at, (30, 1)), label)


def test_only_lines_that_change_are_drawn_again(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn = []
    monkeypatch.setattr(widgets.MeshPicture, "refresh", lambda self, *regions, **_: drawn.append(regions))
    monkeypatch.setattr(widgets.MeshPicture, "size", Size(6, 4))
    for colour in (True, False):
        shown = widgets.MeshPicture(colour)
        image = np.random.default_rng(1).integers(0, 255, (8, 6, 3)).astype(np.uint8)
        shown.show(image)
        changed = image.copy()
        changed[5, 2] = (255, 255, 255)
        drawn.clear()
        shown.show(changed)
        assert drawn == [(Region(0, 2, 6, 1),)]
        whole = widgets.MeshPicture(colour)
        whole.show(changed)
        assert [s.text for s in shown._lines] == [s.text for s in whole._lines]
        assert [list(s) for s in shown._lines] == [list(s) for s in whole._lines]
        drawn.clear()
        shown.show(changed.copy())
        assert drawn == []
        shown.caption = "from above"
        shown.show(changed)
        assert drawn == [()], "all of it"


def test_nothing_is_drawn_while_nothing_changes(tmp_path: Path) -> None:
    app, drawn = ArtemisTui(Fake(), tmp_path), list[str]()

    async def script(pilot: Pilot[None]) -> None:
        await settled(pilot, lambda: live(app).query_one("#queries", DataTable).row_count == 2)
        page, told = live(app), app._remote.status()
        page.redraw()
        for part in page.walk_children(with_self=False):
            part.refresh = partial(_note, drawn, type(part).__name__)  # type: ignore[method-assign]
        for _ in range(3):
            page.show(told)
            page.redraw()
        assert drawn == []
        page.show(replace(told, frames=told.frames + 1))
        assert set(drawn) == {"Gauges"}
        streams = [*told.streams[:1], replace(told.streams[1], hz=7.0), *told.streams[2:]]
        page.show(replace(told, frames=told.frames + 1, streams=streams))
        assert set(drawn) == {"Gauges", "Streams"}
        assert page.query_one("#streams", DataTable).get_row_at(1)[1].plain == "7/10"

    run(app, script, (100, 30))


def _note(drawn: list[str], name: str, *regions: object, **words: object) -> None:
    drawn.append(name)
