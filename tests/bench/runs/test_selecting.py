"""Layers that a person could select by answer a protocol's strokes and masks through `select`."""

import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import pytest
import torch

from splatseg.core import (
    Features,
    InstanceTree,
    LabelMap,
    Labels,
    Layer,
    LayerInfo,
    MaskSet,
    Selection,
    TreeNode,
)
from splatseg.errors import InputError
from splatseg.io.evidence import create_evidence, save_masks
from splatseg.io.scene import load_scene
from splatseg.lift import GaussianField
from splatseg.lift.affinity import AffinityHead
from splatseg.methods import Method, MethodInputs, _method, register_method
from splatseg.methods.uplift import UpliftMethodOptions
from splatseg.tasks.sources import OpenedSource, SourceRequest, open_source
from splatseg_bench.answers import BySelection, stroke_prompt
from splatseg_bench.layouts import read_benchmark
from splatseg_bench.options import BenchOptions
from splatseg_bench.protocols import find_protocol
from splatseg_bench.run import BenchRun, bench
from splatseg_bench.scene import Scribble, TargetTask, TrueMask
from support.red_square import NAMES, SIZE, camera, save_strokes, wall

SQUARE, WALL, ALL = 2, 3, 1
HELD = ("scored_in_training=yes",)


def ids(count: int) -> torch.Tensor:
    return torch.where(torch.arange(count) < 25, SQUARE, WALL)


def labels(count: int) -> Labels:
    return Labels(ids=ids(count), confidence=torch.ones(count))


def tree(count: int) -> InstanceTree:
    """The square and the wall, and a group of both."""
    nodes = (
        TreeNode(id=ALL, level="group"),
        TreeNode(id=SQUARE, parent=ALL),
        TreeNode(id=WALL, parent=ALL),
    )
    return InstanceTree(nodes=nodes, labels=labels(count))


def affinity(count: int) -> Features:
    values = torch.eye(2)[ids(count) - SQUARE]
    info = LayerInfo(head=AffinityHead(channels=2, unit=True).to_json())
    return Features(values=values, weights=torch.ones(count), info=info)


def published(count: int) -> Features:
    """The same, said to be trained as published."""
    layer = affinity(count)
    details = {"published": True}
    return replace(layer, info=replace(layer.info, method="saga", details=details))


def unsure(count: int) -> Labels:
    """The square at 0.9, and much of the wall at 0.7 of the square."""
    share = torch.full((count, 2), 0.1)
    share[:, 0] = 0.9
    spoilt = torch.arange(count) >= 25 + (count - 25) // 2
    share[spoilt] = torch.tensor([0.3, 0.7])
    own = ids(count)
    candidates = torch.stack((own, SQUARE + WALL - own), dim=1).int()
    top = torch.where(spoilt, SQUARE, own)
    return Labels(ids=top, confidence=share.amax(1), candidates=candidates, shares=share)


def nothing(count: int) -> Labels:
    return Labels(ids=torch.full((count,), -1), confidence=torch.zeros(count))


@pytest.fixture
def run(tiny: tuple[Path, Path], tmp_path: Path) -> Iterator[Callable[..., BenchRun]]:
    """Runs a protocol on the wall with a method that gives a layer, whatever the masks are."""
    data, scenes = tiny
    given: list[Layer] = []

    def go(protocol: str, layer: Callable[[int], Layer], **options) -> BenchRun:
        given[:] = [layer(len(wall()))]
        folder = nvos(data, tmp_path / "nvos") if protocol == "nvos" else data
        switches = options.pop("switches", ()) + (HELD if protocol == "nvos" else ())
        made = BenchOptions(
            methods=("stranger",), models=(str(masks(data.parent)),), again=True,
            fitted=str(scenes / "{scene}"), switches=switches, **options,
        )  # fmt: skip
        return bench(protocol, folder, tmp_path / "out", options=made, command="c")

    def layer_of(inputs: MethodInputs, options: UpliftMethodOptions) -> Layer:
        return given[0]

    register_method(
        Method(
            name="stranger", summary="s", reference="r", evidence=("masks",),
            options=UpliftMethodOptions, run=layer_of, complete=False,
        )
    )  # fmt: skip
    yield go
    del _method._REGISTERED["stranger"]


def masks(folder: Path) -> Path:
    """Evidence that is there and says nothing."""
    evidence = folder / "masks"
    if not evidence.exists():
        created = create_evidence(evidence, kind="masks")
        for name in NAMES:
            one = MaskSet.from_dense(torch.ones(1, SIZE, SIZE, dtype=torch.bool))
            save_masks(one, created, name)
    return evidence


def nvos(data: Path, folder: Path) -> Path:
    """The wall in NVOS's layout: strokes in view a, the mask of view b."""
    if not folder.exists():
        shutil.copytree(data / "wall", folder / "llff" / "wall")
        save_strokes(folder / "scribbles/red/pos_0_wall.png", (slice(15, 18), slice(13, 20)))
        save_strokes(folder / "scribbles/red/neg_0_wall.png", (slice(2, 3), slice(2, 30)))
        (folder / "masks/red").mkdir(parents=True)
        (folder / "reference_image/red").mkdir(parents=True)
        shutil.copy(data / "wall/masks/b.png", folder / "masks/red/b_mask.png")
        shutil.copy(data / "wall/images/a.png", folder / "reference_image/red/a.png")
    return folder


@pytest.mark.parametrize("protocol", ["nvos", "spin-nerf"])
def test_features_trained_as_published_answer_as_published(
    protocol: str, run, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Thresholds of section 3.4 and what follows in section 3.5, by the record of the layer."""
    asked: list[tuple[str | None, bool]] = []

    def opened(offer: SourceRequest) -> OpenedSource:
        found = open_source(offer)
        asked.append((found.rule, found.published))
        return found

    monkeypatch.setattr(import_module("splatseg.tasks.select"), "open_source", opened)
    for layer in (affinity, published):
        assert run(protocol, layer).methods[0].scores["iou"] > 0.3
    assert asked == [("fixed", False), ("adaptive", True)]


@pytest.mark.parametrize("layer", [labels, tree, affinity])
@pytest.mark.parametrize("protocol", ["nvos", "spin-nerf", "spin-nerf-ludvig"])
def test_strokes_and_masks_select(protocol: str, layer, run) -> None:
    found = run(protocol, layer).methods[0]
    # Of 25 Gaussians the steps after features take some for outliers.
    assert found.scores["iou"] > (0.6 if layer is affinity else 0.85)
    views = [row["view"] for row in found.scenes[0].rows]
    assert views == {"nvos": ["b"], "spin-nerf": ["a", "b", "c"]}.get(protocol, ["b", "c"])


def test_strokes_need_nobody_who_makes_a_mask_of_them(run, monkeypatch) -> None:
    def never(*_, **__):
        raise AssertionError("a mask was made of the strokes")

    monkeypatch.setattr("splatseg_bench.targets.prompted_mask", never)
    assert run("nvos", labels).methods[0].scores["iou"] > 0.85


def test_the_granularity_is_the_protocols(run) -> None:
    """Asked for a group, the mask of the square means the square and the wall."""
    square = run("spin-nerf", tree, switches=("granularity=object",)).methods[0].scores["iou"]
    both = run("spin-nerf", tree, switches=("granularity=group",)).methods[0].scores["iou"]
    assert square > 0.85
    assert both < 0.5


def test_segments_answer_where_the_protocol_says_so(run, monkeypatch) -> None:
    assert find_protocol("lerf-mask").switches.answered == "segments"
    monkeypatch.setattr("splatseg_bench.targets.LayerSelector.select", None)
    found = run("spin-nerf", tree, switches=("answered=segments",)).methods[0]
    assert found.scores["iou"] > 0.85
    # Half of the wall is one segment with the square, of which little lies in the mask.
    shares = {
        share: run(
            "spin-nerf", unsure, switches=("answered=segments", f"segment_share={share}")
        ).methods[0]
        for share in (0.01, 0.9)
    }
    assert shares[0.01].scores["iou"] > 0
    assert shares[0.9].scores["iou"] == 0


def test_a_selection_is_cut_where_the_protocol_says_so(run) -> None:
    """Half of the wall is taken for the square at 0.7: a cut above that is without it."""
    scores = {
        threshold: run("spin-nerf", unsure, switches=(f"threshold={threshold}",)).methods[0]
        for threshold in ("fixed", "reference", "oracle")
    }
    assert scores["fixed"].scores["iou"] < 0.6
    assert scores["reference"].scores["iou"] > 0.8
    assert scores["oracle"].scores["iou"] >= scores["reference"].scores["iou"] - 0.02
    assert scores["oracle"].oracle == ("cut",)
    solid = run("spin-nerf", labels, switches=("decided=gaussians",)).methods[0]
    assert solid.scores["iou"] > 0.5
    with pytest.raises(InputError, match="threshold: expected fixed or oracle with words and str"):
        run("nvos", labels, switches=("threshold=reference",))


def test_what_is_not_answered_counts_as_wrong_and_is_said(run) -> None:
    found = run("spin-nerf", nothing).methods[0]
    assert found.scores["iou"] == 0
    assert not found.scenes[0].rows[0]["found"]
    assert "nothing was selected" in found.scenes[0].notes[0]


def test_a_selection_is_drawn_as_render_draws_it() -> None:
    gaussians = wall()
    confidence = torch.rand(len(gaussians), generator=torch.Generator().manual_seed(0))
    selection = Selection.of_confidence(confidence)
    switches = find_protocol("spin-nerf").switches
    answer = BySelection(gaussians=gaussians, selection=selection, switches=switches)
    with GaussianField(gaussians, {"s": selection}).view(camera(0.1)) as view:
        drawn: LabelMap = view.label_map("s")
    assert torch.equal(answer.answer(camera(0.1)).mask, drawn.ids == 1)


def test_a_share_of_the_strokes_is_taken(tiny, tmp_path) -> None:
    """In the view's pixels, on the middle lines; the same for a seed, others for another."""
    data, scenes = tiny
    scene = load_scene(scenes / "wall")
    (found,) = read_benchmark("nvos", nvos(data, tmp_path / "nvos"))
    (task,) = found.tasks
    switches = find_protocol("nvos").switches
    all_of_them = replace(switches, positive_share=1.0, negative_share=1.0)
    few = stroke_prompt(scene, task, switches, seed=0)
    many = stroke_prompt(scene, task, all_of_them, seed=0)
    assert many.scribble is not None
    assert few.scribble is not None
    assert 1 <= int(few.scribble.sum()) < int(many.scribble.sum())
    assert set(torch.nonzero(many.scribble)[:, 0].tolist()) <= {15, 16, 17}
    assert few.negative_scribble is None or bool(few.negative_scribble.any())
    assert many.negative_scribble is not None
    assert set(torch.nonzero(many.negative_scribble)[:, 0].tolist()) == {2}
    half = replace(switches, positive_share=0.5)
    drawn = [stroke_prompt(scene, task, half, seed=seed).scribble for seed in (1, 1, 2, 3)]
    assert torch.equal(drawn[0], drawn[1])
    assert any(not torch.equal(drawn[0], other) for other in drawn[2:])
    plain = TargetTask(name="red", truth=task.truth)
    with pytest.raises(InputError, match="expected strokes in one view as prompt, got none"):
        stroke_prompt(scene, plain, switches, seed=0)


def test_strokes_of_another_size_lie_in_the_views_pixels(tiny) -> None:
    _, scenes = tiny
    scene = load_scene(scenes / "wall")
    small = torch.zeros(SIZE // 4, SIZE // 4, dtype=torch.bool)
    small[-1, -1] = True
    scribble = Scribble(view="a", read=lambda: (small, torch.zeros_like(small)))
    true = TrueMask(view="b", read=lambda: torch.ones(SIZE, SIZE, dtype=torch.bool))
    task = TargetTask(name="t", truth=(true,), scribble=scribble)
    drawn = stroke_prompt(scene, task, find_protocol("nvos").switches, seed=0)
    assert drawn.scribble is not None
    assert torch.nonzero(drawn.scribble).tolist() == [[SIZE - 2, SIZE - 2]]
    assert drawn.negative_scribble is None
