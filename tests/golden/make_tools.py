"""Makes the splat files in tests/golden/tools with other programs, from one generated scene.

    npm install --ignore-scripts @playcanvas/splat-transform@2.7.1 \\
        @mkkellogg/gaussian-splats-3d@0.4.7 three@0.187.0              (in any folder F)
    python tests/golden/make_tools.py F

Needs gsplat==1.5.3 and numpy. gsplat writes a PLY, a .splat and a compressed PLY; of that PLY
PlayCanvas's splat-transform makes the others, and GaussianSplats3D the .ksplat files. splatseg is
not used. ring.npz has what went in; versions.json the programs. A test makes gsplat's files again
and compares the bytes.
"""

import json
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import numpy as np
import torch
from gsplat.exporter import export_splats

FOLDER = Path(__file__).parent / "tools"
COUNT = 600
GSPLAT = {"ring.ply": "ply", "ring.splat": "splat", "ring.gsplat.compressed.ply": "ply_compressed"}
TRANSFORMED: dict[str, tuple[str, ...]] = {
    "ring.compressed.ply": (),
    "ring.spz": (),
    "ring.v3.spz": ("--spz-version", "3"),
    "ring.sog": ("--max-workers", "0"),
    "ring.glb": (),
}

KSPLAT = {"ring.0.ksplat": 0, "ring.1.ksplat": 1, "ring.2.ksplat": 2}
"""Compression level by file."""

WRITE_KSPLAT = """
globalThis.window = globalThis;  // it is made for browsers
const { PlyLoader } = await import("@mkkellogg/gaussian-splats-3d");
const fs = await import("fs");
const [source, target, level] = process.argv.slice(1);
const file = fs.readFileSync(source);
const bytes = file.buffer.slice(file.byteOffset, file.byteOffset + file.byteLength);
const made = await PlyLoader.loadFromFileData(bytes, 0, Number(level), true, 2);
fs.writeFileSync(target, Buffer.from(made.bufferData));
"""


def ring() -> dict[str, np.ndarray]:
    """Flat Gaussians on a torus that lies tilted, coloured by where they are; harmonics of 20
    kinds, because SOG keeps a palette of them."""
    rng = np.random.default_rng(11)
    around, across = rng.uniform(0, 2 * np.pi, (2, COUNT))
    radius = 2 + 0.7 * np.cos(across)
    means = np.stack([radius * np.cos(around), 0.7 * np.sin(across), radius * np.sin(around)], 1)
    means[:, 1] += 0.3 * means[:, 0]
    rotations = rng.normal(size=(COUNT, 4))
    kinds = rng.uniform(-0.4, 0.4, (20, 8, 3))
    return {
        "means": means.astype(np.float32),
        "log_scales": rng.uniform((-4, -4, -7), (-2, -2, -5), (COUNT, 3)).astype(np.float32),
        "rotations": (rotations / np.linalg.norm(rotations, axis=1)[:, None]).astype(np.float32),
        "logits": rng.uniform(-3, 5, COUNT).astype(np.float32),
        "sh0": (means / 2.7 + rng.normal(0, 0.1, (COUNT, 3))).astype(np.float32)[:, None],
        "shN": kinds[rng.integers(0, 20, COUNT)].astype(np.float32),
    }


def write_with_gsplat(folder: Path) -> None:
    arrays = {name: torch.from_numpy(value) for name, value in ring().items()}
    for name, layout in GSPLAT.items():
        export_splats(
            arrays["means"], arrays["log_scales"], arrays["rotations"], arrays["logits"],
            arrays["sh0"], arrays["shN"], format=layout, save_to=str(folder / name),
        )  # fmt: skip


def main() -> None:
    modules = Path(sys.argv[1]) / "node_modules"
    installed = modules / "@playcanvas" / "splat-transform"
    FOLDER.mkdir(exist_ok=True)
    np.savez_compressed(FOLDER / "ring.npz", **ring())
    write_with_gsplat(FOLDER)
    for name, options in TRANSFORMED.items():
        command = ["node", str(installed / "bin" / "cli.mjs"), "-q", "-w", "-g", "cpu", *options]
        subprocess.run([*command, str(FOLDER / "ring.ply"), str(FOLDER / name)], check=True)
    for name, level in KSPLAT.items():
        command = ["node", "--input-type=module", "-e", WRITE_KSPLAT]
        files = [str((FOLDER / file).resolve()) for file in ("ring.ply", name)]
        subprocess.run([*command, *files, str(level)], check=True, cwd=sys.argv[1])
    versions = {"gsplat": version("gsplat")}
    for folder in (installed, modules / "@mkkellogg" / "gaussian-splats-3d"):
        package = json.loads((folder / "package.json").read_text())
        versions[package["name"]] = package["version"]
    (FOLDER / "versions.json").write_text(json.dumps(versions, indent=1) + "\n")


if __name__ == "__main__":
    main()
