"""What all layouts have in common: told by their files, lazy, and one sentence for each fault."""

import shutil

import pytest

from splatseg.errors import FileFormatError, InputError, MissingFileError
from splatseg_bench.layouts import LAYOUTS, find_layout, read_benchmark
from support.benchmark_layouts import WRITERS, write_layout


def test_every_layout_has_a_writer() -> None:
    assert sorted(WRITERS) == sorted(LAYOUTS)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_layout_is_told_by_its_files(layout, converted) -> None:
    assert find_layout(converted(layout)) == layout


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_scene_of_a_data_set_is_read_alone(layout, converted) -> None:
    (whole,) = read_benchmark(layout, converted(layout))
    (alone,) = read_benchmark(layout, whole.capture.path)
    assert find_layout(whole.capture.path) == layout
    assert alone.name == whole.name
    assert alone.layout == layout
    assert [task.name for task in alone.tasks] == [task.name for task in whole.tasks]
    assert [view.split for view in alone.capture.views] == [v.split for v in whole.capture.views]


@pytest.mark.parametrize("layout", LAYOUTS)
def test_no_mask_is_read_to_know_a_scene(layout, converted, tmp_path) -> None:
    """Every mask is damaged, and nobody notices before it is asked for."""
    folder = tmp_path / "set"
    shutil.copytree(converted(layout), folder)
    damaged = [
        path
        for path in folder.rglob("*.png")
        if path.parent.name not in ("rgb", "color", "depth", "images", "images_train", "data_rect")
    ]
    for path in damaged:
        path.unlink()  # photographs are links, masks are not
        path.write_bytes(b"no picture")
    (scene,) = read_benchmark(layout, folder)
    reads = [mask.read for task in scene.tasks for mask in task.truth]
    reads += [task.scribble.read for task in scene.tasks if task.scribble is not None]
    for maps in (scene.semantic, scene.instances):
        reads += list(maps.read.values()) if maps is not None else []
    assert reads or scene.points is not None
    for read in reads if damaged else ():
        with pytest.raises(FileFormatError, match=r"\.png: expected an image"):
            read()


@pytest.mark.parametrize("layout", LAYOUTS)
def test_an_empty_folder(layout, tmp_path) -> None:
    with pytest.raises(InputError) as caught:
        read_benchmark(layout, tmp_path)
    assert str(caught.value).startswith(f"{tmp_path}: expected")
    assert str(caught.value).count("\n") == 0


def test_paths_and_words_that_are_wrong(tmp_path) -> None:
    with pytest.raises(MissingFileError, match="nowhere: there is no such folder"):
        read_benchmark("nvos", tmp_path / "nowhere")
    with pytest.raises(MissingFileError, match="nowhere: there is no such folder"):
        find_layout(tmp_path / "nowhere")
    with pytest.raises(InputError, match="layout: expected one of nvos, .*got 'nvs'"):
        read_benchmark("nvs", tmp_path)
    with pytest.raises(InputError, match=r"expected a benchmark in one of the layouts nvos, "):
        find_layout(tmp_path)


def test_a_photograph_that_lacks_is_refused(converted, tmp_path) -> None:
    """Numbers of a scene with fewer photographs would not compare."""
    shutil.copytree(converted("spin-nerf"), tmp_path / "set")
    (path,) = (tmp_path / "set").iterdir()
    next((path / "images").iterdir()).unlink()
    with pytest.raises(MissingFileError, match="1 of 19 photographs that it lists are not there"):
        read_benchmark("spin-nerf", tmp_path / "set")


def test_what_is_written_is_never_mixed_with_what_is_there(generated_room, tmp_path) -> None:
    (tmp_path / "a").write_text("")
    with pytest.raises(FileExistsError, match="expected a new folder"):
        write_layout("nvos", generated_room, tmp_path)
