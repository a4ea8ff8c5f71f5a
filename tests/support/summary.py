"""pytest's summary, where pytest itself fails."""

import pytest


class SummaryAfterInternalError:
    """Prints what failed, and which tests were running, after an internal error.

    An internal error, pytest's own or that of a worker of pytest-xdist, ends the run, and pytest
    prints its traceback instead of a summary: without this, nobody learns which tests failed
    before, nor which one brought it down.
    """

    def __init__(self) -> None:
        self._running: dict[str, None] = {}

    def pytest_runtest_logstart(self, nodeid: str) -> None:
        self._running[nodeid] = None

    def pytest_runtest_logfinish(self, nodeid: str) -> None:
        self._running.pop(nodeid, None)

    @pytest.hookimpl(trylast=True)
    def pytest_sessionfinish(self, session: pytest.Session, exitstatus: int) -> None:
        config = session.config
        reporter = config.pluginmanager.get_plugin("terminalreporter")
        if exitstatus != pytest.ExitCode.INTERNAL_ERROR or reporter is None:  # None in workers
            return
        config.hook.pytest_terminal_summary(
            terminalreporter=reporter, exitstatus=exitstatus, config=config
        )
        reporter.write_sep("=", "internal error: the run is not complete", red=True, bold=True)
        for nodeid in self._running:
            reporter.write_line(f"was running: {nodeid}")
        reporter.summary_stats()
