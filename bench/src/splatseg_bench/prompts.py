"""What a protocol gives of a thing, as a mask in one view."""

import hashlib
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatseg.core import Model, Prompt, PromptableMasks, Scene, View
from splatseg.core.models import GroundedMasks, Image
from splatseg.errors import InputError
from splatseg.lift import GaussianField
from splatseg.prompting.prompts import ViewPrompt
from splatseg_bench.protocols import TargetSwitches, resized_mask
from splatseg_bench.scene import Scribble, TargetTask


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PromptedMask:
    """The mask of a thing in the view that it is asked for in."""

    view: str
    mask: Bool[Tensor, "height width"]
    """In the photograph's pixels."""


def prompted_mask(
    scene: Scene,
    task: TargetTask,
    switches: TargetSwitches,
    *,
    prompter: Model | None,
    seed: int,
) -> PromptedMask:
    """The mask that is given, or that a model makes of strokes.

    Args:
        scene: The fitted scene.
        task: What is asked for.
        switches: What is given of it.
        prompter: Who answers strokes.
        seed: Of the points that are taken on strokes.

    Raises:
        InputError: If the benchmark gives no such prompt, or the model answers none.
    """
    if switches.prompt == "mask":
        if task.reference is None:
            raise InputError(f"task {task.name}: expected a mask of one view as prompt, got none.")
        camera = scene.view(task.reference.view).camera
        mask = resized_mask(task.reference.read(), (camera.height, camera.width))
        return PromptedMask(view=task.reference.view, mask=mask)
    if task.scribble is None:
        raise InputError(f"task {task.name}: expected strokes in one view as prompt, got none.")
    if not isinstance(prompter, PromptableMasks):
        name = "none" if prompter is None else prompter.name
        raise InputError(f"prompter: expected a model that answers points, got {name}.")
    view = scene.view(task.scribble.view)
    image: Image = view.read_image()
    prompt = scribble_prompt(
        task.scribble, switches, height=view.camera.height, width=view.camera.width,
        seed=_seed_of(seed, task.name),
    )  # fmt: skip
    found = prompter.prompted_masks(prompter.embed(image), prompt)
    if not len(found):
        raise InputError(f"task {task.name}: {prompter.name} found nothing at its strokes.")
    return PromptedMask(view=view.name, mask=found.masks[0].decode())


def worded_mask(
    field: GaussianField, view: View, words: str, grounder: GroundedMasks
) -> PromptedMask | None:
    """What words mean in a view as the scene draws it, all of it together; None for nothing.

    Args:
        field: The scene.
        view: A view; its photograph is not read.
        words: What is asked for.
        grounder: Who finds it.
    """
    with field.view(view.camera) as drawn:
        colour = drawn.signals().colour
    if colour is None:
        raise InputError("field: expected one with colours, got one without.")
    image = (colour.clamp(0, 1) * 255 + 0.5).to(torch.uint8)
    found = grounder.grounded_masks(image, [words]).masks
    if not len(found):
        return None
    together = torch.zeros(view.camera.height, view.camera.width, dtype=torch.bool)
    for mask in found.masks:
        together |= mask.decode()
    return PromptedMask(view=view.name, mask=together)


def mask_prompt(scene: Scene, prompt: PromptedMask) -> ViewPrompt:
    """A mask of a view as `select` takes it."""
    return ViewPrompt(view=scene.view(prompt.view), mask=prompt.mask)


def stroke_prompt(
    scene: Scene, task: TargetTask, switches: TargetSwitches, *, seed: int
) -> ViewPrompt:
    """Strokes as `select` takes them: the pixels that are sampled on their skeletons.

    They stay strokes, of which some pixels may slip over a border, and are no points, each of
    which was meant.

    Args:
        scene: The fitted scene.
        task: What is asked for.
        switches: The shares of the skeletons that are taken.
        seed: Of the sample.

    Raises:
        InputError: If the benchmark gives no strokes, or none on the thing.
    """
    if task.scribble is None:
        raise InputError(f"task {task.name}: expected strokes in one view as prompt, got none.")
    view = scene.view(task.scribble.view)
    height, width = view.camera.height, view.camera.width
    given = scribble_prompt(
        task.scribble, switches, height=height, width=width, seed=_seed_of(seed, task.name)
    )
    drawn = torch.zeros(2, height, width, dtype=torch.bool)
    columns, rows = given.points.long().unbind(dim=1)
    drawn[(~given.signs).long(), rows.clamp_max(height - 1), columns.clamp_max(width - 1)] = True
    return ViewPrompt(
        view=view, scribble=drawn[0], negative_scribble=drawn[1] if bool(drawn[1].any()) else None
    )


def scribble_prompt(
    scribble: Scribble, switches: TargetSwitches, *, height: int, width: int, seed: int
) -> Prompt:
    """Points on the skeletons of strokes, as SAGA samples them.

    A share of the skeleton's pixels, at least one of strokes on the thing, becomes points in the
    middle of the photograph's pixels that they stand for.

    Args:
        scribble: The strokes.
        switches: The shares.
        height: Rows of the photograph.
        width: Columns of it.
        seed: Of the sample.

    Raises:
        InputError: If there is no stroke on the thing.
    """
    on, off = scribble.read()
    generator = torch.Generator().manual_seed(seed)
    scale = torch.tensor([width / on.shape[1], height / on.shape[0]])
    positive = _sampled(on, switches.positive_share, generator, at_least=1)
    negative = _sampled(off, switches.negative_share, generator, at_least=0)
    if not len(positive):
        raise InputError(f"view {scribble.view}: expected a stroke on the thing, got none.")
    points = torch.cat((positive, negative)) * scale
    signs = torch.arange(len(points)) < len(positive)
    return Prompt(points=points, positive=signs)


def _sampled(
    strokes: Bool[Tensor, "height width"],
    share: float,
    generator: torch.Generator,
    *,
    at_least: int,
) -> Float[Tensor, "n 2"]:
    """Centres of a share of the pixels of a skeleton, x and y."""
    from skimage.morphology import skeletonize

    thin = torch.from_numpy(skeletonize(strokes.numpy()))
    pixels = torch.nonzero(thin).flip(1).float() + 0.5
    # Skeletons of single pixels are empty.
    if not len(pixels):
        pixels = torch.nonzero(strokes).flip(1).float() + 0.5
    noise = torch.rand(len(pixels), generator=generator)
    count = min(len(pixels), max(at_least, int((noise > 1 - share).sum())))
    return pixels[noise.argsort(descending=True, stable=True)[:count].sort().values]


def _seed_of(seed: int, task: str) -> int:
    """A seed for each task, whatever other tasks there are."""
    return int.from_bytes(hashlib.sha256(f"{seed}:{task}".encode()).digest()[:4], "little")
