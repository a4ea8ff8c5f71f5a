"""Prompts of a protocol answered by `select`, from the layer that a method made."""

from typing import Self

from splatseg.core import Features, InstanceTree, Labels, Layer, Selection
from splatseg.errors import InputError
from splatseg.evaluate.protocols import TargetSwitches
from splatseg.lift import GaussianField
from splatseg.lift.affinity import KIND
from splatseg.prompting.prompts import ViewPrompt
from splatseg.tasks.benchmark.job import Job
from splatseg.tasks.select import SelectionSession, open_selector
from splatseg.tasks.sources import SelectOptions

_LAYER = "layer"


class LayerSelector:
    """Selects by one layer, again and again; a context that releases what it holds.

    Args:
        job: The method, the scene, and the protocol, which says the granularity.
    """

    def __init__(self, job: Job) -> None:
        self._job = job
        self._session: SelectionSession | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._session is not None:
            self._session.close()
            self._session = None

    def select(self, layer: Layer, prompt: ViewPrompt) -> Selection:
        """The Gaussians that a prompt means.

        Args:
            layer: The method's layer, the same in each call.
            prompt: What the protocol gives.

        Raises:
            InputError: If the prompt shows nothing that the layer knows.
        """
        if self._session is None:
            self._session = self._opened(layer)
        return self._session.select(prompt, advise=False).selection

    def _opened(self, layer: Layer) -> SelectionSession:
        switches = self._job.protocol.switches
        if not isinstance(switches, TargetSwitches):
            raise InputError("protocol: expected one of things asked for, got one of maps.")
        affinity = isinstance(layer, Features) and is_affinity(layer)
        if not affinity and not isinstance(layer, Labels | InstanceTree):
            # The labels that features with a classifier give to Gaussians.
            field = GaussianField(self._job.scene.gaussians, {_LAYER: layer})
            layer = field.labels(_LAYER)
        options = SelectOptions(
            source="features" if affinity else "layer",
            from_layer=_LAYER,
            granularity=switches.granularity,
            seed=self._job.options.seed,
        )
        return open_selector(
            self._job.scene,
            options=options,
            layers={_LAYER: layer},
            backend=self._job.backend,
            observer=self._job.observer,
        )


def is_affinity(layer: Features) -> bool:
    """Whether features were trained to be compared with each other (`lift.affinity`)."""
    return (layer.info.head or {}).get("kind") == KIND
