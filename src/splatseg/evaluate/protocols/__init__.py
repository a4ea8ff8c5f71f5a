"""Protocols of published benchmarks as data: what is asked, every choice, the published figures."""

from splatseg.evaluate.protocols.published import published_figures as published_figures
