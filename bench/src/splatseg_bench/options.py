"""What a run of a protocol is told: methods, models, fits, other choices than its own."""

from collections.abc import Sequence
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

from splatseg.core.options import Count, options
from splatseg.core.typed_text import typed_field
from splatseg.errors import InputError
from splatseg.fit import FitOptions, Preset
from splatseg.methods import Method


@options
class BenchOptions:
    """What is run under a protocol, and with what."""

    methods: tuple[str, ...] = ("uplift",)
    """Methods of `segment`, by name."""

    models: tuple[str, ...] = ()
    """Who sees for the methods, each NAME[=WEIGHTS][,OPTION=VALUE...], or a folder of recorded
    evidence in which {scene} stands for the scene's name. A method takes the first that gives what
    it needs."""

    method_options: tuple[str, ...] = ()
    """Options of methods other than their own, each NAME=VALUE; all methods that have an option of
    the name take it, and results record it."""

    companions: tuple[str, ...] = ()
    """Who sees what methods take besides their evidence, such as features and masks, named in the
    same way. Each option of a method takes the first that gives what it may name."""

    prompter: str = "classical"
    """Who turns strokes into a mask: a model that answers points, named in the same way."""

    grounder: str | None = None
    """Who finds words in the drawn first view, such as langsam, where words become the mask of a
    prompt; None asks for words by features."""

    scenes: tuple[str, ...] = ()
    """Names of scenes to run; none takes all that are there."""

    fitted: str | None = None
    """Scene folders that were fitted before, with {scene} for the scene's name; None fits."""

    preset: Preset = "default"
    """Preset of the fits."""

    steps: Count | None = None
    """Length of the fits in steps; None is the preset's."""

    max_gaussians: Count | None = None
    """Most Gaussians of a fit; None is the preset's, for its length."""

    switches: tuple[str, ...] = ()
    """Choices other than the protocol's, each NAME=VALUE; results record them."""

    published: bool = False
    """Methods as their authors published them."""

    beside: tuple[Path, ...] = ()
    """Folders of other runs whose results stand in the same table; refused, with the differences,
    where they were scored by other choices or in other scenes."""

    seed: int = 0
    """Of fits, methods and points on strokes."""

    again: bool = False
    """Run what was run before."""

    download: bool = False
    """Fetch weights that are not on this machine."""

    device: str = "auto"
    """Where networks run."""

    def __post_init__(self) -> None:
        if not self.methods:
            raise InputError("methods: expected at least one method, got none.")
        if len(set(self.methods)) != len(self.methods):
            raise InputError(f"methods: expected each once, got {', '.join(self.methods)}.")

    def options_of(self, method: Method) -> Any:
        """Options of a method: its own or those of its publication, changed by `method_options`.

        Raises:
            InputError: If a value does not fit.
        """
        chosen = method.published_options if self.published else method.options()
        for text in self.method_options:
            if text.partition("=")[0] in method.option_names():
                chosen = _with_option(chosen, text)
        return chosen

    def check_methods(self, methods: Sequence[Method]) -> None:
        """Raise `InputError` unless each of `method_options` is of a method, and fits it."""
        known = {name for method in methods for name in method.option_names()}
        for text in self.method_options:
            name, equals, _ = text.partition("=")
            if not equals or name not in known:
                raise InputError(
                    f"option: expected NAME=VALUE with an option of {', '.join(self.methods)} "
                    f"({', '.join(sorted(known))}), got {text!r}."
                )
        for method in methods:
            self.options_of(method)

    def fit_options(self, *, fixed: bool) -> FitOptions:
        """Options of the fits.

        Args:
            fixed: Whether Gaussians stay at the capture's points.
        """
        options = FitOptions.preset(self.preset)
        options = options.with_strategy("fixed" if fixed else options.strategy)
        options = options.with_length(steps=self.steps)
        options = replace(options, seed=self.seed)
        if self.max_gaussians is None:
            return options
        return replace(options, max_gaussians=self.max_gaussians)


def _with_option(options: Any, text: str) -> Any:
    """Options with one of them, or of those that they hold, changed as ``NAME=VALUE`` says."""
    name = text.partition("=")[0]
    if name in {each.name for each in fields(options)}:
        return replace(options, **dict([typed_field(type(options), text, what="option")]))
    held = {each.name: getattr(options, each.name) for each in fields(options)}
    inner = {key: one for key, one in held.items() if is_dataclass(one)}
    return replace(options, **{key: _with_option(one, text) for key, one in inner.items()})
