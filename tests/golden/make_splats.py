"""Make the golden splat files: the same three Gaussians in every layout that is read.

    python tests/golden/make_splats.py

Written with struct and plain loops, number by number, and without splatseg: it is a second
reading of docs/formats/splats.md. Needs Pillow and zstandard. Files are made once per
version of a layout and then stay; this script says how.
"""

import base64
import gzip
import io
import json
import math
import struct
import zipfile
from pathlib import Path

import zstandard
from PIL import Image

FOLDER = Path(__file__).parent / "splats"
C0 = 0.28209479177387814

SCENE = [
    {
        "mean": (1.0, -2.0, 3.0),
        "log_scale": (-1.0, -2.0, -3.0),
        "opacity": 51 / 255,
        "rotation": (1.0, 0.0, 0.0, 0.0),
        "sh": ((0.5, -1.0, 0.25), (0.125, -0.25, 0.5), (-0.5, 0.25, -0.125), (0.0, 0.75, -0.75)),
    },
    {
        "mean": (-0.5, 0.25, 10.0),
        "log_scale": (0.0, -4.0, 1.5),
        "opacity": 153 / 255,
        "rotation": (0.5, 0.5, -0.5, 0.5),
        "sh": ((0.0, 1.0, -0.25), (0.25, 0.5, -0.5), (0.375, -0.625, 0.5), (-0.25, 0.0, 0.125)),
    },
    {
        "mean": (0.0, 0.0, 0.0),
        "log_scale": (-9.5, -5.0, -0.25),
        "opacity": 204 / 255,
        "rotation": (0.0, 0.6, 0.0, -0.8),
        "sh": ((-1.5, 0.75, 1.25), (0.0, 0.0, 0.0), (0.5, 0.5, 0.5), (-0.5, -0.25, 0.625)),
    },
]
CLASS_ID = (7, 4000000000, 0)  # uint32
WEIGHT = (0.5, -1.25, 3.0)  # float32
AXIS_FLIP = (1, -1, -1)
HARMONIC_FLIP = (-1, -1, 1)  # of degree 1, when y and z change sign


def logit(p):
    return math.log(p / (1 - p))


def byte(x):
    return max(0, min(255, math.floor(x + 0.5)))


def ply():
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    names += [f"f_rest_{i}" for i in range(9)] + ["opacity"]
    names += [f"scale_{i}" for i in range(3)] + [f"rot_{i}" for i in range(4)]
    head = ["ply", "format binary_little_endian 1.0", "comment a golden file", "element vertex 3"]
    head += [f"property float {name}" for name in names]
    head += ["property uint class_id", "property float weight", "end_header\n"]
    body = b""
    for g, class_id, weight in zip(SCENE, CLASS_ID, WEIGHT, strict=True):
        row = [*g["mean"], 0, 0, 0, *g["sh"][0]]
        row += [g["sh"][1 + k][c] for c in range(3) for k in range(3)]  # channel by channel
        row += [logit(g["opacity"]), *g["log_scale"], *g["rotation"]]
        body += struct.pack(f"<{len(row)}fIf", *row, class_id, weight)
    return "\n".join(head).encode() + body


def smallest_three(q, signed):
    """The 32-bit word of a quaternion: SuperSplat's (wxyz) or SPZ's signed one (xyzw)."""
    if signed:
        q = (*q[1:], q[0])
    largest = max(range(4), key=lambda i: abs(q[i]))
    sign = 1 if q[largest] > 0 else -1
    word = largest
    for i in range(4):
        if i == largest:
            continue
        value = q[i] * sign
        if signed:
            size = math.floor(abs(value) * math.sqrt(2) * 511 + 0.5)
            word = word << 10 | (512 if value < 0 else 0) | size
        else:
            word = word << 10 | math.floor((value / math.sqrt(2) + 0.5) * 1023 + 0.5)
    return word


def pack_111011(share):
    x, y, z = share
    return (
        math.floor(x * 2047 + 0.5) << 21
        | math.floor(y * 1023 + 0.5) << 11
        | math.floor(z * 2047 + 0.5)
    )


def share(value, low, high):
    return [(v - a) / (b - a) for v, a, b in zip(value, low, high, strict=True)]


def compressed_ply():
    def bounds(rows):
        return [min(c) for c in zip(*rows, strict=True)], [max(c) for c in zip(*rows, strict=True)]

    colours = [[0.5 + C0 * v for v in g["sh"][0]] for g in SCENE]
    position = bounds([g["mean"] for g in SCENE])
    scale = bounds([g["log_scale"] for g in SCENE])
    colour = bounds(colours)
    ends = [value for pair in (position, scale, colour) for end in pair for value in end]
    chunk = struct.pack("<18f", *ends)
    vertices, harmonics = b"", b""
    for g, rgb in zip(SCENE, colours, strict=True):
        steps = [byte(255 * v) for v in share(rgb, *colour)]
        packed_colour = steps[0] << 24 | steps[1] << 16 | steps[2] << 8 | byte(g["opacity"] * 255)
        vertices += struct.pack(
            "<4I",
            pack_111011(share(g["mean"], *position)),
            smallest_three(g["rotation"], signed=False),
            pack_111011(share(g["log_scale"], *scale)),
            packed_colour,
        )
        harmonics += bytes(
            math.floor((g["sh"][1 + k][c] / 8 + 0.5) * 256) for c in range(3) for k in range(3)
        )
    head = ["ply", "format binary_little_endian 1.0", "element chunk 1"]
    for what in ("", "scale_"):
        head += [f"property float {end}_{what}{a}" for end in ("min", "max") for a in "xyz"]
    head += [f"property float {end}_{a}" for end in ("min", "max") for a in "rgb"]
    head += ["element vertex 3"]
    head += [f"property uint packed_{n}" for n in ("position", "rotation", "scale", "color")]
    head += ["element sh 3", *(f"property uchar f_rest_{i}" for i in range(9)), "end_header\n"]
    return "\n".join(head).encode() + chunk + vertices + harmonics


def splat():
    data = b""
    for g in SCENE:
        rgba = [byte((0.5 + C0 * v) * 255) for v in g["sh"][0]] + [byte(g["opacity"] * 255)]
        rotation = [byte(128 + 128 * v) for v in g["rotation"]]
        scales = [math.exp(v) for v in g["log_scale"]]
        data += struct.pack("<6f8B", *g["mean"], *scales, *rgba, *rotation)
    return data


def ksplat():
    """Level 2, degree 1: a section of a full bucket of one row and of a bucket of one more, and
    a section with room for a row that is not there."""
    low, high, edge, steps = -1.0, 1.0, 8.0, 32767

    def row(g, centre):
        place = [
            math.floor((x - c) / (edge / 2 / steps) + steps + 0.5)
            for x, c in zip(g["mean"], centre, strict=True)
        ]
        rgba = [byte((0.5 + C0 * v) * 255) for v in g["sh"][0]] + [byte(g["opacity"] * 255)]
        rest = [
            byte((g["sh"][1 + k][c] - low) / (high - low) * 255) for c in range(3) for k in range(3)
        ]
        scales = [math.exp(v) for v in g["log_scale"]]
        return struct.pack("<3H7e13B", *place, *scales, *g["rotation"], *rgba, *rest)

    def section(count, room, full, lengths, centres, rows):
        buckets = full + len(lengths)
        head = struct.pack("<4IfHxx", count, room, 1, buckets, edge, 12)
        head += struct.pack("<4IH", steps, 0, full, len(lengths), 1)
        flat = [x for centre in centres for x in centre]
        body = struct.pack(f"<{len(lengths)}I{len(flat)}f", *lengths, *flat)
        return head.ljust(1024, b"\0"), body + b"".join(rows)

    centres = [(1.0, -1.0, 4.0), (0.0, 0.0, 8.0)]
    rows = [row(g, centre) for g, centre in zip(SCENE, centres, strict=False)]
    first = section(2, 2, 1, [1], centres, rows)
    last = [row(SCENE[2], (2.0, 2.0, 2.0)), b"\xff" * 33]
    second = section(1, 2, 0, [1], [(2.0, 2.0, 2.0)], last)
    head = struct.pack("<4B4IHxx3f2f", 0, 1, 0, 0, 2, 2, 4, 3, 2, 0, 0, 0, low, high)
    return head.ljust(4096, b"\0") + first[0] + second[0] + first[1] + second[1]


def spz_streams(version, bits):
    positions, opacities, colours, scales, rotations, harmonics = (b"" for _ in range(6))
    for g in SCENE:
        for value, sign in zip(g["mean"], AXIS_FLIP, strict=True):
            positions += struct.pack("<i", round(value * sign * 2**bits))[:3]
        opacities += bytes([byte(g["opacity"] * 255)])
        colours += bytes(byte((0.5 + 0.15 * v) * 255) for v in g["sh"][0])
        scales += bytes(byte((v + 10) * 16) for v in g["log_scale"])
        w, x, y, z = g["rotation"]
        y, z = -y, -z
        if version == 2:
            sign = -1 if w < 0 else 1
            rotations += bytes(byte(v * sign * 127.5 + 127.5) for v in (x, y, z))
        else:
            rotations += struct.pack("<I", smallest_three((w, x, y, z), signed=True))
        for k in range(3):
            harmonics += bytes(byte(v * HARMONIC_FLIP[k] * 128 + 128) for v in g["sh"][1 + k])
    return [positions, opacities, colours, scales, rotations, harmonics]


def spz_gzip(version):
    head = struct.pack("<4sIIBBBB", b"NGSP", version, 3, 1, 12, 0, 0)
    return gzip.compress(head + b"".join(spz_streams(version, 12)), mtime=0)


def spz_4():
    """With an extension record between header and table, which readers must step over."""
    streams = spz_streams(4, 16)
    frames = [zstandard.ZstdCompressor().compress(stream) for stream in streams]
    extension = struct.pack("<II", 0x12340001, 4) + b"skip"
    head = struct.pack("<4sIIBBBB", b"NGSP", 4, 3, 1, 16, 2, len(streams))
    head += struct.pack("<I12x", 32 + len(extension)) + extension
    for frame, stream in zip(frames, streams, strict=True):
        head += struct.pack("<QQ", len(frame), len(stream))
    return head + b"".join(frames)


def webp(rows, size):
    """A lossless image of RGBA pixels, filled up with zeros."""
    width, height = size
    pixels = b"".join(bytes(row) for row in rows).ljust(4 * width * height, b"\0")
    buffer = io.BytesIO()
    image = Image.frombytes("RGBA", size, pixels)
    image.save(buffer, "WEBP", lossless=True, exact=True)
    return buffer.getvalue()


def pad(book):
    return book + [book[-1]] * (256 - len(book))


def sog(version):
    """The members of a SOG bundle; every value has its own place in the codebooks."""
    logs = [[math.copysign(math.log1p(abs(v)), v) for v in g["mean"]] for g in SCENE]
    low, high = [min(c) for c in zip(*logs, strict=True)], [max(c) for c in zip(*logs, strict=True)]
    steps = [[math.floor(s * 65535 + 0.5) for s in share(row, low, high)] for row in logs]
    rotations = []
    for g in SCENE:
        q = g["rotation"]
        largest = max(range(4), key=lambda i: abs(q[i]))
        sign = 1 if q[largest] > 0 else -1
        three = [byte((q[i] * sign / math.sqrt(2) + 0.5) * 255) for i in range(4) if i != largest]
        rotations.append([*three, 252 + largest])
    meta = {
        "means": {"mins": low, "maxs": high, "files": ["means_l.webp", "means_u.webp"]},
        "quats": {"files": ["quats.webp"]},
    }
    palette = [g["sh"][1:] for g in SCENE]
    numbers = sorted({v for entry in palette for row in entry for v in row})
    if version == 2:
        meta = {"version": 2, "count": 3, **meta}
        scale_book = sorted({v for g in SCENE for v in g["log_scale"]})
        colour_book = sorted({v for g in SCENE for v in g["sh"][0]})
        meta["scales"] = {"codebook": pad(scale_book), "files": ["scales.webp"]}
        meta["sh0"] = {"codebook": pad(colour_book), "files": ["sh0.webp"]}
        meta["shN"] = {"count": 3, "bands": 1, "codebook": pad(numbers)}
        scales = [[*(scale_book.index(v) for v in g["log_scale"]), 255] for g in SCENE]
        sh0 = [
            [*(colour_book.index(v) for v in g["sh"][0]), byte(g["opacity"] * 255)] for g in SCENE
        ]
        of_number = {v: i for i, v in enumerate(numbers)}
    else:
        meta["means"] |= {"shape": [3, 3], "dtype": "float32"}
        meta["quats"] |= {"shape": [3, 4], "dtype": "uint8", "encoding": "quaternion_packed"}
        meta["scales"] = {"shape": [3, 3], "mins": [-10, -5, -3], "maxs": [0, -2, 2]}
        meta["scales"]["files"] = ["scales.webp"]
        lows, highs = [-2, -1, -1, -4], [1, 1, 2, 4]  # the last is the opacity's logit
        meta["sh0"] = {"shape": [3, 1, 4], "mins": lows, "maxs": highs, "files": ["sh0.webp"]}
        meta["shN"] = {"shape": [3, 9], "mins": -1.0, "maxs": 1.0, "quantization": 8}
        scales = [
            [*(byte(255 * s) for s in share(g["log_scale"], [-10, -5, -3], [0, -2, 2])), 255]
            for g in SCENE
        ]
        sh0 = [
            [byte(255 * s) for s in share([*g["sh"][0], logit(g["opacity"])], lows, highs)]
            for g in SCENE
        ]
        of_number = {v: byte((v + 1) / 2 * 255) for v in numbers}
    meta["shN"]["files"] = ["shN_centroids.webp", "shN_labels.webp"]
    # The palette backwards, so that labels are not just row numbers.
    centroids = [[*(of_number[v] for v in row), 255] for entry in palette[::-1] for row in entry]
    return {
        "meta.json": json.dumps(meta).encode(),
        "means_l.webp": webp([[s & 255 for s in row] + [255] for row in steps], (4, 4)),
        "means_u.webp": webp([[s >> 8 for s in row] + [255] for row in steps], (4, 4)),
        "quats.webp": webp(rotations, (4, 4)),
        "scales.webp": webp(scales, (4, 4)),
        "sh0.webp": webp(sh0, (4, 4)),
        "shN_centroids.webp": webp(centroids, (192, 1)),
        "shN_labels.webp": webp([[2 - i, 0, 0, 255] for i in range(3)], (4, 4)),
    }


def bundle(members):
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive:
        for name, data in members.items():
            archive.writestr(zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0)), data)
    return buffer.getvalue()


def gltf(logs):
    """The JSON and the buffer, scales linear as ratified or logs as in drafts."""
    columns = {
        "POSITION": [g["mean"] for g in SCENE],
        "ROTATION": [(*g["rotation"][1:], g["rotation"][0]) for g in SCENE],
        "SCALE": [g["log_scale"] if logs else [math.exp(v) for v in g["log_scale"]] for g in SCENE],
        "OPACITY": [[g["opacity"]] for g in SCENE],
        "SH_DEGREE_0_COEF_0": [g["sh"][0] for g in SCENE],
    } | {f"SH_DEGREE_1_COEF_{k}": [g["sh"][1 + k] for g in SCENE] for k in range(3)}
    data, views, accessors, attributes = b"", [], [], {}
    for name, rows in columns.items():
        flat = [v for row in rows for v in row]
        kind = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}[len(rows[0])]
        views.append({"buffer": 0, "byteOffset": len(data), "byteLength": 4 * len(flat)})
        accessors.append(
            {"bufferView": len(views) - 1, "componentType": 5126, "count": 3, "type": kind}
        )
        data += struct.pack(f"<{len(flat)}f", *flat)
        full = name if name == "POSITION" else f"KHR_gaussian_splatting:{name}"
        attributes[full] = len(accessors) - 1
    extension = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    primitive = {"attributes": attributes, "mode": 0}
    primitive["extensions"] = {"KHR_gaussian_splatting": extension}
    document = {
        "asset": {"version": "2.0"},
        "extensionsUsed": ["KHR_gaussian_splatting"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "buffers": [{"byteLength": len(data)}],
        "bufferViews": views,
        "accessors": accessors,
    }
    return document, data


def glb():
    document, data = gltf(logs=False)
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    body = struct.pack("<II", len(text), 0x4E4F534A) + text
    body += struct.pack("<II", len(data), 0x004E4942) + data
    return struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body


def draft_gltf():
    document, data = gltf(logs=True)
    head = "data:application/octet-stream;base64,"
    document["buffers"][0]["uri"] = head + base64.b64encode(data).decode()
    return json.dumps(document, indent=1).encode()


def main():
    files = {
        "three.ply": ply(),
        "three.compressed.ply": compressed_ply(),
        "three.splat": splat(),
        "three.ksplat": ksplat(),
        "three.v2.spz": spz_gzip(2),
        "three.v3.spz": spz_gzip(3),
        "three.v4.spz": spz_4(),
        "three.v1.sog": bundle(sog(1)),
        "three.v2.sog": bundle(sog(2)),
        "three.glb": glb(),
        "three.draft.gltf": draft_gltf(),
        "three.json": json.dumps(SCENE, indent=1).encode(),
    }
    FOLDER.mkdir(exist_ok=True)
    for name, data in files.items():
        (FOLDER / name).write_bytes(data)


if __name__ == "__main__":
    main()
