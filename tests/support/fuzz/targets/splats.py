"""Splat files."""

from pathlib import Path

import torch

from splatseg.io.splats import read_splats, write_splats
from support.fuzz.targets.base import GOLDEN, Target, gaussians, target, whole


def _splats(name: str, source: str) -> None:
    @target(name)
    def make(folder: Path) -> Target:
        file = folder / f"a{''.join(Path(source).suffixes[-1:])}"
        return whole(file, (GOLDEN / source).read_bytes(), read_splats)


_splats("compressed.ply", "splats/three.compressed.ply")
_splats("splat", "splats/three.splat")
_splats("ksplat", "splats/three.ksplat")
_splats("ksplat-2", "tools/ring.2.ksplat")
_splats("spz-2", "splats/three.v2.spz")
_splats("spz-3", "splats/three.v3.spz")
_splats("spz-4", "splats/three.v4.spz")
_splats("sog-1", "splats/three.v1.sog")
_splats("sog-2", "splats/three.v2.sog")
_splats("gltf", "splats/three.draft.gltf")
_splats("glb", "splats/three.glb")


@target("ply")
def ply(folder: Path) -> Target:
    """With extra columns and the comments that go with them."""
    file = folder / "a.ply"
    extra = {"kind": torch.arange(4), "feature": torch.ones(4, 2)}
    write_splats(gaussians().replace(extra=extra, antialiased=True, low_pass=0.1), file)
    return Target(file=file, read=lambda: read_splats(file))


@target("sog-meta")
def sog_meta(folder: Path) -> Target:
    """The meta.json of an unbundled SOG."""
    import zipfile

    with zipfile.ZipFile(GOLDEN / "splats/three.v2.sog") as archive:
        archive.extractall(folder)
    return Target(file=folder / "meta.json", read=lambda: read_splats(folder))
