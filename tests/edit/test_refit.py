"""A short fit before a removal: a thing becomes opaque, and all else stays as it is."""

from dataclasses import replace

import pytest
import torch

from splatseg.core import Gaussians, Labels, Scene, Selection, View
from splatseg.edit import Document, Operation, apply, prepare, replay
from splatseg.errors import InputError
from splatseg.io.images import save_png
from splatseg.render import back_project, render
from splatseg.render.cpu import set_threads, threads
from splatseg.selection import Where

from .conftest import BACKEND, camera

THING = 3
REMOVAL = Operation(kind="remove", where=Where(layer="objects", ids=(THING,)), refit=60)


@pytest.fixture
def document(tmp_path) -> Document:
    """A ball that lets a third of the light of the wall behind it through."""
    along = torch.arange(-1.4, 1.5, 0.2)
    x, y = (part.reshape(-1) for part in torch.meshgrid(along, along, indexing="ij"))
    wall = torch.stack((x, y, torch.full_like(x, 0.5)), dim=1)
    ball = torch.tensor([[0.0, 0.0, -0.3], [0.1, 0.0, -0.3], [0.0, 0.1, -0.3]])
    means = torch.cat((wall, ball))
    n = len(means)
    gaussians = Gaussians(
        means=means,
        rotations=torch.eye(4)[:1].expand(n, 4).clone(),
        scales=torch.full((n, 3), 0.14),
        opacities=torch.cat((torch.full((len(wall),), 0.9), torch.full((len(ball),), 0.3))),
        sh=torch.full((n, 1, 3), 0.4),
    )
    views = []
    for i in range(4):
        view = View(name=f"v{i}", camera=camera(turn=0.2 * i - 0.3))
        path = tmp_path / f"{view.name}.png"
        save_png(render(gaussians, view.camera, backend=BACKEND).image, path)
        views.append(replace(view, image=path))
    ids = torch.cat((torch.ones(len(wall)), torch.full((len(ball),), THING))).int()
    return Document(
        scene=Scene(gaussians=gaussians, views=tuple(views)),
        layers={"objects": Labels(ids=ids, confidence=torch.ones(n))},
    )


def weight(gaussians: Gaussians, thing: Selection, view: View) -> torch.Tensor:
    """The thing's weight in each pixel."""
    signal = thing.mask.float()[:, None]
    return render(gaussians, view.camera, signal, backend=BACKEND).image[..., 0]


def test_the_thing_becomes_opaque_and_all_else_stays(document) -> None:
    ready = prepare(document, REMOVAL, backend=BACKEND)
    thing = ready.selection
    assert thing is not None
    before, after = document.scene.gaussians, ready.document.scene.gaussians
    assert len(after) == len(before)
    touched = thing.mask.clone()
    for view in document.scene.views:
        first, second = (weight(g, thing, view) for g in (before, after))
        mask = first > 0.5
        assert int(mask.sum()) > 5
        left = (1 - first)[mask].mean(), (1 - second)[mask].mean()
        assert float(left[1]) < 0.7 * float(left[0])
        sums = back_project(before, view.camera, mask.float()[..., None], backend=BACKEND).sums
        touched |= sums[:, 0] > 0.01
    assert int((~touched).sum()) > 100
    for name in ("means", "rotations", "scales", "opacities", "sh"):
        assert torch.equal(getattr(after, name)[~touched], getattr(before, name)[~touched])
    without = prepare(document, replace(REMOVAL, refit=None), backend=BACKEND)
    assert torch.equal(without.document.scene.gaussians.means, before.means)


def test_it_is_in_the_history_and_replays(document) -> None:
    assert Operation.from_json(REMOVAL.to_json()) == REMOVAL
    short = replace(REMOVAL, refit=4)
    done = apply(document, short, backend=BACKEND)
    assert done.history[-1]["refit"] == 4
    again = replay(document, done.history, backend=BACKEND)
    assert torch.equal(again.scene.gaussians.means, done.scene.gaussians.means)
    assert not torch.equal(
        done.scene.gaussians.opacities,
        apply(document, replace(short, refit=8), backend=BACKEND).scene.gaussians.opacities,
    )


@pytest.mark.bits
def test_threads_change_nothing(document) -> None:
    with_threads = []
    before = threads()
    try:
        for count in (1, 3):
            set_threads(count)
            ready = prepare(document, replace(REMOVAL, refit=6), backend=BACKEND)
            with_threads.append(ready.document.scene.gaussians)
    finally:
        set_threads(before)
    for name in ("means", "rotations", "scales", "opacities", "sh"):
        assert torch.equal(*(getattr(one, name) for one in with_threads))


def test_photographs_of_the_scene_as_it_is_are_needed(document) -> None:
    views = tuple(replace(view, image=None) for view in document.scene.views)
    bare = replace(document, scene=replace(document.scene, views=views))
    with pytest.raises(InputError, match="refit: expected a photograph that shows"):
        apply(bare, REMOVAL, backend=BACKEND)
    box = Operation(kind="remove", where=Where(box=(-2, -2, -2, -1, 2, 2)))
    edited = apply(document, box, backend=BACKEND)
    with pytest.raises(InputError, match="before it was edited"):
        apply(edited, REMOVAL, backend=BACKEND)
