"""The page of a segmentation: whole, self-contained, and true to what went in."""

import base64
import io
import re
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from PIL import Image

from splatseg.core import (
    Camera,
    ClassInfo,
    ClassTable,
    Gaussians,
    InstanceFacts,
    LabelMap,
    Labels,
    LayerInfo,
    MaskSet,
    RenderableLayer,
    Scene,
    View,
)
from splatseg.errors import MissingFileError, ShapeError
from splatseg.io.evidence import (
    MaskEvidence,
    create_evidence,
    open_evidence,
    save_label_map,
    save_masks,
)
from splatseg.io.images import save_png
from splatseg.lift import GaussianField
from splatseg.report import segment_report, segment_tables, segment_views
from splatseg.report.colours import layer_colours
from splatseg.report.segment_report import SegmentationRun, write_segmentation_report

WIDTH, HEIGHT = 40, 30
CLASSES = ClassTable(
    rows=(
        ClassInfo(id=1, name="sky", isthing=False, colour=(1, 2, 200)),
        ClassInfo(id=2, name="red <wall>", colour=(200, 0, 0)),
        ClassInfo(id=3, name="blue wall", colour=(0, 0, 100)),
    )
)


RUN = SegmentationRun(
    timings={"lifting": 1.25, "writing": 0.5},
    peak_bytes=3 << 30,
    command="splatseg segment SCENE --report",
    backend="cpu",
)


@dataclass
class Maps:
    """Label maps from memory."""

    maps: dict[str, torch.Tensor]

    @property
    def view_names(self):
        return tuple(self.maps)

    def label_map(self, name: str) -> LabelMap:
        return LabelMap(ids=self.maps[name])


def scene_of(folder) -> Scene:
    """A wall of two halves and six views, two of them held out."""
    x, y = torch.meshgrid(torch.arange(-1.9, 2, 0.2), torch.arange(0.1, 1.6, 0.2), indexing="ij")
    means = torch.stack((x, y, torch.full_like(x, 2.0)), -1).reshape(-1, 3)
    n = len(means)
    gaussians = Gaussians(
        means=means,
        rotations=torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1),
        scales=torch.full((n, 3), 0.1),
        opacities=torch.full((n,), 0.95),
        sh=torch.zeros(n, 1, 3),
    )
    views = []
    for i in range(6):
        pose = torch.eye(4, dtype=torch.float64)
        pose[0, 3] = 0.1 * i
        camera = Camera(width=WIDTH, height=HEIGHT, fx=34, fy=34, cx=20, cy=15, cam_from_world=pose)
        image = folder / f"v{i}.png"
        save_png(torch.full((HEIGHT, WIDTH, 3), 0.1 * i), image)
        views.append(
            View(name=f"v{i}", camera=camera, image=image, split="test" if i > 3 else "train")
        )
    return Scene(gaussians=gaussians, views=tuple(views), classes=CLASSES)


def layer_of(scene: Scene, **fields) -> Labels:
    left = scene.gaussians.means[:, 0] < 0
    ids = torch.where(left, 2, 3)
    words = {"method": "uplift", "options": {"candidates": 2}, "seed": 5, "evidence": "said"}
    words |= {"names": {row.id: row.name for row in CLASSES.rows}} | fields.pop("info", {})
    return Labels(
        ids=ids,
        confidence=torch.full((len(ids),), 0.75),
        background=1,
        info=LayerInfo(**words),
        **fields,
    )


def maps_of(scene: Scene, names, *, wrong: bool = False) -> Maps:
    out = {}
    for i, name in enumerate(names):
        ids = torch.ones(HEIGHT, WIDTH, dtype=torch.int32)
        border = 20 + round(34 * scene.view(name).camera.cam_from_world[0, 3].item() / 2)
        ids[15:, :border] = 2
        ids[15:, border:] = 3
        if wrong:
            ids[20:, : 4 + i] = 3
        out[name] = ids
    return Maps(out)


@pytest.fixture
def write(tmp_path):
    scene = scene_of(tmp_path)

    def run(*, labels=None, scene=scene, name="report.html", **words) -> str:
        given = {
            "evidence": maps_of(scene, ["v0", "v1", "v2", "v3"], wrong=True),
            "views": scene.train_views,
            "truth": None,
            "run": RUN,
        }
        given |= words
        labels = layer_of(scene) if labels is None else labels
        write_segmentation_report(
            scene,
            tmp_path / name,
            field=GaussianField(scene.gaussians, {"walls & sky": labels}, backend="cpu"),
            labels=labels,
            layer="walls & sky",
            **given,
        )
        return (tmp_path / name).read_text()

    run.scene = scene
    run.folder = tmp_path
    return run


def pictures(page: str) -> list[np.ndarray]:
    found = re.findall(r'src="data:image/\w+;base64,([^"]+)"', page)
    return [np.array(Image.open(io.BytesIO(base64.b64decode(data)))) for data in found]


def test_the_page_needs_nothing_else_and_says_everything(write) -> None:
    page = write(truth=maps_of(write.scene, ["v0", "v4", "v5"]))
    assert not re.search(r'(src|href)="(?!data:|#)', page)
    assert "<script" not in page
    assert "red &lt;wall&gt;" in page
    assert "red <wall>" not in page
    assert "Segmentation walls &amp; sky" in page
    for words in (
        "v4, held out", "evidence as it came", "confidence", "truth", "errors in red",
        "2 held-out views", "Coverage", "at least 3 views", "Conflicts", "1.8 s", "3.00 GiB",
        "splatseg segment SCENE", "--report</span></code>", "seed", "torch", "candidates",
        "blue wall",
    ):  # fmt: skip
        assert words in page, words
    # Four views that it was made from and two held out, seven images each, and three labels.
    assert len(pictures(page)) == 6 * 7 + 3


def test_figures_are_those_of_the_maps(write) -> None:
    from splatseg.evaluate import Confusion, semantic_score
    from splatseg.lift import label_map

    truth = maps_of(write.scene, ["v4", "v5"])
    page = write(truth=truth)
    labels = layer_of(write.scene)
    total = Confusion.none()
    for name in ("v4", "v5"):
        view = write.scene.view(name)
        drawn = label_map(write.scene.gaussians, view.camera, labels, backend="cpu")
        total = total + Confusion.of(drawn.ids, truth.maps[name])
    score = semantic_score(total)
    assert f"{score.miou:.3f}" in page
    for value in score.per_class.values():
        assert f'<td class="number">{value:.3f}</td>' in page


def test_without_truth_and_evidence_the_columns_are_left_out(write) -> None:
    page = write(evidence=None)
    assert "There is no truth" in page
    assert "errors in red" not in page
    assert "evidence as it came" not in page
    assert "differs from the layer" not in page
    assert len(pictures(page)) == 6 * 4 + 3


def test_views_without_photographs_are_rendered(write) -> None:
    bare = replace(write.scene, views=tuple(replace(v, image=None) for v in write.scene.views))
    page = write(scene=bare)
    first = pictures(page)[0]
    assert first.shape == (HEIGHT, WIDTH, 3)
    assert first[20, 20].mean() > 100  # the wall is grey, the sky black
    assert first[3, 20].mean() < 10
    gone = tuple(replace(v, image=write.folder / "no.png") for v in write.scene.views)
    assert pictures(write(scene=replace(write.scene, views=gone))) == []


def test_truth_with_other_ids_is_matched(write) -> None:
    """Instances of the truth are called otherwise: they are renamed, and errors are real ones."""
    same = maps_of(write.scene, ["v4", "v5"])
    other = Maps({n: torch.where(m == 2, 70, torch.where(m == 3, 80, -1)) for n, m in
                  same.maps.items()})  # fmt: skip
    labels = layer_of(write.scene, info={"method": "associate", "names": {}})
    page = write(truth=other, labels=labels, evidence=other, views=write.scene.train_views)
    assert "mIoU of instances" in page
    assert "matched one to one, 2 held-out views" in page
    right = [float(v) for v in re.findall(r" ([\d.]+)% right</figcaption>", page)]
    assert len(right) == 2
    assert min(right) > 90


def test_conflicts_and_support(write) -> None:
    scene = write.scene
    n = len(scene.gaussians)
    ids = layer_of(scene).ids
    shares = torch.tensor([[0.6, 0.4]]).repeat(n, 1)
    shares[: n // 2] = torch.tensor([0.95, 0.05])
    second = torch.where(ids == 2, 3, 2)
    evidence = torch.full((n,), 2.0)
    evidence[: n // 4] = 0
    inferred = torch.zeros(n, dtype=torch.bool)
    inferred[: n // 4] = True
    page = write(
        labels=layer_of(
            scene,
            candidates=torch.stack((ids, second), 1),
            shares=shares,
            evidence=evidence,
            inferred=inferred,
        )
    )
    for words in ("Who contests whom", "inferred from neighbours", "share of their evidence"):
        assert words in page
    bars = re.search(r"second has 50% of the first or more.*?<b>([\d.]+)</b>", page, re.S)
    assert float(bars[1]) == pytest.approx(0.5, abs=1e-3)
    assert re.search(r"inferred from neighbours</td><td[^>]*>40</td><td[^>]*>25.0%", page)


def test_what_association_says_is_shown(write) -> None:
    said = {
        "segments": 812,
        "instances": 40,
        "merged": [{"instance": 3, "segments": 22}, {"instance": 9, "extra": "x & y"}],
        "split": [[4, 5], [6]],
        "odd": {"a": [1] * 500},
        "empty": [],
    }
    listed = {2: InstanceFacts(segments=31, views=4), 3: InstanceFacts(segments=17)}
    info = {"details": {"associate": said}, "instances": listed}
    page = write(labels=layer_of(write.scene, info=info))
    row = re.search(r"<td>red &lt;wall&gt;</td>.*?</tr>", page)
    assert re.findall(r">([^<>]+)</td>", row[0])[3:] == ["31", "4"]
    for words in ("Segments to instances", "812", "Merged", "Split", "4, 5", "x &amp; y", "Odd"):
        assert words in page, words
    assert "Empty" not in page
    assert "500: 1, 1" in page
    broken = write(labels=layer_of(write.scene, info={"details": {"associate": "yes"}}))
    assert "Segments to instances" not in broken


def test_how_a_layer_was_trained_is_shown(write) -> None:
    curve = [[10, 0.75], [20, 0.5], [30, "x"], "odd"]
    said = {
        "loss_curve": curve,
        "trained": "published, 30 of 10000 steps",
        "point_network": "randla",
        "point_network_trained_on": 7,
    }
    page = write(labels=layer_of(write.scene, info={"details": said}))
    for words in ("How it was trained", "Loss", "steps", "published, 30 of 10000 steps", "randla"):
        assert words in page, words
    assert "How it was trained" not in write()
    broken = write(labels=layer_of(write.scene, info={"details": {"loss_curve": "yes"}}))
    assert "How it was trained" not in broken


def test_a_page_that_is_too_large_gets_smaller_pictures(write, monkeypatch) -> None:
    large = write()
    monkeypatch.setattr(segment_report, "_IMAGE_SIZES", (448, 20, 10))
    monkeypatch.setattr(segment_report, "_LARGEST", len(large.encode()) - 1)
    small = write()
    cut = (256, 256)
    assert {p.shape[:2] for p in pictures(large)} == {(HEIGHT, WIDTH), cut}
    assert {p.shape[:2] for p in pictures(small)} == {(15, 20), cut}
    assert len(small) < len(large)
    # And where nothing is small enough, the smallest is written.
    monkeypatch.setattr(segment_report, "_LARGEST", 1)
    assert {p.shape[:2] for p in pictures(write())} == {(8, 10), cut}


def test_nothing_half_written_stays(write) -> None:
    with pytest.raises(MissingFileError):
        write(name="nowhere/report.html")
    torn = Maps({"v4": torch.ones(7, 99, dtype=torch.int32)})
    with pytest.raises(ShapeError, match="v4"):
        write(truth=torn)
    assert not list(write.folder.glob("*.html"))
    assert not list(write.folder.glob(".splatseg*"))


def test_masks_are_painted_from_large_to_small(write) -> None:
    dense = torch.zeros(2, HEIGHT, WIDTH, dtype=torch.bool)
    dense[0, 20:25, 5:10] = True  # inside the second
    dense[1, 15:] = True
    folder = write.folder / "masks"
    create_evidence(folder, kind="masks")
    save_masks(MaskSet.from_dense(dense), folder, "v0")
    evidence = open_evidence(folder)
    assert isinstance(evidence, MaskEvidence)
    ids = segment_views._evidence_ids(evidence, "v0")
    assert ids[22, 7] == 1
    assert ids[16, 7] == 2
    assert ids[3, 3] == -1
    labels = layer_of(write.scene, info={"method": "associate"})
    page = write(evidence=evidence, labels=labels)
    assert "evidence as it came" in page


def test_ids_agree_by_their_names(write) -> None:
    folder = write.folder / "named"
    create_evidence(folder, kind="labels", classes=CLASSES)
    save_label_map(LabelMap(ids=torch.ones(HEIGHT, WIDTH, dtype=torch.int32)), folder, "v0")
    source = open_evidence(folder)
    named = layer_of(write.scene)
    assert segment_report.ids_agree(RenderableLayer.of(named), source, otherwise=False)
    other = layer_of(write.scene, info={"names": {2: "blue wall"}})
    assert not segment_report.ids_agree(RenderableLayer.of(other), source, otherwise=True)
    # A name of an id that is not in use is no contradiction.
    unused = layer_of(write.scene, info={"names": {2: "red <wall>", 77: "pole"}})
    assert segment_report.ids_agree(RenderableLayer.of(unused), source, otherwise=False)
    for otherwise in (True, False):
        bare = layer_of(write.scene, info={"names": {}})
        assert (
            segment_report.ids_agree(RenderableLayer.of(bare), source, otherwise=otherwise)
            == otherwise
        )
        assert (
            segment_report.ids_agree(RenderableLayer.of(named), Maps({}), otherwise=otherwise)
            == otherwise
        )


def test_names_and_colours(write) -> None:
    bare = layer_of(write.scene, info={"names": {}})
    known = layer_colours(RenderableLayer.of(bare), CLASSES)
    assert known.rows[1].name == "red <wall>"
    assert known.rows[1].colour == (200, 0, 0)
    tracks = layer_colours(RenderableLayer.of(bare), None)
    assert [row.name for row in tracks.rows] == ["id 1", "id 2", "id 3"]
    assert tracks.rows[1].colour != (200, 0, 0)


def test_confidence_bars_by_hand() -> None:
    labels = Labels(
        ids=torch.tensor([1, 1, 1, -1]),
        confidence=torch.tensor([1.0, 0.95, 0.0, 0.5]),
        evidence=torch.tensor([1.0, 0.0, 3.0, 9.0]),
    )
    rows = dict(segment_tables.confidence_bars(labels).rows)
    assert rows["0.9 to 1.0"] == (pytest.approx(2 / 3), pytest.approx(1 / 4))
    assert rows["0.0 to 0.1"] == (pytest.approx(1 / 3), pytest.approx(3 / 4))
    assert rows["0.5 to 0.6"] == (0, 0)
    nothing = replace(labels, ids=torch.full((4,), -1))
    assert set(segment_tables.confidence_bars(nothing).rows[0][1]) == {0}


def test_coverage_bars_by_hand() -> None:
    rows = dict(segment_tables.coverage_bars(torch.tensor([0, 1, 2, 7]), views=5).rows)
    assert rows == {
        "at least 1 view": (0.75,),
        "at least 2 views": (0.5,),
        "at least 3 views": (0.25,),
        "at least 5 views": (0.25,),
    }


def test_an_empty_scene_has_a_report(write) -> None:
    empty = replace(write.scene, gaussians=write.scene.gaussians[:0])
    page = write(scene=empty, labels=layer_of(empty))
    assert "on 0 Gaussians" in page
