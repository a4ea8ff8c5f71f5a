"""What a removed thing hid: floors go on under it, and end where they end."""

import math
from dataclasses import dataclass, field, replace

import numpy as np
import pytest
import torch

from splatseg.core import Features, Gaussians, Labels, Scene, Selection, View
from splatseg.core.sh import SH_C0
from splatseg.edit import (
    Document,
    FillBy,
    Operation,
    apply,
    exposed,
    fill,
    filled_layer,
    find_inpainter,
    replay,
)
from splatseg.edit.holes import _first_met
from splatseg.edit.inpainting import ExemplarInpainter, OpenCvInpainter
from splatseg.errors import InputError, ShapeError
from splatseg.render import render
from splatseg.render.cpu import set_threads, threads
from splatseg.selection import Where
from splatseg.synthetic import look_at

from .conftest import BACKEND, layers_of

FLOOR, THING, BELOW = 1, 2, 3
GREY, RED = (0.3, 0.5, 0.6), (0.9, 0.1, 0.1)


def sheet(x: torch.Tensor, y: torch.Tensor, z: float, colour, *, step: float) -> Gaussians:
    """Flat Gaussians that cover the places."""
    means = torch.stack((x, y, torch.full_like(x, z)), dim=1)
    n = len(means)
    sh = ((torch.tensor(colour) - 0.5) / SH_C0).expand(n, 1, 3).clone()
    return Gaussians(
        means=means,
        rotations=torch.eye(4)[:1].expand(n, 4).clone(),
        scales=torch.tensor([0.7 * step, 0.7 * step, 0.1 * step]).expand(n, 3).clone(),
        opacities=torch.full((n,), 0.95),
        sh=sh,
    )


def places(half: float, step: float) -> tuple[torch.Tensor, torch.Tensor]:
    along = torch.arange(-half, half + step / 2, step)
    x, y = torch.meshgrid(along, along, indexing="ij")
    return x.reshape(-1), y.reshape(-1)


def views(count: int = 12) -> tuple[View, ...]:
    """From all around, looking down at the middle by 35 degrees."""
    found = []
    for i in range(count):
        turn = 2 * math.pi * i / count
        eye = (2.6 * math.cos(turn), 2.6 * math.sin(turn), 1.9)
        camera = look_at(eye, (0.0, 0.0, 0.1), width=96, height=72)
        found.append(View(name=f"v{i:02d}", camera=camera))
    return tuple(found)


def scene_parts(*, floor_half: float = 2.0, under: bool = False):
    """A floor that was not fitted under a low box, the box, and the floor as it really is."""
    x, y = places(floor_half, 0.08)
    whole = sheet(x, y, 0.0, GREY, step=0.08)
    outside = (x.abs() > 0.42) | (y.abs() > 0.42)
    tx, ty = places(0.4, 0.05)
    box = [sheet(tx, ty, z, RED, step=0.05) for z in (0.0, 0.08, 0.16, 0.24)]
    parts = [whole[outside], *box]
    ids = [FLOOR] * int(outside.sum()) + [THING] * sum(map(len, box))
    if under:
        bx, by = places(0.3, 0.1)
        parts.append(sheet(bx, by, -0.3, (0.0, 1.0, 0.0), step=0.1))
        ids += [BELOW] * len(bx)
    return Gaussians.concatenate(parts), torch.tensor(ids), whole


def only(ids: torch.Tensor, wanted: int) -> Selection:
    return Selection(mask=ids == wanted)


@pytest.fixture(scope="module")
def filled():
    gaussians, ids, whole = scene_parts()
    return gaussians, ids, whole, fill(gaussians, only(ids, THING), views(), backend=BACKEND)


def test_a_floor_goes_on_under_what_stood_on_it(filled) -> None:
    gaussians, ids, whole, found = filled
    new = found.gaussians
    assert len(new) > 100
    # A pixel of these views is 5 cm wide there.
    assert float(new.means[:, 2].abs().max()) < 0.05
    assert float(new.means[:, :2].abs().max()) < 0.55
    colours = 0.5 + SH_C0 * new.sh[:, 0]
    torch.testing.assert_close(colours, torch.tensor(GREY).expand_as(colours), atol=0.03, rtol=0)
    stays = gaussians[ids != THING]
    joined = Gaussians.concatenate([stays, new])
    above = View(name="above", camera=look_at((0.0, 0.3, 2.5), (0, 0, 0), width=64, height=48))
    for view in (*views(5), above):
        empty, now, true = (
            render(part, view.camera, backend=BACKEND).image for part in (stays, joined, whole)
        )
        assert float((now - true).square().mean()) < 0.02 * float((empty - true).square().mean())


def test_holes_have_the_rim_of_their_plane(filled) -> None:
    gaussians, ids, _, found = filled
    stays = gaussians[ids != THING]
    assert int(found.holes.max()) == len(found.rims) - 1
    (largest,) = {int(torch.bincount(found.holes).argmax())}
    around = stays.means[found.rims[largest]]
    assert len(around) > 10
    assert float(around[:, 2].abs().max()) < 0.2


@pytest.mark.bits
def test_neither_order_of_views_nor_threads_change_anything(filled) -> None:
    gaussians, ids, _, found = filled
    before = threads()
    try:
        set_threads(3)
        again = fill(gaussians, only(ids, THING), views()[::-1], backend=BACKEND)
    finally:
        set_threads(before)
    for name in ("means", "rotations", "scales", "sh"):
        assert torch.equal(getattr(again.gaussians, name), getattr(found.gaussians, name))


def test_a_surface_ends_where_views_look_past_it() -> None:
    """A box that stands mostly beyond the edge of a table: the table is not made longer."""
    gaussians, ids, _ = scene_parts()
    kept = (ids == THING) | (gaussians.means[:, 0] < -0.25)
    gaussians, ids = gaussians[kept], ids[kept]
    assert len(fill(gaussians, only(ids, THING), views(), backend=BACKEND).gaussians) == 0


def test_nothing_is_filled_behind_what_hides_nothing(filled) -> None:
    _, _, whole, _ = filled
    x, y = places(0.05, 0.05)
    gaussians = Gaussians.concatenate([whole, sheet(x, y, 1.0, RED, step=0.05)])
    thing = Selection(mask=torch.arange(len(gaussians)) >= len(whole))
    assert len(fill(gaussians, thing, views(), backend=BACKEND).gaussians) == 0


def test_unseen_gaussians_of_the_surface_are_replaced() -> None:
    """A floor under the box that no view ever saw, in a colour by chance."""
    gaussians, ids, _ = scene_parts()
    x, y = places(0.2, 0.08)
    green = sheet(x, y, 0.01, (0.0, 1.0, 0.0), step=0.08)
    deeper = sheet(x, y, -0.8, (0.0, 1.0, 0.0), step=0.08)
    everything = Gaussians.concatenate([gaussians, green, deeper])
    kinds = torch.cat((ids, torch.full((len(green),), BELOW), torch.full((len(deeper),), 4)))
    found = fill(everything, only(kinds, THING), views(), backend=BACKEND)
    assert float(found.replaced.mask[kinds == BELOW].float().mean()) > 0.9
    assert not bool(found.replaced.mask[kinds == 4].any())
    assert not bool(found.replaced.mask[kinds == THING].any())
    assert float(found.replaced.mask[kinds == FLOOR].float().mean()) < 0.01
    # What lies around a hole is counted without the thing and without what is replaced.
    rest = everything[~(found.replaced.mask | (kinds == THING))]
    around = rest.means[torch.cat(found.rims)]
    assert float(around[:, 2].abs().max()) < 0.2
    assert float(around[:, :2].abs().amax(dim=1).min()) > 0.3
    colours = 0.5 + SH_C0 * found.gaussians.sh[:, 0]
    torch.testing.assert_close(colours, torch.tensor(GREY).expand_as(colours), atol=0.05, rtol=0)


def test_first_met_walks_against_a_direction() -> None:
    wanted, other = np.zeros((4, 5), bool), np.zeros((4, 5), bool)
    wanted[1, 0] = other[1, 3] = True
    right = np.zeros((4, 5), bool)
    right[1, :3] = True
    assert np.array_equal(_first_met(wanted, other, 0, 1), right)
    down = np.zeros((4, 5), bool)
    down[1:, 0] = True
    assert np.array_equal(_first_met(wanted, other, 1, 0), down)
    slanted = np.zeros((4, 5), bool)
    slanted[[1, 2, 3], [0, 1, 2]] = True
    assert np.array_equal(_first_met(wanted, other, 1, 1), slanted)
    # What leaves the image does not come in again.
    assert _first_met(wanted, other, 1, -1).sum() == 1
    assert np.array_equal(_first_met(other, wanted, 0, -1)[1], [False, True, True, True, False])
    assert _first_met(wanted, other, -1, 0)[:2, 0].all()


def test_what_no_view_saw_goes_along() -> None:
    gaussians, ids, _ = scene_parts(under=True)
    found = exposed(gaussians, only(ids, THING), views(), backend=BACKEND)
    below = found.mask[ids == BELOW].float().mean()
    assert float(below) > 0.9
    assert int(found.mask[ids == FLOOR].sum()) == 0
    assert not bool(found.mask[ids == THING].any())


@dataclass(frozen=True)
class Painter:
    """A model of another package: one colour."""

    colour: tuple[int, int, int] = (0, 0, 255)
    size: int = 0
    name: str = "painter"
    note: str = ""
    settings: dict[str, int] = field(default_factory=dict)

    def inpaint(self, image: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
        painted = image.clone()
        painted[mask] = torch.tensor(self.colour, dtype=torch.uint8)
        return painted[self.size :]


def test_another_inpainter_paints(filled) -> None:
    gaussians, ids, _, _ = filled
    found = fill(gaussians, only(ids, THING), views(), inpainter=Painter(), backend=BACKEND)
    colours = 0.5 + SH_C0 * found.gaussians.sh[:, 0]
    blue = (colours - torch.tensor([0.0, 0.0, 1.0])).abs().amax(dim=1) < 1e-3
    assert float(blue.float().mean()) > 0.5
    with pytest.raises(ShapeError, match="inpainted image"):
        fill(gaussians, only(ids, THING), views(), inpainter=Painter(size=1), backend=BACKEND)


def test_inpainters_have_names(monkeypatch) -> None:
    assert find_inpainter("opencv") == OpenCvInpainter()
    assert find_inpainter("exemplar") == ExemplarInpainter()
    for name in ("classical", "nothing"):
        with pytest.raises(InputError, match=f"fill: .* a model that inpaints, got '{name}'"):
            find_inpainter(name)
    monkeypatch.setattr("splatseg.edit.inpainting.model_names", lambda: ("painter",))
    monkeypatch.setattr("splatseg.edit.inpainting.find_model", lambda _: Painter())
    assert find_inpainter("painter") == Painter()


def test_layers_have_what_most_of_the_rim_has(filled, rng) -> None:
    found = replace(
        filled[3],
        gaussians=filled[3].gaussians[:3],
        holes=torch.tensor([0, 0, 1]),
        rims=(torch.tensor([0, 1, 2]), torch.tensor([], dtype=torch.int64)),
    )
    joined = filled[0][:8]
    labels = Labels(
        ids=torch.tensor([4, 7, 7, 1, 1]), confidence=torch.ones(5), evidence=torch.ones(5)
    )
    new = filled_layer(labels, found, joined)
    assert new.ids.tolist() == [4, 7, 7, 1, 1, 7, 7, -1]
    assert new.evidence is not None
    assert new.evidence.tolist() == [1, 1, 1, 1, 1, 0, 0, 0]
    picked = Selection(mask=torch.tensor([True, True, False, False, False]))
    assert filled_layer(picked, found, joined).mask.tolist()[5:] == [True, True, False]
    features = Features(values=torch.tensor([[0.0], [1.0], [5.0], [9.0], [9.0]]))
    assert filled_layer(features, found, joined).values[5:, 0].tolist() == [1.0, 1.0, 0.0]
    assert set(layers_of(rng, 5)) == {"objects", "colours", "picked"}


def test_a_filled_removal_replays_to_the_last_bit(filled) -> None:
    gaussians, ids, _, found = filled
    scene = Scene(gaussians=gaussians, views=views())
    labels = Labels(ids=ids.int(), confidence=torch.ones(len(ids)))
    document = Document(scene=scene, layers={"objects": labels})
    by = FillBy(views=tuple(view.name for view in scene.views))
    operation = Operation(kind="remove", where=Where(layer="objects", ids=(THING,)), fill=by)
    assert Operation.from_json(operation.to_json()) == operation
    done = apply(document, operation, backend=BACKEND)
    result = done.history[-1]["result"]
    assert result["filled"] == len(found.gaussians)
    assert len(done.scene.gaussians) == int((ids == FLOOR).sum()) + result["filled"]
    named = done.layers["objects"]
    assert isinstance(named, Labels)
    assert float((named.ids[-result["filled"] :] == FLOOR).float().mean()) > 0.95
    again = replay(document, done.history, backend=BACKEND)
    assert torch.equal(again.scene.gaussians.means, done.scene.gaussians.means)
    assert torch.equal(again.scene.gaussians.sh, done.scene.gaussians.sh)


def test_views_are_needed(filled) -> None:
    with pytest.raises(InputError, match="views: expected at least one"):
        fill(filled[0], only(filled[1], THING), (), backend=BACKEND)
