"""No family of networks lets its weights call the package kernels, which fetches and runs code."""

import json
import os
import subprocess
import sys
from pathlib import Path

import support
from support.networks import KINDS, checkpoint

FAKE = """
from pathlib import Path

CALLS = Path(__file__).with_name("calls")

def __getattr__(name):
    if name.startswith("__"):
        raise AttributeError(name)
    def called(*words, **more):
        CALLS.open("a").write(name + chr(10))
        raise OSError("no kernels here")
    return called

def unchanged(*words, **more):  # what the library decorates its classes with, at import
    return lambda wrapped: wrapped

use_kernel_forward_from_hub = use_kernelized_func = unchanged
"""
ASK = """
import json
import sys
from pathlib import Path

import transformers

from splatseg.errors import FileFormatError
from support.networks import asked

packages, checkpoints = Path(sys.argv[1]), json.loads(sys.argv[2])
calls = packages / "kernels" / "calls"
HUB = "kernels-community/flash-attn2"
others = {"use_kernels": True, "kernel_config": {"a": HUB}, "experts_implementation": HUB}
for family, folder in checkpoints:
    file = Path(folder) / "config.json"
    sound = file.read_text()
    names = [key for key, value in json.loads(sound).items() if isinstance(value, dict)]
    parts = [None, *(name for name in names if name.endswith("_config"))]
    for part in parts:
        for key in ("attn_implementation", "_attn_implementation", "_attn_implementation_internal"):
            content = json.loads(sound)
            (content if part is None else content[part])[key] = HUB
            file.write_text(json.dumps(content))
            try:
                asked(family, Path(folder))
            except FileFormatError as error:
                known = f"{key}: expected eager or sdpa" in str(error)
                print(family, "refused" if known else error)
            else:
                print(family, "took", part, key)
    content = json.loads(sound)
    for part in parts:
        (content if part is None else content[part]).update(others)
    file.write_text(json.dumps(content))
    asked(family, Path(folder))
print("calls", calls.exists())
content["attn_implementation"] = HUB
file.write_text(json.dumps(content))
try:
    transformers.AutoModel.from_pretrained(folder)
except Exception:
    print("calls of the library itself", calls.read_text().split())
"""


def test_kernels_are_never_called(tmp_path) -> None:
    from transformers.utils.import_utils import KERNELS_MIN_VERSION

    packages = tmp_path / "packages"
    (packages / "kernels" / "layer").mkdir(parents=True)
    (packages / "kernels" / "__init__.py").write_text(FAKE)
    (packages / "kernels" / "layer" / "__init__.py").touch()
    (packages / "kernels" / "layer" / "mode.py").write_text("Mode = object\n")
    about = packages / f"kernels-{KERNELS_MIN_VERSION}.dist-info"
    about.mkdir()
    (about / "METADATA").write_text(
        f"Metadata-Version: 2.1\nName: kernels\nVersion: {KERNELS_MIN_VERSION}\n"
    )
    names = [name for name in KINDS if name != "dinov2"] + ["dinov2"]
    folders = [(KINDS[name][0], str(checkpoint(*KINDS[name], tmp_path))) for name in names]
    tests = str(Path(support.__path__[0]).parent)
    paths = os.pathsep.join([str(packages), tests, os.environ.get("PYTHONPATH", "")])
    done = subprocess.run(
        [sys.executable, "-c", ASK, str(packages), json.dumps(folders)],
        capture_output=True, text=True, env={**os.environ, "PYTHONPATH": paths},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    *said, ours, theirs = done.stdout.splitlines()
    assert {line.split(maxsplit=1)[1] for line in said} == {"refused"}, said
    assert {line.split()[0] for line in said} == {family for family, _ in KINDS.values()}
    assert ours == "calls False"
    assert theirs == "calls of the library itself ['get_kernel']", "the fake is what it asks"
