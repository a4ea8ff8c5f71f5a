"""Tests of `splatseg.lift`; a package so that they share the helpers of conftest."""
