"""A protocol as data: its switches, which layout it reads, and figures that were published."""

import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any, Literal

from splatseg._check import check_choice, check_range
from splatseg.core.boundary import convert_fields
from splatseg.core.typed_text import typed_field
from splatseg.errors import InputError, RangeError

Averaging = Literal["tasks", "scenes", "pairs", "pooled"]
"""tasks: mean over the views of a task, then over all tasks of all scenes. scenes: over views, then
over the tasks of a scene, then over scenes. pairs: over all (view, task) of a scene, then over
scenes. pooled: pixels of all views of a task together, then over the tasks of a scene, then over
scenes."""

Missing = Literal["wrong", "skipped"]
"""What a view or task without a prediction counts as: nothing right, or as if it were not asked."""

Threshold = Literal["fixed", "reference", "oracle"]
"""Where a cut comes from: the protocol, the prompt of the reference view, or the truth that is
evaluated, which no user has."""


POINT_RULES = ("field", "views", "density", "region", "fair")
"""How points take labels. field: by the method's own field that is no Gaussians (eq. 9). views:
from what views show at them and from their shapes. density: from the Gaussians around them.
region: by the majority of centres in a ball, as published. fair: the same, where a centre's vote
is how much all views saw it."""

_SAMPLED = ("positive_share", "negative_share")


@dataclass(frozen=True, slots=True, kw_only=True)
class Switches:
    """What all protocols choose."""

    averaging: Averaging = "scenes"
    """How figures of views and tasks become one."""

    missing: Missing = "wrong"
    """What a missing prediction counts as."""

    scored_in_training: bool = False
    """Whether photographs of scored views were fitted, or are held out."""

    def __post_init__(self) -> None:
        convert_fields(self)
        check_choice("averaging", self.averaging, ("tasks", "scenes", "pairs", "pooled"))
        check_choice("missing", self.missing, ("wrong", "skipped"))


@dataclass(frozen=True, slots=True, kw_only=True)
class TargetSwitches(Switches):
    """Choices where one thing is asked for at a time, and is a mask."""

    prompt: Literal["scribble", "mask", "words"] = "mask"
    """What is given: strokes in a view, a mask of a view, or text."""

    decided: Literal["pixels", "gaussians"] = "pixels"
    """Whether pixels of a rendered signal are chosen, or Gaussians, whose silhouette is drawn
    without what may hide it."""

    threshold: Threshold = "fixed"
    """Where the cut of scores comes from."""

    silhouette_cut: float = 0.5
    """Alpha above which a pixel is in the silhouette of chosen Gaussians."""

    reference_scored: bool = False
    """Whether the view of the prompt counts."""

    boundary_ratio: float | None = None
    """Width of the band of Boundary IoU, as a share of the diagonal; None leaves it out."""

    hits_at: tuple[float, ...] = ()
    """IoU above which a (view, task) counts as found, for Acc@."""

    negatives: tuple[str, ...] = ()
    """Words that relevancy is held against."""

    temperature: float = 10.0
    """Factor of cosines in the softmax of relevancy."""

    box_filter: int = 0
    """Side of the box that relevancy is averaged with, pixels; 0 takes it as it is."""

    stretch: bool = False
    """Whether relevancy is stretched to [-1, 1] in each view and clipped at 0 before it is cut."""

    relevancy_cut: float = 0.5
    """Relevancy above which a pixel, or a Gaussian, is taken."""

    majority: int = 0
    """Side of the window of the majority filter on masks, pixels; 0 has none."""

    localisation: bool = False
    """Whether the peak of relevancy is held against the annotation's boxes."""

    positive_share: float = 0.02
    """Share of the pixels of the skeleton of positive strokes that become points."""

    negative_share: float = 0.005
    """Share of the pixels of the skeleton of negative strokes that do."""

    answered: Literal["select", "segments"] = "select"
    """How layers of instances, trees and affinity features answer. select: as `splatseg select`
    answers a person. segments: all segments are taken that lie in the prompt's mask."""

    granularity: Literal["auto", "group", "object", "part"] = "auto"
    """How much a prompt means, where `select` answers."""

    segment_share: float = 0.5
    """Share of a segment's pixels in the prompted view that must lie in the prompt's mask for it
    to be taken, where segments answer."""

    def __post_init__(self) -> None:
        Switches.__post_init__(self)
        check_choice("prompt", self.prompt, ("scribble", "mask", "words"))
        check_choice("decided", self.decided, ("pixels", "gaussians"))
        check_choice("threshold", self.threshold, ("fixed", "reference", "oracle"))
        check_choice("answered", self.answered, ("select", "segments"))
        check_choice("granularity", self.granularity, ("auto", "group", "object", "part"))
        shares = ("silhouette_cut", "relevancy_cut", "segment_share", *_SAMPLED)
        for name in (*shares, *(("boundary_ratio",) if self.boundary_ratio is not None else ())):
            check_range(name, getattr(self, name), 0.0, 1.0)
        for name in ("box_filter", "majority"):
            if getattr(self, name) < 0:
                raise RangeError(f"{name}: expected 0 or more, got {getattr(self, name)}.")


@dataclass(frozen=True, slots=True, kw_only=True)
class SpokenSwitches(TargetSwitches):
    """Choices where the words of a scene are a choice of the experiment, not of the data set."""

    scene_words: tuple[str, ...] = ()
    """What is asked for in scenes, each ``SCENE:WORDS``. Scenes that are not among them are asked
    for what their data set says."""

    def __post_init__(self) -> None:
        TargetSwitches.__post_init__(self)
        for pair in self.scene_words:
            scene, _, words = pair.partition(":")
            if not (scene.strip() and words.strip()):
                raise InputError(f"scene_words: expected pairs SCENE:WORDS, got {pair!r}.")
        if len(self.words_of_scenes) < len(self.scene_words):
            raise InputError(f"scene_words: expected each scene once, got {self.scene_words}.")

    @property
    def words_of_scenes(self) -> dict[str, str]:
        """Words by scene."""
        pairs = (pair.partition(":") for pair in self.scene_words)
        return {scene.strip(): words.strip() for scene, _, words in pairs}


@dataclass(frozen=True, slots=True, kw_only=True)
class MapSwitches(Switches):
    """Choices where every pixel of views has a true class or instance."""

    zero_is_instance: bool = False
    """Whether pixels without an instance are one more, as in Gaga's evaluation."""

    hold_out_every: int = 8
    """Of a data set without a split of its own, every so many views by name are held out and
    scored, the first among them."""

    void_rule: Literal["coco", "strict"] = "coco"
    """Which segments of an image without a match are false in PQ of images. strict: all. coco: not
    those with more than half of their pixels where the truth is void."""

    def __post_init__(self) -> None:
        Switches.__post_init__(self)
        if self.hold_out_every < 2:
            raise RangeError(f"hold_out_every: expected 2 or more, got {self.hold_out_every}.")
        check_choice("void_rule", self.void_rule, ("coco", "strict"))


@dataclass(frozen=True, slots=True, kw_only=True)
class RoomSwitches(Switches):
    """Choices of CoSSegGaussians' experiments: rooms whose frames are a walk, in two tasks."""

    task: Literal["semantic", "panoptic"] = "semantic"
    """semantic: a class of every pixel. panoptic: classes, and which thing each pixel is of."""

    scene_list: Literal["dm-nerf", "gaga", "all"] = "all"
    """The scenes: a published list of the data set, see `SCENE_LISTS`, or all that are there."""

    sequence: Literal["Sequence_1", "Sequence_2"] | None = None
    """The walk through a scene, where the data set has several; None where it has one."""

    train_every: int = 5
    """Of the frames in their order every so many are fitted, and the one in the middle between two
    of these is held out and scored; all others are left out."""

    stuff: tuple[str, ...] = ()
    """Names of the classes whose instances are not told apart; all others are things."""

    aliases: tuple[str, ...] = ()
    """What classes of the evidence are called in the truth, each ``THERE:HERE``, where they have
    other names there. A class whose name the truth does not know is wrong wherever it is found."""

    def __post_init__(self) -> None:
        Switches.__post_init__(self)
        check_choice("task", self.task, ("semantic", "panoptic"))
        check_choice("scene_list", self.scene_list, ("dm-nerf", "gaga", "all"))
        if self.sequence is not None:
            check_choice("sequence", self.sequence, ("Sequence_1", "Sequence_2"))
        if self.train_every < 2:
            raise RangeError(f"train_every: expected 2 or more, got {self.train_every}.")
        for pair in self.aliases:
            words = [word.strip() for word in pair.split(":")]
            if len(words) != 2 or not all(words):
                raise InputError(f"aliases: expected pairs THERE:HERE of names, got {pair!r}.")
        # What would change nothing is no choice.
        if self.averaging != "scenes":
            raise InputError(f"averaging: rooms are averaged over scenes, got {self.averaging!r}.")
        if self.missing != "wrong":
            raise InputError(f"missing: a pixel without a label is wrong, got {self.missing!r}.")

    @property
    def named_alike(self) -> dict[str, str]:
        """Name in the truth by name in the evidence, in lower case."""
        pairs = (pair.lower().split(":") for pair in self.aliases)
        return {there.strip(): here.strip() for there, here in pairs}


@dataclass(frozen=True, slots=True, kw_only=True)
class PointSwitches(Switches):
    """Choices where points of the surface have a true class."""

    class_ids: tuple[int, ...] = ()
    """Ids that are scored; points of others are left out."""

    fixed_points: bool = True
    """Whether Gaussians stay at the points that are scored, so that a label of one is that of the
    other; else points take labels from Gaussians around them."""

    min_opacity: float = 0.1
    """Gaussians of less opacity have no label, and their points are left out."""

    frame_step: int = 20
    """Every so many frames of the capture are used."""

    def __post_init__(self) -> None:
        Switches.__post_init__(self)
        check_range("min_opacity", self.min_opacity, 0.0, 1.0)
        if self.frame_step < 1:
            raise RangeError(f"frame_step: expected 1 or more, got {self.frame_step}.")


ALL_WINDOWS = "all"
"""All windows of a drive that are there."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StreetSwitches(Switches):
    """Choices of a drive along a street: points of lasers, and views that were held out."""

    points: tuple[str, ...] = ("field", "views", "region", "fair")
    """By which rules points take labels, a row of the table each, of `POINT_RULES`; a method is
    run by those of them that it has."""

    radius: float = 0.5
    """Of the balls of regions, metres."""

    undefined: Missing = "wrong"
    """What a point without a label counts as: nothing right, or as if it were not asked."""

    classes: Literal["table-1", "own"] = "table-1"
    """table-1: all classes are merged to the 13 of the paper's Table 1, and sky. own: those of the
    data set."""

    sky: bool = True
    """Whether sky is one of the classes of views; points have none."""

    visible: bool = False
    """Whether only those points count that the data set says a photograph shows. KITTI-360's own
    evaluation counts all."""

    confidence: bool = False
    """Whether points count by the confidence of their truth, as in KITTI-360's own evaluation."""

    windows: str = ALL_WINDOWS
    """all: all windows of a drive that are there. Another word, such as val: those that the data
    set's list of this name has, 2013_05_28_drive_val.txt beside the drives' points."""

    scans: bool = True
    """Whether fits take the scans of the layout, where it has any."""

    def __post_init__(self) -> None:
        Switches.__post_init__(self)
        for rule in self.points:
            check_choice("points", rule, POINT_RULES)
        if not self.points or len(set(self.points)) != len(self.points):
            raise InputError(f"points: expected each rule once, got {', '.join(self.points)!r}.")
        if not self.radius > 0:
            raise RangeError(f"radius: expected a positive number, got {self.radius}.")
        if not re.fullmatch(r"[a-z0-9]+", self.windows):
            raise InputError(f"windows: expected the word of a list, got {self.windows!r:.80}.")
        check_choice("undefined", self.undefined, ("wrong", "skipped"))
        check_choice("classes", self.classes, ("table-1", "own"))
        # What would change nothing is no choice.
        if self.averaging != "scenes":
            raise InputError(f"averaging: drives are averaged over, got {self.averaging!r}.")
        if self.missing != "wrong":
            raise InputError(f"missing: a pixel without a label is wrong, got {self.missing!r}.")


def recorded(switches: Switches) -> dict[str, Any]:
    """All switches, in values that JSON holds."""
    return {
        name: list(value) if isinstance(value, tuple) else value
        for name, value in asdict(switches).items()
    }


def differences(one: Switches | dict[str, Any], other: Switches | dict[str, Any]) -> list[str]:
    """What two sets of switches differ in, a phrase each; none where they are the same."""
    left, right = (s if isinstance(s, dict) else recorded(s) for s in (one, other))
    return [
        f"{name} {_shown(left, name)} and {_shown(right, name)}"
        for name in sorted(set(left) | set(right))
        if name not in left or name not in right or left[name] != right[name]
    ]


def _shown(switches: dict[str, Any], name: str) -> str:
    return repr(switches[name]) if name in switches else "absent"


def names_of(switches: type[Switches]) -> tuple[str, ...]:
    """Names of the switches of a kind."""
    return tuple(field.name for field in fields(switches))


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneList:
    """Scenes of a data set."""

    scenes: tuple[str, ...]
    """As the data set's folders are called."""

    source: str
    """Where they are named."""

    def __post_init__(self) -> None:
        convert_fields(self)


# A protocol: which layout, what is asked of a method, and every choice of how it is scored.


@dataclass(frozen=True, slots=True, kw_only=True)
class Protocol:
    """An experiment of the field as data."""

    name: str
    """As ``splatseg bench NAME`` asks for it."""

    summary: str
    """What is asked and measured, one line, lower case, without a full stop."""

    layouts: tuple[str, ...]
    """Layouts of the data set that it reads, of `splatseg_bench.layouts.LAYOUTS`."""

    reference: str
    """Who states it."""

    switches: Switches
    """Every choice; its class says what is asked: targets, maps, or points."""

    measure: str
    """The measure that it is known for, such as ``iou``."""

    scenes: tuple[str, ...] = ()
    """Its scenes; none where all of the data set are meant."""

    scene_lists: Mapping[str, SceneList] = field(default_factory=dict[str, SceneList])
    """Lists of which the switch ``scene_list`` takes one to be the scenes."""

    note: str = ""
    """What else should be known, such as what of the original is not settled."""

    def __post_init__(self) -> None:
        convert_fields(self)
        if isinstance(self.switches, RoomSwitches):
            object.__setattr__(self, "scenes", self._listed(self.switches.scene_list))

    def with_switches(self, changes: dict[str, Any]) -> "Protocol":
        """The same protocol with other choices; results record them.

        Raises:
            InputError: If it has no such switch.
        """
        known = {each.name for each in fields(self.switches)}
        for name in changes:
            if name not in known:
                raise InputError(
                    f"switch: protocol {self.name} has {', '.join(sorted(known))}; got {name!r}."
                )
        return replace(self, switches=replace(self.switches, **changes))

    def _listed(self, name: str) -> tuple[str, ...]:
        """Scenes of a list by its name; none where all are meant."""
        if name == "all":
            return ()
        if name not in self.scene_lists:
            raise InputError(
                f"scene_list: protocol {self.name} has {', '.join((*self.scene_lists, 'all'))}; "
                f"got {name!r}."
            )
        return self.scene_lists[name].scenes


def switch_value(protocol: Protocol, text: str) -> tuple[str, Any]:
    """Name and value of ``NAME=VALUE`` as a person types it.

    Raises:
        InputError: If it is not of this form, there is no such switch, or the value does not fit.

    Example:
        >>> from splatseg_bench.protocols import find_protocol
        >>> switch_value(find_protocol("spin-nerf"), "reference_scored=no")
        ('reference_scored', False)
    """
    return typed_field(type(protocol.switches), text, what="switch")


# Figures that were published, beside which measured ones stand.


_MAX_DECIBELS = 100.0  # of one level in 8 bits it is 48

AMOUNTS = {
    "psnr": (0.0, _MAX_DECIBELS),
    "fps": (0.0, 1e6),
    "learned_mb": (0.0, 1e9),
    "scene_mb": (0.0, 1e9),
}
"""Measures that are no shares, with what they can be."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PublishedFigure:
    """What a publication reports of a method under a protocol."""

    protocol: str
    """Name of the protocol, such as ``nvos``."""

    method: str
    """As the publication calls it."""

    scores: Mapping[str, float]
    """By measure, as results name them (``iou``, ``accuracy``, ``pq_scene``); shares in [0, 1],
    PSNR in decibels, frames per second, megabytes."""

    scene: str | None = None
    """The scene; None is the mean over all of them."""

    source: str
    """Where it stands: a table of a paper, a repository, an issue, or second-hand. Where one source
    gives several figures of a method and scene, words after a comma tell them apart."""

    verified: bool
    """Whether it was read in the original table."""

    note: str = ""
    """In what the setting differed from the protocol, where that is known."""

    def __post_init__(self) -> None:
        convert_fields(self)
        for name in ("protocol", "method", "source"):
            if not getattr(self, name).strip():
                raise InputError(f"{name}: expected a name, got none.")
        if not self.scores:
            raise InputError("scores: expected at least one measure, got none.")
        for name, value in self.scores.items():
            if name in AMOUNTS:
                check_range(name, value, *AMOUNTS[name])
            elif not 0 <= value <= 1:
                raise RangeError(f"{name}: expected a share in [0, 1], got {value}.")
