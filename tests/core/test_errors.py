"""Messages are of a size to be read, whatever stands in them."""

import pickle
from pathlib import Path

import pytest

from splatseg.core.boundary import boundary
from splatseg.errors import InputError, MissingFileError, OutputError, SplatsegError


@pytest.mark.parametrize("kind", [SplatsegError, InputError, MissingFileError, OutputError])
def test_what_is_longer_than_a_name_is_cut(kind: type[SplatsegError]) -> None:
    name = "b" * 4000 + "c"
    error = kind(f"layer: there is no {name!r}, only 'things'.")
    assert str(error).startswith("layer: there is no 'bbbb")
    assert str(error).endswith("c', only 'things'.")
    assert len(str(error)) < 120
    assert str(pickle.loads(pickle.dumps(error))) == str(error)


def test_names_that_files_can_have_stay_whole() -> None:
    path = "/".join(["d" * 255] * 3)
    assert str(InputError(f"{path}: expected a scene.")) == f"{path}: expected a scene."


def test_the_ends_of_a_long_message_are_said() -> None:
    said = str(InputError("names: got " + "a b " * 2000 + "in all."))
    assert len(said) == 1000
    assert said.startswith("names: got a b")
    assert said.endswith("a b in all.")


def test_text_that_is_to_be_a_path_can_be_one() -> None:
    @boundary
    def opened(folder: Path | str) -> Path | str:
        return folder

    assert opened("a") == "a"
    with pytest.raises(InputError, match="folder: expected a path, got ''"):
        opened("")


def test_a_name_too_long_for_a_file_is_an_input_error(tmp_path) -> None:
    @boundary
    def opened(name: str) -> bytes:
        return (tmp_path / name).read_bytes()

    with pytest.raises(InputError, match="xxx: expected the name of a file, got one .* too long"):
        opened("x" * 5000)
    with pytest.raises(FileNotFoundError):
        opened("x")
