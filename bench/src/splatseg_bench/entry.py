"""What this distribution adds to the command line of splatseg; imports nothing heavy."""

from splatseg.cli import CommandEntry

BENCH = CommandEntry(
    module="splatseg_bench.command",
    summary="methods under a published protocol, with the published figures beside",
)
