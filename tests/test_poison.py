"""Every public function and class takes what it can and refuses the rest in one sentence.

Each argument in turn is each of some forty values that a notebook may hand over, the others being
valid: the answer is a result or an error of ours, never a `TypeError` from somewhere inside.
"""

import dataclasses
import inspect
import typing
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from splatseg.core.boundary import converters
from splatseg.errors import SplatsegError
from splatseg.methods import _method
from support import poison
from support.public import public_callables

LONGEST_MESSAGE = 400
CALLABLES = public_callables()
POISONS = poison.poisons()
NEEDED = {
    # What they take is made by nobody but the package itself.
    "render.CompactRows",
    "render.PreparedView",
    "lift.GaussianView",
    "lift.training.DrawnRows",
    "lift.training.Values",
    "lift.training.train",
    "tasks.save_street_field",
}
SLOW = (
    "lift.sharpen",
    "pose.",
    "fit.fit",
    "fit.refine",
    "fit.Refinement",
    "tasks.make_",
    "tasks.import_scene",
    "tasks.e",
    "tasks.render_truth",
    "tasks.render_views",
    "tasks.attach_layers",
    "tasks.label_scans",
    "tasks.open_drive",
    "tasks.s",
    "tasks.report_layer",
    "lift.cut_",
    "lift.match_gaussians",
    "importing.",
    "models.record_evidence",
    "models.classical.region_masks",
    "models.regions.learned_masks",
    "models.classical.colour_gradient_features",
    "synthetic.",
    "evaluate.evaluate_",
)
"""Of these, only calls that the boundary refuses are made: the others would do the work."""


@pytest.fixture(scope="module")
def known(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Any]]:
    before = dict(_method._REGISTERED)
    yield poison.valid(poison.World(tmp_path_factory.mktemp("world")))
    # `register_method` is called too: pages of help that are tested later know no such method.
    _method._REGISTERED.clear()
    _method._REGISTERED.update(before)


def runs_nothing(value: Callable[..., Any]) -> bool:
    """A class that only holds what it is given, or that cannot be made."""
    if not inspect.isclass(value):
        return False
    holds = dataclasses.is_dataclass(value) and not hasattr(value, "__post_init__")
    return holds or inspect.isabstract(value)


def hints_of(value: Callable[..., Any]) -> dict[str, Any]:
    plain = value if not inspect.isclass(value) else value.__init__
    is_data = dataclasses.is_dataclass(value)
    target = value if is_data else inspect.unwrap(plain)
    words = {"JSON": object, "Sequence": typing.Sequence, "Mapping": typing.Mapping}
    return typing.get_type_hints(target, localns=words)


def arguments(known: dict[str, Any], key: str, value: Callable[..., Any]) -> dict[str, Any]:
    """Valid arguments for all that have no default, and the backend."""
    hints = hints_of(value)
    return {
        name: poison.argument(known, key, parameter, hints.get(name))
        for name, parameter in inspect.signature(value).parameters.items()
        if parameter.default is parameter.empty
        or name == "backend"
        or f"{key}.{name}" in known["special"]
    }


def refused(key: str, value: Callable[..., Any]) -> Callable[[str, Any], bool]:
    """Whether the boundary of a function refuses a value of an argument by itself."""
    names = tuple(inspect.signature(value).parameters)
    owner = value if dataclasses.is_dataclass(value) or not inspect.isclass(value) else None
    known = converters(inspect.unwrap(owner or value.__init__), names)

    def is_refused(name: str, given: Any) -> bool:
        try:
            known[name](name, given) if name in known else None
        except SplatsegError:
            return True
        return False

    return is_refused


def complaints(value: Callable[..., Any], valid: dict[str, Any]) -> list[str]:
    """What is said of the valid arguments by themselves: poison would hide behind it."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            value(**valid)
    except SplatsegError as error:
        said = str(error)
        return [said] if any(f"{name}: expected" in said for name in valid) else []
    return []


WALKED = [key for key, value in CALLABLES.items() if not runs_nothing(value) and key not in NEEDED]


@pytest.mark.parametrize("key", WALKED)
def test_poison(
    key: str, known: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    value, hints = CALLABLES[key], hints_of(CALLABLES[key])
    valid = arguments(known, key, value)
    is_slow = key.startswith(SLOW)
    is_refused = refused(key, value)
    wrong = [] if is_slow else complaints(value, valid)
    for name in inspect.signature(value).parameters:
        for what, given in POISONS.items():
            if what in ("class", "function") and "Callable" in str(hints.get(name)):
                continue
            if is_slow and not is_refused(name, given):
                continue
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")
                    value(**{**valid, name: given})
            except SplatsegError as error:
                if len(str(error)) > LONGEST_MESSAGE or "\n" in str(error):
                    wrong.append(f"{name}={what}: a message of {len(str(error))} characters")
            except Exception as error:  # noqa: BLE001  (what is looked for)
                wrong.append(f"{name}={what}: {type(error).__name__}: {error}")
    assert not wrong, "\n".join(wrong)


def test_an_object_is_no_argument(known: dict[str, Any]) -> None:
    """The poison test can fail: what takes anything is seen."""
    refuses = refused("render.render", CALLABLES["render.render"])
    assert refuses("gaussians", object())
    assert not refuses("gaussians", poison.gaussians())
