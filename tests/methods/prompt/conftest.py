"""Two balls before a wall, seen by nine cameras; masks and features drawn from the truth."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest
import torch

from lift.conftest import gaussians_at
from splatseg.core import Camera, FeatureMap, Gaussians, Labels, MaskSet, View
from splatseg.io.evidence import (
    FeatureEvidence,
    MaskEvidence,
    TextEmbeddings,
    create_evidence,
    open_evidence,
    save_features,
    save_masks,
    save_text_embeddings,
)
from splatseg.lift import label_map
from splatseg.methods.prompt import PromptOptions, PromptSession, PromptSources

WIDTH, HEIGHT, STRIDE = 64, 48, 4
APPLE, PEAR, WALL = 1, 2, 3
WORDS = ("apple", "pear", "wall", "dog", "object")
KINDS = ("class", "class", "class", "class", "negative")
APART = 0.5


def ball(x: float, y: float, z: float, count: int, generator: torch.Generator) -> torch.Tensor:
    away = torch.randn(count, 3, generator=generator)
    return torch.tensor([x, y, z]) + 0.12 * torch.nn.functional.normalize(away, dim=1)


@dataclass(frozen=True)
class Fruit:
    """The scene, its truth and its evidence."""

    gaussians: Gaussians
    ids: torch.Tensor
    views: tuple[View, ...]
    features: FeatureEvidence
    masks: MaskEvidence

    def truth(self, view: View) -> torch.Tensor:
        labels = Labels(ids=self.ids, confidence=torch.ones(len(self.ids)))
        return label_map(self.gaussians, view.camera, labels).ids

    def session(self, *, seed: int = 0, **options) -> PromptSession:
        return PromptSession(
            self.gaussians,
            self.views,
            PromptSources(features=self.features, masks=self.masks),
            options=PromptOptions(**options),
            seed=seed,
        )


def fruit_gaussians() -> tuple[Gaussians, torch.Tensor]:
    generator = torch.Generator().manual_seed(3)
    apple = ball(-APART, 0.0, 2.5, 150, generator)
    pear = ball(APART, 0.0, 2.5, 150, generator)
    across, down = torch.meshgrid(
        torch.linspace(-4, 4, 41), torch.linspace(-3, 3, 31), indexing="ij"
    )
    wall = torch.stack((across.ravel(), down.ravel(), torch.full((41 * 31,), 4.0)), dim=1)
    balls = gaussians_at(torch.cat((apple, pear)), scale=0.04, opacity=0.95)
    back = gaussians_at(wall, scale=0.14, opacity=0.95)
    ids = torch.tensor([APPLE] * 150 + [PEAR] * 150 + [WALL] * len(wall))
    return Gaussians.concatenate([balls, back]), ids.int()


def camera_from(x: float, y: float, turn: float) -> Camera:
    """From (x, y, 0), turned about the vertical so that the balls stay in the picture."""
    angle = torch.tensor(turn, dtype=torch.float64)
    rotation = torch.tensor(
        [
            [torch.cos(angle), 0, -torch.sin(angle)],
            [0, 1, 0],
            [torch.sin(angle), 0, torch.cos(angle)],
        ],
        dtype=torch.float64,
    )
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = rotation
    pose[:3, 3] = -rotation @ torch.tensor([x, y, 0.0], dtype=torch.float64)
    return Camera(
        width=WIDTH, height=HEIGHT, fx=60, fy=60, cx=WIDTH / 2, cy=HEIGHT / 2, cam_from_world=pose
    )


def fruit_views() -> tuple[View, ...]:
    places = [(x, y) for y in (-0.4, 0.0, 0.4) for x in (-0.8, 0.0, 0.8)]
    return tuple(
        View(name=f"v{i}", camera=camera_from(x, y, -x / 2.5)) for i, (x, y) in enumerate(places)
    )


def vectors() -> torch.Tensor:
    """Words with an angle of 60 degrees between those of fruit, as related words have."""
    rows = torch.eye(5, 6)
    rows[1] = torch.tensor([0.5, 0.866, 0, 0, 0, 0])
    rows[4] = torch.tensor([0.4, 0.4, 0.4, 0.4, 0, 0.4])
    return torch.nn.functional.normalize(rows, dim=1)


def write_features(folder: Path, maps: dict[str, torch.Tensor]) -> FeatureEvidence:
    words = vectors()
    create_evidence(folder, kind="features")
    for name, ids in maps.items():
        shown = torch.zeros(HEIGHT, WIDTH, words.shape[1])
        for id in (APPLE, PEAR, WALL):
            shown[ids == id] = words[id - 1]
        cells = torch.nn.functional.avg_pool2d(shown.permute(2, 0, 1)[None], STRIDE)[0]
        grid = FeatureMap(
            features=cells.permute(1, 2, 0).contiguous(),
            stride=STRIDE,
            height=HEIGHT,
            width=WIDTH,
        )
        save_features(grid, folder, name)
    embeddings = TextEmbeddings(
        labels=WORDS, vectors=words, kinds=KINDS, target_ids=(1, 2, 3, -1, -1)
    )
    save_text_embeddings(embeddings, folder)
    found = open_evidence(folder)
    assert isinstance(found, FeatureEvidence)
    return found


def write_masks(folder: Path, maps: dict[str, torch.Tensor]) -> MaskEvidence:
    """Each thing, both fruits together, and the left half of the apple: of all levels."""
    create_evidence(folder, kind="masks")
    for name, ids in maps.items():
        apple = ids == APPLE
        columns = torch.nonzero(apple)[:, 1]
        half = apple.clone()
        if len(columns):
            half[:, int(columns.double().mean()) :] = False
        masks = [apple, ids == PEAR, ids == WALL, (ids == APPLE) | (ids == PEAR), half]
        kept = torch.stack([mask for mask in masks if int(mask.sum()) > 4])
        save_masks(MaskSet.from_dense(kept), folder, name)
    found = open_evidence(folder)
    assert isinstance(found, MaskEvidence)
    return found


@pytest.fixture(scope="session")
def fruit(tmp_path_factory: pytest.TempPathFactory) -> Fruit:
    gaussians, ids = fruit_gaussians()
    labels = Labels(ids=ids, confidence=torch.ones(len(ids)))
    views = fruit_views()
    maps = {view.name: label_map(gaussians, view.camera, labels).ids for view in views}
    folder = tmp_path_factory.mktemp("fruit")
    return Fruit(
        gaussians=gaussians,
        ids=ids,
        views=views,
        features=write_features(folder / "text", maps),
        masks=write_masks(folder / "masks", maps),
    )


def agreement(confidence: torch.Tensor, wanted: torch.Tensor) -> float:
    """IoU of what is selected with what should be."""
    found = confidence > 0.5
    return int((found & wanted).sum()) / max(int((found | wanted).sum()), 1)


Agreement = Callable[[torch.Tensor, torch.Tensor], float]
