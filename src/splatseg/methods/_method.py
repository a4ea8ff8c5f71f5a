"""What a method declares of itself; flags, help, documentation and refusals follow from it."""

import difflib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from importlib.metadata import EntryPoint, entry_points
from typing import Any, Literal, cast

from splatseg.core import LOCAL, Camera, ClassTable, Executor, Features, Gaussians, Layer, View
from splatseg.core.boundary import boundary, convert_fields
from splatseg.core.checkpoints import Checkpoints
from splatseg.errors import InputError, MissingPackageError
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

    executor: Executor = LOCAL
    """Where independent items are worked on, such as views; the layer does not depend on it."""

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

    update: Callable[[MethodInputs, Any, Any], Layer] | None = None
    """Adds the evidence of further views, those of the inputs, to a layer that it made (the last
    argument). None where a method starts again with all views."""

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

    camera: Callable[[MethodInputs, Any, View], Camera] | None = None
    """The camera, of the inputs and the options, through which it looks at a view, where all that
    it asks of Gaussians is what these cameras see: of a scene in chunks it is given those that are
    seen. None where it needs them all."""

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


# Another package brings a method by an entry point of the group ``splatseg.methods``: its name is
# the method's, its value a `Method`. ``docs/methods.md`` has one of ten lines.


ENTRY_POINT_GROUP = "splatseg.methods"

_OWN = {
    "uplift": "uplift:METHOD", "features": "uplift:FEATURES", "objects": "objects:METHOD",
    "voxels": "voxels:METHOD", "vote": "vote:METHOD", "associate": "associate:METHOD",
    "object-classes": "object_classes:METHOD", "identity": "identity:METHOD",
    "saga": "saga:METHOD", "cosseg": "cosseg:METHOD", "prompt": "prompt:METHOD",
}  # fmt: skip
"""Methods of this package, imported when they are asked for, and where they are."""

_ABOVE = {"dnmp": "splatseg.street.method:METHOD"}
"""The same of packages above this one."""

_REMOVED = dict.fromkeys(
    ("logits", "probabilities"), "identity with as many channels as there are ids does the same"
)
"""Methods that went, whose layers keep the ids of the evidence, and what to use instead."""

_REGISTERED: dict[str, Method] = {}


def method_names() -> tuple[str, ...]:
    """Names that `find_method` knows: ours in the order of the documentation, then others'."""
    return (*_known(), *_REGISTERED)


@boundary
def find_method(name: str) -> Method:
    """The method of this name.

    Raises:
        InputError: If there is none, or what another package brings is no method.
        MissingPackageError: If the package that brings it, or one it needs, cannot be imported.
    """
    if name in _REGISTERED:
        return _REGISTERED[name]
    if name in _REMOVED:
        raise InputError(f"method {name!r} was removed; {_REMOVED[name]}.")
    known = _known()
    if name not in known:
        close = difflib.get_close_matches(name, known, n=3, cutoff=0.5)
        hint = f"did you mean {' or '.join(close)}?" if close else f"known: {', '.join(known)}."
        raise InputError(f"there is no method {name!r}; {hint}")
    entry = known[name]
    try:
        found: object = entry.load()
    except (ImportError, AttributeError) as error:
        raise MissingPackageError(
            f"method {name!r} ({entry.value}) cannot be loaded: {error}."
        ) from error
    if not isinstance(found, Method):
        raise InputError(
            f"method {name!r} ({entry.value}): expected a splatseg.methods.Method, "
            f"got {type(found).__name__}."
        )
    if found.name != name:
        raise InputError(
            f"method {name!r} ({entry.value}): expected a method of this name, got {found.name!r}."
        )
    return found


@boundary
def register_method(method: Method) -> Method:
    """Make a method known by its name for as long as this process runs.

    A notebook tries a method so; a package that brings one for good has an entry point. One that
    was registered before under the name is replaced, which a cell that runs twice does.

    Raises:
        InputError: If the name is that of a method of ours or of an installed package.
    """
    if method.name in _known():
        raise InputError(f"method: expected a name that is free, got {method.name!r}.")
    _REGISTERED[method.name] = method
    return method


def methods() -> tuple[Method, ...]:
    """All methods, in the order of `method_names`."""
    return tuple(find_method(name) for name in method_names())


@boundary
def keeps_ids(method: object) -> bool:
    """Whether layers of this method have the ids of the evidence that they were made from.

    Args:
        method: Its name, as the info of a layer has it; no method keeps no ids.
    """
    if not isinstance(method, str):
        return False
    return method in _REMOVED or (method in method_names() and find_method(method).keeps_ids)


@boundary
def keeps_boundaries(method: object) -> bool:
    """Whether layers of this method have their boundaries where the label maps have them.

    Args:
        method: Its name, as the info of a layer has it; no method keeps none.
    """
    return keeps_ids(method) and (method in _REMOVED or not find_method(str(method)).repairs)


def _known() -> dict[str, EntryPoint]:
    places = {name: f"splatseg.methods.{place}" for name, place in _OWN.items()} | _ABOVE
    own = {
        name: EntryPoint(name=name, value=value, group=ENTRY_POINT_GROUP)
        for name, value in places.items()
    }
    others = {entry.name: entry for entry in entry_points(group=ENTRY_POINT_GROUP)}
    # Another package cannot take the place of a method of ours.
    return own | {name: others[name] for name in sorted(others) if name not in own}
