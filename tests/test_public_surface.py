"""The names people import from `splatseg`, and nothing else."""

import ast
import importlib
import subprocess
import sys
from pathlib import Path

import pytest

import splatseg

SURFACE = {
    "AttachLayersOptions",
    "Camera",
    "Capture",
    "CheckpointOptions",
    "DemoOptions",
    "EditOptions",
    "EvaluationOptions",
    "ExportOptions",
    "FeatureMap",
    "Features",
    "FitOptions",
    "Gaussians",
    "ImportOptions",
    "InputError",
    "LabelMap",
    "Labels",
    "MakeSceneOptions",
    "MaskSet",
    "Method",
    "MethodInputs",
    "QueryOptions",
    "RenderOptions",
    "RenderingOptions",
    "Scene",
    "ScanLabelOptions",
    "SeeOptions",
    "SelectOptions",
    "SharpenSceneOptions",
    "SegmentOptions",
    "Selection",
    "Similarity",
    "SplatsegError",
    "StreetOptions",
    "View",
    "attach_layers",
    "back_project",
    "contributors",
    "create_evidence",
    "describe",
    "edit_scene",
    "evaluate_scene",
    "examine_capture",
    "export_scene",
    "find_method",
    "fit_capture",
    "get_backend",
    "import_scene",
    "label_map",
    "label_scans",
    "load_layer",
    "load_scene",
    "load_scene_layer",
    "make_demo",
    "make_street_field",
    "open_drive",
    "open_evidence",
    "open_selector",
    "query",
    "read_capture",
    "read_splats",
    "register_method",
    "render_truth",
    "render_views",
    "save_label_map",
    "save_layer",
    "save_masks",
    "save_scene",
    "save_scene_layer",
    "save_segmentation",
    "save_street_field",
    "see",
    "segment",
    "select",
    "sharpen_scene",
    "street_field",
    "uplift",
    "view",
    "weights",
    "write_capture",
    "write_splats",
}

PACKAGES = {
    "core",
    "edit",
    "evaluate",
    "prompting",
    "selection",
    "fit",
    "importing",
    "io",
    "lift",
    "mesh",
    "methods",
    "models",
    "neighbours",
    "pose",
    "raycast",
    "render",
    "report",
    "street",
    "synthetic",
    "tasks",
    "viewer",
}


def written_imports() -> dict[str, str]:
    """Name -> module of every ``from .M import X as X`` in the package's stub."""
    stub = Path(splatseg.__file__).with_suffix(".pyi")
    found: dict[str, str] = {}
    for node in ast.walk(ast.parse(stub.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom):
            for alias in node.names:
                assert alias.asname == alias.name, f"{alias.name} is not re-exported as itself"
                found[alias.name] = f"splatseg.{node.module}" if node.module else "splatseg"
    return found


SURFACE = written_imports().keys() - PACKAGES


def test_the_surface_is_what_the_stub_says() -> None:
    assert set(dir(splatseg)) == SURFACE | PACKAGES


@pytest.mark.parametrize("name", sorted(SURFACE))
def test_each_name_is_the_object_of_its_home_and_documented(name: str) -> None:
    value = getattr(splatseg, name)
    assert value is getattr(importlib.import_module(written_imports()[name]), name)
    assert (value.__doc__ or "").strip(), f"{name} has no docstring"


def test_each_package_is_there_without_an_import_of_its_own() -> None:
    """By one process, which forgets each package's attribute before it asks for it."""
    code = f"""
import splatseg
for name in {sorted(PACKAGES)}:
    vars(splatseg).pop(name, None)
    print(getattr(splatseg, name).__name__)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == [f"splatseg.{name}" for name in sorted(PACKAGES)]


def test_a_missing_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="No splatseg attribute Gausians"):
        splatseg.__getattr__("Gausians")


@pytest.mark.parametrize("name", ["bench", "BenchOptions"])
def test_what_moved_says_where(name: str) -> None:
    with pytest.raises(AttributeError, match=f"is now splatseg_bench.{name}; install"):
        getattr(splatseg, name)


def test_no_public_name_hides_a_package() -> None:
    """`splatseg.render` is always the package, whatever was imported before."""
    for name in SURFACE:
        assert f"splatseg.{name}" not in sys.modules, name
    packages = {path.parent.name for path in Path(splatseg.__file__).parent.glob("*/__init__.py")}
    assert not packages & SURFACE
    assert packages - {"cli"} | {"raycast"} == PACKAGES  # raycast is one module
