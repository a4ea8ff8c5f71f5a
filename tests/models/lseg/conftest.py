"""The folder of a tiny LSeg."""

from pathlib import Path

import pytest

from support.checkpoints import saved

pytest.importorskip("transformers")


@pytest.fixture(scope="session")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """demo_e200.ckpt in the published layout, and a vocabulary."""
    return saved("lseg", tmp_path_factory.mktemp("lseg"))


@pytest.fixture(autouse=True)
def offline(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The hub is not asked, and its cache is empty."""
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path / "hub"))
