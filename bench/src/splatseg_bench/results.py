"""Results of a protocol: one a scene and method, with all that they came from; kept as files."""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from splatseg.core.boundary import boundary, convert_fields
from splatseg.errors import FileFormatError, InputError, MissingFileError
from splatseg.io.atomic import path_inside
from splatseg.io.json_files import json_text, parse_object, read_json, write_json
from splatseg_bench.protocols import (
    MaskRow,
    Protocol,
    Switches,
    TargetSwitches,
    differences,
    mask_scores,
    recorded,
)

RESULTS_FOLDER = "results"
_ROW_FIELDS = tuple(MaskRow.__dataclass_fields__)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SceneResult:
    """What a method reached in one scene under a protocol."""

    protocol: str
    scene: str
    method: str
    scores: Mapping[str, float]
    """Of this scene, by measure."""

    rows: tuple[Mapping[str, Any], ...]
    """What they are made of: views, tasks or classes."""

    switches: Mapping[str, Any]
    """Every choice of the protocol."""

    oracle: tuple[str, ...] = ()
    """What was chosen with the help of the truth that is evaluated."""

    notes: tuple[str, ...] = ()
    """What should be known of it, a sentence each."""

    made: Mapping[str, Any] = field(default_factory=dict[str, Any])
    """From what: command, seed, options, digests, versions, seconds."""

    key: str = ""
    """Digest of what it was made from; another one is another experiment."""

    def __post_init__(self) -> None:
        convert_fields(self)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MethodResult:
    """What a method reached over scenes."""

    protocol: str
    method: str
    scores: Mapping[str, float]
    scenes: tuple[SceneResult, ...]

    def __post_init__(self) -> None:
        convert_fields(self)

    @property
    def oracle(self) -> tuple[str, ...]:
        """What was chosen with the help of the truth, in any scene."""
        return tuple(dict.fromkeys(word for one in self.scenes for word in one.oracle))


@boundary
def over_scenes(protocol: Protocol, method: str, scenes: Sequence[SceneResult]) -> MethodResult:
    """Figures over scenes: masks as the protocol averages them, others by the mean over scenes.

    Raises:
        InputError: If there is no scene, or scenes were scored by different choices.
    """
    if not scenes:
        raise InputError(f"method {method}: expected a result of at least one scene, got none.")
    check_comparable(scenes)
    if isinstance(protocol.switches, TargetSwitches):
        rows = [MaskRow(**{n: row[n] for n in _ROW_FIELDS}) for one in scenes for row in one.rows]
        scores = mask_scores(rows, protocol.switches)
    else:
        scores = mean_scores([one.scores for one in scenes])
    return MethodResult(protocol=protocol.name, method=method, scores=scores, scenes=tuple(scenes))


def check_same_scenes(one: MethodResult, other: MethodResult) -> None:
    """Raise `InputError` unless two methods were measured in the same scenes."""
    names = [{scene.scene for scene in result.scenes} for result in (one, other)]
    if names[0] != names[1]:
        raise InputError(
            f"{other.method}: expected results of the scenes {', '.join(sorted(names[0]))}, got "
            f"those of {', '.join(sorted(names[1]))}."
        )


def results_of(root: Path, protocol: Protocol) -> list[MethodResult]:
    """What another run measured under a protocol, a result a method, named after its folder.

    Raises:
        MissingFileError: If there is nothing.
        FileFormatError: If a file is damaged.
        InputError: If its scenes were scored by different choices.
    """
    folder = root / RESULTS_FOLDER / protocol.name
    methods = sorted(path for path in folder.glob("*") if path.is_dir())
    if not methods:
        raise MissingFileError(f"{folder}: expected results of {protocol.name}, got none.")
    return [
        replace(
            over_scenes(protocol, path.name, [load_result(one) for one in sorted(path.glob("*"))]),
            method=f"{path.name} ({root.resolve().name})",
        )
        for path in methods
    ]


def mean_scores(scores: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """The mean of each measure over scenes; of measures that some scenes lack, none."""
    shared = [name for name in scores[0] if all(name in one for one in scores)]
    return {name: sum(one[name] for one in scores) / len(scores) for name in shared}


@boundary
def check_comparable(results: Sequence[SceneResult]) -> None:
    """Raise `InputError` if results were scored by different choices; it lists them."""
    first = results[0]
    for one in results[1:]:
        found = differences(dict(first.switches), dict(one.switches))
        if first.protocol != one.protocol:
            found.insert(0, f"protocol {first.protocol!r} and {one.protocol!r}")
        if found:
            raise InputError(
                f"{one.method}, {one.scene}: expected results scored as {first.method}, "
                f"{first.scene}, got others; they differ in {'; '.join(found)}."
            )


def oracle_of(switches: Switches) -> tuple[str, ...]:
    """What a protocol chooses with the help of the evaluated truth."""
    if isinstance(switches, TargetSwitches) and switches.threshold == "oracle":
        return ("cut",)
    return ()


def result_path(root: Path, protocol: str, method: str, scene: str) -> Path:
    """The file of a result."""
    return path_inside(root, RESULTS_FOLDER, protocol, method, f"{scene}.json")


@boundary
def save_result(result: SceneResult, path: Path) -> None:
    """Write a result."""
    write_json(asdict(result), path)


@boundary
def load_result(path: Path) -> SceneResult:
    """Read what `save_result` wrote.

    Raises:
        FileFormatError: If it holds something else.
    """
    content = read_json(path)
    names = set(SceneResult.__dataclass_fields__)
    if set(content) != names:
        raise FileFormatError(
            f"{path}: expected a result of a benchmark ({', '.join(sorted(names))}), got something "
            "else."
        )
    try:
        return SceneResult(**content)
    except InputError as error:
        raise FileFormatError(f"{path}: expected a result of a benchmark: {error}") from error


def kept_result(path: Path, key: str) -> SceneResult | None:
    """The result of an earlier run, if it was made from the same."""
    if not path.is_file():
        return None
    found = load_result(path)
    return found if found.key == key else None


def key_of(parts: Mapping[str, Any]) -> str:
    """Digest of what a result is made from, given in values that JSON holds."""
    text = json.dumps(parse_object(json_text("parts", parts), where="parts"), sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def switches_of(protocol: Protocol) -> dict[str, Any]:
    """The choices of a protocol in values that JSON holds."""
    return recorded(protocol.switches)
