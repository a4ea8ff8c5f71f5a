"""`splatseg chunks` and the commands that stream what it makes, as a person types them."""

import json
import shutil
from pathlib import Path

import pytest

from splatseg.cli import main
from splatseg.io import chunks as files
from splatseg.io.limits import memory_to_use
from splatseg.io.scene import load_scene
from splatseg.render.prepared import ViewPart


@pytest.fixture
def scene(small) -> Path:
    return small.scene


@pytest.fixture
def capture(small) -> Path:
    return small.capture


@pytest.fixture
def chunked(scene, tmp_path, monkeypatch) -> Path:
    """The tiny scene in chunks of sixteen."""
    monkeypatch.setattr(files, "CHUNK_ROWS", 16)
    assert main(["chunks", str(scene), "-o", str(tmp_path / "chunked")]) == 0
    return tmp_path / "chunked"


def failed(capsys, *words: object) -> str:
    """What a refusal says, after the status of bad input; one sentence."""
    capsys.readouterr()
    assert main([str(word) for word in words]) == 2
    said = capsys.readouterr().err.strip()
    assert said.count("\n") == 0
    return said


STREAMED = {
    "render": "render CHUNKED --split all -o HERE/made --what rgb,depth",
    "uplift": "segment CHUNKED --method uplift --evidence labels_semantic",
    "select": "select CHUNKED --sphere 0 1 2 1",
    "edit": "edit CHUNKED -o HERE/made --remove --sphere 0 1 2 0.5 --pictures 0",
    "export": "export CHUNKED -o HERE/made.ply",
    "chunks": "chunks CHUNKED --whole -o HERE/made",
}


def line(words: str, **places: Path) -> list[str]:
    for name, path in places.items():
        words = words.replace(name, str(path))
    return words.split()


@pytest.mark.parametrize("name", STREAMED)
def test_a_command_streams_within_the_memory(chunked, tmp_path, capsys, monkeypatch, name) -> None:
    seen: list[int] = []
    opened = files.open_chunks

    def watched(folder: Path, *, memory: int):
        seen.append(memory)
        return opened(folder, memory=memory)

    for module in ("scene", "chunks"):
        monkeypatch.setattr(f"splatseg.io.{module}.open_chunks", watched)
    words = line(STREAMED[name], CHUNKED=chunked, HERE=tmp_path)
    assert main([*words, "--memory", "900kB"]) == 0
    assert set(seen) - {1} == {900_000}, "1 is to look at what was written"
    assert "error" in failed(capsys, *words, "--memory", "much")
    assert "--memory: expected more than nothing" in failed(capsys, *words, "--memory", "0")


@pytest.mark.parametrize("name", ["render", "uplift"])
def test_a_memory_that_is_too_small_is_one_sentence(chunked, tmp_path, capsys, name) -> None:
    words = line(STREAMED[name], CHUNKED=chunked, HERE=tmp_path)
    said = failed(capsys, *words, "--memory", "2kB")
    assert "GB that were allowed; allow more" in said


def test_memory_goes_with_chunks_alone(scene, chunked, tmp_path, capsys) -> None:
    for name, words in STREAMED.items():
        if name == "chunks":
            continue
        said = failed(capsys, *line(words, CHUNKED=scene, HERE=tmp_path), "--memory", "1GB")
        assert "--memory: goes with a scene in chunks" in said, name


def test_without_it_half_of_the_machine_is_used(chunked, monkeypatch) -> None:
    kilobytes = int(Path("/proc/meminfo").read_text().split()[1])
    assert memory_to_use(None) == pytest.approx(kilobytes * 1024 / 2, rel=0.01)
    assert memory_to_use("2 GiB") == 2 << 30


@pytest.mark.parametrize(
    "words",
    [
        "evaluate CHUNKED --layer a --truth CHUNKED",
        "segment CHUNKED --method vote --evidence labels_semantic",
        "sharpen CHUNKED -o HERE/made --layer a",
        "query CHUNKED chair",
        "select CHUNKED --text chair",
        "export CHUNKED -o HERE/made.spz",
        "export CHUNKED -o HERE/made --what points",
        "segment CHUNKED --method uplift --evidence labels_semantic --report",
        "edit CHUNKED -o HERE/made --remove --box 0 0 0 1 1 1",
        "edit CHUNKED -o HERE/made --undo",
        "attach CHUNKED CHUNKED/gaussians.ply -o HERE/made",
        "fit CAPTURE --add CHUNKED -o HERE/made",
    ],
)
def test_a_command_that_cannot_stream_says_so(chunked, capture, tmp_path, capsys, words) -> None:
    before = sorted(path.name for path in tmp_path.iterdir())
    said = failed(capsys, *line(words, CHUNKED=chunked, CAPTURE=capture, HERE=tmp_path))
    assert "chunks" in said
    assert sorted(path.name for path in tmp_path.iterdir()) == before


def test_info_and_see_need_no_gaussians(chunked, capsys) -> None:
    assert main(["info", str(chunked)]) == 0
    assert " in 10 chunks, harmonics of degree" in capsys.readouterr().out
    assert main(["see", str(chunked), "--model", "classical", "--evidence", "masks"]) == 0
    assert (chunked / "evidence" / "masks").is_dir()


def test_a_cut_has_no_options_where_nothing_is_cut(chunked, tmp_path, capsys) -> None:
    words = line(STREAMED["edit"], CHUNKED=chunked, HERE=tmp_path)
    said = failed(capsys, *words, "--min-pixels", "9")
    assert "cutting: expected none for a scene in chunks" in said


@pytest.mark.parametrize("words", [("--memory", "1GB"), ("--level", "1")])
def test_a_surface_is_drawn_without_gaussians(chunked, tmp_path, capsys, words) -> None:
    given = ("render", chunked, "-o", tmp_path / "a", "--surface", "b.ply", *words)
    assert "--memory, --level: expected neither with a surface" in failed(capsys, *given)


def test_a_coarser_level_is_drawn(scene, chunked, tmp_path, capsys) -> None:
    made = tmp_path / "levels"
    assert main(["chunks", str(scene), "-o", str(made), "--levels", "2"]) == 0
    pictures: dict[str, bytes] = {}
    for level in ("0", "1", "2"):
        words = ["render", str(made), "-o", str(tmp_path / level), "--level", level]
        assert main([*words, "--what", "rgb,depth"]) == 0
        pictures[level] = (tmp_path / level / "rgb" / "test_2.png").read_bytes()
    assert len(set(pictures.values())) == 3
    render = ("render", made, "-o", tmp_path / "other", "--level")
    said = failed(capsys, *render, "3")
    assert "level: expected one that" in said
    assert "`splatseg chunks --levels` makes them" in said
    said = failed(capsys, *render, "1", "--what", "rgb,classes")
    assert "level: goes with rgb, depth, alpha, got classes" in said
    said = failed(capsys, "render", scene, "-o", tmp_path / "other", "--level", "1")
    assert "level: goes with a scene in chunks" in said
    assert not (tmp_path / "other").exists()


def test_what_is_said(scene, chunked, tmp_path, capsys) -> None:
    count = len(load_scene(scene).gaussians)
    assert main(["chunks", str(chunked), "--whole", "-o", str(tmp_path / "back"), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert facts["gaussians"] == count
    assert (facts["chunks"], facts["layers"]) == (0, [])
    again = ["chunks", str(tmp_path / "back"), "-o", str(tmp_path / "again"), "--harmonics"]
    assert main([*again, "float16"]) == 0
    out = capsys.readouterr().out
    assert f"{count} Gaussians in 10 chunks; no layers" in out
    assert load_scene(tmp_path / "again", memory=1).gaussians.sh.itemsize == 2


def test_exports_of_a_layer_are_those_of_the_scene_in_memory(chunked, tmp_path) -> None:
    whole = tmp_path / "whole"
    assert main(["chunks", str(chunked), "--whole", "-o", str(whole)]) == 0
    words = "segment SCENE --method uplift --evidence labels_semantic --layer made --export"
    made: list[dict[Path, bytes]] = []
    for root in (chunked, whole):
        assert main(line(words, SCENE=root)) == 0
        folder = root / "exports" / "made"
        files = [path for path in folder.rglob("*") if path.is_file()]
        own = str(root).encode()
        made.append({p.relative_to(folder): p.read_bytes().replace(own, b"") for p in files})
    assert Path("labelled.ply") in made[0]
    assert made[0] == made[1]


def test_a_missing_chunk_file_is_one_error(chunked, tmp_path, capsys) -> None:
    shutil.copytree(chunked, tmp_path / "broken")
    (tmp_path / "broken" / "gaussians" / "scales.npy").unlink()
    said = failed(capsys, "render", tmp_path / "broken", "-o", tmp_path / "made")
    assert "scales.npy" in said
    assert not (tmp_path / "made").exists()


def test_a_view_is_let_go_before_the_next(chunked, tmp_path, monkeypatch) -> None:
    """The memory is for one."""
    opened: list[int] = []
    view, close = ViewPart.view, ViewPart.close

    def viewed(self: ViewPart, *, colours: bool = False):
        made = view(self, colours=colours)
        opened.append(id(self))
        assert len(set(opened)) == 1
        return made

    def closed(self: ViewPart) -> None:
        opened.clear()
        close(self)

    monkeypatch.setattr(ViewPart, "view", viewed)
    monkeypatch.setattr(ViewPart, "close", closed)
    render = line(STREAMED["render"], CHUNKED=chunked, HERE=tmp_path)
    assert main(render) == 0
    points = ["--point", "train_0:8,15", "--point", "train_1:8,15", "--source", "layer"]
    lift = line(STREAMED["uplift"], CHUNKED=chunked)
    assert main([*lift, "--layer", "classes"]) == 0
    assert main(["select", str(chunked), *points]) == 0
