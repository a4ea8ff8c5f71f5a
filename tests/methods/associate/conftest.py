"""Runs tests on each backend, see `support.backends`."""

from support.backends import each_backend as each_backend
from support.backends import pytest_generate_tests as pytest_generate_tests
