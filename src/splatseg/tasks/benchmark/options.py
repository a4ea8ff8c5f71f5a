"""What a run of a protocol is told: methods, models, fits, other choices than its own."""

from dataclasses import dataclass, replace
from pathlib import Path

from splatseg.core.boundary import convert_fields
from splatseg.errors import InputError
from splatseg.fit import FitOptions, Preset


@dataclass(frozen=True, slots=True, kw_only=True)
class BenchOptions:
    """What is run under a protocol, and with what."""

    methods: tuple[str, ...] = ("uplift",)
    """Methods of `segment`, by name."""

    models: tuple[str, ...] = ()
    """Who sees for the methods, each NAME[=WEIGHTS][,OPTION=VALUE...], or a folder of recorded
    evidence in which {scene} stands for the scene's name. A method takes the first that gives what
    it needs."""

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

    steps: int | None = None
    """Length of the fits in steps; None is the preset's."""

    max_gaussians: int | None = None
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
        convert_fields(self)
        if not self.methods:
            raise InputError("methods: expected at least one method, got none.")
        if len(set(self.methods)) != len(self.methods):
            raise InputError(f"methods: expected each once, got {', '.join(self.methods)}.")

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
