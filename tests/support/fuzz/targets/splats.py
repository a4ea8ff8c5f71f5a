"""Splat files."""

import struct
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


def _foreign(head: str, rows: str) -> bytes:
    lines = [
        "ply",
        "format ascii 1.0",
        "element vertex 2",
        *(f"property {p}" for p in head.split(",")),
    ]
    return "\n".join([*lines, "end_header", *rows.split(","), ""]).encode()


@target("ply-ascii")
def ply_ascii(folder: Path) -> Target:
    """Lines of text, of every type of number, before a list."""
    head = "float x,double y,float z,float f_dc_0,float f_dc_1,float f_dc_2,float opacity,"
    head += "float scale_0,float scale_1,float scale_2,float rot_0,float rot_1,float rot_2,"
    head += "float rot_3,uchar kind,int count"
    content = _foreign(
        head, "0 1 2 .1 .2 .3 1 -4 -3 -2 1 0 0 0 7 -9,1e0 nan 2 1 2 3 inf -4 -inf -2 1 0 0 1 255 0"
    )
    face = b"element face 1\nproperty list uchar int vertex_indices\nend_header"
    return whole(folder / "a.ply", content.replace(b"end_header", face) + b"3 0 1 0\n", read_splats)


@target("ply-list-before")
def ply_list_before(folder: Path) -> Target:
    """Faces of two lengths before Gaussians, and harmonics of degree 4."""
    names = "x,y,z,f_dc_0,f_dc_1,f_dc_2,opacity,scale_0,scale_1,scale_2,rot_0,rot_1,rot_2,rot_3"
    names += "".join(f",f_rest_{i}" for i in range(72))
    count = names.count(",") + 1
    lines = ["ply", "format binary_little_endian 1.0", "comment SplatRenderMode: mip"]
    lines += ["element face 2", "property list uchar int ids", "element vertex 1"]
    lines += [*(f"property float {name}" for name in names.split(",")), "end_header", ""]
    faces = struct.pack("<B3iB2i", 3, 0, 1, 2, 2, 0, 1)
    body = struct.pack(f"<{count}f", *(0.5 + 0.01 * i for i in range(count)))
    return whole(folder / "a.ply", "\n".join(lines).encode() + faces + body, read_splats)


@target("ply-other-names")
def ply_other_names(folder: Path) -> Target:
    """Surfels with a filter, colours for harmonics, and no logs."""
    head = "float means_0,float means_1,float means_2,uchar red,uchar green,uchar blue,uchar alpha,"
    head += "float scales_0,float scales_1,float qw,float qx,float qy,float qz,float filter_3D"
    content = _foreign(head, "0 1 2 10 20 30 255 .1 .2 1 0 0 0 .05,1 1 1 0 0 0 0 .1 0 0 0 1 0 0")
    return whole(folder / "a.ply", content, lambda file: read_splats(file, linear=["scales"]))


@target("sog-meta")
def sog_meta(folder: Path) -> Target:
    """The meta.json of an unbundled SOG."""
    import zipfile

    with zipfile.ZipFile(GOLDEN / "splats/three.v2.sog") as archive:
        archive.extractall(folder)
    return Target(file=folder / "meta.json", read=lambda: read_splats(folder))
