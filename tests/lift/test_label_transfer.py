"""Gaussians found again: every row has its own identity, so a wrong one is seen."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from splatseg.core import (
    Features,
    Gaussians,
    Labels,
    LayerInfo,
    Selection,
    Similarity,
)
from splatseg.core.rigid import normalised, rotation_from_quaternion
from splatseg.errors import RangeError, ShapeError
from splatseg.io.splats import read_splats, write_splats
from splatseg.lift.label_transfer import MatchOptions, match_gaussians

COUNT = 3000


def scene_of(rng: np.random.Generator, count: int = COUNT) -> Gaussians:
    """Clumps of many sizes, saturated opacities, few colours: as in fitted scenes."""

    def tensor(values) -> torch.Tensor:
        return torch.from_numpy(np.asarray(values, np.float32))

    clumps = rng.normal(0, 2, (20, 3))[rng.integers(0, 20, count)]
    palette = rng.uniform(-1, 1, (20, 3))[rng.integers(0, 20, count)]
    return Gaussians(
        means=tensor(clumps + rng.normal(0, 0.2, (count, 3))),
        rotations=normalised(tensor(rng.normal(0, 1, (count, 4)))),
        scales=tensor(np.exp(rng.normal(-4, 1, (count, 3)))),
        opacities=tensor(rng.beta(2, 0.5, count).clip(0, 1)),
        sh=torch.cat(
            (
                tensor(palette + rng.normal(0, 0.1, (count, 3))).unsqueeze(1),
                tensor(rng.normal(0, 0.05, (count, 8, 3))),
            ),
            dim=1,
        ),
    )


def move_of(rng: np.random.Generator) -> Similarity:
    return Similarity(
        rotation=rotation_from_quaternion(torch.from_numpy(rng.normal(0, 1, 4))),
        translation=torch.from_numpy(rng.normal(0, 5, 3)),
        scale=float(np.exp(rng.uniform(-2, 2))),
    )


def kept_of(rng: np.random.Generator, count: int, share: float = 0.7) -> torch.Tensor:
    return torch.from_numpy(rng.permutation(count)[: int(share * count)])


def right(rows: torch.Tensor, truth: torch.Tensor) -> float:
    return float((rows == truth).double().mean())


@pytest.fixture(scope="module")
def scene() -> Gaussians:
    return scene_of(np.random.default_rng(5))


def test_cropped_and_reordered(scene, rng) -> None:
    kept = kept_of(rng, COUNT)
    found = match_gaussians(scene, scene[kept])
    assert torch.equal(found.rows, kept)
    assert found.share == 1
    assert [move.stayed for move in found.moves] == [True]
    assert found.report["source_gone"] == COUNT - len(kept)
    assert (found.report["copies"], found.report["ambiguous"]) == (0, 0)
    assert found.similarity is not None
    assert torch.equal(found.similarity.matrix, torch.eye(4, dtype=torch.float64))


@settings(max_examples=5)
@given(seed=st.integers(0, 2**32 - 1))
def test_moved_as_a_whole(seed) -> None:
    rng = np.random.default_rng(seed)
    scene, move = scene_of(rng, 800), move_of(rng)
    kept = kept_of(rng, 800)
    found = match_gaussians(scene, scene[kept].transformed(move))
    assert right(found.rows, kept) == 1
    assert found.similarity is not None
    close = 1e-4 * (1 + move.matrix.abs().max())
    assert torch.allclose(found.similarity.matrix, move.matrix, atol=float(close))


def test_a_part_was_moved_and_another_too(scene, rng) -> None:
    kept = kept_of(rng, COUNT)
    edited = scene[kept]
    near = (edited.means - edited.means[0]).norm(dim=1)
    order = near.argsort()
    truth, parts, moves = [kept[order[500:]]], [edited[order[500:]]], [move_of(rng), move_of(rng)]
    for chosen, move in zip((order[:300], order[300:500]), moves, strict=True):
        truth.append(kept[chosen])
        parts.append(edited[chosen].transformed(move))
    found = match_gaussians(scene, Gaussians.concatenate(parts))
    assert right(found.rows, torch.cat(truth)) == 1
    assert [move.gaussians for move in found.moves] == [len(kept) - 500, 300, 200]
    for got, want in zip(found.moves[1:], moves, strict=True):
        assert torch.allclose(got.edited_from_source.matrix, want.matrix, atol=2e-3)
    assert found.move_of.tolist() == [0] * (len(kept) - 500) + [1] * 300 + [2] * 200


def test_a_part_was_duplicated(scene, rng) -> None:
    part = torch.arange(200)
    edited = Gaussians.concatenate([scene, scene[part].transformed(move_of(rng))])
    found = match_gaussians(scene, edited)
    assert right(found.rows, torch.cat((torch.arange(COUNT), part))) == 1
    assert found.report["copies"] == 200
    # On the spot: no row is nearer than the other, but all are found, those in place first.
    found = match_gaussians(scene, Gaussians.concatenate([scene, scene[part]]))
    assert right(found.rows, torch.cat((torch.arange(COUNT), part))) == 1
    assert found.report["copies"] == 200


def test_mirrored(scene, rng) -> None:
    """y became -y, as between the conventions of two tools, and a rotation on top."""
    kept = kept_of(rng, COUNT)
    flip = torch.tensor([1.0, -1.0, 1.0])
    axes = torch.tensor([1.0, -1.0, 1.0, -1.0])  # of a quaternion, when y is mirrored
    edited = scene[kept]
    edited = edited.replace(means=edited.means * flip + 30, rotations=edited.rotations * axes)
    found = match_gaussians(scene, edited.transformed(move_of(rng)))
    assert right(found.rows, kept) == 1
    assert found.moves[0].mirrored
    assert found.similarity is None


@pytest.mark.parametrize("moved", [False, True])
@pytest.mark.parametrize("format", ["splat", "spz", "spz3", "compressed.ply"])
def test_through_a_format_that_rounds(scene, rng, tmp_path, format, moved) -> None:
    kept = kept_of(rng, COUNT)
    edited = scene[kept]
    if format == "splat":
        edited = edited.replace(sh=edited.sh[:, :1])
    if format == "compressed.ply":
        # It changes the order of rows; harmonics of the last degree carry the row's number.
        code = torch.arange(len(kept))
        digits = torch.stack((code % 16, code // 16 % 16, code // 256), 1).float()
        sh = edited.sh.clone()
        sh[:, -1] = digits / 4 - 2
        edited = edited.replace(sh=sh)
    path = tmp_path / "a"
    write_splats(edited, path, format=format)
    if format == "splat":  # it has no header to be known by
        path = path.rename(tmp_path / "a.splat")
    back = read_splats(path)
    if format == "compressed.ply":
        digits = ((back.sh[:, -1] + 2) * 4).round().long()
        truth = kept[digits[:, 0] + 16 * digits[:, 1] + 256 * digits[:, 2]]
    else:
        truth = kept
    if moved:
        back = back.transformed(move_of(rng))
    found = match_gaussians(scene, back)
    assert right(found.rows, truth) >= 0.995
    assert len(torch.unique(found.rows[found.rows >= 0])) >= 0.995 * len(kept)


def test_what_an_editor_changes_besides(scene, rng) -> None:
    """A tint of a part, opacity of another: the rest of a row tells who it is."""
    kept = kept_of(rng, COUNT)
    edited = scene[kept]
    left = edited.means[:, 0] < 0
    tinted = torch.where(left[:, None, None], edited.sh * 0.5 + 0.2, edited.sh)
    faded = torch.where(left, edited.opacities, edited.opacities * 0.6)
    found = match_gaussians(scene, edited.replace(sh=tinted, opacities=faded))
    assert right(found.rows, kept) == 1


def test_what_others_added_is_not_found(scene, rng) -> None:
    other = scene_of(rng, 1000)
    found = match_gaussians(scene, Gaussians.concatenate([scene, other]))
    assert torch.equal(found.rows[:COUNT], torch.arange(COUNT))
    assert float((found.rows[COUNT:] >= 0).double().mean()) < 0.01
    nothing = match_gaussians(scene, other)
    assert nothing.share < 0.01


def test_equal_rows_keep_their_order_and_get_one_each(scene) -> None:
    """Rows that nothing tells apart, more of them than candidates are looked at at first."""
    many = scene[torch.tensor([3] * 30 + list(range(50)))]
    found = match_gaussians(many, many)
    assert torch.equal(found.rows, torch.arange(80))
    turned = match_gaussians(many, many[torch.arange(79, -1, -1)])
    equal = [i for i in range(80) if i < 30 or i == 33]
    expected = torch.arange(79, -1, -1)
    expected[[79 - i for i in reversed(equal)]] = torch.tensor(equal)
    assert torch.equal(turned.rows, expected)
    assert turned.report["copies"] == 0
    assert turned.report["ambiguous"] == len(equal)
    few = match_gaussians(many, many[torch.tensor([29, 60, 2])])
    assert few.rows.tolist() == [0, 60, 1]


def test_layers_go_along() -> None:
    g = scene_of(np.random.default_rng(0), 40)
    stranger = scene_of(np.random.default_rng(1), 40)[:1]
    labels = Labels(
        ids=torch.arange(1, 41),
        confidence=torch.linspace(0.1, 1, 40),
        background=77,
        candidates=torch.arange(80).reshape(40, 2),
        shares=torch.full((40, 2), 0.5),
        evidence=torch.arange(40.0) + 1,
        effective_views=torch.arange(40.0) + 2,
        inferred=torch.ones(40, dtype=torch.bool),
        info=LayerInfo(names={1: "chair"}),
    )
    features = Features(values=torch.arange(80.0).reshape(40, 2) + 1, weights=torch.ones(40))
    selection = Selection(mask=torch.ones(40, dtype=torch.bool))
    found = match_gaussians(
        g, Gaussians.concatenate([g[5:7], stranger]), options=MatchOptions(moves=0)
    )
    assert found.rows.tolist() == [5, 6, -1]
    got = found.transfer(labels)
    assert got.ids.tolist() == [6, 7, -1]
    assert got.confidence[2] == 0
    assert (got.background, got.info.names) == (77, {1: "chair"})
    assert got.candidates is not None
    assert got.candidates.tolist() == [[10, 11], [12, 13], [-1, -1]]
    assert got.shares is not None
    assert got.shares[2].tolist() == [0, 0]
    assert got.evidence is not None
    assert got.evidence.tolist() == [6, 7, 0]
    assert got.effective_views is not None
    assert got.effective_views.tolist() == [7, 8, 0]
    assert got.inferred is not None
    assert got.inferred.tolist() == [True, True, False]
    assert found.transfer(features).values.tolist() == [[11, 12], [13, 14], [0, 0]]
    assert found.transfer(features).weights is not None
    assert found.transfer(selection).mask.tolist() == [True, True, False]
    columns = found.transfer_columns({"a": torch.arange(40), "b": torch.ones(40, 2)})
    assert columns["a"].tolist() == [5, 6, 0]
    assert columns["b"].tolist() == [[1, 1], [1, 1], [0, 0]]
    with pytest.raises(ShapeError, match="expected 40 rows"):
        found.transfer(labels[:20])


def test_nothing_to_find() -> None:
    g = scene_of(np.random.default_rng(0), 10)
    empty = g[:0]
    assert match_gaussians(g, empty).rows.tolist() == []
    lost = match_gaussians(empty, g)
    assert lost.rows.tolist() == [-1] * 10
    assert (lost.moves, lost.share, lost.similarity) == ((), 0.0, None)
    labels = Labels(ids=torch.zeros(0, dtype=torch.int32), confidence=torch.zeros(0))
    assert lost.transfer(labels).ids.tolist() == [-1] * 10
    assert match_gaussians(g[:1], g[:1]).rows.tolist() == [0]
    same = g.replace(means=torch.zeros(10, 3))  # all in one place
    assert torch.equal(match_gaussians(same, same).rows, torch.arange(10))
    clones = g[torch.zeros(10, dtype=torch.int64)]
    assert torch.equal(match_gaussians(clones, clones).rows, torch.arange(10))


def test_extreme_values() -> None:
    g = scene_of(np.random.default_rng(0), 200)
    hard = g.replace(
        scales=g.scales * torch.tensor([0.0, 1.0, 1e-20]),
        opacities=torch.where(torch.arange(200) % 2 == 0, 0.0, 1.0),
        means=torch.where(torch.arange(200)[:, None] == 7, 1e9, g.means),
    )
    found = match_gaussians(hard, hard[torch.arange(199, -1, -1)])
    assert torch.equal(found.rows, torch.arange(199, -1, -1))
    with pytest.raises(RangeError, match="means"):
        match_gaussians(g, g.replace(means=g.means * float("nan")))
    with pytest.raises(RangeError, match="moves"):
        MatchOptions(moves=-1)


@pytest.mark.bits
def test_the_same_every_time_and_with_any_number_of_threads(scene, rng) -> None:
    edited = scene[kept_of(rng, COUNT)].transformed(move_of(rng))
    before = torch.get_num_threads()
    results = []
    try:
        for threads in (1, 4):
            torch.set_num_threads(threads)
            results.append(match_gaussians(scene, edited))
    finally:
        torch.set_num_threads(before)
    assert torch.equal(results[0].rows, results[1].rows)
    assert results[0].report == results[1].report
