"""What a method declares of itself; flags, help, documentation and refusals follow from it."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from typing import Any, Literal, cast

from splatseg.core import ClassTable, Features, Gaussians, Layer, View
from splatseg.core.boundary import convert_fields
from splatseg.core.checkpoints import Checkpoints
from splatseg.errors import InputError
from splatseg.io.evidence import Evidence, EvidenceKind, FeatureEvidence, TrackedEvidence

ANY_COMPANION = "any"
"""What an option of `Method.companions` says to take evidence that is at hand."""

Returns = Literal["labels", "features", "tree", "selection", "field"]
"""labels: one id a Gaussian. features: one vector a Gaussian, with the head that reads it. tree:
instances with groups above and parts below them. selection: the Gaussians of what was asked for.
field: something that is no Gaussian's."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MethodInputs:
    """What a method is given."""

    gaussians: Gaussians
    views: tuple[View, ...]
    """Those it may learn from; all of them have evidence."""

    evidence: Evidence
    """Of one of the kinds that the method takes."""

    prompt_views: tuple[View, ...] = ()
    """All views of the scene: points by hand may lie in any, whose photograph and evidence stay
    unused."""

    companions: Mapping[str, Evidence] = field(default_factory=dict[str, Evidence])
    """Further evidence of the same views, by the options that name it, see `Method.companions`."""

    models: Mapping[str, object] = field(default_factory=dict[str, object])
    """Models, by the options that name them, see `Method.models`."""

    trained: Features | None = None
    """What the method made before, where its options name such a layer, see `Method.trained`."""

    classes: ClassTable | None = None
    """Names of the scene's classes."""

    metres_per_unit: float | None = None
    """Length of a unit of the scene; None where that is not known."""

    up: tuple[float, float, float] | None = None
    """Direction away from the ground; None where that is not known."""

    backend: str = "auto"
    """Name of the rendering backend."""

    seed: int = 0
    """Of all random choices; a method that declares itself not seeded makes none."""

    progress: Callable[[int, int], None] | None = None
    """Called with the steps done and all there are. An exception from it ends the method."""

    checkpoints: Checkpoints | None = None
    """Where and how often a method that declares `resumes` keeps its state, and whether it goes
    on from it; None keeps none."""

    def features(self, option: str) -> FeatureEvidence | None:
        """The features that an option names; None where it names none."""
        return cast("FeatureEvidence | None", self.companions.get(option))

    @property
    def label_names(self) -> ClassTable | None:
        """Names of the evidence's ids, where these are classes; those of tracks mean nothing."""
        return (self.evidence.classes or self.classes) if self.evidence.kind == "labels" else None

    @property
    def categories(self) -> ClassTable | None:
        """Names of the categories of segments; a tracker's own table is of its tracks."""
        if isinstance(self.evidence, TrackedEvidence):
            return self.evidence.maps.table or self.classes
        return self.evidence.classes or self.classes


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Refined:
    """A layer of Gaussians that learnt along, see `Method.refines`."""

    layer: Layer
    gaussians: Gaussians
    """Row for row those that were given."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Method:
    """A way from evidence of views to a layer of the scene.

    Raises:
        InputError: If the options are no frozen dataclass whose fields all have defaults.

    Example:
        >>> from splatseg.methods import find_method
        >>> find_method("vote").evidence
        ('labels', 'tracked')
    """

    name: str
    """How it is asked for: the name of its paper, or the field's word for it."""

    summary: str
    """What it does, in one line."""

    reference: str
    """The paper, or the page of documentation, that describes it."""

    evidence: tuple[EvidenceKind, ...]
    """Kinds of evidence it takes."""

    options: type[Any]
    """Frozen dataclass of its options: fields become flags, the strings below them help."""

    run: Callable[[MethodInputs, Any], Layer | Refined]
    """Makes the layer, from the inputs and an instance of `options`."""

    returns: Returns = "labels"

    keeps_ids: bool = False
    """Whether the ids of the layer are those of the evidence, rather than new ones."""

    repairs: bool = False
    """Whether the layer differs on purpose from the label maps it was made from, so that boundaries
    of things are not to be found in these."""

    seeded: bool = False
    """Whether the seed makes a difference."""

    resumes: bool = False
    """Whether it keeps its state as `MethodInputs.checkpoints` says, so that what was interrupted
    goes on to the result of a run that was not."""

    published: Any = None
    """The options of the publication, an instance of `options`; None where the defaults are."""

    published_differs: str = ""
    """What of the publication its setting here leaves out or does otherwise, in a sentence for the
    help of ``--published``."""

    companions: Mapping[str, tuple[EvidenceKind, ...]] = field(
        default_factory=dict[str, tuple[EvidenceKind, ...]]
    )
    """Options that name evidence which the method takes besides, and the kinds that each may be
    of. An option that is None names none; one that is `ANY_COMPANION` takes what is at hand."""

    models: Mapping[str, type[Any]] = field(default_factory=dict[str, type[Any]])
    """Options that name models, as ``NAME[=WEIGHTS][,OPTION=VALUE...]``, and the protocol of
    `core.models` that each must fulfil. An option that is None names none."""

    trained: str | None = None
    """Name of the option that names a layer of features which the method made before, to be read
    in another way without training again; None where it takes none."""

    refines: str | None = None
    """Name of the option that names the folder of a new scene, whose Gaussians learn along with
    the layer; None where Gaussians always stay as they are."""

    words: Literal["cosines", "span"] = "cosines"
    """How words are asked of its features: by cosines; or in the span of all features, held against
    what else a thing could be, as `query` asks (`lift.words`)."""

    published_words: Literal["cosines", "span"] | None = None
    """The same in the setting of the publication, where that is not `words`."""

    readouts: Mapping[str, Returns] = field(default_factory=dict[str, Returns])
    """What it gives by its option ``readout``, where that is not `returns`."""

    complete: bool = True
    """Whether Gaussians that no view explains take the labels of their neighbours by default."""

    def __post_init__(self) -> None:
        convert_fields(self)
        parameters = getattr(self.options, "__dataclass_params__", None)
        if not (is_dataclass(self.options) and parameters is not None and parameters.frozen):
            raise InputError(f"method {self.name!r}: expected options in a frozen dataclass.")
        try:
            self.options()
        except TypeError as error:
            raise InputError(
                f"method {self.name!r}: expected a default for every option ({error})."
            ) from error
        named = (
            *self.companions,
            *self.models,
            self.trained,
            self.refines,
            "readout" if self.readouts else None,
        )
        for option in named:
            if option is not None and option not in self.option_names():
                raise InputError(f"method {self.name!r}: expected an option {option!r}.")

    @property
    def published_options(self) -> Any:
        """The setting of the publication."""
        return self.options() if self.published is None else self.published

    def gives(self, options: Any) -> Returns:
        """What it returns with some options.

        Args:
            options: An instance of the method's options.
        """
        return self.readouts.get(getattr(options, "readout", ""), self.returns)

    def option_names(self) -> tuple[str, ...]:
        """Names of all options, those of nested dataclasses included."""
        return tuple(_field_names(self.options))

    def check_evidence(self, evidence: Evidence) -> None:
        """Raise `InputError` unless the method takes evidence of this kind."""
        if evidence.kind not in self.evidence:
            raise InputError(
                f"{evidence.folder}: method {self.name} takes evidence of "
                f"{' or '.join(self.evidence)}, got {evidence.kind}."
            )


def _field_names(options: type[Any]) -> list[str]:
    names: list[str] = []
    for each in fields(options):
        nested = each.default_factory if callable(each.default_factory) else None
        if isinstance(nested, type) and is_dataclass(nested):
            names += _field_names(nested)
        else:
            names.append(each.name)
    return names
