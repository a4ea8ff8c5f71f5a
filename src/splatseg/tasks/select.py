"""Prompts become a selection."""

from collections.abc import Mapping, Sequence

from splatseg.core import Layer, PromptableMasks, Scene, Selection
from splatseg.core.boundary import boundary
from splatseg.prompting.pipeline import MembershipSource
from splatseg.prompting.prompts import SelectionPrompt
from splatseg.render import BackendName
from splatseg.tasks._observer import SILENT, Observer
from splatseg.tasks.select_options import SelectOptions
from splatseg.tasks.select_session import Selected, SelectionSession


@boundary
def open_selector(
    scene: Scene,
    *,
    options: SelectOptions | None = None,
    source: MembershipSource | None = None,
    prompter: PromptableMasks | None = None,
    layers: Mapping[str, Layer] | None = None,
    backend: BackendName = "auto",
    observer: Observer = SILENT,
) -> SelectionSession:
    """A session that selects again and again in a scene, each time in milliseconds.

    Args:
        scene: The scene; it must stay as it is.
        options: What holds for selections that say nothing else.
        source: Says which Gaussians belong together; None opens what `options` ask for.
        prompter: Turns points and boxes into masks of their views, such as SAM; None leaves them.
        layers: Layers at hand; others are read from the scene's folder.
        backend: Who renders.
        observer: Is told of what is opened.

    Raises:
        InputError: If the scene has nothing to select by, or not what the options ask for.
    """
    session = SelectionSession(
        scene,
        options=options,
        source=source,
        prompter=prompter,
        layers=layers,
        backend=backend,
        observer=observer,
    )
    session.source  # noqa: B018  (opens it: whatever takes long is done before the first click)
    return session


@boundary
def select(
    scene: Scene,
    prompts: SelectionPrompt | Sequence[SelectionPrompt],
    *,
    options: SelectOptions | None = None,
    source: MembershipSource | None = None,
    prompter: PromptableMasks | None = None,
    base: Selection | None = None,
    layers: Mapping[str, Layer] | None = None,
    backend: BackendName = "auto",
    observer: Observer = SILENT,
) -> Selected:
    """The Gaussians that prompts mean.

    Prompts in views, and `Similar` ones, are answered by a source: masks, features, or a layer of
    the scene. `AxisBox`, `Ball` and `Lasso` bound the answer: of several, all hold. Alone, they
    select all that is inside.

    What the command ``splatseg select`` does. `open_selector` is for more than one selection.

    Args:
        scene: The scene; it stays as it is.
        prompts: One prompt, or several that mean one thing together.
        options: The source, the granularity, and what follows.
        source: Says which Gaussians belong together; None opens what `options` ask for.
        prompter: Turns points and boxes into masks of their views, such as SAM; None leaves them.
        base: A selection that `SelectOptions.mode` adds to, subtracts from or intersects with.
        layers: Layers at hand; others are read from the scene's folder.
        backend: Who renders.
        observer: Is told of what is opened.

    Returns:
        The selection with its confidence, and where the next click would help most.

    Raises:
        InputError: If there is nothing to select by, a prompt shows nothing, or prompts
            contradict each other.
        ShapeError: If the base or a layer is of another scene.
    """
    with SelectionSession(
        scene,
        options=options,
        source=source,
        prompter=prompter,
        layers=layers,
        backend=backend,
        observer=observer,
    ) as session:
        return session.select(prompts, base=base)
