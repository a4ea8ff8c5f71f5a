"""A scene that is asked for names of classes; what benchmarks of words share."""

import json
import shutil
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from PIL import Image
from scored import ScoredScene
from torch import Tensor

from splatseg.core import UNLABELLED, Features, Labels, Layer, VoxelFeatures
from splatseg.io.scene import load_scene_layer
from splatseg.lift import complete
from splatseg.lift.label_maps import label_map
from splatseg.lift.vocabulary import Vocabulary
from splatseg.lift.words import WordIndex
from splatseg.methods.voxels.words import VoxelWords
from splatseg.tasks import QueryOptions, QuerySession

PAPER_CLASSES = (
    "chair", "cabinet", "window", "wall", "door", "keyboard", "ceiling", "floor", "table",
    "laptop", "paper", "lamp", "monitor",
)  # fmt: skip
"""The 13 of the voxel paper's table; its light is lamp in the scenes here."""


class WordScene(ScoredScene):
    """A scene, its classes, and label maps by their names."""

    @cached_property
    def classes(self) -> list[dict[str, Any]]:
        """All that a scene might have, those that are there marked."""
        return json.loads((self.data / "metadata.json").read_text())["classes"]

    @property
    def names(self) -> list[str]:
        """Of the classes that are there."""
        return [row["name"] for row in self.classes if row["present"]]

    @cached_property
    def vocabulary(self) -> Vocabulary:
        """Words of the recorded features."""
        return self.session(self.features("objects")).index.vocabulary

    def layer(self, name: str) -> Layer:
        """A layer of the scene."""
        return load_scene_layer(self.scene.root or Path(), name)

    def features(self, name: str) -> Features:
        """A layer of features."""
        layer = self.layer(name)
        if not isinstance(layer, Features):
            raise TypeError(f"{name}: expected features.")
        return layer

    def voxels(self, name: str) -> VoxelFeatures:
        """A layer of voxels."""
        layer = self.layer(name)
        if not isinstance(layer, VoxelFeatures):
            raise TypeError(f"{name}: expected voxels.")
        return layer

    def session(
        self, layer: Features | VoxelFeatures, *, phrases: Literal["parts", "whole"] = "parts"
    ) -> QuerySession:
        """To be asked for the likeliest word of each Gaussian."""
        options = QueryOptions(
            from_layer="asked", every=True, features="features_text", phrases=phrases
        )
        return QuerySession(self.scene, options=options, layers={"asked": layer})

    def asking(self, layer: Features) -> QuerySession:
        """To be asked which things answer, as `splatseg query` does."""
        options = QueryOptions(from_layer="asked", features="features_text")
        return QuerySession(self.scene, options=options, layers={"asked": layer})

    def instances(self, index: WordIndex | VoxelWords) -> list[int]:
        """The true instance that most pixels of each thing show, in every fourth train view."""
        if isinstance(index, VoxelWords):
            raise TypeError("index: expected things.")
        known = (index.rows >= 0).float()
        things = Labels(ids=index.rows.int(), confidence=known)
        counts = np.zeros((len(index), 1 << 12), np.int64)
        for view in self.scene.train_views[::4]:
            drawn = label_map(self.scene.gaussians, view.camera, things).ids.numpy()
            truth = np.asarray(Image.open(self.data / "instance" / f"{view.name}.png"))
            seen = drawn >= 0
            np.add.at(counts, (drawn[seen], truth[seen].astype(np.int64)), 1)
        return (counts[:, 1:].argmax(axis=1) + 1).tolist()

    def means(self, own: Features, rows: Tensor) -> Features:
        """Mean features of sets of Gaussians, each given to its Gaussians.

        Args:
            own: Of each Gaussian, weighted.
            rows: The set of each, -1 for none.
        """
        if own.weights is None:
            raise TypeError("features: expected weights.")
        there = torch.nonzero(rows >= 0).squeeze(1)
        sums = torch.zeros(int(rows.max()) + 1, own.values.shape[1] + 1, dtype=torch.float64)
        weighted = torch.cat((own.values * own.weights[:, None], own.weights[:, None]), dim=1)
        sums.index_add_(0, rows[there], weighted[there].double())
        mean = (sums[:, :-1] / sums[:, -1:].clamp_min(1e-12)).float()
        values = torch.where((rows >= 0)[:, None], mean[rows.clamp_min(0)], 0.0)
        return replace(own, values=values)

    def scored(
        self, row: str, found: Tensor, known: Tensor, names: Sequence[str], *, others: bool = True
    ) -> dict[str, float]:
        """Print mIoU and the rest; Gaussians that nothing is known of are labelled by neighbours.

        Args:
            row: What is printed before.
            found: (n, k) numbers of each Gaussian, the largest of which decides.
            known: (n,) whether they say anything.
            names: The k words.
            others: Whether pixels of other classes count, or are left out.
        """
        by_name = {one["name"]: one["id"] for one in self.classes}
        ids = torch.tensor([by_name[name] for name in names])[found.argmax(dim=1)]
        labels = Labels(ids=torch.where(known, ids, UNLABELLED).int(), confidence=known.float())
        whole = complete(self.scene.gaussians, labels)
        drawn = self.draw(whole, row.replace(" ", "_"))
        truth = "semantic" if others else self._alone(frozenset(by_name[name] for name in names))
        said = self.score("semantic", [drawn], truth)
        print(row, {k: round(v, 4) for k, v in said.items() if isinstance(v, float)}, flush=True)
        return said

    def _alone(self, ids: frozenset[int]) -> str:
        """Truth with the pixels of other classes left out: a folder, as `score` takes it."""
        folder = self.work / f"truth_{len(ids)}"
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        for path in sorted((self.data / "semantic").glob("*.png")):
            truth = np.array(Image.open(path))
            kept = np.where(np.isin(truth, list(ids)), truth, 0).astype(np.uint16)
            Image.fromarray(kept).save(folder / path.name)
        return str(folder.resolve())
