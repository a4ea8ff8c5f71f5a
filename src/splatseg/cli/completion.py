"""``splatseg completion``: a script that completes commands, flags and methods in a shell."""

import re
import sys
from dataclasses import dataclass
from typing import Annotated, Literal

import tyro

from splatseg.cli import find_commands
from splatseg.cli._words import FOLDER

Shell = Literal["bash", "zsh", "fish"]

_FLAG = re.compile(r"(?<![\w-])--[a-z][a-z0-9.-]*")
_OPTION_LINE = re.compile(r"^ +-")


@dataclass(frozen=True, slots=True, kw_only=True)
class Command:
    """Print a script that completes commands, flags and methods in a shell.

    bash: source <(splatseg completion bash), in ~/.bashrc. zsh: the same, in ~/.zshrc, behind
    compinit. fish: splatseg completion fish | source, in config.fish.

    For example:

    splatseg completion bash > ~/.splatseg.bash

    splatseg completion zsh > ~/.splatseg.zsh

    splatseg completion fish > ~/.config/fish/completions/splatseg.fish
    """

    shell: Annotated[Shell, tyro.conf.Positional]
    """The shell."""


def run(command: Command) -> None:
    """Print the script."""
    write = {"bash": _bash, "zsh": _zsh, "fish": _fish}[command.shell]
    sys.stdout.write(write(flags_by_command()))


def flags_by_command() -> dict[str, tuple[str, ...]]:
    """The flags of each command, of all methods together, as its pages of help show them.

    Commands of other distributions have no page; they are completed by name.
    """
    found: dict[str, set[str]] = {}
    for path in sorted(FOLDER.glob("*.txt")):
        command = path.stem.partition("-")[0]
        flags = found.setdefault(command, set())
        for line in path.read_text(encoding="utf-8").splitlines():
            if _OPTION_LINE.match(line):
                flags.update(_FLAG.findall(line))
    for name in find_commands():
        found.setdefault(name, set())
    return {name: tuple(sorted(flags)) for name, flags in found.items()}


def _methods() -> tuple[str, ...]:
    return tuple(path.stem.removeprefix("segment-") for path in sorted(FOLDER.glob("segment-*")))


def _bash(flags: dict[str, tuple[str, ...]]) -> str:
    cases = "\n".join(
        f'    {name}) words="{" ".join(options)}" ;;' for name, options in flags.items()
    )
    return f"""_splatseg() {{
  local current=${{COMP_WORDS[COMP_CWORD]}} words=""
  if [ "$COMP_CWORD" -eq 1 ]; then
    COMPREPLY=($(compgen -W "{" ".join([*flags, "help"])}" -- "$current"))
    return
  fi
  if [ "${{COMP_WORDS[COMP_CWORD-1]}}" = --method ]; then
    COMPREPLY=($(compgen -W "{" ".join(_methods())}" -- "$current"))
    return
  fi
  case ${{COMP_WORDS[1]}} in
{cases}
    help) words="{" ".join(flags)}" ;;
  esac
  if [[ $current == -* || ${{COMP_WORDS[1]}} == help ]]; then
    COMPREPLY=($(compgen -W "$words" -- "$current"))
  fi
}}
complete -o default -F _splatseg splatseg
"""


def _zsh(flags: dict[str, tuple[str, ...]]) -> str:
    return f"autoload -U +X bashcompinit && bashcompinit\n{_bash(flags)}"


def _fish(flags: dict[str, tuple[str, ...]]) -> str:
    alone = "not __fish_seen_subcommand_from " + " ".join(flags)
    lines = [f"complete -c splatseg -n '{alone}' -f -a '{' '.join([*flags, 'help'])}'"]
    for name, options in flags.items():
        seen = f"__fish_seen_subcommand_from {name}"
        lines += [
            f"complete -c splatseg -n '{seen}' -l {option.removeprefix('--')}"
            for option in options
            if option != "--method"
        ]
    lines.append(
        "complete -c splatseg -n '__fish_seen_subcommand_from segment' -l method -x "
        f"-a '{' '.join(_methods())}'"
    )
    return "\n".join(lines) + "\n"
