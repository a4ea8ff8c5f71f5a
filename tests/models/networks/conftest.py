"""Tiny checkpoints, and no network."""

from collections.abc import Callable
from pathlib import Path

import pytest

from support.checkpoints import saved

pytest.importorskip("transformers")


@pytest.fixture(scope="session")
def checkpoints(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """The folder of a tiny checkpoint, by kind."""
    folder = tmp_path_factory.mktemp("checkpoints")
    return lambda kind: saved(kind, folder)


@pytest.fixture(autouse=True)
def offline(monkeypatch: pytest.MonkeyPatch) -> None:
    """The hub is not asked, whatever the machine's network is."""
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
