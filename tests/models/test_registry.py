"""Models by name, those of other packages, and the ten lines of docs/own-models.md."""

import re
import sys
import types
from dataclasses import dataclass
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import ClassVar

import pytest
import torch

from splatseg.core import (
    AutomaticMasks,
    DeepFeatures,
    DenseFeatures,
    MaskSet,
    Model,
    Pointmap,
    PointmapModel,
    PromptableMasks,
)
from splatseg.errors import InputError, MissingPackageError
from splatseg.models import (
    ENTRY_POINT_GROUP,
    LoadOptions,
    ModelFamily,
    _registry,
    find_family,
    find_model,
    model_names,
    record_evidence,
)


class Halves:
    name = "halves"
    settings: ClassVar[dict] = {}
    note = ""

    def masks(self, image) -> MaskSet:
        height, width = image.shape[:2]
        left = torch.zeros(1, height, width, dtype=torch.bool)
        left[..., : width // 2] = True
        return MaskSet.from_dense(left)


class NoModel:
    pass


NOT_CALLABLE = 3


@pytest.fixture
def installed(monkeypatch):
    """Entry points as if another package had been installed with them."""

    def install(**values: str) -> None:
        entries = [EntryPoint(name=n, value=v, group=ENTRY_POINT_GROUP) for n, v in values.items()]
        monkeypatch.setattr(
            _registry, "entry_points", lambda group: entries if group == ENTRY_POINT_GROUP else []
        )

    return install


HERE = __name__


@pytest.fixture(autouse=True)
def importable(monkeypatch):
    """This file under a name that an entry point can import."""
    monkeypatch.setitem(sys.modules, "models_of_another_package", sys.modules[HERE])


def test_another_packages_model_is_found_by_its_name(installed, views, tmp_path) -> None:
    installed(halves="models_of_another_package:Halves")
    assert model_names()[0] == "classical", "ours come first"
    assert model_names()[-1] == "halves"
    model = find_model("halves")
    assert isinstance(model, Model)
    assert isinstance(model, AutomaticMasks)
    assert not isinstance(model, PromptableMasks)
    seen = record_evidence(model, views, tmp_path / "halves")
    assert (seen.kind, seen.views, seen.masks) == ("masks", 3, 3)


def test_names_that_nobody_knows_are_answered_with_those_that_are(installed) -> None:
    installed(halves="models_of_another_package:Halves")
    with pytest.raises(InputError) as caught:
        find_model("sammy")
    sentence = str(caught.value)
    assert sentence.startswith("model: expected one of classical, ")
    assert sentence.endswith(", halves, or a file or folder of recorded evidence, got 'sammy'.")
    with pytest.raises(InputError, match="did you mean halves"):
        find_family("halfes")
    assert find_family("halves") is None, "it is made whole"


def test_another_package_cannot_take_the_place_of_a_name_of_ours(installed) -> None:
    installed(classical="models_of_another_package:Halves")
    assert type(find_model("classical")).__name__ == "Classical"


def test_a_name_comes_before_a_folder(tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "classical").mkdir()
    assert find_model("classical").name == "classical"
    with pytest.raises(InputError, match="expected evidence"):
        find_model("./classical")


@pytest.mark.parametrize(
    ("value", "error", "words"),
    [
        ("package_that_is_not_there:Model", MissingPackageError, "cannot be loaded: No module"),
        ("models_of_another_package:Gone", MissingPackageError, "no attribute 'Gone'"),
        ("models_of_another_package:NoModel", InputError, "name, settings and note, got NoModel"),
        (
            "models_of_another_package:NOT_CALLABLE",
            InputError,
            "something to call or a family, got int",
        ),
    ],
)
def test_what_cannot_be_loaded_is_said(installed, value, error, words) -> None:
    installed(broken=value)
    assert "broken" in model_names(), "names are listed without loading anything"
    with pytest.raises(error, match=words) as caught:
        find_model("broken")
    assert str(caught.value).startswith(f"model 'broken' ({value})")


@dataclass(frozen=True, slots=True, kw_only=True)
class SideOptions:
    """Options of a family of another package."""

    left: bool = True


def side(options: SideOptions, place: object) -> Halves:
    """A model of these options."""
    model = Halves()
    model.settings = {"left": options.left, "place": place is not None}
    return model


SIDES = ModelFamily(
    name="sides",
    summary="a side",
    reference="none",
    gives=("masks",),
    options=SideOptions,
    load=side,
)


def test_a_family_of_another_package_has_options(installed) -> None:
    installed(sides="models_of_another_package:SIDES")
    assert find_model("sides").settings == {"left": True, "place": False}
    assert find_model("sides", SideOptions(left=False)).settings["left"] is False
    with pytest.raises(InputError, match="expected SideOptions for model sides, got dict"):
        find_model("sides", {"left": False})
    with pytest.raises(InputError, match="model sides has none"):
        find_model("sides", loading=LoadOptions(weights="x"))
    installed(halves="models_of_another_package:Halves", other="models_of_another_package:SIDES")
    with pytest.raises(InputError, match="takes neither options nor weights"):
        find_model("halves", SideOptions())
    with pytest.raises(InputError, match="expected a family of this name, got 'sides'"):
        find_model("other")


def test_deep_features_have_a_name_a_depth() -> None:
    with pytest.raises(InputError, match="one name a map"):
        DeepFeatures(maps=(), depths=())


@pytest.fixture
def my_network(monkeypatch) -> list[tuple[torch.Size, ...]]:
    """A scripted network with DUSt3R's outputs; gives the sizes of what it saw."""
    sizes: list[tuple[torch.Size, ...]] = []

    def network(first, second):
        sizes.append((first.shape, second.shape))
        depth = (first.mean(dim=1) + 2)[..., None]  # of images in [-1, 1]
        one = {"pts3d": depth.expand(-1, -1, -1, 3), "conf": depth[..., 0]}
        two = {"pts3d_in_other_view": -depth.expand(-1, -1, -1, 3), "conf": depth[..., 0] + 1}
        return one, two

    module = types.ModuleType("my_network")
    module.load_network = lambda: network
    monkeypatch.setitem(sys.modules, "my_network", module)
    return sizes


def test_the_pointmaps_of_the_documentation_run(
    project_root: Path, my_network, installed, monkeypatch
) -> None:
    text = (project_root / "docs" / "own-models.md").read_text(encoding="utf-8")
    (block,) = (b for b in _python(text) if "class MyPointmaps" in b)
    lines = [line for line in block.splitlines() if line.strip()]
    assert sum(not line.startswith(("import", "from")) for line in lines) <= 10
    package = types.ModuleType("their_package")
    exec(compile(block, "docs/own-models.md", "exec"), package.__dict__)
    monkeypatch.setitem(sys.modules, "their_package", package)
    installed(**{"my-pointmaps": "their_package:MyPointmaps"})
    model = find_model("my-pointmaps")
    assert isinstance(model, PointmapModel)
    assert not isinstance(model, DenseFeatures)
    black, white = (torch.full((48, 64, 3), value, dtype=torch.uint8) for value in (0, 255))
    first, second = model.pointmaps(white, black)
    assert my_network == [((1, 3, 384, 512),) * 2]
    assert isinstance(first, Pointmap)
    torch.testing.assert_close(first.points, torch.full((384, 512, 3), 3.0))
    torch.testing.assert_close(second.points, torch.full((384, 512, 3), -3.0))
    torch.testing.assert_close(first.confidence, torch.full((384, 512), 3.0))
    torch.testing.assert_close(second.confidence, torch.full((384, 512), 4.0))


@pytest.mark.parametrize(
    ("points", "confidence", "words"),
    [
        (torch.zeros(2, 3, 2), torch.ones(2, 3), r"points: expected shape \(any, any, 3\)"),
        (torch.zeros(2, 3, 3), torch.ones(3, 2), r"confidence: expected shape \(2, 3\)"),
        (torch.full((2, 3, 3), torch.nan), torch.ones(2, 3), "points: 18 of 18 values are not"),
        (torch.zeros(2, 3, 3), -torch.ones(2, 3), "confidence: expected values in"),
    ],
)
def test_pointmaps_that_are_none(points, confidence, words: str) -> None:
    with pytest.raises(InputError, match=words):
        Pointmap(points=points, confidence=confidence)


def _python(text: str) -> list[str]:
    return re.findall(r"^```python\n(.*?)^```", text, re.MULTILINE | re.DOTALL)


def test_the_models_of_the_documentation_run(
    project_root: Path, views, tmp_path, my_network
) -> None:
    """The code of both pages of models, the model in ten lines among it."""
    pages = [project_root / "docs" / page for page in ("own-models.md", "models.md")]
    blocks = [block for page in pages for block in _python(page.read_text(encoding="utf-8"))]
    assert len(blocks) >= 2
    names: dict[str, object] = {}
    for block in blocks:
        exec(compile(block, "docs/own-models.md", "exec"), names)
    model = names["BrightSide"]
    lines = next(b for b in blocks if "class BrightSide" in b).strip().splitlines()
    body = [line for line in lines if line.strip() and not line.startswith(("import", "from"))]
    assert len(body) <= 10
    instance = model()
    assert isinstance(instance, AutomaticMasks)
    assert not isinstance(instance, DenseFeatures)
    seen = record_evidence(instance, views, tmp_path / "bright")
    assert seen.masks == 3
