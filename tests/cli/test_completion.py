"""Completion as bash does it; the other shells' scripts name the same words."""

import shutil
import subprocess

import pytest

from splatseg.cli import COMMANDS, find_commands
from splatseg.cli.completion import flags_by_command


def completed(script: str, *words: str) -> set[str]:
    """What bash offers for the last of the words."""
    quoted = " ".join(f"'{word}'" for word in words)
    code = (
        f"{script}\nCOMP_WORDS=({quoted})\nCOMP_CWORD={len(words) - 1}\n_splatseg\n"
        'printf "%s\\n" "${COMPREPLY[@]}"'
    )
    done = subprocess.run(["bash", "-c", code], capture_output=True, text=True, check=True)
    return set(done.stdout.split())


@pytest.fixture
def script(splatseg) -> str:
    status, text, _ = splatseg("completion", "bash")
    assert status == 0
    return text


@pytest.mark.skipif(shutil.which("bash") is None, reason="needs bash")
def test_bash(script) -> None:
    assert completed(script, "splatseg", "") == {*find_commands(), "help"}
    assert completed(script, "splatseg", "se") == {"see", "segment", "select"}
    assert {"--method", "--evidence"} <= completed(script, "splatseg", "segment", "--")
    assert completed(script, "splatseg", "segment", "S", "--evi") == {"--evidence"}
    assert completed(script, "splatseg", "segment", "--method", "vo") == {"vote", "voxels"}
    assert completed(script, "splatseg", "help", "ren") == {"render"}
    assert completed(script, "splatseg", "fit", "--max-g") == {"--max-gaussians"}


def test_every_command_and_its_flags_are_known(splatseg) -> None:
    flags = flags_by_command()
    assert set(flags) == set(find_commands())
    assert "--occlusion" in flags["segment"], "flags of methods too"
    for shell in ("zsh", "fish"):
        text = splatseg("completion", shell)[1]
        assert all(name in text for name in COMMANDS)
        assert "max-gaussians" in text
        assert "associate" in text


def test_an_unknown_shell_is_refused(splatseg) -> None:
    status, _, error = splatseg("completion", "tcsh")
    assert status == 2
    assert "bash" in error
