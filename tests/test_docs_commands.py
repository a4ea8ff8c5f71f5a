"""Every command that a page shows is run, to its end, in a small world that has what it names.

A page is a case. Its commands run in order, those of blocks first, then those of its tables and
sentences. `tests/support/docs_world.py` is the world: a room with the things that the pages speak
of, a drive, data sets, networks of random weights. What a page's words are changed to stands in the
tables below, so that a new command of a page fails here until it can be run.
"""

import re
import shlex
import shutil
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from importlib.util import find_spec
from pathlib import Path

import pytest

from splatseg import cli
from splatseg.models import model_names
from support.docs_commands import Reader, Shown, commands_of
from support.docs_world import furnish, write_data_sets, write_networks, write_world
from support.hub import in_place_of_the_real, local_hub
from support.once import made_once

ROOT = Path(__file__).resolve().parent.parent
PAGES = [
    ROOT / "README.md",
    *sorted(page for page in (ROOT / "docs").rglob("*.md") if "reference" not in page.parts),
]

PACKAGES = (
    "coacd", "h5py", "imageio_ffmpeg", "laspy", "pyarrow", "pycolmap", "ray", "sklearn",
    "transformers", "trimesh", "uvicorn",
)  # fmt: skip
"""Of extras that the pages tell to install."""

FEW = "--steps 30 --max-gaussians 500"
FAST = "--voxels 8.0 --geometry-iterations 1 --iterations 3 --rays 64"

SHORTER: Sequence[tuple[str, str]] = (
    (r"--steps \d+( --max-gaussians \d+)?", FEW),
    (r"--minutes \d+( --longest \d+)?", "--steps 100 --max-gaussians 1500"),
    (r"--refit \d+", "--refit 3"),
    (r"--frames \d+", "--frames 10"),
    (r"--resolution \d+", "--resolution 16"),
    (r"--size \d+", "--size 112"),
    (r"--port \d+", "--port 0"),
)
"""How long to work, and how large: what stands there, and what takes a second here."""

YOURS: Sequence[tuple[str, str]] = (
    # Files and folders.
    (r"--points FILE", "--points CAPTURE/points3D.ply"),
    (r"attach SCENE FILE", "attach room imported"),
    (r"FILE", "guitar.ply"),
    (r"export SCENE -o OUT$", "export SCENE -o OUT.ply"),
    (r"more-photographs", "MORE"),
    (r"fit PHOTOS (.*) --poses pointmaps", r"fit FEW_PHOTOS \1 --poses pointmaps"),
    (r"--pointmaps FOLDER", "--pointmaps pointmaps"),
    (r"street SCENE --label-scans", "street street --label-scans"),
    (r"--truth truth$", "--truth CAPTURE/instance"),
    # A scene of more Gaussians, which have surroundings.
    (r"segment \w+ --method cosseg", "segment closer --method cosseg"),
    # Weights.
    (r"--model sam2-video", "--model sam2-video --weights weights/sam2_video"),
    (r"lseg --weights (FOLDER|demo_e200.ckpt)", "lseg --weights weights/lseg"),
    (r"lseg=FOLDER", "lseg=weights/lseg"),
    (r"--sam-weights FOLDER", "--sam-weights weights/sam_hq"),
    (r"--weights FOLDER", "--weights facebook/dinov2-small"),
    (r"clip=WEIGHTS", "clip=openai/clip-vit-base-patch16"),
    # Data sets; of networks of random weights no mask is sure, and none is a thing.
    (r"bench ([\w-]*?)(nvos|lerf-ovs|spin-nerf|replica|scannet|kitti360|waymo)(\S*) --data \S+",
     r"bench \1\2\3 --data sets/\2"),
    (r"TRACKS/", "sets/TRACKS/"),
    (r"--companion sam2", "--companion classical"),
    (r"(bench .*) sam2\b", r"\1 sam2,points_per_side=2,min_iou=0,min_stability=0"),
    # Words, and what dots and placeholders stand for.
    (r'"brown chair"', "chair"),
    (r"car pedestrian", "car person"),
    # By the published settings a few random points, whose Gaussians other views of so few pixels
    # need not show; of a ceiling they do.
    (r'(--method prompt .*--words) (mug|"red mug")', r"\1 ceiling"),
    (r"COMMAND", "fit"),
    (r"^select SCENE$", "select SCENE --point front:200,150"),
    (r"^query SCENE$", "query SCENE mug"),
    (r"render CHUNKS --memory 8GB \.\.\.", "render CHUNKS --memory 8GB -o pictures"),
    (r"segment NEW \.\.\. --update", "segment NEW --method associate --evidence masks --update"),
)  # fmt: skip
"""What is the reader's own, and what it is here. VIEW, pixels and edited files: `Reader`."""

APPENDED: Sequence[tuple[str, str]] = (
    (r"fit PHOTOS (?!.*--steps)", "--steps 100 --max-gaussians 1500"),
    (r"fit (?!PHOTOS|.*--(steps|help))", FEW),
    (r"import (?!.*--data)", "--max-views 6 --width 64"),
    (r"(render|export) .*--split path", "--frames 4"),
    (r"export .*--what meshes(?!.*--resolution)", "--resolution 16"),
    (r"export .*--what meshes(?!.*--only)", "--only chair"),
    (r"segment .*--method (saga|identity|cosseg)(?!.*--(features affinity|help))", "--steps 4"),
    (r"segment .*--method saga(?!.*--(evidence|features affinity))", "--evidence masks_sam"),
    (r"segment .*--method (uplift|majority)(?!.*--(evidence|help))", "--evidence labels_semantic"),
    (r"segment .*--method dnmp", FAST),
    (r"street (?!.*--label-scans)", FAST),
    (r"sharpen ", "--sharpen-steps 3"),
    (r"see .*--no-depth-from-scene", "--views front"),
    (r"see .*--model dinov2 (?!.*--(size|help))", "--size 112"),
    (r"see .*--model hed", "--weights weights/hed"),
    (r"see .*--model sam2? ", "--points-per-side 2 --min-iou 0 --min-stability 0"),
    (r"bench ", "--steps 30 --max-gaussians 400"),
    (r"bench cosseg-replica(?!.*--scenes)", "--scenes room_0"),
    (r"bench cosseg-scannet(?!.*--scenes)", "--scenes scene0010_00"),
    (r"bench .*dnmp", "--option voxels=8.0 geometry_iterations=1 iterations=3 rays=64"),
    (r"bench .*identity", "--option steps=4"),
)
"""What a command gets besides, so that it takes a second or downloads nothing."""

BEFORE: Mapping[str, Sequence[str]] = {
    "splatseg street SCENE --label-scans": (
        f"fit drive -o street {FEW}",
        "segment street --method uplift --evidence labels_semantic",
    ),
    "splatseg fit DATA -o SCENE --resume": (
        "fit DATA -o SCENE --steps 20 --max-gaussians 500 --keep-checkpoint --overwrite",
    ),
    "splatseg segment NEW ... --update": ("see NEW --model regions --evidence masks",),
    "splatseg see OTHER --model frames": (
        "export room --what coco --instances objects --split train -o frames",
    ),
}
"""What a reader did before a command that a page shows alone, by how the command begins."""

WITHOUT: Mapping[str, Sequence[str]] = {
    "README": ("CAPTURE/masks_sam", "CAPTURE/masks_nested"),
    "selecting": ("CAPTURE/masks_nested", "SCENE/evidence/masks"),
}
"""What the world has and the reader of a page has not: where there is one set of masks, commands
need no name of it."""

HUB = {"facebook/dinov2-base": "facebook/dinov2-small"}
"""What is downloaded, from a hub of this machine, and the network that it is."""

NO_COMMANDS = ("splatseg antialiased",)
"""Words that begin like a command: a note in the header of a file."""

SHOWN = {page: [one for one in commands_of(page) if one.line not in NO_COMMANDS] for page in PAGES}
RUN = {
    page: [one for one in shown if not one.mention]
    for page, shown in SHOWN.items()
    if not all(one.mention for one in shown)
}


def page_name(page: Path) -> str:
    """Its path, as the site has it."""
    return page.relative_to(ROOT).with_suffix("").as_posix().removeprefix("docs/")


def before(one: Shown) -> list[list[str]]:
    """What is run before a command, in words."""
    lines = [lines for start, lines in BEFORE.items() if one.line.startswith(start)]
    return [shlex.split(line) for some in lines for line in some]


def here(one: Shown) -> list[str]:
    """A command's words after ``splatseg``, with the names, lengths and sizes of this world."""
    line = one.line.removeprefix("splatseg ")
    for pattern, replacement in (*YOURS, *SHORTER):
        line = re.sub(pattern, replacement, line)
    more = [words for pattern, words in APPENDED if re.match(pattern, line)]
    return shlex.split(" ".join([line, *more]), comments=True)


def names_a_network(words: Sequence[str]) -> bool:
    """Whether a model is named that has weights."""
    names = {re.split("[=,]", word)[0] for word in words}
    return bool(names & set(model_names()) - {"classical", "regions"})


@pytest.fixture(scope="session")
def make(
    tmp_path_factory: pytest.TempPathFactory, worker_id: str, generated_drive: Path
) -> Callable[[str], Path]:
    """Parts of the world by name, made when they are asked for; not to be changed."""

    def part(name: str) -> Path:
        def written(folder: Path) -> None:
            if name == "networks":
                write_networks(folder)
            elif name == "sets":
                write_data_sets(folder, part("world") / "CAPTURE", generated_drive)
            elif name == "kept":
                folder.mkdir()
            else:
                write_world(folder, generated_drive, ROOT / "docs")

        return made_once(tmp_path_factory, worker_id, f"docs-{name}", written)

    return part


@pytest.fixture
def place(
    page: Path, make: Callable[[str], Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Path]:
    """The folder in which the commands of a page are run, with what they name."""
    commands = [words for one in RUN[page] for words in (*before(one), here(one))]
    furnish(tmp_path, make("world"), map(shlex.join, commands))
    for name in WITHOUT.get(page.stem, ()):
        shutil.rmtree(tmp_path / name)
    packages = make("world") / "installed"
    monkeypatch.syspath_prepend(packages)
    monkeypatch.chdir(tmp_path)
    with ExitStack() as stack:
        for path in packages.glob("*.py"):  # other tests have packages of these names
            stack.callback(sys.modules.pop, path.stem, None)
        if any(word.startswith("sets/") for words in commands for word in words):
            shutil.copytree(make("sets"), tmp_path / "sets")
        if any(map(names_a_network, commands)):
            for path in make("networks").iterdir():  # linked: they are read, and large
                (tmp_path / path.name).symlink_to(path)
            served = {id: make("networks") / network for id, network in HUB.items()}
            hub = stack.enter_context(local_hub(served))
            stack.enter_context(in_place_of_the_real(hub, tmp_path / "home"))
        yield tmp_path


@pytest.mark.skipif(
    not all(map(find_spec, PACKAGES)), reason="a package of the extras is not installed"
)
@pytest.mark.parametrize("page", RUN, ids=page_name)
def test_the_commands_of_a_page_run(
    page: Path,
    place: Path,
    make: Callable[[str], Path],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    reader = Reader(monkeypatch, capsys, kept=make("kept"))
    failed = []
    for one in RUN[page]:
        for words in before(one):
            assert not reader.run(words, step=True), words
        error = reader.run(here(one), step=one.step)
        if error:
            failed.append(f"{one.line}\n  as: {shlex.join(here(one))}\n  {error}")
    assert not failed, f"{page_name(page)}:\n" + "\n".join(failed)


def test_pages_show_many() -> None:
    assert sum(map(len, RUN.values())) > 200
    assert len(RUN) > 20


def test_no_command_stands_within_a_line() -> None:
    """Lines of an indented block that were filled like a paragraph are no commands any more."""
    names = "|".join(cli.find_commands())
    for page in PAGES:
        text = re.sub(r"^```.*", "", page.read_text("utf-8"), flags=re.MULTILINE)
        text = re.sub(r"`[^`]+`", "", text)
        found = re.findall(rf"^.*\S.* splatseg (?:{names}) .*$", text, re.MULTILINE)
        assert not found, page_name(page)


def test_what_is_only_named_exists(capsys: pytest.CaptureFixture[str]) -> None:
    """Commands and flags that a sentence speaks of without showing a whole line."""
    mentions = [(page, one) for page, shown in SHOWN.items() for one in shown if one.mention]
    assert mentions
    for page, one in mentions:
        name, *flags = one.words
        assert name in cli.find_commands(), f"{page_name(page)}: {one.line}"
        assert cli.main([name, "--help"]) == 0
        text = capsys.readouterr().out
        for flag in flags:
            assert not flag.startswith("-") or flag in text, f"{page_name(page)}: {one.line}"


def test_no_row_of_the_tables_is_left_over() -> None:
    """What no page shows any more stands in no table."""
    shown = [one.line for commands in RUN.values() for one in commands]
    for start in BEFORE:
        assert any(line.startswith(start) for line in shown), start
    lines = [line.removeprefix("splatseg ") for line in shown]
    for pattern, replacement in (*YOURS, *SHORTER):
        assert any(re.search(pattern, line) for line in lines), pattern
        lines = [re.sub(pattern, replacement, line) for line in lines]
    for pattern, _ in APPENDED:
        assert any(re.match(pattern, line) for line in lines), pattern
