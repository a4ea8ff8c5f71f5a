"""Ways to keep features of words at equal storage: accuracy, bytes, milliseconds of a query.

    python benchmarks/word_storage.py SCENE ../shared/data/office --budgets 3.5 7 36 70 500

SCENE has the layers `objects`, `voxels` and `features_text` that `benchmarks/words.py` takes. Each
way is given the finest setting that stays within a budget (MB, all that a query reads: rows,
codebooks, bases, decoders, and 4 bytes a Gaussian for the number of its row where rows are shared):

- `gaussians`: 512 numbers of each Gaussian, float16 or int8.
- `pca`: their first principal components, float16. `product`: product quantisation of them.
- `autoencoder`: LangSplat's (Qin et al. 2024): an MLP of their widths trained on the scene's
  features, whose code each Gaussian keeps in float16; its decoder runs before a query.
- `voxels`: float16, int8 or product quantisation of voxels.
- `means`: over the instances of `associate`; `objects`: solved for all of them together.

Recorded features have 24 components, which compress without any loss. So every row is printed
without and with noise of full rank: each Gaussian's feature, 512 numbers, gets a normal vector of
its own, as long as `--noise` says in shares of the feature's length, before anything is averaged or
compressed; a voxel and an object get the mean of their Gaussians' noise.

`mIoU` is that of names of classes on test views by ../shared/score/score.py, by plain cosines and
in the span as `query --every` asks; `open` the seconds before the first query, `query ms` the
median of 9 queries of one word, to the probability of each Gaussian.
"""

import argparse
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn
from word_scene import WordScene

from splatseg.core.voxels import StoredTable
from splatseg.io.scene import load_scene
from splatseg.lift.vocabulary import TextSpace
from splatseg.methods.voxels.words import TableWords, store

_CHUNK = 16_384
_SAMPLE = 32_768
_WIDTH = 512
_CODEBOOKS = 256 * _WIDTH * 4
_ENCODER, _DECODER = (256, 128, 64, 32), (16, 32, 64, 128, 256, 256)
"""Widths of LangSplat's autoencoder, for codes of 3."""
_AUTOENCODER_STEPS = 1000


@dataclass(frozen=True, kw_only=True)
class Kept:
    """Features as they are kept."""

    table: StoredTable
    extra: int = 0
    """Bytes of a basis or a decoder."""
    space: TextSpace = field(default_factory=lambda: TextSpace(width=_WIDTH))
    decoder: Callable[[Tensor], Tensor] | None = None
    setting: str = ""


@dataclass(frozen=True, kw_only=True)
class Rows:
    """Features of 512 numbers, a row a thing, and the row of each Gaussian (None: its own)."""

    values: Tensor
    weights: Tensor
    of_gaussian: Tensor | None = None

    @property
    def numbering(self) -> int:
        """Bytes of the numbers of rows."""
        return 0 if self.of_gaussian is None else 4 * len(self.of_gaussian)


def noisy(clean: Tensor, of_gaussian: Tensor | None, level: float, seed: int = 0) -> Tensor:
    """Rows with the mean noise of their Gaussians, (m, 512) float16."""
    sums = torch.zeros(len(clean), _WIDTH) if of_gaussian is not None else None
    counts = torch.zeros(len(clean))
    out = torch.empty(len(clean), _WIDTH, dtype=torch.float16)
    generator = torch.Generator().manual_seed(seed)
    count = len(clean) if of_gaussian is None else len(of_gaussian)
    for start in range(0, count, _CHUNK):
        part = slice(start, min(start + _CHUNK, count))
        noise = torch.randn(part.stop - start, _WIDTH, generator=generator) * (level / _WIDTH**0.5)
        if of_gaussian is None or sums is None:
            lengths = clean[part].float().norm(dim=1, keepdim=True)
            out[part] = (clean[part].float() + noise * lengths).half()
            continue
        there = torch.nonzero(of_gaussian[part] >= 0).squeeze(1)
        sums.index_add_(0, of_gaussian[part][there], noise[there])
        counts.index_add_(0, of_gaussian[part][there], torch.ones(len(there)))
    if sums is not None:
        lengths = clean.float().norm(dim=1, keepdim=True)
        out = (clean.float() + lengths * sums / counts.clamp_min(1)[:, None]).half()
    return out


def expanded(values: Tensor, space: TextSpace) -> Tensor:
    """(m, 512) float16 of components; rows of zeros stay so."""
    parts = [
        torch.where(part.abs().amax(dim=1, keepdim=True) > 0, space.expand(part.float()), 0.0)
        for part in values.split(_CHUNK)
    ]
    return torch.cat([part.half() for part in parts])


def sources(bench: WordScene, level: float) -> dict[str, Rows]:
    """What each way begins with."""
    space = bench.vocabulary.space
    own, objects, voxels = (
        bench.features("features_text"), bench.features("objects"), bench.voxels("voxels"),
    )  # fmt: skip
    index = bench.session(objects).index
    read = voxels.rows[:, 0].long()
    of_object = index.rows
    means = bench.means(own, of_object).values
    first = torch.zeros(len(index), dtype=torch.int64)
    first[of_object[of_object >= 0]] = torch.nonzero(of_object >= 0).squeeze(1)
    weights = own.weights if own.weights is not None else torch.ones(len(own.values))
    rows = {
        "gaussians": (own.values, weights, None),
        "voxels": (voxels.table.decode(), voxels.weights, read),
        "means": (means[first], index.weights, of_object),
        "objects": (index.values, index.weights, of_object),
    }
    return {
        name: Rows(
            values=noisy(expanded(values, space), of_gaussian, level),
            weights=weighed.float(),
            of_gaussian=of_gaussian,
        )
        for name, (values, weighed, of_gaussian) in rows.items()
    }


def plain(rows: Rows, budget: int, *, product: bool = False) -> Kept | None:
    """float16, int8, or with `product` the most parts that fit."""
    count, rest = len(rows.values), budget - rows.numbering
    if count * _WIDTH * 2 <= rest:
        return Kept(table=StoredTable(codes=rows.values), setting="float16")
    if count * (_WIDTH + 4) <= rest:
        return Kept(table=store(rows.values.float(), precision="int8"), setting="int8")
    return quantised(rows, budget) if product else None


def quantised(rows: Rows, budget: int) -> Kept | None:
    """Product quantisation of the most parts that fit."""
    rest = budget - rows.numbering - _CODEBOOKS
    parts = next((one for one in (256, 128, 64, 32, 16, 8, 4) if len(rows.values) * one <= rest), 0)
    if not parts:
        return None
    table = store(rows.values.float(), precision="product", parts=parts)
    return Kept(table=table, setting=f"{parts} parts")


def principal(rows: Rows, budget: int) -> Kept | None:
    """The first components that fit, float16."""
    count = (budget - 4 * _WIDTH) // (2 * len(rows.values) + 4 * _WIDTH)
    count = min(int(count), 128)
    if count < 1:
        return None
    sample = _sample(rows)
    mean = sample.mean(dim=0)
    basis = torch.linalg.svd(sample - mean, full_matrices=False).Vh[:count].contiguous()
    parts = [(part.float() - mean) @ basis.T for part in rows.values.split(_CHUNK)]
    known = _known(rows)
    codes = torch.where(known[:, None], torch.cat(parts), 0.0).half()
    return Kept(
        table=StoredTable(codes=codes),
        extra=basis.nbytes + mean.nbytes,
        space=TextSpace(width=_WIDTH, basis=basis, mean=mean),
        setting=f"{count} components",
    )


def autoencoded(rows: Rows, budget: int) -> Kept | None:
    """LangSplat's autoencoder with the longest code that fits, 16 at most."""
    widths = (*_DECODER, _WIDTH)
    decoder_bytes = 4 * sum((a + 1) * b for a, b in pairwise((16, *widths)))
    count = min(int((budget - decoder_bytes) // (2 * len(rows.values))), 16)
    if count < 3:
        return None
    torch.manual_seed(0)
    encoder, decoder = _mlp((_WIDTH, *_ENCODER, count), norm=True), _mlp((count, *widths))
    sample = nn.functional.normalize(_sample(rows), dim=1)
    both = nn.ModuleList((encoder, decoder))
    optimizer = torch.optim.Adam(both.parameters(), lr=2e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, _AUTOENCODER_STEPS)
    for _ in range(_AUTOENCODER_STEPS):
        batch = sample[torch.randint(len(sample), (256,))]
        found = decoder(encoder(batch))
        cosine = 1 - nn.functional.cosine_similarity(found, batch).mean()
        loss = (found - batch).square().sum(dim=1).mean() + 0.001 * cosine
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    both.eval()
    with torch.no_grad():
        codes = torch.cat(
            [encoder(nn.functional.normalize(part.float(), dim=1)) for part in
             rows.values.split(_CHUNK)]
        )  # fmt: skip
    codes = torch.where(_known(rows)[:, None], codes, 0.0).half()

    def decode(values: Tensor) -> Tensor:
        with torch.no_grad():
            return decoder(values)

    return Kept(
        table=StoredTable(codes=codes), extra=decoder_bytes, decoder=decode,
        setting=f"codes of {count}",
    )  # fmt: skip


def _mlp(widths: tuple[int, ...], *, norm: bool = False) -> nn.Sequential:
    layers: list[nn.Module] = [nn.Linear(widths[0], widths[1])]
    for inside, outside in pairwise(widths[1:]):
        layers += [nn.BatchNorm1d(inside)] if norm else []
        layers += [nn.ReLU(), nn.Linear(inside, outside)]
    return nn.Sequential(*layers)


def _known(rows: Rows) -> Tensor:
    return torch.cat([part.abs().amax(dim=1) > 0 for part in rows.values.split(_CHUNK)])


def _sample(rows: Rows) -> Tensor:
    known = torch.nonzero(_known(rows)).squeeze(1)
    chosen = known[torch.linspace(0, len(known) - 1, min(_SAMPLE, len(known))).long()]
    return rows.values[chosen].float()


_WAYS: dict[str, tuple[str, Callable[[Rows, int], Kept | None]]] = {
    "gaussians": ("gaussians", plain),
    "pca": ("gaussians", principal),
    "product": ("gaussians", quantised),
    "autoencoder": ("gaussians", autoencoded),
    "voxels": ("voxels", lambda rows, budget: plain(rows, budget, product=True)),
    "means": ("means", plain),
    "objects": ("objects", plain),
}


def measured(bench: WordScene, name: str, rows: Rows, kept: Kept) -> None:
    """Accuracy, bytes and times of one way."""
    vocabulary = replace(bench.vocabulary, space=kept.space)

    def opened(components: int | None) -> TableWords:
        return TableWords(
            kept.table, rows.weights, vocabulary, components=components, last_layers=kept.decoder
        )

    scores: list[float] = []
    for components in (None, 32):
        began = time.perf_counter()
        asked = opened(components)
        opening = time.perf_counter() - began
        found = _on_gaussians(asked.cosines(vocabulary.vectors(bench.names)), rows)
        known = found.abs().amax(dim=1) > 0
        scores.append(bench.scored(f"  {name} {components}", found, known, bench.names)["mIoU"])
    asked = opened(32)
    milliseconds = list(_queries(bench, asked, rows))
    size = kept.table.nbytes + kept.extra + rows.numbering
    print(
        f"| {name} | {kept.setting} | {size / 1e6:.1f} MB | {scores[0]:.3f} | {scores[1]:.3f} | "
        f"{opening:.1f} s | {np.median(milliseconds):.1f} ms |",
        flush=True,
    )


def _queries(bench: WordScene, asked: TableWords, rows: Rows) -> Iterator[float]:
    asked.ask(bench.names[:1])
    for turn in range(9):
        began = time.perf_counter()
        _on_gaussians(asked.ask([bench.names[turn % len(bench.names)]]).probabilities, rows)
        yield 1000 * (time.perf_counter() - began)


def _on_gaussians(found: Tensor, rows: Rows) -> Tensor:
    if rows.of_gaussian is None:
        return found
    padded = torch.cat((found, found.new_zeros(1, found.shape[1])))
    return padded[rows.of_gaussian]


def main() -> None:
    """Print a table for each level of noise."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scene", type=Path)
    parser.add_argument("data", type=Path)
    parser.add_argument("--budgets", nargs="+", type=float, default=[3.5, 7, 36, 70, 500])
    parser.add_argument("--noise", nargs="+", type=float, default=[0.0, 0.5])
    parser.add_argument("--ways", nargs="+", choices=list(_WAYS), default=list(_WAYS))
    arguments = parser.parse_args()
    for level in arguments.noise:
        with tempfile.TemporaryDirectory() as work:
            bench = WordScene(load_scene(arguments.scene), arguments.data, Path(work))
            rows = sources(bench, level)
            print(f"noise of {level:g} of the length", flush=True)
            done: set[tuple[str, str]] = set()
            for budget in arguments.budgets:
                for name in arguments.ways:
                    source, way = _WAYS[name]
                    kept = way(rows[source], int(1e6 * budget))
                    if kept is not None and (name, kept.setting) not in done:
                        done.add((name, kept.setting))
                        measured(bench, name, rows[source], kept)


if __name__ == "__main__":
    main()
