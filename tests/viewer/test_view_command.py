"""`splatseg view`: scenes, splat files, fits that run; its link, and its end."""

import json
import shutil
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import pytest
import torch

import splatseg
from splatseg.cli import view
from splatseg.core import Gaussians
from splatseg.fit import checkpoint_gaussians
from splatseg.fit._checkpoint import FitState, write_checkpoint
from splatseg.io.chunks import CHUNKS_FOLDER, level_rows
from splatseg.io.scene import load_scene
from splatseg.io.scene_folder import CHECKPOINT_FILE
from splatseg.io.splats import write_splats
from splatseg.tasks import ChunkOptions, chunk_scene
from splatseg.viewer import _fitting
from splatseg.viewer._server import ViewServer
from support.forked import Forked
from support.viewer import EACH, RED_PIXEL, WIDTH, Page, opened


@contextmanager
def running(*words: object) -> Iterator[tuple[dict[str, Any], Forked]]:
    """The command in a process of its own, once it has printed its link."""
    with Forked("view", *words, "--no-open", "--json") as process:
        try:
            line = process.stdout.readline()
            assert line, process.communicate()[1]
            yield json.loads(line), process
        finally:
            process.kill()


def entered(facts: dict[str, Any]) -> Page:
    """A page that followed the link, and has the state."""
    address, _, token = facts["url"].partition("#")
    base = address.rstrip("/")
    answer = httpx.post(f"{base}/login", json={"token": token}, headers={"origin": base})
    page = Page(
        uri=f"{base.replace('http', 'ws')}/socket",
        origin=base,
        additional_headers={"Cookie": answer.headers["set-cookie"].partition(";")[0]},
        max_size=None,
    )
    page.send("hello", version=1)
    page.next("state")
    return page


def meanwhile(monkeypatch: pytest.MonkeyPatch, look: Callable[[Page], None]) -> None:
    """Let a page do something instead of waiting for Ctrl-C, in this process."""

    def wait(server: ViewServer) -> None:
        with opened(server) as page:
            look(page)

    monkeypatch.setattr(ViewServer, "wait", wait)


def ended(process: Forked, number: int = signal.SIGINT) -> tuple[int, str]:
    """The status and the errors of a process that a signal ends."""
    process.send_signal(number)
    _, errors = process.communicate(timeout=120)  # of a machine that does much else
    return process.wait(), errors


def test_a_scene_is_served_until_ctrl_c_and_kept(things) -> None:
    with running(things) as (facts, process):
        assert facts["scene"] == str(things)
        assert facts["url"].startswith(f"http://127.0.0.1:{facts['port']}/#")
        with entered(facts) as page:
            page.select(1, points=[RED_PIXEL])
            page.command("keep", name="mug")
            # With a page open, too.
            assert ended(process) == (0, "")


def test_what_was_made_outlives_a_killed_process(things, run, monkeypatch) -> None:
    with running(things) as (facts, process), entered(facts) as page:
        page.select(1, points=[RED_PIXEL])
        page.command("keep", name="mug")
        process.kill()
        process.wait()
    with running(things) as (facts, _), entered(facts) as page:
        assert [one["name"] for one in page.heard[0]["document"]["objects"]] == ["mug"]


def test_a_second_process_is_refused_in_a_sentence(things, run) -> None:
    with running(things):
        status, _, errors = run("view", things, "--no-open")
    assert status == 2
    assert errors.startswith("error: ")
    assert errors.count("\n") == 1


@pytest.mark.parametrize(
    ("words", "stage"),
    [((), "server"), (("--stage", "auto"), "server"), (("--stage", "server"), "server"),
     (("--stage", "gpu"), "gpu")],
)  # fmt: skip
def test_the_stage_that_the_page_begins_with(things, run, monkeypatch, words, stage) -> None:
    def look(page: Page) -> None:
        assert page.heard[0]["stage"] == stage

    meanwhile(monkeypatch, look)
    assert run("view", things, "--no-open", "--quiet", *words)[0] == 0


def test_a_level_of_a_scene_in_chunks_is_opened_with_its_layers(
    things, tmp_path, run, monkeypatch
) -> None:
    city = tmp_path / "city"
    chunk_scene(things, city, options=ChunkOptions(levels=1))
    rows = level_rows(city / CHUNKS_FOLDER, 1)
    monkeypatch.setattr(view, "_MOST", 3 * EACH - 1)

    def look(page: Page) -> None:
        state = page.heard[0]
        assert state["scene"]["count"] == len(rows) < 3 * EACH
        assert 0 < page.select(1, points=[RED_PIXEL])["count"] < len(rows)

    meanwhile(monkeypatch, look)
    status, _, errors = run("view", city, "--output", tmp_path / "level", "--no-open")
    assert status == 0
    assert f"level 1 of it is opened, {len(rows)} Gaussians" in errors
    layers = set(load_scene(things).layers)
    assert layers
    assert set(load_scene(tmp_path / "level").layers) == layers
    assert run("view", city, "--no-open", "--quiet")[0] == 0, "in a temporary folder"
    monkeypatch.setattr(view, "_MOST", 1)
    status, _, errors = run("view", city, "--no-open")
    assert status == 2
    assert "expected a level of at most 1 Gaussians, got 1 coarser ones" in errors


@pytest.fixture
def file(things, tmp_path) -> Path:
    """A splat file of the things."""
    path = tmp_path / "things.ply"
    write_splats(load_scene(things).gaussians, path)
    return path


def test_a_splat_file_is_imported_into_a_new_scene(file, tmp_path, run, monkeypatch) -> None:
    folder = tmp_path / "new"

    def look(page: Page) -> None:
        state = page.heard[0]
        assert state["scene"]["count"] == 3 * EACH
        assert state["views"]
        assert not any(view["photograph"] for view in state["views"])
        assert page.still(1).size[0] == WIDTH
        name = state["views"][0]["name"]
        assert page.select(1, "box", box=[0, 0, 800, 600], camera=None, view=name)["count"]

    meanwhile(monkeypatch, look)
    assert run("view", file, "--output", folder, "--no-open", "--quiet")[0] == 0
    assert len(load_scene(folder).gaussians) == 3 * EACH
    assert (folder / "view" / "journal.jsonl").is_file()


def test_without_a_folder_the_scene_is_temporary(file, tmp_path, run, monkeypatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    folders: list[Path] = []

    def look(page: Page) -> None:
        folders.extend(tmp_path.glob("splatseg-view-*"))
        assert page.heard[0]["scene"]["name"] == "things"

    meanwhile(monkeypatch, look)
    status, _, errors = run("view", file, "--no-open")
    assert status == 0
    assert "--output keeps it" in errors
    assert len(folders) == 1
    assert not folders[0].exists()


def checkpoint(folder: Path, gaussians: Gaussians, steps: int) -> None:
    """The folder of a fit, as it is after so many steps."""
    path = folder / CHECKPOINT_FILE
    path.parent.mkdir(parents=True, exist_ok=True)
    count = len(gaussians)
    tensors = {
        "parameters/means": gaussians.means,
        "parameters/log_scales": gaussians.scales.log(),
        "parameters/rotations": gaussians.rotations.contiguous(),
        "parameters/logits": torch.logit(gaussians.opacities).unsqueeze(1),
        "parameters/sh": gaussians.sh.reshape(count, -1),
    }
    content = {"steps": steps, "progress": steps / 100, "seconds": 1.0, "gaussians": count}
    write_checkpoint(FitState(tensors=tensors, content=content), path)


def test_gaussians_of_a_checkpoint_are_those_of_the_fit(things, tmp_path) -> None:
    wanted = load_scene(things).gaussians
    checkpoint(tmp_path, wanted, 5)
    found = checkpoint_gaussians(tmp_path / CHECKPOINT_FILE)
    for name in ("means", "rotations", "scales", "opacities", "sh"):
        torch.testing.assert_close(getattr(found, name), getattr(wanted, name))


def test_a_fit_is_shown_as_its_checkpoints_come(things, tmp_path, run, monkeypatch) -> None:
    monkeypatch.setattr(_fitting, "_SECONDS", 0.05)
    gaussians = load_scene(things).gaussians
    folder = tmp_path / "fit-of-things"
    checkpoint(folder, gaussians[:EACH], 10)

    def look(page: Page) -> None:
        state = page.heard[0]
        assert state["scene"]["count"] == EACH
        assert state["fitting"] == {"steps": 10, "progress": 0.1}
        page.still(1)
        checkpoint(folder, gaussians, 50)
        state = page.next("state")
        assert state["scene"]["count"] == 3 * EACH
        assert state["fitting"]["steps"] == 50
        assert page.frame(1).rest
        # scene.json comes last, as in a fit.
        shutil.copytree(
            things, folder, dirs_exist_ok=True, ignore=shutil.ignore_patterns("scene.json")
        )
        shutil.copy(things / "scene.json", folder)
        state = page.next("state")
        assert state["fitting"] is None
        assert (state["stage"], page.heard[0]["stage"]) == ("gpu", "gpu")
        assert state["views"]
        page.select(1, points=[RED_PIXEL])

    meanwhile(monkeypatch, look)
    assert run("view", folder, "--no-open", "--stage", "gpu")[0] == 0
    assert (folder / "view" / "journal.jsonl").is_file()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["no-such"], "no-such: there is no such"),
        (["{folder}"], "scene.json"),
        (["{things}", "--port", "99999"], "--port: expected a free port"),
        (["{things}", "--host", "no such"], "--host: expected an address"),
        (["{things}", "--output", "x"], "--output: goes with a splat file"),
        (["{things}", "--layer", "no-such"], "no-such"),
        (["{file}", "--output", "{things}"], "--output: expected a new folder"),
        (["{things}", "--backend", "vulkan"], "backend"),
    ],
)
def test_what_cannot_be_shown_is_said(run, things, file, tmp_path, words, said) -> None:
    (tmp_path / "folder").mkdir()
    names = {"things": things, "folder": tmp_path / "folder", "file": file}
    status, _, errors = run("view", *(word.format(**names) for word in words), "--no-open")
    assert status == 2
    assert said in errors
    assert threading.active_count() < 10


def test_a_fit_without_a_checkpoint_is_said(run, tmp_path) -> None:
    (tmp_path / "new" / "fit").mkdir(parents=True)
    status, _, errors = run("view", tmp_path / "new", "--no-open")
    assert status == 2
    assert "no checkpoint yet; wait a minute" in errors


def test_the_browser_is_opened_where_there_is_a_screen(things, run, monkeypatch) -> None:
    import webbrowser

    shown: list[str] = []
    monkeypatch.setattr(webbrowser, "open", shown.append)
    monkeypatch.setattr(ViewServer, "wait", lambda self: None)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.delenv("DISPLAY", raising=False)
    assert run("view", things)[0] == 0
    assert shown == []
    monkeypatch.setenv("DISPLAY", ":0")
    status, text, _ = run("view", things)
    assert status == 0
    assert len(shown) == 1
    assert shown[0] in text
    assert run("view", things, "--no-open")[0] == 0
    assert len(shown) == 1


def test_other_machines_are_let_in_with_a_warning(things, run, monkeypatch) -> None:
    monkeypatch.setattr(ViewServer, "wait", lambda self: None)
    status, text, notes = run("view", things, "--no-open", "--host", "0.0.0.0")
    assert status == 0
    assert "not encrypted" in notes
    assert "http://127.0.0.1:" in text
    assert "not encrypted" not in run("view", things, "--no-open")[2]


def test_a_notebook_shows_a_frame_and_reads_the_selection(things) -> None:
    with splatseg.view(things, backend="cpu") as shown:
        frame = shown._repr_html_()
        assert frame.startswith('<iframe src="http://127.0.0.1:')
        assert "/?embed#" in frame
        assert shown.selection is None
        with entered_embedded(shown.url) as page:
            page.select(1, points=[RED_PIXEL])
            found = shown.selection
            assert found is not None
            assert found.count == pytest.approx(EACH, abs=15)
            shown.do(splatseg.viewer.commands.Keep("mug"))
            assert page.next("patch")["objects"][0]["name"] == "mug"
            assert list(shown.objects) == ["mug"]
            assert shown.document.objects[0].name == "mug"
    time.sleep(0.1)
    with pytest.raises(splatseg.InputError, match="got a closed one"):
        shown.document  # noqa: B018


def entered_embedded(url: str) -> Page:
    address, _, token = url.partition("#")
    base = address.partition("/?")[0]
    page = Page(uri=f"{base.replace('http', 'ws')}/socket", origin=base, max_size=None)
    page.send("hello", version=1, token=token)
    page.next("state")
    return page
